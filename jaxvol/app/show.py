"""Shows the picture of a volume that `jaxvol render` makes, in one call."""

import inspect
import os
import warnings
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._util.checks import described
from .._util.texts import near
from .._util.vec3 import apart
from ..compositing.isosurface import Isosurface
from ..ray import check_arguments
from ..scene.camera import Camera
from ..scene.rendering import Rendering, in_notebook, open_window
from ..scene.space import enter
from ..scene.transfer import Transfer, TransferFunction, voxel_size
from ..scene.volume import Volume
from ..xla.persistent_cache import keep_programs_by_default
from .automatic import check_known
from .picture import PictureRequest, scene_of, with_march
from .settings import ALIASES, DEFAULTS, check_exclusive


CAMERA_OPTIONS = {"direction", "view_up", "view_angle", "parallel", "size"}
FAINT = 0.01
"""Largest opacity that is hardly visible: on white, it changes 8-bit colours by 1."""


def show(
    volume: Volume | str | os.PathLike[str], transfer: Transfer | None = None, **options: Any
) -> Rendering:
    """Renders a volume and shows it, as `jaxvol render FILE` does: framed, upright, lit, with a colour for
    each label, by a planned march.

        jv.show("ct.nii.gz", preset="CT-Bone", direction=(0, -1, 0), size=800, background="black")
        jv.show("mr.nii.gz", compositing="maximum", window=400, level=200)
        jv.show("ct.nii.gz", others=[("pet.nii.gz", "hot", 1, 10)])

    Args:
        volume: a `Volume`, or the path of a file that `jv.load` reads.
        transfer: a transfer function; by default that of `preset` or `cmap`, else `automatic_transfer`, or
            `labels_shown`.
        options: the options of `jaxvol render`, with _ for -, which `jaxvol render --help` describes.
            Colours: `preset`, `cmap`, `clim`, or `window` and `level`, `unit_distance`, `labels` (a file).
            More volumes: `others`, each a file or `Volume`, or a tuple of it and a transfer function, or of
            it, a colormap, and optionally its range. Look: `compositing`, `isovalue`, `shade`, `background`.
            Camera: `camera`, a `Camera` or six numbers, `direction`, `view_up`, `view_angle`, `parallel`,
            `zoom`, `size`. Clipping: `clip_box`, `clip_plane`, `clip_inside_out`. Computation: `step` or
            `tolerance`, `quiet`. For files: `shape`, `dtype`, `offset`, `spacing`, `nan`, `time`, `channel`.

    Returns:
        The `Rendering`. In a notebook it is shown as the last line of a cell; elsewhere it has been shown in
        a window, or, without a display, written to a file, whose path a warning gives.

    Raises:
        ValueError: for an unknown option, those that exclude each other, and as `jv.load` and `jv.render` do.

    Warns of a preset for another range of values, and of an image in which hardly anything is visible.
    """
    for name in options.keys() - (DEFAULTS.keys() - {"transfer"}):
        hint = near(ALIASES.get(name, name), DEFAULTS)
        raise ValueError(f"show has no option {name!r}.{hint} jaxvol render --help has them.")
    is_file = isinstance(volume, str | os.PathLike)
    arguments: dict[str, Any] = {} if is_file else {"volume": volume}
    arguments |= {} if transfer is None else {"transfer": transfer}
    check_arguments("show(volume, transfer)", **arguments)
    check_known("show", arguments, options)
    mode = options.get("compositing", "over")
    if isinstance(mode, Isosurface) and options.get("isovalue") is None:
        options |= {"compositing": "isosurface", "isovalue": float(mode.value)}
    elif not isinstance(mode, str):
        raise ValueError(f"compositing must be a name; got {described(mode)}, which jaxvol.render takes.")
    if isinstance(options.get("camera"), Camera):
        for name in options.keys() & CAMERA_OPTIONS:
            raise ValueError(f"camera is a Camera, which has its own {name}; leave {name} out.")
    options["transfer"] = transfer
    check_exclusive(options)
    keep_programs_by_default()
    file = Path(volume) if is_file else volume
    namespace = Namespace(**DEFAULTS | options, recorded_transfer=None, file=file)
    scene = with_march(scene_of(namespace), namespace)
    rendering = replace(scene.picture(namespace.quiet), background=scene.background)
    if reason := why_empty(scene, rendering):
        warnings.warn(reason, stacklevel=2)
    if not in_notebook():
        open_window(rendering)
    return rendering


_known = [
    inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=value)
    for name, value in DEFAULTS.items()
    if name != "transfer"
]
_positional = [*inspect.signature(show).parameters.values()][:2]
show.__signature__ = inspect.Signature([*_positional, *_known])  # pyright: ignore[reportFunctionMemberAccess]
"""Signature for completion in editors and notebooks."""


def why_empty(scene: PictureRequest, rendering: Rendering) -> str | None:
    """Explain an image that shows nothing; None if a pixel is more opaque than `FAINT`."""
    opacity = float(np.asarray(rendering.rgba)[..., 3].max())
    alone = scene.volume.field is None and scene.volume.labels is None and not scene.extra_pairs
    if alone and (data := np.asarray(scene.volume.data)).min() == data.max():
        return f"all voxels have the value {float(data.flat[0]):g}: there is nothing to see in the volume"
    if np.isnan(opacity):
        return None
    if opacity > FAINT:
        differs = float(np.abs(np.asarray(rendering.image(scene.background)) - scene.background).max())
        low = f"hardly anything is visible: no pixel differs from the background by more than {differs:.2g}"
        return None if differs > FAINT / 2 else f"{low}. Use another clim, background or compositing."
    if opacity > 0:
        size = f"voxels have the size {voxel_size(scene.volume):.3g}"
        change = f"a shorter unit_distance ({size}) or another clim"
        return f"hardly anything is visible: the opacity is at most {opacity:.2g}. Use {change}."
    return f"nothing is visible: {_why_nothing(scene)}"


def _why_nothing(scene: PictureRequest) -> str:
    """Explain why all pixels are transparent."""
    volume, transfer = scene.volume, scene.transfer
    space, zero = scene.march.locate(volume), jnp.zeros((), jnp.int32)
    lengths = jax.jit(jax.vmap(lambda o, d: enter(space, apart(o), apart(d), (zero, zero)).length))
    if not (lengths(*(vectors.reshape(-1, 3) for vectors in scene.camera.rays())) > 0).any():
        bounds = " to ".join(str(np.asarray(corner)) for corner in volume.corners)
        clipped = "or what the clip leaves of it, which may be thinner than a pixel"
        return f"no ray of the camera meets the volume, {bounds}, {clipped}."
    data = np.asarray(volume.data)
    low, high = float(data.min()), float(data.max())
    values = f"the volume's values run from {low:g} to {high:g}"
    if isinstance(scene.compositing, Isosurface):
        return f"{values}, and no ray crosses the isosurface's value, {float(scene.compositing.value):g}."
    if not isinstance(transfer, TransferFunction):
        return f"{values}, and the transfer function shows none of those that the rays meet."
    shown = np.flatnonzero(np.asarray(transfer.extinction) > 0)
    if not shown.size:
        return f"{values}, and the transfer function's opacity is 0 everywhere."
    # the opacity of a point extends to its neighbours, that of the first and the last to infinity
    points = [-np.inf, *np.asarray(transfer.values), np.inf]
    first, last = float(points[shown[0]]), float(points[shown[-1] + 2])
    advice = f" A clim from {low:g} to {high:g} would show something." if first > low or last < high else ""
    return f"{values}, and the transfer function shows values between {first:g} and {last:g}.{advice}"
