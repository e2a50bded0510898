"""Transfer functions of segmented volumes: one for each label."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from .._util import piecewise_linear as linear
from .._util.checks import Arrayable, described, flag, integer, not_negative
from .._util.piecewise_means import mean_by_rows
from .._util.vec3 import Scalar, Vec3
from ..xla.memory import gather
from ..xla.platform import in_numpy, is_traced, stack
from .occupancy import Blocks
from .transfer import Classify, Measured, Transfer, TransferFunction
from .volume import Volume


class LabelTransferFunction(Transfer):
    """A transfer function for each label of a segmented volume.

    Args:
        functions: a dictionary from label to function, `{1: function}`; or a sequence of functions for the
            labels 0, 1, 2, …. Labels with None or without a function are invisible. Labels are 0 to 255;
            `jv.load(path, labels=...)` and `np.unique(labels, return_inverse=True)` renumber others.

    A sample has the label of the nearest node. Labels change half-way between nodes, and a pixel jumps where
    a sample crosses there: gradients with respect to camera and place do not include these jumps.
    `AlphaCorrection(labels=True)` cuts cells there, so that pixels are continuous; otherwise
    `"preintegrated"` takes the label in the middle of a cell.

    Rays leap over hidden labels (`with_visibility`). New factors and visibilities do not recompile.

    Raises:
        ValueError: for no function, an entry that is no `TransferFunction`, and labels out of range; and when
            rendering a volume without labels.
    """

    bands = 3
    subclass_instead: ClassVar[str] = "jaxvol.Transfer instead"

    stacked: TransferFunction
    """All functions, stacked along a leading axis for the label; the last one is that of invisible labels."""
    opacity: Float[Array, " labels"]
    """Factor of the extinction by label: see `with_opacity`. Differentiable."""
    shown: Bool[Array, " labels"]
    """Visibility by label: see `with_visibility`."""

    def __init__(self, functions: Mapping[Any, TransferFunction | None] | Sequence[TransferFunction | None]):
        by_label = _by_label(functions)
        visible = [function for function in by_label if function is not None]
        if not visible:
            raise ValueError("functions must hold a TransferFunction for at least one label; got none.")
        if any(function.per_voxel for function in visible):
            raise ValueError(
                "functions must count lengths in world length; got one with per_voxel=True. Pass a "
                "unit_distance, such as the volume: jv.colormap(..., unit_distance=volume)."
            )
        n = visible[0].values.shape[0]
        hidden = TransferFunction(visible[0].values, np.zeros((n, 3)), np.zeros(n))
        complete = [hidden if function is None else function for function in [*by_label, None]]
        self.stacked = _stacked(complete)
        self.opacity = jnp.asarray(np.ones(len(complete), dtype := self.stacked.extinction.dtype), dtype)
        self.shown = jnp.asarray(np.ones(len(complete), bool), bool)

    def with_visibility(self, visible: Mapping[Any, bool | np.bool_ | Array]) -> "LabelTransferFunction":
        """A copy with labels hidden or shown: `{3: False}` hides label 3, `{3: True}` shows it again.

        Raises:
            ValueError: for labels beyond the last one, and for values that are not true or false.
        """
        result = self.shown
        for label, shown in self._changes("visible", visible):
            is_array = isinstance(shown, jax.Array) and shown.shape == () and shown.dtype == bool
            result = _with_entry(result, label, shown if is_array else flag(f"visible[{label}]", shown))
        return eqx.tree_at(lambda transfer: transfer.shown, self, result)

    def with_opacity(self, opacity: Mapping[Any, Arrayable]) -> "LabelTransferFunction":
        """A copy with new factors f of labels' opacity: `{2: 0.3}` makes label 2 fainter. Other labels keep
        their factors, initially 1.

        f multiplies the extinction: an opacity α at f = 1 becomes 1 - (1 - α)^f. f may exceed 1, and is
        differentiable; at f = 0, its derivative misses regions that rays leap over (`SpaceLeaping`).

        Raises:
            ValueError: for labels beyond the last one, and for factors that are negative or not finite.
        """
        result = self.opacity
        for label, factor in self._changes("opacity", opacity):
            result = _with_entry(result, label, not_negative(f"opacity[{label}]", factor))
        return eqx.tree_at(lambda transfer: transfer.opacity, self, result)

    def _changes(self, name: str, changes: Any) -> list[tuple[int, Any]]:
        """Pairs of a checked label and its new value."""
        if not isinstance(changes, Mapping):
            raise ValueError(f"{name} must be by label, such as {{1: ...}}; got {described(changes)}.")
        last = self.opacity.shape[0] - 2  # the entry after it is that of all labels without a function
        return [(integer(f"{name}'s label", label, 0, last), value) for label, value in changes.items()]

    @property
    def channels(self) -> int:
        return 1

    @property
    def valid(self) -> Bool[Array, ""] | bool:
        return self.stacked.valid

    @property
    def _effective(self) -> TransferFunction:
        """The stacked functions with extinctions times opacity factors, 0 for hidden labels."""
        factor = jnp.where(self.shown, self.opacity, 0)
        extinction = linear.not_negative(self.stacked.extinction * factor[:, None])
        return eqx.tree_at(lambda functions: functions.extinction, self.stacked, extinction)

    def attributes(self, volume: Volume, coordinate: Vec3) -> Measured:
        return (volume.label(coordinate),)

    def classifier(self) -> Classify:
        functions = self._tables(TransferFunction.rows)

        def classify(measured: Measured) -> tuple[Vec3, Scalar]:
            value, label = measured
            values, row_at = functions(label)
            row = row_at(jnp.maximum(linear.points_below(values, value) - 1, 0))
            return linear.interpolate_row(row, linear.clip_below(value - row[0], jnp.zeros_like(row[0])))

        return classify

    def integrator(self) -> Classify:
        functions = self._tables(TransferFunction.span_rows)

        def integrate(measured: Measured) -> tuple[Vec3, Scalar]:
            _, label, (front,), (back,) = measured
            values, row_at = functions(label)
            i, j = (linear.points_below(values, end) for end in (front, back))
            return mean_by_rows(row_at(i), row_at(j), front, back, i == j)

        return integrate

    def _tables(self, table_of: Callable[[TransferFunction], Array]) -> Callable[[Any], tuple[Array, Any]]:
        """A function from a label to its control points and a look-up of its table's rows."""
        tables = jax.vmap(table_of)(self._effective)
        hidden, count, rows = tables.shape[0] - 1, tables.shape[1], tables.reshape(-1, tables.shape[2])

        def table(label: Array) -> tuple[Array, Any]:
            label = jnp.where((label < 0) | (label > hidden), hidden, label)
            return gather(self.stacked.values, label), lambda row: linear.table_row(rows, label * count + row)

        return table

    def majorant(self, blocks: Blocks) -> Float[Array, "bx by bz"]:
        return jnp.where(
            self.visible(blocks), self._greatest(linear.upper_bound_between, blocks, blocks.low.dtype), 0
        )

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        return self._greatest(linear.positive_between, blocks, bool)

    def _greatest(
        self, between: Callable[..., Array], blocks: Blocks, dtype: Any
    ) -> Shaped[Array, "bx by bz"]:
        """The maximum of `between` over the labels that a block may hold, without a gradient."""
        functions = jax.lax.stop_gradient(self._effective)
        greatest = jnp.zeros(blocks.low.shape, dtype)
        for label, points in enumerate(zip(functions.values[:-1], functions.extinction[:-1], strict=True)):
            larger = jnp.maximum(greatest, between(*points, blocks.low, blocks.high))
            greatest = jnp.where(blocks.may_hold(label), larger, greatest)
        return greatest


def _by_label(functions: Any) -> list[TransferFunction | None]:
    """The functions of labels 0, 1, 2, …, checked."""
    if isinstance(functions, Mapping):
        named = {integer("functions' label", label, 0, 255): entry for label, entry in functions.items()}
        functions = [named.get(label) for label in range(max(named, default=-1) + 1)]
    if not isinstance(functions, list | tuple) or len(functions) > 256:
        expected = "{label: TransferFunction}, or a sequence of functions for labels 0 to 255"
        raise ValueError(f"functions must be {expected}; got {described(functions)}.")
    for label, entry in enumerate(functions):
        if not isinstance(entry, TransferFunction | None):
            raise ValueError(
                f"functions[{label}] must be a TransferFunction, or None; got {described(entry)}."
            )
    return list(functions)


def _with_entry(array: Array, label: int, entry: Array | bool) -> Array:
    """The array with another entry; by NumPy, which compiles nothing, if both are concrete."""
    if is_traced(array, entry):
        return array.at[label].set(jnp.asarray(entry, array.dtype))
    changed = np.array(array)
    changed[label] = entry
    return jnp.asarray(changed, array.dtype)


def _stacked(functions: list[TransferFunction]) -> TransferFunction:
    """The functions along a leading axis, padded to the same number of points with copies of the last one."""
    points = max(function.values.shape[0] for function in functions)
    xp, functions = in_numpy(*functions)

    def continued(function: TransferFunction) -> TransferFunction:
        values, missing = function.values, points - function.values.shape[0]
        # far enough apart to differ in the float type
        gap = xp.maximum(values[-1] - values[0], xp.maximum(abs(values[-1]), 1))
        beyond = values[-1] + gap * xp.arange(1, missing + 1, dtype=values.dtype)
        padded = jax.tree.map(lambda leaf: xp.concatenate([leaf, *[leaf[-1:]] * missing]), function)
        return eqx.tree_at(lambda f: f.values, padded, xp.concatenate([values, beyond]))

    return jax.tree.map(lambda *leaves: stack(leaves), *map(continued, functions))
