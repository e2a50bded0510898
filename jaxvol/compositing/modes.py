"""Which compositing mode does `compositing=` name?"""

from typing import Any, Literal, TypeAlias

import jax

from .._util.checks import described
from .._util.texts import near
from .blending import Compositing, Over, Weighting
from .line_integral import LineIntegral
from .projections import Average, Maximum, Minimum
from .selection import Selection


Mode: TypeAlias = Literal["over", "maximum", "minimum", "average", "integral"]
"""The keys of `MODES`."""

MODES: dict[str, type[Compositing[Any]]] = {
    "over": Over,
    "maximum": Maximum,
    "minimum": Minimum,
    "average": Average,
    "integral": LineIntegral,
}


MODES_ELSEWHERE = {"composite": "over", "dvr": "over", "mip": "maximum", "max": "maximum", "minip": "minimum"}
MODES_ELSEWHERE |= {"min": "minimum", "aip": "average", "mean": "average", "additive": "integral"}
MODES_ELSEWHERE |= {"xray": "integral", "x-ray": "integral", "drr": "integral", "iso": "isosurface"}
"""What other programs call them."""


OVER = Over()
"""The same for all images, since what is kept for a scene is kept for its parts."""


def compositing_of(given: Mode | Any) -> Compositing[Any]:
    """The mode of this name, or the mode itself. **Raises** `ValueError` for anything else, and for a
    `Weighting` whose fields are not all static although its weights may depend on them."""
    if isinstance(given, Weighting | Selection):
        if isinstance(given, Weighting) and not given.resolves and jax.tree.leaves(given):
            raise ValueError(
                "compositing must be a Weighting with static fields only, eqx.field(static=True); "
                f"{described(given)} has others."
            )
        return given
    if given == "over":
        return OVER
    if isinstance(given, str) and given in MODES:
        return MODES[given]()
    names = ", ".join(f'"{name}"' for name in MODES)
    hint = near(MODES_ELSEWHERE.get(given.lower(), given), MODES) if isinstance(given, str) else ""
    raise ValueError(
        f"compositing must be one of {names}, a jaxvol.Isosurface, or another Weighting or Selection; "
        f"got {described(given)}.{hint}"
    )
