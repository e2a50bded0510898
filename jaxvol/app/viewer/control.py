"""Description of a control, from which each face makes a widget."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Control:
    """A control: "buttons", "number", "checkbox", "color", "slider", "range", "dropdown", or
    "pad": HTML for drags, with boxes `data-pad` (their name) of elements `data-part`."""

    kind: str
    label: str = ""
    get: Callable[[], Any] = str  # value: text, number, pair of numbers (range), sRGB `#rrggbb` (color)
    set: Callable[[Any], None] = lambda value: None  # takes a value, a button's text, or a pad's message
    limits: tuple[float, float, float] = (0.0, 1.0, 0.001)  # lowest and highest number, and the step
    choices: Sequence[str] = ()  # of a dropdown, or texts of buttons


def press_of(message: str) -> tuple[str, str, str, bool, float, float]:
    """Parse a pad's message: number of the press, box, part or "", True for a double press, and the position
    from the upper left, 0 to 1. **Raises** `ValueError` for another text."""
    press, pad, part, twice, *position = message.split(",")
    x, y = (min(max(float(number), 0.0), 1.0) for number in position)
    if math.isnan(x + y):
        raise ValueError(f"the position of a press must be two numbers; got {position}.")
    return press, pad, part, twice == "true", x, y


PRESSED = Path(__file__).with_name("pressed.js").read_text("utf-8")
