"""Transfer functions: from values of the volume to colour and extinction.

A transfer function defines its inputs besides the value (`attributes`), the map from inputs to colour and
extinction (`classifier`), and upper bounds of the extinction in blocks of the volume (`majorant`).
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeAlias, TypeVar

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
"""Inputs of a transfer function at a point: the value, or the values of all channels, then attributes and
search results. Inputs of an integrated cell (`Classification.spanned`): the mean of the values at its ends,
the attributes in its middle, and two tuples, `front` and `back`, (value, *search results) at each end."""

Classify: TypeAlias = Callable[[Measured], tuple[Any, Scalar]]
"""A function from `Measured` to colour (r, g, b), or `bands` numbers, and extinction (1/length)."""


class Classification(NamedTuple):
    """A transfer function applied to one volume: `measure` reads the volume, `classify` computes."""

    measure: Callable[[Vec3], Measured]
    attributes: Callable[[Vec3], Measured]
    """The inputs besides the value."""
    classify: Classify
    search: Callable[[Measured], Measured] | None = None
    """`Transfer.search`; its results are appended to the measured values."""
    integrate: Classify | None = None
    """Mean colour and extinction of a cell (`spanned`), for linear values; None: `classify` its sample."""
    light: Callable[[Any], Vec3] | None = None
    """Shaded colours of one `lighting.shading.Sample` or many; None: unlit colours."""

    def at(self, coordinate: Vec3) -> Measured:
        """Inputs of `classify` at a grid coordinate."""
        return self.searched(self.measure(coordinate))

    @staticmethod
    def spanned(attributes: Measured, front: Measured, back: Measured) -> Measured:
        """Inputs of `integrate`, from the attributes in a cell's middle and the values at its ends."""
        return ((front[0] + back[0]) / 2, *attributes, front, back)

    @property
    def of_cells(self) -> Classify:
        """The classifier of cells: `integrate`, or that of samples."""
        return self.classify if self.integrate is None else self.integrate

    def searched(self, measured: Measured) -> Measured:
        """The measured values, followed by the results of `search`."""
        return measured if self.search is None else (*measured, *self.search(measured))


class Transfer(eqx.Module):
    """The interface of all transfer functions. A subclass overrides `classifier`; `attributes` if it depends
    on more than the value; `majorant`, so that rays leap over transparent blocks; `integrator` for
    `quadrature="preintegrated"`; `channels`, so that volumes of another number are refused; `valid` if
    parameters must do more than be finite. `search`, `visible` and `vjp` only save time. Extinctions of
    custom classifiers are not checked: they must not be negative.

    A classifier may return n colours, of spectra or features: pixels then have n + 1 numbers, the opacity
    last, in every mode. Lighting and pictures need three colours.
    """

    bands: ClassVar[int | None] = None
    """Number of colours of the classifier; None, the default: determined by tracing it, at each call."""

    @abstractmethod
    def classifier(self) -> Classify:
        """The function from `Measured` to colour and extinction; its tables are computed here, once."""

    def attributes(self, volume: Volume, coordinate: Vec3) -> Measured:
        """Inputs read at a grid coordinate besides the value; by default none."""
        return ()

    @property
    def valid(self) -> Any:
        """True if the parameters, which may be traced, are as the constructor requires; else the image is
        NaN. (Finiteness is checked for every transfer function.)"""
        return True

    @property
    def title(self) -> str:
        """Description for errors; by default the name of the class."""
        return type(self).__name__

    @property
    def reads_more(self) -> bool:
        """True if `attributes` reads anything; by default, if it is overridden."""
        return type(self).attributes is not Transfer.attributes

    @property
    def reads_gradient(self) -> bool:
        """True if `attributes` reads the volume's gradient, so that slopes are stored; by default False."""
        return False

    def majorant(self, blocks: Blocks) -> Float[Array, "bx by bz"]:
        """An upper bound of the extinction (1/length) in each block, without a gradient; 0 only where the
        extinction is proven to be 0. The bound of blocks that hold NaN (`Blocks.unordered`) is ignored: rays
        do not leap over them. By default infinite."""
        return jnp.full(blocks.shape, jnp.inf)

    @property
    def channels(self) -> int | None:
        """Number of channels that a volume must have; None, the default: unknown."""
        return None

    def integrator(self) -> Classify | None:
        """The function from the inputs of a cell (`Measured`) to its mean extinction, and its mean of
        extinction × colour divided by the mean extinction, for a value that is linear between the ends; None,
        the default: `quadrature="preintegrated"` is refused."""
        return None

    def search(self) -> Callable[[Measured], Measured] | None:
        """A function from `Measured` to results appended to it (such as the interval of the value), so that
        `classifier` and `vjp` need not search again; None, the default: nothing is appended. With an
        `integrator`, results depend only on the value. Override `vjp`, too."""
        return None

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """True where `majorant` is positive; overridden if that can be computed in less time."""
        return self.majorant(blocks) > 0

    def vjp(
        self, measured: Measured, color: Color, extinction: Scalar, *, integrated: bool = False
    ) -> tuple["Transfer", Measured]:
        """Vector–Jacobian product of classifying many samples, or `integrated` cells: cotangents of the
        transfer function and of `measured`, including search results; None without a derivative."""

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
            "transfer has per_voxel=True, but no volume is known here. Pass unit_distance=volume or a length."
        )
    integrate = transfer.integrator() if integrated else None
    if integrated and integrate is None:
        why = f"{transfer.title} has no integrator"
        raise ValueError(f'quadrature="preintegrated" needs means: {why}; use "midpoint".')

    def measure(coordinate: Vec3) -> Measured:
        return (*volume.values(coordinate), *transfer.attributes(volume, coordinate))

    attributes = partial(transfer.attributes, volume)
    return Classification(measure, attributes, transfer.classifier(), transfer.search(), integrate)


MAX_WRITTEN = 16
"""Most points of a transfer function that its `repr` shows."""


class TransferFunction(Transfer):
    """Colour and extinction, piecewise linear in the volume's value and constant beyond the ends.

    Args:
        values: (n,) increasing control points, in value units; n ≥ 2. Two equal points make a step: values
            below it take colour and extinction of the first one, others of the second one. Without a
            gradient.
        colors: (n, 3) linear RGB at the points. Not premultiplied; usually in [0, 1].
        extinction: (n,) at the points, in 1/length, ≥ 0; a width w has opacity `1 - exp(-extinction w)`.
            A negative one, after an optimiser's step, counts as 0, and has no gradient.
        per_voxel: whether extinction is per voxel (`voxel_size`) of the volume that is rendered, as it is by
            default in `colormap`. Static.

    VTK interpolates opacity instead; the results differ between points of high opacity. Put a step between
    values of the data: interpolation may round a value to either side.

    Limits of its accuracy: `experiments/stability.py`, "extinction without bound".

    Raises:
        ValueError: for fewer than two points, points that do not increase, three equal points, negative
            extinction, NaN or infinity, or lengths that differ.
    """

    bands = 3
    subclass_instead: ClassVar[str] = "jaxvol.Transfer instead"

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
        cls, points: Sequence[tuple[Arrayable, Arrayable, Arrayable]], unit_distance: Arrayable = 1.0
    ) -> "TransferFunction":
        """A transfer function from control points `(value, (r, g, b), opacity)`, as drawn in a viewer.

        Args:
            points: control points in increasing order of value; two of equal value make a step.
            unit_distance: thickness of a layer with these opacities, world length (VTK's
                `ScalarOpacityUnitDistance`); extinctions are `-ln(1 - opacity) / unit_distance`. A `Volume`
                gives the size of its voxels.

        Raises:
            ValueError: the errors of the class, and for an opacity outside [0, 1].
        """
        try:
            values, colors, opacities = zip(*points, strict=True)
        except (TypeError, ValueError) as fault:
            raise ValueError(f"points must be (value, (r, g, b), opacity); got {points!r}.") from fault
        return cls(values, colors, extinction_of(opacities, unit_distance))

    def __repr__(self) -> str:
        arrays = self.values, self.colors, self.extinction
        if not all(map(is_concrete, arrays)) or self.values.ndim != 1 or len(self.values) > MAX_WRITTEN:
            return eqx.tree_pformat(self)
        values, colors, extinction = map(pasted, arrays)
        more = ", per_voxel=True" if self.per_voxel else ""
        return f"TransferFunction(values={values}, colors={colors}, extinction={extinction}{more})"

    def __call__(self, value: Scalar) -> tuple[Color, Scalar]:
        """Colour (r, g, b) and extinction of a value."""
        search, measured = self.search(), (value,)
        return self.classifier()(measured if search is None else (*measured, *search(measured)))

    def opacity(self, unit_distance: float = 1.0) -> Float[Array, " n"]:
        """Opacity at the control points of a layer of thickness `unit_distance`, in voxels if `per_voxel`."""
        return -jnp.expm1(-self._effective * number("unit_distance", unit_distance, above=0))

    @property
    def channels(self) -> int:
        return 1

    @property
    def valid(self) -> Any:
        return (self.values[..., 1:] >= self.values[..., :-1]).all()

    @property
    def _effective(self) -> Float[Array, " n"]:
        """The extinction at the control points, negative ones as 0."""
        return linear.not_negative(self.extinction)

    def majorant(self, blocks: Blocks) -> Float[Array, "bx by bz"]:
        values, extinction = jax.lax.stop_gradient((self.values, self._effective))
        bound = linear.upper_bound_between(values, extinction, blocks.low, blocks.high)
        return jnp.where(self.visible(blocks), bound, 0)

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        values, extinction = jax.lax.stop_gradient((self.values, self._effective))
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
        rows, is_small = self.rows(), self.values.shape[0] <= linear.few()

        def looked_up(measured: Measured) -> tuple[Vec3, Scalar]:
            _, interval, past = measured
            return linear.interpolate_row(linear.table_row(rows, interval), past)

        def chosen(measured: Measured) -> tuple[Vec3, Scalar]:
            (value,) = measured
            # unstacked here: XLA would compile a kernel for each number that enters a loop
            entries, width = jnp.unstack(rows.reshape(-1)), rows.shape[1]
            row, *later = (entries[i : i + width] for i in range(0, len(entries), width))
            for candidate in later:  # numbers one by one, since XLA would store rows
                reached = value >= candidate[0]
                row = [jnp.where(reached, *pair) for pair in zip(candidate, row, strict=True)]
            return linear.interpolate_row(
                tuple(row), linear.clip_below(value - row[0], jnp.zeros_like(row[0]))
            )

        return chosen if is_small else looked_up

    def integrator(self) -> Classify:
        rows, is_small = self.span_rows(), self.values.shape[0] <= linear.few()

        def integrate(measured: Measured) -> tuple[Vec3, Scalar]:
            _, front, back = measured
            if is_small:
                return mean_by_spans(rows, front[0], back[0])
            (a, i), (b, j) = (_span_of(rows, end) for end in (front, back))
            return mean_by_rows(a, b, front[0], back[0], i == j)

        return integrate

    def span_rows(self) -> Float[Array, "spans 26"]:
        """The table of `piecewise_means.span_rows`."""
        at_points = jnp.concatenate([self.colors, self._effective[:, None]], axis=1)
        return span_rows(jax.lax.stop_gradient(self.values), at_points)

    def vjp(
        self, measured: Measured, color: Color, extinction: Scalar, *, integrated: bool = False
    ) -> tuple[Transfer, Measured]:
        # One scatter of rows; JAX's transpose would scatter each entry of a row by itself.
        if integrated:
            _, front, back = measured
            rows, pull_rows = jax.vjp(lambda transfer: transfer.span_rows(), self)
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
        bars = jnp.stack([*color, extinction], axis=-1)
        shared = jnp.concatenate([bars * (1 - part)[..., None], bars * part[..., None]], axis=-1)
        sums = row_sums(len(rows), interval, shared)
        at_points = sums[:, :4] + jnp.pad(sums[:-1, 4:], ((1, 0), (0, 0)))
        of_extinction = jnp.where(self.extinction < 0, 0, at_points[:, 3])
        leaves = jnp.zeros_like(self.values), at_points[:, :3], of_extinction
        none = jax.tree.map(jnp.zeros_like, eqx.filter(self, eqx.is_inexact_array))
        transfer = eqx.tree_at(lambda t: (t.values, t.colors, t.extinction), none, leaves)
        of_value = color[0] * r + color[1] * g + color[2] * b + extinction * slope
        return transfer, (jnp.where(value < self.values[0], 0, of_value),)

    def rows(self) -> Float[Array, "points 10"]:
        """One row for each interval: value, colour and extinction of its first point, slopes of colour and
        extinction, and 1 over its length; slopes are 0 beyond the last point and between equal points."""
        values = jax.lax.stop_gradient(self.values)
        gap = (values[1:] - values[:-1])[:, None]
        inverse = jnp.where(gap > 0, 1 / jnp.where(gap > 0, gap, 1), 0)
        at_points = jnp.concatenate([self.colors, self._effective[:, None]], axis=1)
        slopes = jnp.concatenate([(at_points[1:] - at_points[:-1]) * inverse, inverse], axis=1)
        return jnp.concatenate([values[:, None], at_points, jnp.pad(slopes, ((0, 1), (0, 0)))], axis=1)


def _span_of(rows: Float[Array, "spans 26"], measured: Measured) -> tuple[linear.Row, Int[Array, "..."]]:
    """The row and index of the span that contains a value, from the value and its search results."""
    value, *searched = measured
    index = jnp.where(value < rows[0, 0], 0, searched[0] + 1) if searched else span_index(rows, value)
    return linear.table_row(rows, index), index


SHARED_POINTS = 8, 16, 256
"""Numbers of control points to which transfer functions are padded, so that programs are shared."""

T = TypeVar("T", bound=Transfer)


def with_shared_points(transfer: T) -> T:
    """The same function with a number of points from `SHARED_POINTS`, constant beyond the last one."""
    if type(transfer) is not TransferFunction or transfer.values.shape[0] in SHARED_POINTS:
        return transfer
    if linear.FEW < transfer.values.shape[0] <= linear.few():
        return transfer
    arrays: tuple[Any, ...] = transfer.values, transfer.colors, transfer.extinction
    if not all(isinstance(leaf, jax.Array) and not is_traced(leaf) for leaf in arrays):
        return transfer
    values, colors, extinction = memoized_of(arrays, _padded)
    return unchecked(transfer, values=values, colors=colors, extinction=extinction)


def _padded(arrays: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    values, colors, extinction = map(np.asarray, arrays)
    missing = min((n for n in SHARED_POINTS if n >= len(values)), default=0) - len(values)
    if missing <= 0:
        return arrays
    # far enough apart to differ in the float type
    step = max(float(values[-1] - values[0]) or 1.0, 1e-3 * abs(float(values[-1])))
    beyond = (values[-1] + step * np.arange(1, missing + 1)).astype(values.dtype)
    values, extinction = np.append(values, beyond), np.append(extinction, np.repeat(extinction[-1], missing))
    colors = np.append(colors, np.repeat(colors[-1:], missing, axis=0), axis=0)
    return jax.device_put((values, colors, extinction))


def sized(transfer: object, volume: object) -> Any:
    """The transfer function with extinction in world length if it is per voxel; else unchanged."""
    spacing = getattr(volume, "spacing", None)
    if type(transfer) is not TransferFunction or not transfer.per_voxel or spacing is None:
        return transfer
    arrays = transfer.extinction, spacing
    kept = all(isinstance(leaf, jax.Array) and not is_traced(leaf) for leaf in arrays)
    extinction = memoized_of(arrays, _in_world_length) if kept else _in_world_length(arrays)
    # an optimiser may leave numbers negative
    return unchecked(transfer, extinction=extinction, per_voxel=False)


@jax.jit
def _in_world_length(arrays: tuple[Any, Any]) -> Float[Array, " n"]:
    extinction, spacing = arrays
    size = jnp.exp(jnp.mean(jnp.log(jnp.asarray(spacing, extinction.dtype))))
    return extinction / size


def voxel_size(volume: Any) -> Any:
    """Geometric mean of the `spacing` of a `Volume` or a source of bricks."""
    xp = jnp if is_traced(volume.spacing) else np
    return xp.exp(xp.mean(xp.log(xp.asarray(volume.spacing))))


def extinction_of(opacity: Arrayable, unit_distance: Arrayable | Volume = 1.0) -> Float[Array, " n"]:
    """Extinction (1/length) of a layer of thickness `unit_distance` (or a volume's `voxel_size`) with an
    opacity, which is limited to 1 - 2⁻²⁴."""
    if hasattr(unit_distance, "spacing"):
        unit_distance = voxel_size(unit_distance)
    unit_distance = number("unit_distance", unit_distance, above=0)
    opacity = unit_interval("opacity", opacity, (None,))
    xp, (opacity, unit_distance) = in_numpy(opacity, unit_distance)
    return jnp.asarray(-xp.log1p(-xp.minimum(opacity, 1 - 2.0**-24)) / unit_distance, opacity.dtype)
