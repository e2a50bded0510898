"""What does a viewer show? All that its controls change, in one value that never changes itself."""

import math
from dataclasses import dataclass, replace

from ...lighting.shading import Lighting
from ...march.march import March, Transform
from .look import Look
from .orbit import Orbit


SHORTEST, LONGEST = 1 / 16, 16
"""Steps, in voxels, between which a viewer's step lies."""


@dataclass(frozen=True)
class State:
    """All that the controls of a viewer change.

    - `orbit`: the camera. `look`: the transfer function. `size`: (width, height) of the view, pixels.
    - `step`: distance between samples, in voxels.
    - `on`: names of the transforms that are applied. `lit`: whether there is light.
    """

    orbit: Orbit
    look: Look
    size: tuple[int, int]
    step: float
    on: frozenset[str]
    lit: bool

    def with_step(self, step: float) -> "State":
        """With another step, in voxels.

        **Raises:** `ValueError` for one that is too short or too long."""
        if not (math.isfinite(step) and SHORTEST <= step <= LONGEST):
            raise ValueError(f"step must be from {SHORTEST} to {LONGEST} voxels; got {step}.")
        return replace(self, step=float(step))

    def with_size(self, width: float, height: float, most: int = 2048) -> "State":
        """With a view of this many pixels, or, if it is wider or higher than `most`, as many fewer."""
        if not (math.isfinite(width) and math.isfinite(height)) or min(width, height) < 1:
            raise ValueError(f"a view has at least one pixel; got {width} x {height}.")
        shrunk = min(1.0, most / max(width, height))
        return replace(self, size=(max(1, round(width * shrunk)), max(1, round(height * shrunk))))

    def with_transform(self, name: str, on: bool) -> "State":
        """With a transform turned on or off."""
        return replace(self, on=self.on | {name} if on else self.on - {name})


@dataclass(frozen=True)
class Choices:
    """What a viewer offers.

    - `transforms`: those that can be turned on, in the order in which they are applied.
    - `lighting`: the light that can be turned on; None where nothing can be lit.
    - `quadrature`: of the march. `voxel`: world length of a step of 1.
    """

    transforms: tuple[Transform, ...]
    lighting: Lighting | None
    quadrature: str
    voxel: float
    max_samples: int | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Of the transforms."""
        return tuple(type(transform).__name__ for transform in self.transforms)

    def march(self, state: State, coarser: float = 1.0) -> March:
        """The march, with steps that are so many times as long."""
        chosen = tuple(t for t in self.transforms if type(t).__name__ in state.on)
        step = state.step * coarser * self.voxel
        return March(step, chosen, self.quadrature, max_samples=self.max_samples)

    def light(self, state: State) -> Lighting | None:
        """The light, if it is on."""
        return self.lighting if state.lit else None
