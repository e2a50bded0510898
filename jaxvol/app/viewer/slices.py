"""Slices through the picked point across the three axes of the voxels."""

import base64
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from ..._util.srgb import png_of
from ...scene.labels import LabelTransferFunction
from ..automatic import sampled
from .control import Control, press_of
from .editing import colors_of
from .marks import AXES
from .model import Model


SIDE = 256  # pixels of the longest axis


def slice_controls(model: Model) -> list[Control]:
    """A pad of slices, oriented as the world or the camera. A press moves the point."""
    volume = model.scene.volume
    if np.ndim(volume.data) != 3 or volume.field is not None:
        return []
    low, high = np.percentile(np.asarray(sampled(volume), np.float32), (0.5, 99.5)).tolist()
    origin, spacing = np.asarray(volume.origin, np.float64), np.asarray(volume.spacing, np.float64)
    turn = np.eye(3) if volume.direction is None else np.asarray(volume.direction, np.float64)
    last = np.array(volume.shape) - 1
    pixels = np.maximum(SIDE * last * spacing / (last * spacing).max(), 1).round().astype(int)
    upward = turn.T @ model.first.orbit.view_up
    # axes that run down or to the left
    down = np.where(np.abs(upward) > 0.7, upward, turn[np.abs(turn).argmax(axis=0), range(3)]) < 0
    shown: tuple[Any, str] = (), ""
    labels, look = np.asarray(volume.labels), model.first.transfer
    ids = dict(enumerate(volume.label_ids or ()))
    palette = colors_of(look) if isinstance(look, LabelTransferFunction) else None

    def indices() -> np.ndarray:
        """Voxel coordinates of the point, or of the middle of the volume."""
        point = model.state.point
        return last / 2 if point is None else np.clip((point - origin) @ turn / spacing, 0, last)

    def slice_of(axis: int, at: np.ndarray) -> str:
        a, b = (number for number in range(3) if number != axis)
        data = np.asarray(volume.data).take(round(at[axis]), axis).astype(np.float32)
        rgb = np.clip((data - low) / ((high - low) or 1.0), 0, 1)[..., None].repeat(3, axis=2)
        if palette is not None:
            kinds = labels.take(round(at[axis]), axis)
            rgb = np.where((kinds > 0)[..., None], rgb * palette[np.minimum(kinds, len(palette) - 1)], rgb)
        rgb = rgb[:: -1 if down[a] else 1, :: 1 if down[b] else -1].swapaxes(0, 1)
        picture = Image.fromarray((255 * rgb).astype(np.uint8)).resize((pixels[a], pixels[b]))
        x, y = (1 - at[a] / last[a] if down[a] else at[a] / last[a]), at[b] / last[b]
        x, y = x * pixels[a], (y if down[b] else 1 - y) * pixels[b]
        drawing = ImageDraw.Draw(picture)
        drawing.line([x, 0, x, pixels[b]], AXES[a][1], 2)
        drawing.line([0, y, pixels[a], y], AXES[b][1], 2)
        drawing.rectangle([0, 0, *(pixels[[a, b]] - 1)], outline=AXES[axis][1], width=3)
        source = f"data:image/png;base64,{base64.b64encode(png_of(np.asarray(picture))).decode()}"
        style = f"flex: {pixels[a]} 0 0; min-width: 0; cursor: crosshair; touch-action: none"
        return f'<img data-pad="{axis}" draggable="false" style="{style}" src="{source}">'

    def get() -> str:
        nonlocal shown
        at = indices()
        if shown[0] != tuple(at):
            index = tuple(np.round(at).astype(int))
            value = f"{float(np.asarray(volume.data)[index]):.5g}"
            if palette is not None:
                value += f", label {ids.get(int(labels[index]), int(labels[index]))}"
            place = ", ".join(f"{number:.4g}" for number in origin + turn @ (at * spacing))
            slices = "".join(slice_of(axis, at) for axis in range(3))
            text = f'<div style="display: flex; gap: 6px; align-items: flex-end; margin: 4px">{slices}</div>'
            text += f'<div style="font-size: 11px; margin: 0 4px">at ({place}): {value}</div>'
            shown = tuple(at), text
        return shown[1]

    def press(message: str) -> None:
        (_, pad, _, _, x, y), at = press_of(message), indices()
        a, b = (number for number in range(3) if number != int(pad))
        at[a] = (1 - x if down[a] else x) * last[a]
        at[b] = (y if down[b] else 1 - y) * last[b]
        model.mark(origin + turn @ (at * spacing))

    return [Control("pad", "slices", get, press)]
