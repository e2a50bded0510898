"""Which colour and extinction has a value within this structure? One transfer function for each label."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .occupancy import Blocks
from .transfer import (
    Classify,
    Measured,
    Transfer,
    TransferFunction,
    at_least,
    interpolated,
    points_below,
    row_of,
    seen_between,
)
from .triple import Scalar, Triple
from .volume import Volume


class LabelTransferFunction(Transfer):
    """A transfer function for each label of a segmented volume.

    **Arguments:**

    - `functions`: that of label 0, 1, 2, …, or None for a label that is not seen. All have the same number
      of control points. A label beyond the last is not seen either.

    The label is that of the nearest node, so it changes along a ray at once, half-way between nodes;
    `AlphaCorrection(labels=True)` cuts cells there.

    **Raises:** `ValueError` for no function at all, and for different numbers of control points; and when
    rendering a volume without labels.
    """

    stacked: TransferFunction
    """All functions as one, with a leading axis for the label; the last is that of labels not seen."""

    def __init__(self, functions: Sequence[TransferFunction | None]):
        seen = [function for function in functions if function is not None]
        if not seen:
            raise ValueError("functions must hold a TransferFunction for one label at least; got none.")
        counts = sorted({function.values.shape[0] for function in seen})
        if len(counts) > 1:
            raise ValueError(f"functions must have the same number of control points; got {counts}.")
        hidden = TransferFunction(seen[0].values, 0 * seen[0].colors, 0 * seen[0].extinction)
        given = [hidden if function is None else function for function in [*functions, None]]
        self.stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *given)

    def measured(self, volume: Volume, coordinate: Triple) -> Measured:
        """Value and label at a grid coordinate."""
        return volume.value(coordinate), volume.label(coordinate)

    def classifier(self) -> Classify:
        """Look-up of colour and extinction, by label and value."""
        tables = jax.vmap(TransferFunction.rows)(self.stacked)
        unseen, points = tables.shape[0] - 1, tables.shape[1]
        rows = tables.reshape(-1, tables.shape[2])

        def classify(measured: Measured) -> tuple[Triple, Scalar]:
            value, label = measured
            label = jnp.where((label < 0) | (label > unseen), unseen, label)
            values = self.stacked.values.at[label].get(mode="promise_in_bounds", wrap_negative_indices=False)
            value = at_least(value, values[0])
            row = row_of(rows, label * points + jnp.maximum(points_below(values, value) - 1, 0))
            return interpolated(row, value - row[0])

        return classify

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """Which blocks of a volume hold a label, and a value, of which something is seen."""
        functions = jax.lax.stop_gradient(self.stacked)
        seen = jnp.zeros(blocks.low.shape, bool)
        for label in range(functions.values.shape[0] - 1):
            values, extinction = functions.values[label], functions.extinction[label]
            inside = seen_between(values, extinction, blocks.low, blocks.high)
            seen |= inside & blocks.may_hold(label)
        return seen
