"""Controls of a viewer, in groups, for both faces."""

from dataclasses import replace

import numpy as np
from matplotlib.colors import to_rgb

from ..._util.srgb import from_srgb
from .control import Control
from .curve import transfer_controls
from .editing import display_color, rounded
from .model import Model
from .slices import slice_controls
from .state import ISOSURFACE, MAX_STEP, MIN_STEP


FOLDED = {"clip", "save", "march"}  # initially folded groups
SIDES = {f"{'+-'[sign < 0]}{name}": (axis, sign) for axis, name in enumerate("xyz") for sign in (1, -1)}


def controls_of(model: Model) -> dict[str, list[Control]]:
    """Controls by the heading of their group. A change of a control may change the values of others."""
    groups = {"view": _view_controls, "transfer function": transfer_controls, "slices": slice_controls}
    groups |= {"clip": _clip_controls, "save": _save_controls, "march": _march_controls}
    return {heading: group for heading, controls in groups.items() if (group := controls(model))}


def _checkbox(model: Model, label: str, name: str) -> Control:
    """A checkbox of a field of the state."""
    get, put = lambda: getattr(model.state, name), lambda value: model.change(**{name: value})
    return Control("checkbox", label, get, put)


def _view_controls(model: Model) -> list[Control]:
    """Controls of camera, mode, light and background."""
    data = np.asarray(model.scene.volume.data)
    modes = [*model.scene.modes, *([] if model.scene.extra_pairs else [ISOSURFACE])]
    low, high = float(data.min()), float(data.max())
    span = high - low or max(abs(low), 1.0)

    def get_isovalue() -> float:
        return min(max(rounded(model.state.isovalue, span), low), rounded(low + span, span))

    isovalue = get_isovalue, lambda value: model.change(isovalue=value)
    unit = rounded(span / 1000, span / 1000)

    def look(side: str) -> None:
        if side == "reset":
            model.change(orbit=replace(model.first.orbit, view_angle=model.state.orbit.view_angle))
        else:
            axis, sign = SIDES[side]
            model.change(orbit=model.scene.seen_from(model.state, sign * np.eye(3)[axis]))

    def set_background(color: str) -> None:
        model.change(background=tuple(np.asarray(from_srgb(np.asarray(to_rgb(color)))).tolist()))

    def set_mode(mode: str) -> None:
        model.apply(lambda state: model.scene.in_mode(state, mode))

    background = lambda: display_color(np.array(model.state.background)), set_background
    return [
        Control("buttons", "look from", set=look, choices=(*SIDES, "reset")),
        _checkbox(model, "orthographic", "parallel"),
        Control("dropdown", "mode", lambda: model.state.mode, set_mode, choices=modes),
        Control("slider", "isovalue", *isovalue, (low, rounded(low + span, span), unit)),
        _checkbox(model, "light", "lit"),
        Control("color", "background", *background),
    ]


def _clip_controls(model: Model) -> list[Control]:
    """Controls of the clip box and plane; any change turns clipping on."""
    bounds, chosen = model.state.box, "none"

    def range_of(axis: int) -> Control:
        ends = slice(2 * axis, 2 * axis + 2)
        low, high = bounds[ends]
        step = (high - low) / 200

        def put(interval: tuple[float, float]) -> None:
            box = [*model.state.box]
            box[ends] = interval[0], max(interval[1], interval[0] + step)
            model.change(clip=True, box=tuple(box))

        return Control("range", "xyz"[axis], lambda: model.state.box[ends], put, (low, high, step))

    def choose(name: str) -> None:
        nonlocal chosen
        chosen = name
        axis, sign = SIDES.get(name, (0, 1))
        toward = model.state.orbit.toward if name == "view" else sign * np.eye(3)[axis]
        cut = {"clip": True, "normal": tuple((-toward).tolist()), "offset": 0.0}
        model.change(**{"offset": -1.0} if name == "none" else cut)

    def set_depth(offset: float) -> None:
        model.change(clip=True, offset=offset)

    return [
        _checkbox(model, "clip", "clip"),
        *map(range_of, range(3)),
        Control("dropdown", "cut from", lambda: chosen, choose, choices=("none", "view", *SIDES)),
        Control("slider", "depth", lambda: model.state.offset, set_depth, limits=(-1.0, 1.0, 0.01)),
    ]


def _save_controls(model: Model) -> list[Control]:
    pixels = [1920.0]
    width = Control("number", "width", lambda: pixels[0], lambda value: pixels.__setitem__(0, value))
    return [width, Control("buttons", "image", set=lambda _: model.save(pixels[0]), choices=("save PNG",))]


def _march_controls(model: Model) -> list[Control]:
    def switch(name: str) -> Control:
        def turn(on: bool) -> None:
            enabled = model.state.enabled - {name}
            model.change(enabled=enabled | {name} if on else enabled)

        return Control("checkbox", name, lambda: name in model.state.enabled, turn)

    def set_step(step: float) -> None:
        model.change(step=min(max(step, MIN_STEP), MAX_STEP))

    limits = (MIN_STEP, MAX_STEP, MIN_STEP)
    step = Control("slider", "step (voxels)", lambda: model.state.step, set_step, limits)
    return [step, *(switch(type(transform).__name__) for transform in model.scene.transforms)]
