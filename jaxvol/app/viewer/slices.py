"""Three slices through the point that was picked: where is it, and what lies around it?"""

import base64
import io
from typing import Any

import numpy as np
from PIL import Image

from ..automatic import sampled
from .control import Control, Press
from .marks import AXES
from .model import Model


COLORS = tuple("#{:02x}{:02x}{:02x}".format(*color) for _, color in AXES)
MOST = 320  # pixels of a slice's side


def slice_controls(model: Model) -> list[Control]:
    """A pad with a slice across each axis of the voxels, to the right and upwards as the world or the
    camera has it. A press moves the point."""
    volume = model.scene.volume
    if np.ndim(volume.data) != 3 or volume.field is not None:
        return []
    low, high = np.percentile(np.asarray(sampled(volume), np.float32), (0.5, 99.5)).tolist()
    origin, spacing = (np.asarray(each, np.float64) for each in (volume.origin, volume.spacing))
    turn = np.eye(3) if volume.direction is None else np.asarray(volume.direction, np.float64)
    shape = np.array(volume.shape)
    size = (shape - 1) * spacing
    upward = turn.T @ model.first.orbit.view_up
    # axes that run down or to the left
    down = np.where(np.abs(upward) > 0.7, upward, turn[np.abs(turn).argmax(axis=0), range(3)]) < 0
    shown: tuple[Any, str] = (), ""

    def indices() -> np.ndarray:
        """Of the point, or of the middle of the volume, in voxels."""
        if model.state.point is None:
            return (shape - 1) / 2
        return np.clip((model.state.point - origin) @ turn / spacing, 0, shape - 1)

    def one(axis: int, at: np.ndarray) -> str:
        a, b = (each for each in range(3) if each != axis)
        data = np.asarray(volume.data).take(round(at[axis]), axis)
        every = tuple(slice(None, None, -(-n // MOST)) for n in data.shape)
        grey = np.clip((data[every].astype(np.float32) - low) / ((high - low) or 1.0), 0, 1)
        grey = grey[:: -1 if down[a] else 1, :: 1 if down[b] else -1].T
        file = io.BytesIO()
        Image.fromarray(np.uint8(255 * np.ascontiguousarray(grey))).save(file, "JPEG", quality=85)
        source = base64.b64encode(file.getvalue()).decode()
        part = at / (shape - 1)
        x, y = 1 - part[a] if down[a] else part[a], part[b] if down[b] else 1 - part[b]
        rule = "position: absolute; pointer-events: none"
        return (
            f'<div data-pad="{axis}" style="flex: {size[a]:.4g} 0 0; position: relative; overflow: hidden;'
            f" aspect-ratio: {size[a]:.4g} / {size[b]:.4g}; cursor: crosshair; touch-action: none;"
            f" box-shadow: 0 0 0 2px {COLORS[axis]};"
            f' background: 0 0 / 100% 100% url(data:image/jpeg;base64,{source})">'
            f'<div style="{rule}; left: {x:.2%}; height: 100%; border-left: 1px solid {COLORS[a]}"></div>'
            f'<div style="{rule}; top: {y:.2%}; width: 100%; border-top: 1px solid {COLORS[b]}"></div></div>'
        )

    def get() -> str:
        nonlocal shown
        at = indices()
        if shown[0] != tuple(at):
            value = np.asarray(volume.data)[tuple(np.round(at).astype(int))]
            point = origin + turn @ (at * spacing)
            where = ", ".join(f"{each:.4g}" for each in point)
            slices = "".join(one(axis, at) for axis in range(3))
            text = f'<div style="display: flex; gap: 6px; align-items: flex-end; margin: 4px">{slices}</div>'
            text += f'<div style="font-size: 11px; margin: 0 4px">at ({where}): {float(value):.5g}</div>'
            shown = tuple(at), text
        return shown[1]

    def press(message: str) -> None:
        pressed, at = Press.of(message), indices()
        a, b = (each for each in range(3) if each != int(pressed.pad))
        at[a] = (1 - pressed.x if down[a] else pressed.x) * (shape[a] - 1)
        at[b] = (pressed.y if down[b] else 1 - pressed.y) * (shape[b] - 1)
        model.mark(origin + turn @ (at * spacing))

    return [Control("pad", "slices", get, press)]
