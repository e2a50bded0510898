"""Which colour and extinction has this value?

A transfer function says what it reads at a place besides the value (`attributes`), how that becomes colour
and extinction (`classifier`), and how great the extinction can be in a block of the volume (`majorant`).
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._util import piecewise_linear as linear
from .._util.checks import Arrayable, finite_array, flag, increasing, not_negative, number, unit_interval
from .._util.piecewise_means import mean_by_rows, mean_by_spans, span_index, span_rows
from .._util.srgb import warn_of_8_bits
from .._util.texts import is_concrete, pasted
from .._util.vec3 import Color, Scalar, Vec3
from ..xla.memo import memoized_of
from ..xla.memory import gather, row_sums
from ..xla.platform import in_numpy, is_traced
from ..xla.trees import unchecked
from .occupancy import Blocks
from .volume import Volume


Measured: TypeAlias = tuple[Any, ...]
"""What a transfer function reads at a place: the value, or those of all channels, first, then whatever else
it depends on. Of a cell
that is integrated (`Classification.spanned`): the mean of the values at its ends, then what else is read in
its middle, and last two tuples, `front` and `back`: the value at each end, and what `search` found for it."""

Classify: TypeAlias = Callable[[Measured], tuple[Any, Scalar]]
"""From `Measured` to colour (r, g, b), or as many numbers as there are `bands`, and extinction (1/length)."""


class Classification(NamedTuple):
    """A transfer function of one volume: `measure` fetches at a grid coordinate, `classify` the rest."""

    measure: Callable[[Vec3], Measured]
    attributes: Callable[[Vec3], Measured]
    """What is measured besides the value."""
    classify: Classify
    search: Callable[[Measured], Measured] | None = None
    """`Transfer.search`; what it finds is appended to the measured values."""
    integrate: Classify | None = None
    """From a cell (`spanned`) to mean colour and extinction, values linear; None: as its sample."""
    light: Callable[[Any], Vec3] | None = None
    """From a `lighting.shading.Sample`, or many, to shaded colours; None: as classified."""

    def at(self, coordinate: Vec3) -> Measured:
        """What `classify` needs at a grid coordinate."""
        return self.searched(self.measure(coordinate))

    @staticmethod
    def spanned(attributes: Measured, front: Measured, back: Measured) -> Measured:
        """What `integrate` needs, from the attributes in a cell's middle and what is measured at its ends."""
        return ((front[0] + back[0]) / 2, *attributes, front, back)

    @property
    def of_cells(self) -> Classify:
        """Classifies cells: `integrate`, or as their samples."""
        return self.classify if self.integrate is None else self.integrate

    def searched(self, measured: Measured) -> Measured:
        """The measured values, followed by what `search` finds for them."""
        return measured if self.search is None else (*measured, *self.search(measured))


class Transfer(eqx.Module):
    """The interface of all transfer functions. A subclass overrides `classifier`; `attributes` if more than
    the value counts; `majorant`, so that rays leap over what is transparent; `integrator` for
    `quadrature="preintegrated"`; `channels`, so that volumes of other numbers of them
    are refused; `valid` if parameters must do more than be finite. `search`, `visible` and `vjp` only save
    time. Extinctions of one's own are not checked: they must not be negative.

    A classifier may return n colours, of spectra or features: pixels then have n + 1 numbers, the opacity
    last, in every mode, but for light and pictures, which are of three.
    """

    bands: ClassVar[int | None] = None
    """Number of colours of the classifier; None, the default: found by tracing it, at each call."""

    @abstractmethod
    def classifier(self) -> Classify:
        """The function from `Measured` to colour and extinction; its tables are computed here, once."""

    def attributes(self, volume: Volume, coordinate: Vec3) -> Measured:
        """What is read from the volume at a grid coordinate besides the value; by default nothing."""
        return ()

    @property
    def valid(self) -> Any:
        """Whether its parameters, which may be traced, are such as its constructor accepts; else the image is
        NaN. (Whether they are finite is checked of all.)"""
        return True

    @property
    def reads_more(self) -> bool:
        """Whether `attributes` reads anything. By default, if it is overridden."""
        return type(self).attributes is not Transfer.attributes

    @property
    def reads_gradient(self) -> bool:
        """Whether `attributes` reads the volume's gradient, so that slopes are stored. By default not."""
        return False

    def majorant(self, blocks: Blocks) -> Float[Array, "bx by bz"]:
        """An upper bound of the extinction (1/length) in each block, without a gradient; 0 only where that is
        proven to be 0. Of blocks that hold NaN (`Blocks.unordered`) it may be anything: rays do not leap over
        these. By default infinite."""
        return jnp.full(blocks.shape, jnp.inf)

    @property
    def channels(self) -> int | None:
        """How many channels a volume must have; None, the default, if that is not known."""
        return None

    def integrator(self) -> Classify | None:
        """The function from what is measured of a cell (`Measured`) to its mean extinction, and its mean of
        extinction × colour divided by that, as if the value were linear between its ends; None, the default,
        where they are unknown: `quadrature="preintegrated"` is refused."""
        return None

    def search(self) -> Callable[[Measured], Measured] | None:
        """A function from `Measured` to what is appended to it (such as the interval of the value), so that
        `classifier` and `vjp` need not search again; None, the default, if nothing is. With an `integrator`
        it depends only on the value. Overridden together with `vjp`."""
        return None

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """Where `majorant` is positive; overridden where that takes less time to find out."""
        return self.majorant(blocks) > 0

    def vjp(
        self, measured: Measured, color: Color, extinction: Scalar, *, integrated: bool = False
    ) -> tuple["Transfer", Measured]:
        """Vector–Jacobian product of classifying many samples, or `integrated` cells: the cotangents of the
        transfer function and of what was measured, including what `search` found; None without a derivative.
        """

        def classified(transfer: Any, measured: Measured) -> tuple[Vec3, Scalar]:
            classify = transfer.integrator() if integrated else transfer.classifier()
            for _ in range(extinction.ndim):
                classify = jax.vmap(classify)
            return classify(measured)

        _, pull = eqx.filter_vjp(classified, self, measured)
        return pull((color, extinction))


def classification_of(transfer: Transfer, volume: Volume, *, integrated: bool = False) -> Classification:
    """A transfer function applied to a volume; where cells are `integrated`, it must have an `integrator`."""
    if isinstance(transfer, TransferFunction) and transfer.per_voxel:
        raise ValueError(
            "transfer counts lengths in voxels here; give it a unit_distance, such as the volume."
        )
    integrate = transfer.integrator() if integrated else None
    if integrated and integrate is None:
        name = type(transfer).__name__
        raise ValueError(f'quadrature="preintegrated" needs means: {name} has no integrator; use "midpoint".')

    def measure(coordinate: Vec3) -> Measured:
        return (*volume.values(coordinate), *transfer.attributes(volume, coordinate))

    attributes = partial(transfer.attributes, volume)
    return Classification(measure, attributes, transfer.classifier(), transfer.search(), integrate)


MOST_WRITTEN = 16
"""Points that the text of a transfer function holds."""


class TransferFunction(Transfer):
    """Colour and extinction, piecewise linear in the volume's value and constant beyond the ends.

    Args:
        values: (n,) increasing control points, in value units; n ≥ 2. Two of them may be equal, and make a
            step: what lies below takes the first one's colour and extinction, what lies there or above the
            second's. These have no gradient.
        colors: (n, 3) linear RGB at the points. Not premultiplied; usually in [0, 1].
        extinction: (n,) at the points, in 1/length, ≥ 0; a width w has opacity `1 - exp(-extinction w)`.
            Where an optimiser's step leaves it negative, it counts as 0, and has no gradient.
        per_voxel: whether lengths are counted in voxels (`voxel_size`) of whichever volume is rendered, as
            those of `colormap` are by default. Static.

    VTK interpolates opacity instead; the two differ between points where opacities are high. Put a step
    between values of the data: interpolation may round a value to either side.

    Where it fails, and where not: `experiments/stability.py`, "extinction without bound".

    Raises:
        ValueError: for fewer than two points, points that do not increase or of which three are equal,
            negative extinction, NaN or infinity, or lengths that differ.
    """

    bands = 3
    values: Float[Array, " n"]
    colors: Float[Array, "n 3"]
    extinction: Float[Array, " n"]
    per_voxel: bool = eqx.field(static=True)

    def __init__(
        self, values: Arrayable, colors: Arrayable, extinction: Arrayable, *, per_voxel: bool | Any = False
    ):
        self.per_voxel = flag("per_voxel", per_voxel)
        self.values = increasing("values", values)
        n = self.values.shape[0]
        self.colors = finite_array("colors", colors, (n, 3))
        warn_of_8_bits("colors", self.colors)
        self.extinction = not_negative("extinction", extinction, (n,))

    @classmethod
    def from_points(
        cls, points: Sequence[tuple[float, Sequence[float], float]] | Any, unit_distance: Arrayable = 1.0
    ) -> "TransferFunction":
        """From control points `(value, (r, g, b), opacity)`, as one draws them in a viewer.

        Args:
            points: in increasing order of value; two of one value make a step.
            unit_distance: thickness of a layer that has these opacities, world length (VTK's
                `ScalarOpacityUnitDistance`); extinctions are `-ln(1 - opacity) / unit_distance`. Or a
                `Volume`, for the size of its voxels.

        Raises:
            ValueError: as the class does, and for an opacity outside [0, 1].
        """
        try:
            values, colors, opacities = zip(*points, strict=True)
        except (TypeError, ValueError) as fault:
            raise ValueError(f"points must be (value, (r, g, b), opacity); got {points!r}.") from fault
        return cls(values, colors, extinction_of(opacities, unit_distance))

    def __repr__(self) -> str:
        given = self.values, self.colors, self.extinction
        if not all(map(is_concrete, given)) or self.values.ndim != 1 or len(self.values) > MOST_WRITTEN:
            return eqx.tree_pformat(self)
        values, colors, extinction = map(pasted, given)
        more = ", per_voxel=True" if self.per_voxel else ""
        return f"TransferFunction(values={values}, colors={colors}, extinction={extinction}{more})"

    def __call__(self, value: Scalar) -> tuple[Color, Scalar]:
        """Colour (r, g, b) and extinction of a value."""
        search, measured = self.search(), (value,)
        return self.classifier()(measured if search is None else (*measured, *search(measured)))

    def opacity(self, unit_distance: float = 1.0) -> Float[Array, " n"]:
        """Opacity at the control points of a layer of thickness `unit_distance`, in voxels if `per_voxel`."""
        return -jnp.expm1(-self._seen * number("unit_distance", unit_distance, above=0))

    @property
    def channels(self) -> int:
        return 1

    @property
    def valid(self) -> Any:
        return (self.values[..., 1:] >= self.values[..., :-1]).all()

    @property
    def _seen(self) -> Float[Array, " n"]:
        """The extinction at the control points, as it is seen."""
        return linear.not_negative(self.extinction)

    def majorant(self, blocks: Blocks) -> Float[Array, "bx by bz"]:
        values, extinction = jax.lax.stop_gradient((self.values, self._seen))
        bound = linear.upper_bound_between(values, extinction, blocks.low, blocks.high)
        return jnp.where(self.visible(blocks), bound, 0)

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        values, extinction = jax.lax.stop_gradient((self.values, self._seen))
        return linear.positive_between(values, extinction, blocks.low, blocks.high)

    def search(self) -> Callable[[Measured], Measured] | None:
        values, last = jax.lax.stop_gradient(self.values), self.values.shape[0] - 1
        if last < linear.few():
            return None

        def search(measured: Measured) -> Measured:
            interval = jnp.clip(linear.points_below(values, measured[0]) - 1, 0, last)
            past = measured[0] - gather(values, interval)
            return interval, linear.clip_below(past, jnp.zeros_like(values[0]))

        return search

    def classifier(self) -> Classify:
        rows, few = self.rows(), self.values.shape[0] <= linear.few()

        def looked_up(measured: Measured) -> tuple[Vec3, Scalar]:
            _, interval, past = measured
            return linear.interpolate_row(linear.table_row(rows, interval), past)

        def chosen(measured: Measured) -> tuple[Vec3, Scalar]:
            (value,) = measured
            # taken apart here: XLA would compile a kernel for each number that enters a loop
            entries, width = jnp.unstack(rows.reshape(-1)), rows.shape[1]
            row, *others = (entries[i : i + width] for i in range(0, len(entries), width))
            for other in others:  # numbers one by one, since XLA would store whole rows
                reached = value >= other[0]
                row = [jnp.where(reached, *each) for each in zip(other, row, strict=True)]
            return linear.interpolate_row(
                tuple(row), linear.clip_below(value - row[0], jnp.zeros_like(row[0]))
            )

        return chosen if few else looked_up

    def integrator(self) -> Classify:
        rows, few = self.span_rows(), self.values.shape[0] <= linear.few()

        def integrate(measured: Measured) -> tuple[Vec3, Scalar]:
            _, front, back = measured
            if few:
                return mean_by_spans(rows, front[0], back[0])
            (a, i), (b, j) = (_span_of(rows, end) for end in (front, back))
            return mean_by_rows(a, b, front[0], back[0], i == j)

        return integrate

    def span_rows(self) -> Float[Array, "spans 26"]:
        """The table of `piecewise_means.span_rows`."""
        at_points = jnp.concatenate([self.colors, self._seen[:, None]], axis=1)
        return span_rows(jax.lax.stop_gradient(self.values), at_points)

    def vjp(
        self, measured: Measured, color: Color, extinction: Scalar, *, integrated: bool = False
    ) -> tuple[Transfer, Measured]:
        # One scatter of whole rows; JAX's transpose would scatter each entry of a row by itself.
        if integrated:
            _, front, back = measured
            rows, pull_rows = jax.vjp(lambda of: of.span_rows(), self)
            (a, i), (b, j) = (_span_of(rows, end) for end in (front, back))
            _, pull = jax.vjp(partial(mean_by_rows, same=i == j), a, b, front[0], back[0])
            of_a, of_b, of_front, of_back = pull((color, extinction))
            fronts, backs = (
                row_sums(len(rows), index, jnp.stack(part, axis=-1)) for index, part in ((i, of_a), (j, of_b))
            )
            (transfer,) = pull_rows(fronts + backs)
            return transfer, (jnp.zeros_like(of_front), (of_front,), (of_back,))
        rows, value = self.rows(), measured[0]
        if self.values.shape[0] <= linear.few():
            interval = jnp.maximum(linear.points_below(self.values, value) - 1, 0)
            past = linear.clip_below(value - linear.table_row(rows, interval)[0], jnp.zeros_like(value))
        else:
            _, interval, past = measured
        *_, r, g, b, slope, inverse = linear.table_row(rows, interval)
        part = past * inverse
        each = jnp.stack([*color, extinction], axis=-1)
        shared = jnp.concatenate([each * (1 - part)[..., None], each * part[..., None]], axis=-1)
        sums = row_sums(len(rows), interval, shared)
        at_points = sums[:, :4] + jnp.pad(sums[:-1, 4:], ((1, 0), (0, 0)))
        of_extinction = jnp.where(self.extinction < 0, 0, at_points[:, 3])
        leaves = jnp.zeros_like(self.values), at_points[:, :3], of_extinction
        none = jax.tree.map(jnp.zeros_like, eqx.filter(self, eqx.is_inexact_array))
        transfer = eqx.tree_at(lambda t: (t.values, t.colors, t.extinction), none, leaves)
        of_value = color[0] * r + color[1] * g + color[2] * b + extinction * slope
        return transfer, (jnp.where(value < self.values[0], 0, of_value),)

    def rows(self) -> Float[Array, "points 10"]:
        """By point, what values between it and the next need: value, colour and extinction of the point, the
        slopes of colour and extinction, and 1 over the gap; 0 beyond the last point and between equal ones.
        """
        values = jax.lax.stop_gradient(self.values)
        gap = (values[1:] - values[:-1])[:, None]
        inverse = jnp.where(gap > 0, 1 / jnp.where(gap > 0, gap, 1), 0)
        at_points = jnp.concatenate([self.colors, self._seen[:, None]], axis=1)
        slopes = jnp.concatenate([(at_points[1:] - at_points[:-1]) * inverse, inverse], axis=1)
        return jnp.concatenate([values[:, None], at_points, jnp.pad(slopes, ((0, 1), (0, 0)))], axis=1)


def _span_of(rows: Float[Array, "spans 26"], measured: Measured) -> tuple[linear.Row, Int[Array, "..."]]:
    """The row of the span in which a value lies, and its index, from the value and what `search` finds."""
    value, *found = measured
    index = jnp.where(value < rows[0, 0], 0, found[0] + 1) if found else span_index(rows, value)
    return linear.table_row(rows, index), index


SHARED_POINTS = 8, 16, 256
"""Numbers of control points for which programs are compiled."""


def with_shared_points(transfer: Any) -> Any:
    """The same function by one of a few numbers of points: beyond the last one it is constant."""
    if type(transfer) is not TransferFunction or transfer.values.shape[0] in SHARED_POINTS:
        return transfer
    if linear.FEW < transfer.values.shape[0] <= linear.few():
        return transfer
    given: tuple[Any, ...] = transfer.values, transfer.colors, transfer.extinction
    if not all(isinstance(leaf, jax.Array) and not is_traced(leaf) for leaf in given):
        return transfer
    values, colors, extinction = memoized_of(given, _padded)
    return unchecked(transfer, values=values, colors=colors, extinction=extinction)


def _padded(given: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    values, colors, extinction = map(np.asarray, given)
    missing = min((n for n in SHARED_POINTS if n >= len(values)), default=0) - len(values)
    if missing <= 0:
        return given
    # far enough apart to differ in the float type
    step = max(float(values[-1] - values[0]) or 1.0, 1e-3 * abs(float(values[-1])))
    beyond = (values[-1] + step * np.arange(1, missing + 1)).astype(values.dtype)
    values, extinction = np.append(values, beyond), np.append(extinction, np.repeat(extinction[-1], missing))
    colors = np.append(colors, np.repeat(colors[-1:], missing, axis=0), axis=0)
    return jax.device_put((values, colors, extinction))


def sized(transfer: Any, volume: Any) -> Any:
    """The transfer function for a volume: where its lengths are counted in voxels, in world length."""
    if type(transfer) is not TransferFunction or not transfer.per_voxel or not hasattr(volume, "spacing"):
        return transfer
    given = transfer.extinction, volume.spacing
    kept = all(isinstance(each, jax.Array) and not is_traced(each) for each in given)
    extinction = memoized_of(given, _in_world_length) if kept else _in_world_length(given)
    # an optimiser may leave numbers negative
    return unchecked(transfer, extinction=extinction, per_voxel=False)


@jax.jit
def _in_world_length(given: tuple[Any, Any]) -> Float[Array, " n"]:
    extinction, spacing = given
    size = jnp.exp(jnp.mean(jnp.log(jnp.asarray(spacing, extinction.dtype))))
    return extinction / size


def voxel_size(volume: Any) -> Any:
    """Geometric mean of the distances between neighbouring nodes along x, y and z."""
    xp = jnp if is_traced(volume.spacing) else np
    return xp.exp(xp.mean(xp.log(xp.asarray(volume.spacing))))


def extinction_of(opacity: Arrayable, unit_distance: Arrayable | Volume = 1.0) -> Float[Array, " n"]:
    """Extinction (1/length) of a layer of thickness `unit_distance` (or a volume's `voxel_size`) with this
    opacity, which counts as 1 - 2⁻²⁴ at most."""
    if hasattr(unit_distance, "spacing"):
        unit_distance = voxel_size(unit_distance)
    unit_distance = number("unit_distance", unit_distance, above=0)
    opacity = unit_interval("opacity", opacity, (None,))
    xp, (opacity, unit_distance) = in_numpy(opacity, unit_distance)
    return jnp.asarray(-xp.log1p(-xp.minimum(opacity, 1 - 2.0**-24)) / unit_distance, opacity.dtype)
