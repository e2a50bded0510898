"""How many steps long is each cell of a ray? One, unless a `StrideControl` is among the march's transforms.

Cells then come in runs: RUN in a row that are equally long. A run of stride s begins at a multiple of RUN s
steps, counted from `Strides.phase` steps before the ray's first cell. So runs are nested as in a binary tree:
of two that overlap, one holds the other, and leaps do not change which runs are taken.

Both engines make three calls: `predicted` prepares the march, once for each image, `begin` makes a ray's
state, and `Strides.next` chooses the next run. Gradients take strides as given.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._util.checks import check_answer
from .._util.vec3 import Scalar
from ..scene.space import Ray, Space
from ..scene.variation import Variation, Windows
from .march import March, Transform


RUN = 4
"""Cells in a row that are equally long."""


class Run(NamedTuple):
    """RUN cells of `stride` steps each, a power of two, from depth `front` on, to which no shift is added."""

    front: Scalar
    stride: int
    step: Scalar

    @property
    def middle(self) -> Scalar:
        return self.front + RUN * self.stride / 2 * self.step

    def ends_before(self, depth: Scalar) -> Bool[Array, ""]:
        """Whether the run ends at this depth or before, up to a thousandth of a step, for rounding."""
        return self.front + (RUN * self.stride - 1e-3) * self.step <= depth


class StrideControl(Transform):
    """A transform that says how long cells may be. Rays take the longest runs whose error, times the
    transmittance in front of them, is at most `tolerance`, or else of stride 1."""

    tolerance: eqx.AbstractVar[Float[Array, ""]]
    longest: eqx.AbstractVar[int]
    """The longest stride, a power of two up to 64."""

    @abstractmethod
    def prepared(self, march: March, space: Space, windows: Windows, variation: Variation) -> "StrideControl":
        """With what `error` needs of the scene, in arrays of integers, which have no gradient. `windows`,
        `variation`: how values, and what is composited, vary in each block."""

    @abstractmethod
    def error(self, ray: Ray, run: Run) -> Scalar:
        """Predicted error of the image due to these cells if nothing is in front, from ray and run only."""


class Strides(eqx.Module):
    """How long the cells of a ray are."""

    steps: Int[Array, ""]
    """Length of each cell of the current run, in steps."""
    phase: Int[Array, ""] | None
    """Steps from where the first of all runs begins to the ray's first cell; None if 0 for all rays."""
    error: Scalar | None
    """Sum of the squared predicted errors of all runs so far; None where nobody asks for it."""

    def next(
        self, march: March, ray: Ray, index: Any, ahead: Any, transmittance: Any, leaves: Any, finished: Any
    ) -> tuple["Strides", Int[Array, ""]]:
        """Chooses the run that holds the step `index + ahead`, before which all is transparent. Returns the
        state there, and the steps from `index` to that run, 0 if it is the current one. `leaves`: whether the
        ray has left the volume there. `finished`: whether it takes no more cells, so that none errs."""
        control = stride_control(march)
        assert control is not None
        march, control, ray, transmittance = jax.lax.stop_gradient((march, control, ray, transmittance))
        # indices are counted from where the first of all runs begins
        phase = jnp.zeros_like(index) if self.phase is None else self.phase
        here, target, length = index + phase, index + ahead + phase, RUN * self.steps
        end = jnp.where(here & (length - 1) == 0, here, (here | (length - 1)) + 1)
        # before the ray's first cell there is no run
        end = jnp.where(index == 0, phase, end)
        start = march.start(ray)

        def run_at(level: int) -> tuple[Int[Array, ""], Run, Scalar]:
            first = target & -(RUN << level)
            run = Run((start + (first - phase).astype(start.dtype)) * march.step, 1 << level, march.step)
            error = control.error(ray, run)
            check_answer(control, "error", error, run.front)
            # what is unknown is infinite, but does not count where nothing of it is seen
            return first, run, jnp.where(transmittance > 0, transmittance * error, 0)

        first, _, error = run_at(0)
        # the first of all runs may have begun before the ray's first cell
        chosen = jnp.maximum(first, end), jnp.ones_like(index), error
        for level in range(1, control.longest.bit_length()):
            first, run, error = run_at(level)
            fits = (first >= end) & (error <= control.tolerance.astype(error.dtype))
            if not march.ends_at_exit:
                fits &= run.ends_before(ray.length)
                for near, far in ray.gaps:  # a shift may still move the run, by a step at most
                    fits &= run.ends_before(near) | (run.front - run.step >= far)
            longer = first, jnp.full_like(index, run.stride), error
            chosen = jax.tree.map(partial(jnp.where, fits), longer, chosen)
        current = here, self.steps, jnp.zeros_like(error)
        begin, steps, error = jax.tree.map(partial(jnp.where, target < end), current, chosen)
        begin, steps = jnp.where(leaves, target, begin), jnp.where(leaves, 1, steps)
        known = jnp.where(leaves | finished, 0, error)
        total = None if self.error is None else self.error + known**2
        return Strides(steps, self.phase, total), begin - here

    def ends_within(self, cells: int) -> bool:
        """Whether a run may end before so many cells of it are taken."""
        return self.phase is not None or RUN % cells > 0

    def cells_left(self, index: Int[Array, "*rays"], most: Int[Array, "*rays"]) -> Int[Array, "*rays"]:
        """Number of cells up to the end of the run that begin less than `most` steps from here."""
        run, phase = RUN * self.steps, 0 if self.phase is None else self.phase
        steps = jnp.minimum(most, run - ((index + phase) & (run - 1)))
        return jax.lax.div(steps + self.steps - 1, self.steps)


def steps_of(strides: Strides | None) -> Int[Array, "*rays"] | int:
    """Length of the next cell, in steps."""
    return 1 if strides is None else strides.steps


def begin(march: March, ray: Ray, *, estimate: bool) -> Strides | None:
    """The state at a ray's entry; None if all cells are one step long. `estimate`: whether to sum errors."""
    control = stride_control(march)
    if control is None:
        return None
    one = jnp.ones(ray.length.shape, jnp.int32)
    return Strides(one, _phase(march, ray, control), jnp.zeros_like(ray.length) if estimate else None)


def predicted(march: March, space: Space, windows: Windows | None, variation: Callable[..., Any]) -> March:
    """The march, whose `StrideControl`, if it has one, knows the scene."""
    control = stride_control(march)
    if control is None:
        return march
    assert windows is not None
    constant: Any = jax.lax.stop_gradient((march, space, windows, variation(windows)))
    known = control.prepared(*constant)
    transforms = tuple(known if each is control else each for each in march.transforms)
    return eqx.tree_at(lambda march: march.transforms, march, transforms)


def stride_control(march: March) -> StrideControl | None:
    """The transform that chooses strides, if there is one; several are an error."""
    found = [transform for transform in march.transforms if isinstance(transform, StrideControl)]
    if len(found) > 1:
        raise ValueError(f"transforms must have one StrideControl at most; got {len(found)}.")
    return found[0] if found else None


def longest_run(march: March) -> int:
    """The most steps of a run."""
    control = stride_control(march)
    return RUN if control is None else RUN * control.longest


def _phase(march: March, ray: Ray, control: StrideControl) -> Int[Array, ""] | None:
    """Random wherever `start` or `shift` are: these move samples by a step at most, which is too little to
    turn the wood grain of long runs into noise."""
    if not march.overriding("start") and not march.may_shift:
        return None
    # binary digits of the jitter from the sixth on, nearly independent of the jitter itself; without rounding
    part = 32 * jax.lax.stop_gradient(march.start(ray) - march.shift(ray))
    run = RUN * control.longest
    return jnp.floor((part - jnp.floor(part)) * run).astype(jnp.int32) & (run - 1)
