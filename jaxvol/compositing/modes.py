"""Names of compositing modes, the values of the argument `compositing`."""

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
"""Names of the modes in other programs."""

OVER = Over()
"""One object for all images, since caches are keyed by a scene's parts."""


def compositing_of(mode: object) -> Compositing[Any]:
    """The mode, or the mode of this name. **Raises** `ValueError` for anything else, and for a `Weighting`
    with fields that are not static, unless only `resolved` may depend on them."""
    if isinstance(mode, Weighting | Selection):
        if isinstance(mode, Weighting) and not mode.resolves and jax.tree.leaves(mode):
            raise ValueError(
                "compositing must be a Weighting with static fields only, eqx.field(static=True); "
                f"{described(mode)} has others."
            )
        return mode
    hint = ""
    if isinstance(mode, str):
        if mode in MODES:
            return OVER if mode == "over" else MODES[mode]()
        hint = near(MODES_ELSEWHERE.get(mode.lower(), mode), MODES)
    names = ", ".join(f'"{name}"' for name in MODES)
    raise ValueError(
        f"compositing must be one of {names}, a jaxvol.Isosurface, or another Weighting or Selection; "
        f"got {described(mode)}.{hint}"
    )
