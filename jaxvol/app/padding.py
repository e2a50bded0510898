"""How does one compiled program render many transfer functions?"""

from dataclasses import replace
from typing import Any

import numpy as np

from ..scene.transfer import TransferFunction


def padded(transfer: Any, *sizes: int) -> Any:
    """The same function by the least of these numbers of points that holds its own, if any does: beyond the
    last one it is constant. Programs are compiled for numbers of points."""
    if not isinstance(transfer, TransferFunction):
        return transfer
    missing = min((size for size in sizes if size >= len(transfer.values)), default=0) - len(transfer.values)
    if missing <= 0:
        return transfer
    values, colors, extinction = map(np.asarray, (transfer.values, transfer.colors, transfer.extinction))
    # far enough apart to differ in the float type
    step = max(float(values[-1] - values[0]) or 1.0, 1e-3 * abs(float(values[-1])))
    return replace(
        transfer,
        values=np.append(values, values[-1] + step * np.arange(1, missing + 1)),
        colors=np.append(colors, np.repeat(colors[-1:], missing, axis=0), axis=0),
        extinction=np.append(extinction, np.repeat(extinction[-1], missing)),
    )
