"""How is a volume shown of which nothing is known? By a transfer function from its histogram."""

from typing import Any
import numpy as np
from .presets import colormap
from .transfer import TransferFunction
from .labels import LabelTransferFunction
from .volume import Volume


def automatic_transfer(volume: Volume) -> TransferFunction:
    return colormap("gray", (float(volume.data.min()), float(volume.data.max())))


def labels_shown(volume: Volume) -> tuple[Volume, LabelTransferFunction] | None:
    return None
