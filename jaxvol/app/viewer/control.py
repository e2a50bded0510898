"""What is a control? A description, of which each face makes a widget of its own."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Control:
    """Something to look at or to change, by a widget of a kind: "buttons", "number", "checkbox", "color",
    "slider", "log slider", "range" or "dropdown"; or "pad", HTML with boxes in which the pointer presses and
    drags: elements with `data-pad`, the name of the box, and in them `data-part`."""

    kind: str
    label: str = ""
    get: Callable[[], Any] = str  # what it shows: a text, number, two in a range, a color as sRGB, `#rrggbb`
    set: Callable[[Any], None] = lambda value: None  # takes a button's text, of a pad what `press_of` reads
    limits: tuple[float, float, float] = (0.0, 1.0, 0.001)  # lowest and highest number, and the step
    choices: Sequence[str] = ()  # of a dropdown, or the texts of buttons


def press_of(message: str) -> tuple[str, str, str, bool, float, float]:
    """What a face tells of a press of the pointer that goes on: a number of its own, the box, its part, empty
    for none, whether it is the second one, and where it is now, from the upper left corner, 0 to 1. Some
    messages may be lost. **Raises** `ValueError` for another text."""
    press, pad, part, twice, *at = message.split(",")
    x, y = (min(max(float(each), 0.0), 1.0) for each in at)
    if math.isnan(x + y):
        raise ValueError(f"a press lies somewhere; got {at}.")
    return press, pad, part, twice == "true", x, y


PRESSED = """(event, send) => {
  const pad = event.target.closest('[data-pad]'), id = Date.now(), last = window.jaxvolPress ?? {};
  if (!pad || event.button) return;
  event.preventDefault();
  const box = pad.getBoundingClientRect(), name = pad.dataset.pad, part = event.target.dataset.part ?? '';
  const twice = part !== '' && last.key === name + part && id - last.id < 350;
  window.jaxvolPress = {key: name + part, id};
  const tell = at => {
    const x = (at.clientX - box.x) / box.width, y = (at.clientY - box.y) / box.height;
    send([id, name, part, twice, x.toFixed(5), y.toFixed(5)].join(','));
  };
  tell(event);
  if (twice) return;
  window.addEventListener('pointermove', tell);
  window.addEventListener('pointerup', () => window.removeEventListener('pointermove', tell), {once: true});
}"""
"""JavaScript of both faces: handles `pointerdown`, and sends messages for `press_of`. What was pressed may be
drawn anew while the pointer moves."""
