"""How do the cells of a ray become a pixel?

There are two kinds of compositing modes. A `Weighting` gives each cell a weight; the pixel is the sum of the
cells' colours times their weights, and of the weights themselves, which is its opacity. A `Selection`
(`selection.py`) compares the samples of a ray and chooses one depth, at which the pixel is then computed.
"""

from abc import abstractmethod
from typing import Generic, Literal, NamedTuple, TypeAlias, TypeVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._util.vec3 import Scalar, Vec3
from ..march.march import Cell, March
from ..scene.occupancy import Blocks
from ..scene.transfer import Classification, Measured, Transfer
from ..scene.variation import Variation, Windows
from ..scene.volume import Volume


State = TypeVar("State")

Outputs: TypeAlias = Literal["all", "depth", "rgba"]
"""What is computed beside the image and `Rendering.exhausted`: everything, the depth, or nothing."""


class Fragment(NamedTuple):
    """A sample, as compositing sees it.

    - `alpha`: opacity of its cell; 0 past the ray's end.
    - `depth`: of the sample, past the ray's entry. `cell`: the piece of the ray that it stands for.
    - `measured`: what was read from the volume; for a weighting, the value alone.
    - `color`: as shaded; None for a selection, or where nobody asks for it.
    - `valid`: False for what is no sample: past the ray's end, in a gap of the volume, or of width 0.
    """

    alpha: Scalar
    depth: Scalar
    cell: Cell
    measured: Measured
    color: Vec3 | None
    valid: Bool[Array, ""]

    @property
    def value(self) -> Scalar:
        """The volume's value; of a cell that is integrated, the mean of those at its ends."""
        return self.measured[0]


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

    @property
    def resolves(self) -> bool:
        """Whether the pixel is computed after the march, from what that found."""
        return False

    def marched(self, transfer: Transfer, march: March, volume: Volume) -> tuple[Transfer, March]:
        """The transfer function and the march by which rays are marched where the mode `resolves`: what its
        cells show need not be what its pixels show. By default those that are given."""
        return transfer, march

    @abstractmethod
    def transmittance(self, state: State) -> Scalar:
        """Of all cells so far: `Transform.stop` decides by it, and it is what shading is told."""

    def finished(self, state: State) -> Bool[Array, ""]:
        """Whether what follows cannot change the pixel, so that the ray is finished."""
        return jnp.zeros(jnp.shape(self.transmittance(state)), bool)

    def joined(self, front: State, back: State) -> State:
        """The state after the fragments of `front` and then those of `back`, where both were begun anew. By
        default states do not tell, and `render_bricks` refuses to join them.

        **Raises:** `NotImplementedError` by default."""
        raise NotImplementedError(f"{type(self).__name__} does not join the states of two parts of a ray.")

    @property
    @final
    def joins(self) -> bool:
        """Whether the states of two parts of a ray can be joined."""
        return type(self).joined is not Compositing.joined and not self.resolves

    def occupied(self, transfer: Transfer, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """Which blocks of a volume may change a pixel, from the ranges of their values. Rays leap
        over the others, except those that hold NaN. `transfer`: as `marched`."""
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
    numbers of one ray or of many. Parameters are static fields, which have no gradient; or arrays, which have
    one, if nothing but `resolved` depends on them.
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

    def resolved(self, classification: Classification, sums: Float[Array, "4"]) -> Float[Array, "4"]:
        """The premultiplied colour and opacity of a ray that is not transparent, from its Σ w c and Σ w, once
        for each ray after the march. It is differentiated by JAX, also of sums that are 0, which must not be
        NaN. Not called unless overridden. `classification`: of what was given, not of what was `marched`."""
        return sums

    @property
    @final
    def resolves(self) -> bool:
        return type(self).resolved is not Weighting.resolved

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

    def joined(self, front: Composite, back: Composite) -> Composite:
        """The operator is associative: what is behind has the transmittance in front as its weight."""
        return jax.tree.map(lambda a, b: a + (1 - front.opacity) * b, front, back)

    def variation(self, transfer: Transfer, windows: Windows) -> Variation:
        return transfer.variation(windows)
