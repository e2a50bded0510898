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
    """The mode, or the mode of this name. **Raises** `ValueError` for anything else, for a `Weighting` with
    fields that are neither arrays nor static, and for an `Over` with another `weight`."""
    if isinstance(mode, Weighting | Selection):
        if isinstance(mode, Over) and type(mode).weight is not Over.weight:
            raise ValueError(
                f"compositing: {type(mode).__name__} is an Over with another weight, for which its slope and "
                "transmittance are wrong. Subclass jaxvol.Weighting."
            )
        loose = [leaf for leaf in jax.tree.leaves(mode) if not isinstance(leaf, jax.Array)]
        if isinstance(mode, Weighting) and loose:
            raise ValueError(
                f"compositing: fields of {described(mode)} must be JAX arrays, eqx.field(converter="
                f"jnp.asarray), or static, eqx.field(static=True); got {described(loose[0])}."
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
