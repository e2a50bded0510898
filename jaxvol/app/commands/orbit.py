"""Where does a camera stand that turns about its focal point?"""

from typing import Any

import numpy as np

from ...scene.camera import Camera


def turned(camera: Camera, degrees: float, axis: Any) -> Camera:
    """The camera, turned about an axis through its focal point."""
    from scipy.spatial.transform import Rotation

    if not degrees:
        return camera
    axis = np.asarray(axis, float)
    if not np.isfinite(axis).all() or not axis.any():
        raise ValueError(f"--axis must not be 0; got {' '.join(map(str, axis))}.")
    rotation = Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis))
    position, focal, up = (
        np.asarray(v, float) for v in (camera.position, camera.focal_point, camera.view_up)
    )
    return Camera(
        focal + rotation.apply(position - focal),
        focal,
        rotation.apply(up),
        camera.view_angle,
        size=camera.size,
        parallel_scale=camera.parallel_scale,
        window=camera.window,
    )


def angles_of(degrees: float, frames: int) -> list[float]:
    """Angles of the frames: evenly spaced from 0 on, to `degrees`; or, where that ends at the beginning, to
    one frame before it."""
    closed = degrees % 360 == 0
    return [degrees * i / max(frames if closed else frames - 1, 1) for i in range(frames)]
