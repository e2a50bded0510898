"""Places the samples of a ray, and the part of the ray that each of them represents.

A march is a step length d and a tuple of transforms. Without transforms it is Levoy's ray casting: samples at
depths 0, d, 2d, … from the entry to the exit, each of which stands for the cell of width d that begins there;
the last may reach past the exit. A transform is one idea of one paper: it overrides one or two methods of
`Transform`, the seams. At each seam the answers of all transforms are combined, so that they compose.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Literal, NamedTuple, SupportsIndex, TypeAlias, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._util.checks import Arrayable, check_answer, described, integer, number
from .._util.noise import hashed_uniforms_4, seed_word
from .._util.texts import pasted
from .._util.vec3 import Scalar
from ..scene.occupancy import BLOCK, Occupancy
from ..scene.space import Affine, Ray, Space
from ..scene.volume import Volume
from .beams import EmptySpaceIndex, View


Quadrature: TypeAlias = Literal["left", "midpoint", "preintegrated"]


class Cell(eqx.Module):
    """Part of a ray that one sample represents, a cell or a piece of one. `cut`: whether the volume's exit
    shortened it."""

    front: Scalar
    width: Scalar
    cut: Bool[Array, ""]


class DivisionTest(NamedTuple):
    """A test, at little cost, whether `CellRules.divide` may cut a cell, by `Fetch.changes`.

    Attributes:
        parts: number of parts of a cell to be tested. More parts are tested, too, if others need them.
        part: tests a part, (cell, ray, volume, number of the part, number of parts).
    """

    parts: Callable[[Cell, Ray], Int[Array, ""]]
    part: Callable[[Cell, Ray, Volume, Int[Array, ""], Int[Array, ""]], Bool[Array, ""]]


class Transform(eqx.Module):
    """One change to a march. The defaults of the seams change nothing. Where a ray is given, it is one."""

    def locate(self, space: Space, volume: Volume) -> Space:
        """The space in which rays meet the volume, in place of `space`."""
        return space

    def clip(self, space: Space) -> Space:
        """The same space without a part of it: rays are shorter, or have more gaps. Called after `locate`."""
        return space

    def start(self, steps: Scalar, ray: Ray) -> Scalar:
        """Steps from the entry to the front of the first cell, at least -1, and below 0 only if `cut` removes
        what lies before the entry. `steps`: the answer of the transforms before."""
        return steps

    def shift(self, ray: Ray) -> Scalar:
        """Steps by which all samples behind the ray's first cell of opacity 0 move, in [-1, 0]. The answers
        of all transforms are summed and clipped. Otherwise rays advance by whole steps."""
        return jnp.zeros_like(ray.length)

    def empty_space(self, occupancy: Occupancy, view: View | None) -> EmptySpaceIndex | None:
        """Index of empty space, made once for an image; None: unknown. `view`: None for `render_rays`."""
        return None

    def depth(self, distance: Scalar, ray: Ray) -> Scalar:
        """Depth under steps that grow of a point whose depth under equal steps is `distance`, both world
        lengths past the entry. It increases with the distance, is 0 at 0, and from there on at least the
        distance: `March.step` is the shortest step. Defined from one step before the entry on."""
        return distance

    def distance(self, depth: Scalar, ray: Ray) -> Scalar:
        """Inverse of `depth` between entry and exit, without gradient. Overridden with `depth`."""
        return depth

    @property
    def block_side(self) -> int:
        """Cells of the voxel grid along the side of the blocks of `empty_space`'s occupancy."""
        return BLOCK

    def cut(self, cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
        """The pieces, front to back, into which the cell is divided and each of which is sampled: a static
        number, of which some may have width 0."""
        return (cell,)

    @property
    def valid(self) -> Bool[Array, ""] | bool:
        """True where its parameters, which may be traced, are such as its constructor accepts; else the image
        is NaN. (All parameters are checked to be finite besides.)"""
        return True

    joins: ClassVar[bool] = False
    """Whether pieces touch: each that `cut` returns begins where the one before it ends, also across two
    cells, except past the exit. Pieces that are integrated then share the value where they meet."""

    ends_at_exit: ClassVar[bool] = False
    """Whether `cut` shortens what reaches past the exit."""

    def stop(self, stopped: Bool[Array, ""], transmittance: Scalar) -> Bool[Array, ""]:
        """Decide whether the ray is finished. `stopped`: the answer of the transforms before.
        `transmittance`: as for `roulette`, after its factor."""
        return stopped

    def roulette(self, transmittance: Scalar, random: Scalar) -> Scalar:
        """Factor by which the weights of all later cells are multiplied, at least 0; 0 ends the ray. Called
        after each cell that is not transparent, for a `Weighting`.

        With a mean of 1 over `random`, as of 1 / p with probability p and else 0, colour and opacity are
        unbiased. Factors are constants to derivatives, which are therefore unbiased, too: those of the mean
        over all random numbers, not of the image by these. By parameters of the factor they are 0.

        Args:
            transmittance: of the cells so far, times all factors so far.
            random: number in [0, 1), independent for each pixel, cell, transform and `seed`.
        """
        return jnp.ones_like(transmittance)

    seed: ClassVar[Any] = 0
    """Seed of `roulette`: an integer in [0, 2³²), or a key of `jax.random`. May be a field."""

    def rules(self, rules: "CellRules") -> "CellRules | None":
        """The rules with what the `KERNEL_SEAMS` do as numbers, so that marches with and without this
        transform share a program. None, the default where it overrides any: unknown."""
        return None if any(overriding((self,), seam) for seam in KERNEL_SEAMS) else rules

    @property
    def leaves_gaps(self) -> bool:
        """True if rays may leave the volume and come back, by its `locate` or `clip`."""
        seams = "locate", "clip"
        return any(getattr(type(self), seam) is not getattr(Transform, seam) for seam in seams)

    @property
    def reads_labels(self) -> bool:
        """True if `cut` reads the volume's labels."""
        return False

    @property
    def tested_every(self) -> int | None:
        """After how many samples rays that are finished are looked for, and left out; None: any number."""
        return None


KERNEL_SEAMS = "cut", "stop", "depth", "roulette"
"""Seams that are called for each cell."""


def overriding(transforms: tuple[Transform, ...], seam: str) -> list[Transform]:
    """The transforms that override a seam."""
    default = getattr(Transform, seam)
    return [transform for transform in transforms if getattr(type(transform), seam) is not default]


class _Cells(eqx.Module):
    """Answers of all transforms that place and weight cells, for a march and its `CellRules`."""

    @abstractmethod
    def overriding(self, seam: str) -> list[Transform]:
        """The transforms that override a seam."""

    @property
    def grows(self) -> bool:
        """True if steps grow."""
        return bool(self.overriding("depth"))

    @property
    def reweights(self) -> bool:
        """True if cells have factors by `roulette`."""
        return bool(self.overriding("roulette"))

    def depth(self, distance: Scalar, ray: Ray) -> Scalar:
        for transform in self.overriding("depth"):
            distance = _checked(transform, "depth", transform.depth(distance, ray), distance)
        return distance

    def distance(self, depth: Scalar, ray: Ray) -> Scalar:
        for transform in reversed(self.overriding("depth")):
            depth = _checked(transform, "distance", transform.distance(depth, ray), depth)
        return depth

    def roulette(self, transmittance: Scalar, ray: Ray, index: Int[Array, ""]) -> Scalar:
        """Factor of all cells behind the one with this index."""
        column, row, cell = (word.astype(jnp.uint32) for word in (*ray.pixel, index))
        factor = jnp.ones_like(transmittance)
        for i, transform in enumerate(self.overriding("roulette")):
            # far apart, so that successive seeds of two transforms give independent numbers
            seed = seed_word(transform.seed) + np.uint32(i * 0x9E3779B9 % 2**32)
            random = hashed_uniforms_4(column, row, cell, seed)[0].astype(factor.dtype)
            answer = transform.roulette(transmittance * factor, random)
            factor = factor * _checked(transform, "roulette", answer, factor)
        return jax.lax.stop_gradient(factor)


class CellRules(_Cells):
    """Rules by which the kernel of a march cuts rays into cells, and ends them. The library's transforms are
    numbers here, so that all subsets of them, and both quadratures that sample, share a program.

    Attributes:
        step: distance between samples, world length.
        place: where in its cell a sample lies, from 0, its front, to 1.
        at_entry: whether cells are cut at the entry.
        at_exit: whether cells are cut at the exit.
        opacity_left: transmittance at or below which rays end; negative: never.
        most_samples: of a ray.
        divide: cuts a cell at what lies within; None if nothing does.
        may_divide: tests whether `divide` may cut a cell; None: unknown.
        custom: transforms that override `KERNEL_SEAMS` and are no numbers. If there are any, all are here,
            and only `step`, `place` and `most_samples` count beside them.
    """

    step: Float[Array, ""]
    place: Float[Array, ""] | np.ndarray
    at_exit: Bool[Array, ""] | np.ndarray
    opacity_left: Float[Array, ""] | np.ndarray
    most_samples: Int[Array, ""] | np.ndarray
    integrates: bool = eqx.field(static=True)
    at_entry: bool = eqx.field(static=True, default=False)
    divide: Callable[[Cell, Ray, Volume], tuple[Cell, ...]] | None = eqx.field(static=True, default=None)
    may_divide: DivisionTest | None = eqx.field(static=True, default=None)
    custom: tuple[Transform, ...] = ()

    def overriding(self, seam: str) -> list[Transform]:
        return overriding(self.custom, seam)

    @property
    def joins(self) -> bool:
        """True if pieces touch: see `Transform`."""
        return all(transform.joins for transform in self.custom)

    def cut(self, cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
        """The pieces of a cell."""
        if self.custom:
            return cut_by(self.custom, cell, ray, volume)
        cell = cut_at_exit(cut_at_entry(cell) if self.at_entry else cell, ray, self.at_exit)
        return (cell,) if self.divide is None else self.divide(cell, ray, volume)

    def stop(self, transmittance: Scalar) -> Bool[Array, ""]:
        """Decide whether a ray of this transmittance ends before its exit."""
        return stop_by(self.custom, transmittance) if self.custom else transmittance <= self.opacity_left

    def sample(self, cell: Cell) -> Scalar:
        """Depth at which a cell is sampled; of one that is integrated, its middle."""
        return cell.front + cell.width * self.place

    def ends(self, cell: Cell, ray: Ray) -> tuple[Scalar, Scalar]:
        """Depths of a cell's front and back, neither before the entry nor past the exit."""
        return within(ray, cell.front), within(ray, cell.front + cell.width)

    @property
    def moving(self) -> "CellRules":
        """The rules with None in place of all that has no gradient."""
        return eqx.filter(self, self._moves)

    @property
    def constant(self) -> "CellRules":
        """The rules with None in place of all that has a gradient."""
        return eqx.filter(self, self._moves, inverse=True)

    @property
    def _moves(self) -> Any:
        none = jax.tree.map(lambda _: False, self)
        floats = jax.tree.map(eqx.is_inexact_array, self.custom)
        return eqx.tree_at(lambda rules: (rules.step, rules.custom), none, (True, floats))


class March(_Cells):
    """Steps of rays through a volume. Its methods combine the answers of all transforms at a seam.

    Args:
        step: distance d between samples, world length, > 0.
        transforms: applied in this order at every seam; none may be given twice.
        quadrature: how a cell's colour and extinction follow from the values along it.
            `"left"`: those at its front, as in the papers; the error falls with d.
            `"midpoint"`: those in its middle; the error falls with d².
            `"preintegrated"`: as if the value were linear from its front to its back, the mean extinction,
            and the mean of extinction × colour, divided by it. The error falls with d², too, and narrow
            peaks of the transfer function are not missed; where there are none, `"midpoint"` may be more
            accurate, in half to two thirds of the time. What a cell's front hides of its back is neglected:
            for an opacity α and optical depth τ, at most α τ / 8 times the difference of its colours.
            Extinction times the range of values must stay below 3e38 in float32. A cell has the label and
            the light of its middle.
        max_samples: the last cell of a ray begins less than so many steps after its first; an integer from
            1 to 2²⁴, by default 131 072. Rays that need more are marked in `Rendering.exhausted`.

    What is thinner than a step is missed by a part of the rays. Where a march fails:
    `experiments/stability.py`, "sheets thinner than a step", "rays of very many samples",
    "rays that run out of samples".

    Raises:
        ValueError: for a step that is not a positive number, for something that is no transform, for a
            transform given twice, and for another `quadrature` or `max_samples`.
    """

    step: Float[Array, ""]
    transforms: tuple[Transform, ...]
    quadrature: Quadrature = eqx.field(static=True)
    max_samples: int | None = eqx.field(static=True)

    def __init__(
        self,
        step: Arrayable,
        transforms: tuple[Transform, ...] | list[Transform] = (),
        quadrature: Quadrature = "left",
        *,
        max_samples: SupportsIndex | None = None,
    ):
        self.step = number("step", step, above=0)
        if not isinstance(transforms, tuple | list):
            raise ValueError(f"transforms must be a tuple (AlphaCorrection(),); got {described(transforms)}.")
        self.transforms = tuple(transforms)
        kinds = list(map(type, transforms))
        for transform in transforms:
            if not isinstance(transform, Transform):
                raise ValueError(f"transforms must hold jaxvol transforms; got {described(transform)}.")
            if (count := kinds.count(type(transform))) > 1:
                name = type(transform).__name__
                raise ValueError(f"transforms must each be given once; got {name} {count} times.")
            if bool(overriding((transform,), "depth")) != bool(overriding((transform,), "distance")):
                name = type(transform).__name__
                raise ValueError(f"transforms: {name} must override both depth and its inverse, distance.")
        if quadrature not in get_args(Quadrature):
            names = " or ".join(f'"{name}"' for name in get_args(Quadrature))
            raise ValueError(f"quadrature must be {names}; got {quadrature!r}.")
        self.quadrature = quadrature
        self.max_samples = None if max_samples is None else integer("max_samples", max_samples, 1, 2**24)

    def __repr__(self) -> str:
        limit = "" if self.max_samples is None else f", max_samples={self.max_samples}"
        return (
            f"March(step={pasted(self.step)}, transforms={self.transforms}, "
            f"quadrature={self.quadrature!r}{limit})"
        )

    @property
    def most_samples(self) -> int:
        """`max_samples`, or its default."""
        return 2**17 if self.max_samples is None else self.max_samples

    def empty_space(self, occupancy: Occupancy, view: View | None) -> EmptySpaceIndex | None:
        """The index of the first transform that has one."""
        for transform in self.overriding("empty_space"):
            index = transform.empty_space(occupancy, view)
            _check_kind(transform, "empty_space", index, EmptySpaceIndex | None)
            if index is not None:
                return index
        return None

    def overriding(self, seam: str) -> list[Transform]:
        return overriding(self.transforms, seam)

    @property
    def leaps(self) -> bool:
        return bool(self.overriding("empty_space"))

    @property
    def block_side(self) -> int:
        """The smallest side that a transform asks for."""
        return min((transform.block_side for transform in self.transforms), default=BLOCK)

    @property
    def tested_every(self) -> int | None:
        """The smallest number of samples that a transform asks for."""
        numbers = [t.tested_every for t in self.transforms if t.tested_every is not None]
        return min(numbers, default=None)

    @property
    def may_shift(self) -> bool:
        return bool(self.overriding("shift"))

    def locate(self, volume: Volume) -> Space:
        space: Space = Affine(volume)
        for transform in self.transforms:
            space = transform.locate(space, volume)
            _check_kind(transform, "locate", space, Space)
        for transform in self.transforms:
            space = transform.clip(space)
            _check_kind(transform, "clip", space, Space)
        return space

    def start(self, ray: Ray) -> Scalar:
        steps = jnp.zeros_like(ray.length)
        for transform in self.transforms:
            steps = _checked(transform, "start", transform.start(steps, ray), steps)
        return steps

    def shift(self, ray: Ray) -> Scalar:
        shift = jnp.zeros_like(ray.length)
        for transform in self.transforms:
            shift = shift + _checked(transform, "shift", transform.shift(ray), shift)
        # so that the next sample begins within the cell that was found transparent, or at its end
        return jnp.clip(shift, -1, 0)

    def cut(self, cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
        return cut_by(self.transforms, cell, ray, volume)

    def stop(self, transmittance: Scalar) -> Bool[Array, ""]:
        """Decide whether a ray of this transmittance ends before its exit."""
        return stop_by(self.transforms, transmittance)

    @property
    def rules(self) -> CellRules:
        """Rules by which the kernel cuts and ends rays."""
        dtype = self.step.dtype
        middle = 0.0 if self.quadrature == "left" else 0.5
        place, never = np.asarray(middle, dtype), np.asarray(-1, dtype)
        limit = np.asarray(self.most_samples, np.int32)
        plain = rules = CellRules(self.step, place, np.asarray(False), never, limit, self.integrates)
        for transform in self.transforms:
            answer = transform.rules(rules)
            if answer is None:
                return replace(plain, custom=self.transforms)
            rules = answer
        divided = self.reads_labels or any(transform.leaves_gaps for transform in self.transforms)
        return rules if divided else replace(rules, divide=None)

    @property
    def reads_labels(self) -> bool:
        """True if cells are cut at the faces of labels."""
        return any(transform.reads_labels for transform in self.transforms)

    @property
    def integrates(self) -> bool:
        """True if cells are integrated between their ends, rather than sampled."""
        return self.quadrature == "preintegrated"

    @property
    def joins(self) -> bool:
        return all(transform.joins for transform in self.overriding("cut"))

    @property
    def ends_at_exit(self) -> bool:
        return any(transform.ends_at_exit for transform in self.transforms)

    def sample(self, cell: Cell) -> Scalar:
        """Depth at which a cell is sampled; of one that is integrated, its middle."""
        return cell.front if self.quadrature == "left" else cell.front + cell.width / 2

    def ends(self, cell: Cell, ray: Ray) -> tuple[Scalar, Scalar]:
        """Depths of a cell's front and back, neither before the entry nor past the exit."""
        return within(ray, cell.front), within(ray, cell.front + cell.width)


def cut_by(transforms: tuple[Transform, ...], cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
    """The pieces into which transforms divide a cell, one after the other."""
    pieces = (cell,)
    for transform in transforms:
        divided = [transform.cut(piece, ray, volume) for piece in pieces]
        for cells in divided:
            _check_kind(transform, "cut", cells, tuple)
            if not cells:
                raise ValueError(f"{type(transform).__name__}.cut must return at least one Cell; got ().")
            for piece in cells:
                _check_kind(transform, "cut", piece, Cell)
        pieces = tuple(piece for cells in divided for piece in cells)
    return pieces


def stop_by(transforms: tuple[Transform, ...], transmittance: Scalar) -> Bool[Array, ""]:
    """Decide whether transforms end a ray of this transmittance."""
    stopped = jnp.zeros(jnp.shape(transmittance), bool)
    for transform in transforms:
        stopped = _checked(transform, "stop", transform.stop(stopped, transmittance), stopped)
    return stopped


def cut_at_entry(cell: Cell) -> Cell:
    """The cell without its part before the entry; one that ends there has width 0."""
    # not jnp.maximum: inside loops on CPU, XLA loses its derivative (jaxlib 0.10)
    front = jnp.where(cell.front > 0, cell.front, 0)
    width = cell.width - (front - cell.front)
    return Cell(front, jnp.where(width > 0, width, 0), cell.cut)


def cut_at_exit(cell: Cell, ray: Ray, cuts: Bool[Array, ""] | np.ndarray | bool = True) -> Cell:
    """The cell without its part past the ray's exit, if `cuts`."""
    until_exit = jnp.where(cuts, ray.length, jnp.inf) - cell.front
    # Not by jnp.minimum: inside loops on CPU, XLA loses its derivative (jaxlib 0.10). A cell that ends just
    # at the exit counts as cut there: its width, and the gradient of that, then depend on the exit.
    width = jnp.where(until_exit <= cell.width, until_exit, cell.width)
    return Cell(cell.front, jnp.where(width > 0, width, 0), cell.cut | (until_exit < cell.width))


def within(ray: Ray, depth: Scalar) -> Scalar:
    """The depth, clamped to the part of the ray from entry to exit."""
    # not by minima and maxima: inside loops on CPU, XLA loses their derivatives (jaxlib 0.10)
    depth = jnp.where(depth > 0, depth, 0)
    return jnp.where(depth < ray.length, depth, ray.length)


def _checked(transform: Transform, seam: str, answer: Any, expected: Array) -> Array:
    check_answer(transform, seam, answer, expected)
    return answer


def _check_kind(transform: Transform, seam: str, answer: Any, kind: Any) -> None:
    if not isinstance(answer, kind):
        name, wanted = f"{type(transform).__name__}.{seam}", getattr(kind, "__name__", kind)
        raise ValueError(f"{name} must return a {wanted}; got {described(answer)}.")
