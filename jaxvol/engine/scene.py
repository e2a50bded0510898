"""What is rendered?"""

from typing import Any, NamedTuple, TypeAlias

from ..camera import Camera
from ..compositing import Compositing, Over
from ..lighting.shading import Lighting
from ..march import March
from ..transfer import Transfer
from ..volume import Volume
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
