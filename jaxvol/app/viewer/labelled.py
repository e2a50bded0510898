"""A transfer function for each label in a viewer: labels are hidden, and made fainter or denser."""

import math
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np

from ..._util.srgb import to_srgb
from ...scene.labels import LabelTransferFunction
from .look import Color, Look, with_item


DENSEST = 4.0
"""Factor of a label's extinction, at most."""


@dataclass(frozen=True, eq=False)
class Labelled(Look):
    """Labels, of each of which something is seen where it is shown.

    - `function`: the transfer function as it was given.
    - `shown`, `opacities`: by label, whether it is shown, and the factor of its extinction. See
      `LabelTransferFunction.with_visibility` and `with_opacity`.
    """

    function: LabelTransferFunction
    shown: tuple[bool, ...]
    opacities: tuple[float, ...]

    @classmethod
    def of(cls, transfer: LabelTransferFunction) -> "Labelled":
        """The labels of a transfer function."""
        shown, opacities = np.asarray(transfer.shown).tolist(), np.asarray(transfer.opacity).tolist()
        return cls(transfer, tuple(shown), tuple(opacities))

    @property
    def labels(self) -> tuple[int, ...]:
        """Those that have a transfer function."""
        extinction = np.asarray(self.function.stacked.extinction)
        return tuple(map(int, np.flatnonzero(extinction.max(axis=1) > 0)))

    def color(self, label: int) -> Color:
        """sRGB, in [0, 1], of a label where it is densest."""
        functions = self.function.stacked
        densest = int(np.argmax(functions.extinction[label]))
        r, g, b = np.clip(to_srgb(np.asarray(functions.colors[label, densest])), 0, 1).tolist()
        return r, g, b

    def changed(self, label: int, *, shown: bool | None = None, opacity: float | None = None) -> "Labelled":
        """With a label hidden or shown, or with another factor of its extinction.

        **Raises:** `ValueError` for a label that there is not, and a factor that is none."""
        if label not in self.labels:
            raise ValueError(f"there is no label {label}; there are {', '.join(map(str, self.labels))}.")
        if opacity is not None and not (math.isfinite(opacity) and 0 <= opacity <= DENSEST):
            raise ValueError(f"opacity of a label must be from 0 to {DENSEST:g}; got {opacity}.")
        changed = self
        if shown is not None:
            changed = replace(changed, shown=with_item(self.shown, label, shown))
        if opacity is not None:
            changed = replace(changed, opacities=with_item(self.opacities, label, opacity))
        return changed

    def transfer(self) -> LabelTransferFunction:
        return eqx.tree_at(
            lambda function: (function.shown, function.opacity),
            self.function,
            (np.array(self.shown), np.array(self.opacities, self.function.opacity.dtype)),
        )
