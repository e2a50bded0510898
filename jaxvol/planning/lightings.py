"""Lightings that cost less than a given one, or have less noise, and may look nearly the same."""

from dataclasses import replace
from typing import Any, NamedTuple

from ..lighting.deferred import Deferred
from ..lighting.shading import Lighting
from ..lighting.template_lighting import ScattererTemplates


class Simpler(NamedTuple):
    """A lighting in place of another one, what it is, and whether it has gradients."""

    lighting: Lighting
    what: str
    has_gradient: bool = True


def smooth(lighting: Lighting) -> Lighting:
    """The lighting without its noise and savings: what others are compared with."""
    if isinstance(lighting, Deferred):
        return smooth(lighting.lighting)
    if isinstance(lighting, ScattererTemplates):
        return _with(lighting, blend=True, photons=None, baked=False)
    return lighting


def simpler(lighting: Lighting) -> list[Simpler]:
    """Lightings that cost less, the cheapest first."""
    if isinstance(lighting, Deferred):
        return [each for each in simpler(lighting.lighting) if isinstance(each.lighting, Deferred)]
    if not isinstance(lighting, ScattererTemplates):
        return []
    baked = _with(lighting, baked=lighting.baked or True)
    grid = f"computed on a grid of {baked.baked} nodes"
    few = _with(lighting, templates=min(2, lighting.templates), blend=True, photons=8, baked=False)
    return [
        Simpler(Deferred(baked), f"{grid}, fetched once per ray", False),
        Simpler(Deferred(few), "two templates of eight photons, once per ray"),
        Simpler(baked, grid, False),
        Simpler(_with(lighting, photons=4, baked=False), "four photons"),
    ]


def _with(lighting: ScattererTemplates, **changes: Any) -> ScattererTemplates:
    # None would ask for the default cutoff, and 0 nodes are no number of nodes
    kept = {"cutoff": 0.0 if lighting.cutoff is None else lighting.cutoff, "baked": lighting.baked or False}
    return replace(lighting, **(kept | changes))
