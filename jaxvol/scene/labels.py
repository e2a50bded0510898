"""Transfer functions of segmented volumes: one for each label."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from .._util import piecewise_linear as linear
from .._util.checks import described, finite_array, flag, integer, require
from .._util.piecewise_means import mean_by_rows
from .._util.vec3 import Scalar, Vec3
from ..xla.memory import gather
from .occupancy import Blocks
from .transfer import Classify, Measured, Transfer, TransferFunction
from .volume import Volume


class LabelTransferFunction(Transfer):
    """A transfer function for each label of a segmented volume.

    Args:
        functions: by label, `{1: function}`; or a sequence of those of label 0, 1, 2, …, with None for a
            label that is not seen, as others without a function are not. Labels are 0 to 255; renumber
            others, as `jv.load(path, labels=...)` and `np.unique(labels, return_inverse=True)` do.

    The label is that of the nearest node, so it jumps along a ray, half-way between nodes, and a pixel jumps
    where a sample crosses there: gradients with respect to camera and place do not include these jumps.
    `AlphaCorrection(labels=True)` cuts cells there, so that nothing jumps; otherwise `"preintegrated"` takes
    the label in the middle of a cell.

    What `with_visibility` hides is leapt over. Other factors, or labels hidden and shown, compile nothing
    again.

    Raises:
        ValueError: for no function at all, something that is none, and labels out of range; and when
            rendering a volume without labels.
    """

    bands = 3
    stacked: TransferFunction
    """All functions, stacked along a leading axis for the label; the last is that of invisible labels."""
    opacity: Float[Array, " labels"]
    """Of each label, a factor of its extinction: see `with_opacity`. Differentiable."""
    shown: Bool[Array, " labels"]
    """Of each label, whether it is seen: see `with_visibility`."""

    def __init__(self, functions: Mapping[int, Any] | Sequence[TransferFunction | None] | Any):
        given = _by_label(functions)
        seen = [function for function in given if function is not None]
        if not seen:
            raise ValueError("functions must hold a TransferFunction for one label at least; got none.")
        if any(function.per_voxel for function in seen):
            raise ValueError(
                "functions must count lengths in world length; got one per voxel. Give it a unit_distance, "
                "such as the volume: jv.colormap(..., unit_distance=volume)."
            )
        hidden = TransferFunction(seen[0].values, 0 * seen[0].colors, 0 * seen[0].extinction)
        each = [hidden if function is None else function for function in [*given, None]]
        self.stacked = _stacked(each)
        self.opacity = jnp.asarray(np.ones(len(each)), self.stacked.extinction.dtype)
        self.shown = jnp.asarray(np.ones(len(each)), bool)

    def with_visibility(self, visible: Mapping[int, bool] | Any) -> "LabelTransferFunction":
        """The same, with labels hidden or shown: `{3: False}` hides label 3, `{3: True}` shows it again.

        Raises:
            ValueError: for labels beyond the last one, and for what is not true or false.
        """
        found = self.shown
        for label, shown in self._changes("visible", visible):
            is_array = isinstance(shown, jax.Array) and shown.shape == () and shown.dtype == bool
            found = found.at[label].set(shown if is_array else flag(f"visible[{label}]", shown))
        return eqx.tree_at(lambda transfer: transfer.shown, self, found)

    def with_opacity(self, opacity: Mapping[int, float] | Any) -> "LabelTransferFunction":
        """The same, with these factors f of labels' opacity: `{2: 0.3}` makes label 2 fainter. Other labels
        keep theirs, which are 1 at first.

        f is a factor of the extinction: what has the opacity α at f = 1 has 1 - (1 - α)^f. It may exceed 1,
        and is differentiable; where it is 0, its derivative misses what is leapt over (`SpaceLeaping`).

        Raises:
            ValueError: for labels beyond the last one, and for factors that are negative or not finite.
        """
        found = self.opacity
        for label, factor in self._changes("opacity", opacity):
            name = f"opacity[{label}]"
            factor = finite_array(name, factor, ())
            factor = require(factor, lambda f: f >= 0, f"{name} must be at least 0; got {{got}}.")
            found = found.at[label].set(factor.astype(found.dtype))
        return eqx.tree_at(lambda transfer: transfer.opacity, self, found)

    def _changes(self, name: str, changes: Any) -> list[tuple[int, Any]]:
        """Checked labels, each with what was given for it."""
        if not isinstance(changes, Mapping):
            raise ValueError(f"{name} must be by label, such as {{1: ...}}; got {described(changes)}.")
        last = self.opacity.shape[0] - 2  # the one behind it stands for all without a function
        return [(integer(f"{name}'s label", label, 0, last), each) for label, each in changes.items()]

    @property
    def channels(self) -> int:
        return 1

    @property
    def valid(self) -> Bool[Array, ""] | bool:
        return self.stacked.valid

    @property
    def _seen(self) -> TransferFunction:
        """All functions, with the extinctions that are seen."""
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
        """From a label to the control points of its function, and the look-up of its table's rows."""
        tables = jax.vmap(table_of)(self._seen)
        hidden, count, rows = tables.shape[0] - 1, tables.shape[1], tables.reshape(-1, tables.shape[2])

        def of(label: Any) -> tuple[Array, Any]:
            label = jnp.where((label < 0) | (label > hidden), hidden, label)
            return gather(self.stacked.values, label), lambda row: linear.table_row(rows, label * count + row)

        return of

    def majorant(self, blocks: Blocks) -> Float[Array, "bx by bz"]:
        return jnp.where(
            self.visible(blocks), self._greatest(linear.upper_bound_between, blocks, blocks.low.dtype), 0
        )

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        return self._greatest(linear.positive_between, blocks, bool)

    def _greatest(
        self, between: Callable[..., Array], blocks: Blocks, dtype: Any
    ) -> Shaped[Array, "bx by bz"]:
        """The greatest answer of the functions whose labels a block may hold, without a gradient."""
        functions = jax.lax.stop_gradient(self._seen)
        greatest = jnp.zeros(blocks.low.shape, dtype)
        for label, points in enumerate(zip(functions.values[:-1], functions.extinction[:-1], strict=True)):
            found = jnp.maximum(greatest, between(*points, blocks.low, blocks.high))
            greatest = jnp.where(blocks.may_hold(label), found, greatest)
        return greatest


def _by_label(functions: Any) -> list[TransferFunction | None]:
    """Those of label 0, 1, 2, …"""
    if isinstance(functions, Mapping):
        named = {integer("functions' label", label, 0, 255): each for label, each in functions.items()}
        functions = [named.get(label) for label in range(max(named, default=-1) + 1)]
    if not isinstance(functions, list | tuple) or len(functions) > 256:
        expected = "{label: TransferFunction}, or a sequence of those of labels 0 to 255"
        raise ValueError(f"functions must be {expected}; got {described(functions)}.")
    for label, each in enumerate(functions):
        if not isinstance(each, TransferFunction | None):
            raise ValueError(
                f"functions[{label}] must be a TransferFunction, or None; got {described(each)}."
            )
    return list(functions)


@jax.jit
def _stacked(functions: list[TransferFunction]) -> TransferFunction:
    """All functions along a leading axis; those with fewer points get copies of their last one beyond it."""
    points = max(function.values.shape[0] for function in functions)

    def continued(function: TransferFunction) -> TransferFunction:
        values, missing = function.values, points - function.values.shape[0]
        # far enough apart to differ in the float type
        gap = jnp.maximum(values[-1] - values[0], jnp.maximum(abs(values[-1]), 1))
        beyond = values[-1] + gap * jnp.arange(1, missing + 1, dtype=values.dtype)
        padded = jax.tree.map(lambda of: jnp.concatenate([of, *[of[-1:]] * missing]), function)
        return eqx.tree_at(lambda of: of.values, padded, jnp.concatenate([values, beyond]))

    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(continued, functions))
