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
    """The text that a PNG carries, for `save_image`: the settings as options of `jaxvol render`, and the
    transfer function, if it is one of points.

    Args:
        scene: what is looked at.
        state: how, in an image of its size.
        file: name, bytes and SHA-256 of the volume's file; empty if it has none, and is to be named.
    """
    orbit = state.orbit
    numbers: dict[str, Any] = {
        "--size": state.size,
        "--step": (state.step * scene.voxel,),
        "--background": state.background,
        "--view-up": orbit.view_up,
        "--view-angle": (orbit.view_angle,),
    }
    if state.parallel:  # `jaxvol render` looks at the middle of the volume
        low, high = (np.asarray(corner, np.float64) for corner in scene.volume.corners)
        least = np.linalg.norm(high - low) / 2 / min(1.0, state.size[0] / state.size[1])
        numbers |= {"--direction": orbit.toward, "--zoom": (least / orbit.half_height,)}
    else:
        numbers["--camera"] = (*orbit.position, *orbit.focal_point)
    if state.clip:
        origin, normal = scene.plane(state.cut)
        numbers |= {"--clip-box": state.cut.box, "--clip-plane": (*origin, *normal)}
    if state.mode == ISOSURFACE:
        numbers["--isovalue"] = (state.isovalue,)
    words = [word for flag, found in numbers.items() for word in (flag, *map(_shortest, found))]
    words += ["--parallel"] if state.parallel else []
    words += [f"--compositing={state.mode}"] if state.mode in (*MODES, ISOSURFACE) else []
    words.append("--no-shade" if scene.light(state) is None else "--shade")
    content: dict[str, Any] = {"options": words, "file": file or NO_FILE}
    if isinstance(state.transfer, TransferFunction):
        content["transfer"] = transfer_fields(state.transfer)
    return {"jaxvol": json.dumps(content, sort_keys=True)}


def _shortest(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{float(number):.9g}"
