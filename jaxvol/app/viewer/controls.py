"""What can be changed in a viewer? Its controls by groups, for both faces."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb

from ..._util.srgb import from_srgb
from .control import Control
from .curve import transfer_controls
from .editing import display_color, rounded
from .model import Model
from .slices import slice_controls
from .state import ISOSURFACE, MAX_STEP, MIN_STEP, Cut


FOLDED = {"clip", "save", "march"}
"""Groups that are closed at first."""

SIDES = {f"{'+-'[sign < 0]}{name}": (axis, sign) for axis, name in enumerate("xyz") for sign in (1, -1)}
"""From which the camera looks: the axis, and which end of it."""


def controls_of(model: Model) -> dict[str, list[Control]]:
    """A viewer's controls, by the heading of their group. When one has changed the model, others may have
    something else to show."""
    groups = {
        "view": _view_controls(model),
        "transfer function": transfer_controls(model),
        "slices": slice_controls(model),
        "clip": _clip_controls(model),
        "save": _save_controls(model),
        "march": _march_controls(model),
    }
    return {heading: controls for heading, controls in groups.items() if controls}


def _view_controls(model: Model) -> list[Control]:
    """From where the volume is looked at, and how cells become pixels."""
    data = np.asarray(model.scene.volume.data)
    low, high = float(data.min()), float(data.max())

    def look(side: str) -> None:
        old = model.first.orbit
        model.change(orbit=old if side == "reset" else old.facing(*SIDES[side]))

    def set_background(color: str) -> None:
        r, g, b = np.asarray(from_srgb(np.asarray(to_rgb(color)))).tolist()
        model.change(background=(r, g, b))

    modes = [*model.scene.modes, ISOSURFACE]
    span = high - low or max(abs(low), 1.0)
    limits = low, low + span, span / 1000
    return [
        Control("buttons", "look from", set=look, choices=lambda: [*SIDES, "reset"]),
        Control(
            "checkbox", "orthographic", lambda: model.state.parallel, lambda on: model.change(parallel=on)
        ),
        Control(
            "dropdown",
            "mode",
            lambda: model.state.mode,
            lambda mode: model.apply(lambda state: model.scene.in_mode(state, mode)),
            choices=lambda: modes,
        ),
        Control(
            "slider",
            "isovalue",
            lambda: rounded(model.state.isovalue, span),
            lambda value: model.change(isovalue=value),
            limits,
        ),
        Control("checkbox", "light", lambda: model.state.lit, lambda on: model.change(lit=on)),
        Control(
            "color", "background", lambda: display_color(np.array(model.state.background)), set_background
        ),
    ]


def _clip_controls(model: Model) -> list[Control]:
    """A box and a plane, of which any change turns clipping on."""
    whole, chosen = model.state.cut, "none"

    def cut(**changes: Any) -> None:
        model.apply(lambda state: replace(state, clip=True, cut=replace(state.cut, **changes)))

    def range_of(axis: int) -> Control:
        low, high = whole.box[2 * axis : 2 * axis + 2]
        unit = 10.0 ** math.floor(math.log10((high - low) / 100))
        ends = math.floor(low / unit) * unit, math.ceil(high / unit) * unit

        def get() -> tuple[float, float]:
            first, last = (
                min(max(rounded(each, high - low), ends[0]), ends[1])
                for each in model.state.cut.box[2 * axis : 2 * axis + 2]
            )
            return first, last

        def put(both: tuple[float, float]) -> None:
            box = [*model.state.cut.box]
            box[2 * axis : 2 * axis + 2] = both[0], max(both[1], both[0] + unit)
            cut(box=tuple(box))

        return Control("range", "xyz"[axis], get, put, (*ends, unit))

    def choose(name: str) -> None:
        nonlocal chosen
        chosen = name
        if name == "none":
            return cut(offset=Cut.offset)
        toward = model.state.orbit.toward if name == "view" else np.eye(3)[SIDES[name][0]] * SIDES[name][1]
        return cut(normal=tuple((-toward).tolist()), offset=0.0)

    plane = Control(
        "dropdown", "plane from", lambda: chosen, choose, choices=lambda: ["none", "view", *SIDES]
    )
    depth = Control(
        "slider", "depth", lambda: model.state.cut.offset, lambda x: cut(offset=x), (-1.0, 1.0, 0.01)
    )
    on = Control("checkbox", "clip", lambda: model.state.clip, lambda on: model.change(clip=on))
    return [on, *map(range_of, range(3)), plane, depth]


def _save_controls(model: Model) -> list[Control]:
    width = 1920.0

    def set_width(pixels: float) -> None:
        nonlocal width
        width = pixels

    return [
        Control("number", "width (pixels)", lambda: width, set_width),
        Control("buttons", "image", set=lambda _: model.save(int(width)), choices=lambda: ["save PNG"]),
    ]


def _march_controls(model: Model) -> list[Control]:
    def switch(name: str) -> Control:
        def turn(on: bool) -> None:
            enabled = model.state.enabled - {name}
            model.change(enabled=enabled | {name} if on else enabled)

        return Control("checkbox", name, lambda: name in model.state.enabled, turn)

    def set_step(step: float) -> None:
        model.change(step=min(max(step, MIN_STEP), MAX_STEP))

    limits = (MIN_STEP, MAX_STEP, MIN_STEP)
    step = Control("log slider", "step (voxels)", lambda: model.state.step, set_step, limits)
    return [step, *(switch(type(transform).__name__) for transform in model.scene.transforms)]
