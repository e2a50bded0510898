"""Names and defaults of a picture's options, and which exclude each other; quick to import."""

from argparse import Namespace
from typing import Any


FILE_OPTIONS = "shape", "dtype", "spacing", "nan", "time", "channel", "offset"
COLOR_OPTIONS = "preset", "cmap", "transfer", "clim", "window", "level", "unit_distance"
VIEW_OPTIONS = "camera", "direction", "view_up", "clip_box", "background", "isovalue", "shade"
RENDER_OPTIONS = "labels", "step", "tolerance"
DEFAULTS: dict[str, Any] = dict.fromkeys((*FILE_OPTIONS, *COLOR_OPTIONS, *VIEW_OPTIONS, *RENDER_OPTIONS))
DEFAULTS |= {"compositing": "over", "size": (512, 512), "others": [], "quiet": False}
DEFAULTS |= {"view_angle": 30.0, "parallel": False, "zoom": 1.0, "clip_plane": [], "clip_inside_out": False}
"""Options of a picture, with their defaults."""

SYNONYMS = {
    "background": "bg",
    "camera": "camera_position cpos",
    "cmap": "color colormap lut",
    "compositing": "blending mode",
    "isovalue": "isosurface",
    "parallel": "parallel_projection",
    "shade": "lighting shading",
    "size": "resolution window_size",
    "transfer": "opacity",
}
ALIASES = {alias: option for option, aliases in SYNONYMS.items() for alias in aliases.split()}
"""Options by their names in other programs."""

OVERRIDES = {
    "preset": {"cmap", "transfer", "recorded_transfer"},
    "cmap": {"preset", "transfer", "recorded_transfer"},
    "transfer": {"preset", "cmap", "recorded_transfer", "clim", "window", "level", "unit_distance"},
    "recorded_transfer": {"preset", "cmap", "transfer", "clim", "window", "level", "unit_distance"},
    "camera": {"direction"},
    "direction": {"camera"},
    "clim": {"window", "level"},
    "window": {"clim"},
    "level": {"clim"},
    "step": {"tolerance"},
    "tolerance": {"step"},
}
"""Options that each option excludes; it overrides those recorded in a picture."""


def check_exclusive(settings: dict[str, Any]) -> None:
    """Refuse options that exclude each other."""
    on = {name for name, value in settings.items() if value is not None and value is not False}
    for name in sorted(on):
        for excluded in sorted(on & OVERRIDES.get(name, set())):
            names = {"recorded_transfer": "the transfer function in the picture"}
            pair = f"{names.get(name, name)} and {names.get(excluded, excluded)}"
            raise ValueError(f"{pair} exclude each other; leave one out.")


def header_of(options: Namespace) -> dict[str, Any]:
    """Options that describe the file."""
    return {name: getattr(options, name) for name in FILE_OPTIONS}
