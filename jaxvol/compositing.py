"""How do the cells of a ray become a pixel?

There are two kinds of compositing modes. A `Weighting` gives each cell a weight; the pixel is the sum of the
cells' colours times their weights, and of the weights themselves, which is its opacity. A `Selection`
compares the samples of a ray and chooses one depth, at which the pixel is then computed.
"""

from abc import abstractmethod
from typing import Any, Generic, Literal, NamedTuple, TypeAlias, TypeVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._util.checks import described
from ._util.vec3 import Scalar, Vec3, along
from .lighting.shading import Sample
from .occupancy import Blocks
from .space import Ray
from .transfer import Classification, Measured, Transfer
from .variation import Variation, Windows


State = TypeVar("State")

Outputs: TypeAlias = Literal["all", "depth", "rgba"]
"""What is computed beside the image and `Rendering.exhausted`: everything, the depth, or nothing."""


class Fragment(NamedTuple):
    """A sample, as compositing sees it.

    - `alpha`: opacity of its cell; 0 past the ray's end.
    - `depth`: past the ray's entry. `value`: of the volume.
    - `color`: as shaded; None for a selection, or where nobody asks for it.
    - `valid`: False for what is no sample: past the ray's end, in a gap of the volume, or of width 0.
    """

    alpha: Scalar
    depth: Scalar
    value: Scalar
    color: Vec3 | None
    valid: Bool[Array, ""]


class Compositing(eqx.Module, Generic[State]):
    """A compositing mode: a `Weighting` or a `Selection`. All methods see one ray; engines batch them.

    `State`: a tree of arrays, what a mode knows of the fragments so far.
    """

    @abstractmethod
    def begin(self, zero: Scalar, outputs: Outputs | None) -> State:
        """The state before the first fragment. `zero`: of the shape and type of a ray's numbers. `outputs`:
        what is computed; None for the opacity alone."""

    @abstractmethod
    def add(self, state: State, fragment: Fragment) -> State:
        """The state with one more fragment, the next one from the front."""

    @abstractmethod
    def end(self, state: State) -> tuple[Float[Array, "4"], Scalar | None]:
        """Premultiplied colour and opacity; and the depth past the entry, if it is computed: infinite where
        nothing is visible."""

    @abstractmethod
    def transmittance(self, state: State) -> Scalar:
        """Of all cells so far: `Transform.stop` decides by it, and it is what shading is told."""

    def finished(self, state: State) -> Bool[Array, ""]:
        """Whether what follows cannot change the pixel, so that the ray is finished."""
        return jnp.zeros(jnp.shape(self.transmittance(state)), bool)

    def occupied(self, transfer: Transfer, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """Which blocks of a volume may change a pixel, from the ranges of their values. Rays leap
        over the others, except those that hold NaN."""
        return transfer.visible(blocks)

    def variation(self, transfer: Transfer, windows: Windows) -> Variation:
        """How much what cells are composited from changes within the range of each window. By default nothing
        is known, and cells are one step long."""
        return Variation.unknown(windows)


class Composite(eqx.Module):
    """The cells of a ray so far: Σ w, Σ w × colour and Σ w × depth past the entry, where w are the cells'
    weights. What is not asked for is None."""

    opacity: Scalar
    color: Vec3 | None = None
    moment: Scalar | None = None

    def add(self, weight: Scalar, color: Vec3 | None = None, depth: Scalar | None = None) -> "Composite":
        """With one more cell; its colour and depth are left out where they are not given."""
        sums = moment = None
        if self.color is not None and color is not None:
            r, g, b = (sum_ + weight * part for sum_, part in zip(self.color, color, strict=True))
            sums = r, g, b
        if self.moment is not None and depth is not None:
            moment = self.moment + weight * depth
        return Composite(self.opacity + weight, sums, moment)

    def rgba(self) -> Float[Array, "4"]:
        """Premultiplied colour, and opacity."""
        assert self.color is not None
        return jnp.stack([*self.color, self.opacity])

    def mean_depth(self) -> Scalar:
        """Mean depth past the entry of what is visible, weighted by what each cell adds to the opacity;
        infinite where nothing is visible."""
        assert self.moment is not None
        # not `> 0`, which is false for NaN: NaN is to be passed on
        visible = ~(self.opacity <= 0)
        # Both are divided by the opacity first, so that the quotient's denominator is 1: its derivative
        # divides by the square of that, which underflows to 0 in float32 where the opacity is very small.
        whole = jax.lax.stop_gradient(jnp.where(visible, self.opacity, 1))
        mean = (self.moment / whole) / jnp.where(visible, self.opacity / whole, 1)
        return jnp.where(visible, mean, jnp.inf)


class Weighting(Compositing[Composite]):
    """A mode that gives each cell a weight. The pixel is Σ w c, its opacity Σ w. Subclasses override
    `weight`, `slope` and `transmittance` alone.

    Weights depend on the cells' opacities alone, are at least 0, and sum to at most 1. A cell here is a piece
    of one where transforms divide cells. `weight`, `slope` and `transmittance` work elementwise, on the
    numbers of one ray or of many. Parameters are static fields: they have no gradient.
    """

    @abstractmethod
    def weight(self, alpha: Scalar, before: Scalar) -> Scalar:
        """Weight of the next cell, of opacity `alpha`, where the weights of the cells in front sum to
        `before`. It is 0 where `alpha` is, since engines leave such cells out."""

    @abstractmethod
    def slope(self, alpha: Scalar, after: Scalar, worth: Scalar, behind: Scalar) -> Scalar:
        """Derivative of a loss by the optical depth τ of a cell, for the second march. What it is given
        suffices for weights that do not depend on `before`, and for (c - `before`) f(`alpha`).

        **Arguments:**

        - `alpha`: opacity of the cell, 1 - exp(-τ), so that its own derivative is 1 - `alpha`.
        - `after`: sum of the weights up to and including this cell's.
        - `worth`: derivative of the loss by the cell's weight.
        - `behind`: sum over all cells behind this one of weight × worth.
        """

    def transmittance(self, state: Composite) -> Scalar:
        """By default 1: what is in front hides nothing."""
        return jnp.ones_like(state.opacity)

    @final
    def begin(self, zero: Scalar, outputs: Outputs | None) -> Composite:
        moment = zero if outputs in ("all", "depth") else None
        return Composite(zero, None if outputs is None else (zero, zero, zero), moment)

    @final
    def add(self, state: Composite, fragment: Fragment) -> Composite:
        return state.add(self.weight(fragment.alpha, state.opacity), fragment.color, fragment.depth)

    @final
    def end(self, state: Composite) -> tuple[Float[Array, "4"], Scalar | None]:
        return state.rgba(), None if state.moment is None else state.mean_depth()


class Over(Weighting):
    """The operator "over": emission and absorption, front to back.

    A cell of opacity α and colour c, behind opacity A, has the weight w:

        w = (1 - A) α        C ← C + w c        A ← A + w

    so that the weights of a ray and the remaining transmittance 1 - A sum to 1. A is stored rather than the
    transmittance: in float32, subtracting thousands of small equal weights from a number near 1 would round
    the same way each time.

    Source: Porter and Duff 1984; Max 1995.
    """

    def weight(self, alpha: Scalar, before: Scalar) -> Scalar:
        return (1 - before) * alpha

    def slope(self, alpha: Scalar, after: Scalar, worth: Scalar, behind: Scalar) -> Scalar:
        """More of the cell, and less of all that lies behind it."""
        transmittance = 1 - after
        # Below this transmittance `behind` is nothing but the sums' rounding, which the extinction of an
        # opaque sample would amplify.
        nothing = 2 * float(jnp.finfo(behind.dtype).eps)
        return jnp.where(transmittance <= nothing, 0, transmittance * worth - behind)

    def transmittance(self, state: Composite) -> Scalar:
        return 1 - state.opacity

    def variation(self, transfer: Transfer, windows: Windows) -> Variation:
        return transfer.variation(windows)


class RaySampler(NamedTuple):
    """Measures, classifies and shades what is on a ray. Depths are past the entry.

    `depth_scale`: a factor for depths that stand for a number of steps. It is 1, and grows with the step.
    """

    ray: Ray
    classification: Classification
    depth_scale: Scalar | int = 1

    def measured(self, depth: Scalar) -> Measured:
        """The measured values at this depth, the volume's value first."""
        return self.classification.at(self.ray.path(self.differentiable_depth(depth)))

    def differentiable_depth(self, depth: Scalar) -> Scalar:
        """The same depth, as a number to compute with, as in a fog: its derivative by the step is that of so
        many steps."""
        return depth * self.depth_scale

    def color(
        self, depth: Scalar, measured: Measured, classified: tuple[Vec3, Scalar], transmittance: Scalar
    ) -> Vec3:
        """The colour of what was measured and classified at this depth, or around it, shaded where there is a
        lighting. `transmittance`: between the place and the camera."""
        color, extinction = classified
        if self.classification.light is None:
            return color
        ray = self.ray
        point = along(ray.entry, ray.direction, self.differentiable_depth(depth))
        return self.classification.light(
            Sample(point, ray.direction, measured, color, extinction, transmittance, ray.pixel)
        )

    def shaded(self, depth: Scalar) -> tuple[Vec3, Scalar]:
        """Colour, shaded where there is a lighting, and extinction at this depth, which nothing hides."""
        measured = self.measured(depth)
        classified = self.classification.classify(measured)
        return self.color(depth, measured, classified, jnp.ones_like(depth)), classified[1]


class Selection(Compositing[State]):
    """A mode that compares the samples of a ray and chooses a depth. The pixel is computed from what is
    there, once for each ray, after the march.

    Gradients are those of `pixel`. What the march found is constant to them: the depths in its state stay the
    same number of steps past the entry, while the ray, the step and what the ray meets change. They miss that
    a pixel jumps where the choice does, and how the sample of a cell that is cut at a face moves with that
    face. Parameters may have gradients, through `pixel`. The gradient of voxels takes an array of their size
    for each fetch of `pixel`, for each chunk of 2048 pixels: slow for large volumes.
    """

    @abstractmethod
    def depth(self, state: State) -> Scalar:
        """The depth that is chosen, past the entry; infinite as long as there is none."""

    @abstractmethod
    def pixel(self, sampler: RaySampler, state: State) -> tuple[Float[Array, "4"], Scalar]:
        """Premultiplied colour and opacity, and the depth that is reported, of a ray for which a depth was
        chosen. It is differentiated by JAX. Depths, of the state and in the answer, are numbers of steps to
        it: to compute with one, take `sampler.differentiable_depth(depth)`."""

    def end(self, state: State) -> tuple[Float[Array, "4"], Scalar]:
        depth = self.depth(state)
        none, chosen = jnp.zeros_like(depth), (~jnp.isinf(depth)).astype(depth.dtype)
        return jnp.stack([none, none, none, chosen]), depth

    def transmittance(self, state: State) -> Scalar:
        """1: what is in front hides nothing."""
        return jnp.ones_like(self.depth(state))

    def occupied(self, transfer: Transfer, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """By default all blocks: what is transparent may still be chosen."""
        return jnp.ones(blocks.low.shape, bool)


class FirstVisible(Selection[Scalar]):
    """The first sample of positive opacity, shown opaque."""

    def begin(self, zero: Scalar, outputs: Outputs | None) -> Scalar:
        return jnp.full_like(zero, jnp.inf)

    def add(self, state: Scalar, fragment: Fragment) -> Scalar:
        return jnp.where((state == jnp.inf) & ~(fragment.alpha <= 0), fragment.depth, state)

    def depth(self, state: Scalar) -> Scalar:
        return state

    def finished(self, state: Scalar) -> Bool[Array, ""]:
        return state < jnp.inf

    def occupied(self, transfer: Transfer, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        return transfer.visible(blocks)

    def pixel(self, sampler: RaySampler, state: Scalar) -> tuple[Float[Array, "4"], Scalar]:
        color, _ = sampler.shaded(state)
        return jnp.stack([*color, jnp.ones_like(state)]), state


Mode: TypeAlias = Literal["over"]
"""The keys of `MODES`."""

MODES: dict[str, type[Compositing[Any]]] = {"over": Over}


def compositing_of(given: Mode | Any) -> Compositing[Any]:
    """The mode of this name, or the mode itself.

    **Raises:** `ValueError`, naming the argument, for anything else, and for a `Weighting` whose fields are
    not all static."""
    if isinstance(given, Weighting | Selection):
        if isinstance(given, Weighting) and jax.tree.leaves(given):
            raise ValueError(
                "compositing must be a Weighting with static fields only, eqx.field(static=True); "
                f"{described(given)} has others."
            )
        return given
    if isinstance(given, str) and given in MODES:
        return MODES[given]()
    names = " or ".join(f'"{name}"' for name in MODES)
    raise ValueError(
        f"compositing must be {names}, or a jaxvol Weighting or Selection; got {described(given)}."
    )
