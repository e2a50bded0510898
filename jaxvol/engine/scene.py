"""What is rendered?"""

from typing import Any, NamedTuple, TypeAlias

from ..compositing.blending import Compositing, Over
from ..lighting.shading import Lighting
from ..march.march import March
from ..scene.camera import Camera
from ..scene.transfer import Transfer
from ..scene.volume import Volume
from .rays import OwnRays


Source: TypeAlias = Camera | OwnRays
"""Where rays come from."""


class Scene(NamedTuple):
    """Everything that an image depends on."""

    volume: Volume
    transfer: Transfer
    source: Source
    march: March
    compositing: Compositing[Any] = Over()
    lighting: Lighting | None = None
