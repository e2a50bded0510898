"""The settings of an image that a viewer saves, as `jaxvol render --like` reads them from a PNG."""

import json
from typing import Any

import numpy as np

from ...compositing.modes import MODES
from ...fitting.files import transfer_fields
from ...scene.transfer import TransferFunction
from .state import ISOSURFACE, Scene, State


NO_FILE = {"name": "a volume in memory", "bytes": 0, "sha256": 64 * "0"}


def text_of(scene: Scene, state: State, file: dict[str, Any]) -> dict[str, str]:
    """The text that a PNG carries, by its keyword: the settings as options of `jaxvol render`, and a transfer
    function of points. `file`: name, bytes and SHA-256 of the volume's file, if it has one."""
    orbit = state.orbit
    words = ["--no-shade" if scene.light(state) is None else "--shade", *["--parallel"] * state.parallel]
    words += [f"--compositing={state.mode}"] if state.mode in (*MODES, ISOSURFACE) else []
    numbers: dict[str, Any] = {
        "size": state.size,
        "step": [state.step * scene.voxel],
        "background": state.background,
        "view-up": np.round(orbit.view_up, 7) + 0.0,  # no -0
        "view-angle": [orbit.view_angle],
        "camera": [*orbit.position, *orbit.focal_point],
    }
    if state.clip:
        numbers |= {"clip-box": state.box, "clip-plane": np.concatenate(scene.plane(state))}
    if state.mode == ISOSURFACE:
        numbers["isovalue"] = [state.isovalue]
    words += [word for name, found in numbers.items() for word in (f"--{name}", *(f"{x:.9g}" for x in found))]
    content: dict[str, Any] = {"options": words, "file": file or NO_FILE}
    if isinstance(state.transfer, TransferFunction):
        content["transfer"] = transfer_fields(state.transfer)
    return {"jaxvol": json.dumps(content, sort_keys=True)}
