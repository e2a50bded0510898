"""Where does the camera stand after a drag?

The camera turns about its focal point as on a turntable: `view_up` stays up. Drags are given in parts of the
view's height, to the right and down, as the pointer moved.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ...scene.camera import Camera


Vector = Float[np.ndarray, "3"]

STEEPEST = math.radians(89)
"""The camera stays so far from the axis that it turns about, seen from which nothing says what is up."""


@dataclass(frozen=True)
class Orbit:
    """A perspective camera that looks at a point.

    - `focal_point`: world point. `toward`: unit direction from there to the camera. `distance`: between them,
      world length.
    - `view_up`: unit direction about which it turns. `view_angle`: degrees, over the height of the image.
    """

    focal_point: Vector
    toward: Vector
    distance: float
    view_up: Vector
    view_angle: float

    @classmethod
    def of(cls, camera: Camera) -> "Orbit":
        """Where a camera stands.

        **Raises:** `ValueError` for an orthographic camera."""
        if camera.parallel_scale is not None:
            raise ValueError("the viewer's camera must be perspective; got one with a parallel_scale.")
        return cls.at(camera.position, camera.focal_point, camera.view_up, float(camera.view_angle))

    @classmethod
    def at(cls, position: object, focal_point: object, view_up: object, view_angle: float) -> "Orbit":
        """A camera at a world position. One that looks along `view_up` is turned away from it a little."""
        position, focal, up = (np.asarray(v, np.float64) for v in (position, focal_point, view_up))
        offset = position - focal
        distance, length = float(np.linalg.norm(offset)), float(np.linalg.norm(up))
        return cls(focal, offset / distance, distance, up / length, view_angle).turned(0, 0)

    def turned(self, right: float, down: float) -> "Orbit":
        """After a drag that turns what is seen, as if the pointer held its front: by half a turn for a drag
        over the height of the view."""
        up = self.view_up
        height = math.asin(float(np.clip(self.toward @ up, -1, 1)))
        level = self.toward - (self.toward @ up) * up
        if np.linalg.norm(level) < 1e-9:
            level = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        level = level / np.linalg.norm(level)
        angle = -math.pi * right  # the camera moves against what is seen
        level = math.cos(angle) * level + math.sin(angle) * np.cross(up, level)
        height = min(max(height + math.pi * down, -STEEPEST), STEEPEST)
        return replace(self, toward=math.cos(height) * level + math.sin(height) * up)

    def panned(self, right: float, down: float) -> "Orbit":
        """After a drag that moves what is seen along the image: what lies at the focal point's distance stays
        under the pointer."""
        height = 2 * self.distance * math.tan(math.radians(self.view_angle) / 2)
        across = np.cross(-self.toward, self.view_up)
        across = across / np.linalg.norm(across)
        upward = np.cross(across, -self.toward)
        return replace(self, focal_point=self.focal_point + height * (down * upward - right * across))

    def zoomed(self, factor: float) -> "Orbit":
        """Nearer by this factor: what lies at the focal point appears so many times as large."""
        return replace(self, distance=self.distance / factor)

    @property
    def position(self) -> Vector:
        """World position of the camera."""
        return self.focal_point + self.distance * self.toward

    def camera(self, size: tuple[int, int], window: object = None, corner: object = None) -> Camera:
        """The camera, for an image of this size in pixels."""
        place = (self.position, self.focal_point, self.view_up, self.view_angle)
        return Camera(*place, size=size, window=window, corner=corner)  # pyright: ignore[reportArgumentType]
