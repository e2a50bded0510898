"""Names of a picture's options, their defaults, and which exclude each other; quick to import."""

from argparse import Namespace
from typing import Any


OF_FILES = "shape", "dtype", "spacing", "nan", "time", "channel", "offset"
OF_COLORS = "preset", "cmap", "transfer", "clim", "window", "level", "unit_distance"
OF_VIEWS = "camera", "direction", "view_up", "clip_box", "background", "isovalue", "shade"
DEFAULTS: dict[str, Any] = dict.fromkeys((*OF_FILES, *OF_COLORS, *OF_VIEWS, "labels", "memory"))
DEFAULTS |= {"step": None, "tolerance": None, "compositing": "over", "size": (512, 512), "others": []}
DEFAULTS |= {"view_angle": 30.0, "parallel": False, "zoom": 1.0, "clip_plane": [], "clip_inside_out": False}
DEFAULTS |= {"quiet": False}
"""Options of a picture, as they are where nothing is given."""

CALLED = {
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
ELSEWHERE = {theirs: ours for ours, names in CALLED.items() for theirs in names.split()}
"""What other programs call options."""

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
"""Options that exclude this one, which is an error, and that it overrides in a picture."""


def check_exclusive(settings: dict[str, Any]) -> None:
    """Refuse options that exclude each other."""
    on = {name for name, value in settings.items() if value is not None and value is not False}
    for name in sorted(on):
        for other in sorted(on & OVERRIDES.get(name, set())):
            both = f"{name} and {other}".replace("recorded_transfer", "the transfer function in the picture")
            raise ValueError(f"{both} exclude each other; leave one out.")


def header_of(options: Namespace) -> dict[str, Any]:
    """What the options say of the file."""
    return {name: getattr(options, name) for name in OF_FILES}
