"""One line from a volume to a picture, the one that `jaxvol render` makes."""

import argparse
import os
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

from .._util.checks import described, near
from ..scene.rendering import Rendering, in_notebook
from ..scene.transfer import Transfer
from ..scene.volume import Volume
from ..xla.persistent_cache import keep_programs_by_default
from .commands.options import Parser, add_scene, check_exclusive
from .commands.render import why_empty
from .commands.scene import header_of, scene_of, with_march


OF_FILES = "config", "like", "file"
"""Options of the command that a call in Python has no use for."""


def show(
    volume: Volume | str | os.PathLike[str] | list[Any] | Any,
    transfer: Transfer | list[Any] | Any | None = None,
    **options: Any,
) -> Rendering:
    """Renders a volume, and shows it, as `jaxvol render FILE` does: framed, upright, lit, with colours for
    labels, by a march that is planned for it.

        jv.show("ct.nii.gz")
        jv.show("ct.nii.gz", preset="CT-Bone", direction=(0, -1, 0), size=800, background="black")
        jv.show("mr.nii.gz", compositing="maximum", window=400, level=200)
        jv.show(["ct.nii.gz", "pet.nii.gz"], [None, jv.colormap("hot", (1, 10))])

    Args:
        volume: a `Volume`, or the path of a file that `jv.load` reads; or a list of several in one image.
        transfer: a transfer function. By default that of `preset` or `cmap`, or else what suits the values;
            or labels get a colour each. Of several volumes a list, with None where nothing is said.
        options: those of `jaxvol render`, with _ for -. Colours: `preset`, `cmap`, `clim`, or `window` and
            `level`, `unit_distance`, `labels` (a file). Look: `compositing`, `isovalue`, `shade`,
            `background`. Camera: `camera`, `direction`, `view_up`, `view_angle`, `parallel`, `zoom`, `size`.
            What is cut away: `clip_box`, `clip_plane`, `clip_inside_out`. How it is computed: `step` or
            `tolerance`, `memory`. Of a raw file: `shape`, `dtype`, `spacing`, `nan`, `time`, `channel`.
            `jaxvol render --help` describes each.

    Returns:
        The `Rendering`. In a notebook it shows itself as the last line of a cell; elsewhere it has been shown
        in a window. `jv.save_png(path, rendering.image())` writes it.

    Raises:
        ValueError: for an unknown option, those that exclude each other, and as `jv.load` and `jv.render` do.

    Warns of a preset whose values are others, and of an image in which hardly anything is visible.
    """
    parser = Parser()
    add_scene(parser)
    known = {name: value for name, value in parser.defaults().items() if name not in OF_FILES}
    for name in options:
        if name not in known or name == "with":
            raise ValueError(
                f"show has no option {name!r}.{near(name, known)} jaxvol render --help has them."
            )
    volumes, transfers = _listed(volume, transfer)
    if any(each is not None for each in transfers[:1]):
        options["transfer"] = transfers[0]
    keep_programs_by_default()
    try:
        check_exclusive({name: value for name, value in options.items() if value is not None})
        given = argparse.Namespace(**known | options, recorded_transfer=None, file=volumes[0])
        more = zip(volumes[1:], transfers[1:], strict=True)
        vars(given)["with"] = [(each, *(() if own is None else (own,))) for each, own in more]
        if isinstance(given.file, Volume):
            if of_file := [name for name, value in header_of(given).items() if value is not None]:
                raise ValueError(f"{of_file[0]} is of files; volume is a Volume.")
        else:
            given.file = Path(given.file)
        scene = scene_of(given)
        scene = with_march(scene, given, [scene.camera])
        rendering = replace(scene.render(scene.camera), background=scene.background)
        for note in (*scene.notes, why_empty(scene, rendering)):
            if note:
                warnings.warn(_in_python(note), stacklevel=2)
    except ValueError as fault:
        raise ValueError(_in_python(str(fault))) from fault
    if not in_notebook():
        rendering.show()
    return rendering


def _listed(volume: Any, transfer: Any) -> tuple[list[Any], list[Any]]:
    """A volume and a transfer function for each of several."""
    volumes = list(volume) if isinstance(volume, list | tuple) else [volume]
    transfers = list(transfer) if isinstance(transfer, list | tuple) else [transfer]
    transfers += [None] * (len(volumes) - len(transfers) if transfer is None else 0)
    if not volumes or len(volumes) != len(transfers):
        got = f"got {len(volumes)} and {len(transfers)}"
        raise ValueError(
            f"volume and transfer must be lists of as many entries where there are several; {got}."
        )
    for kinds, name, each in (
        *(((Volume, str, os.PathLike), "volume must be a jaxvol Volume or a path", v) for v in volumes),
        *(((Transfer, type(None)), "transfer must be a transfer function or None", t) for t in transfers),
    ):
        if not isinstance(each, kinds):
            raise ValueError(f"{name}; got {described(each)}.")
    return volumes, transfers


def _in_python(text: str) -> str:
    """A text with the names of options as they are in Python."""
    return re.sub(r"--([a-z][a-z-]*)", lambda found: found[1].replace("-", "_"), text)
