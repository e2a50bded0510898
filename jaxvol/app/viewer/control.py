"""What is a control? A description, of which each face makes a widget of its own."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Control:
    """A widget: "buttons", "number", "checkbox", "color", "slider", "log slider", "range", "dropdown"; or
    "pad", HTML in which the pointer drags, with boxes `data-pad` (their name) of elements `data-part`."""

    kind: str
    label: str = ""
    get: Callable[[], Any] = str  # what it shows: a text, number, two in a range, a color as sRGB, `#rrggbb`
    set: Callable[[Any], None] = lambda value: None  # takes a button's text, of a pad what `press_of` reads
    limits: tuple[float, float, float] = (0.0, 1.0, 0.001)  # lowest and highest number, and the step
    choices: Sequence[str] = ()  # of a dropdown, or the texts of buttons


def press_of(message: str) -> tuple[str, str, str, bool, float, float]:
    """Parses a face's message on a press: its number, the box, its part or "", whether it is the second, and
    the place from the upper left, 0 to 1. **Raises** `ValueError` for another text."""
    press, pad, part, twice, *at = message.split(",")
    x, y = (min(max(float(each), 0.0), 1.0) for each in at)
    if math.isnan(x + y):
        raise ValueError(f"a press lies somewhere; got {at}.")
    return press, pad, part, twice == "true", x, y


PRESSED = Path(__file__).with_name("pressed.js").read_text("utf-8")
