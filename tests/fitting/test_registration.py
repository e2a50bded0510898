"""Is a volume found in X-ray images of it, from several starts, and by one call?"""

from typing import Any

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxvol as jv

from ..scenes import SIZE


def blobs():
    """Four balls of different sizes, on a grid that lies turned in the world."""
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    at = np.moveaxis(np.indices((20, 18, 16)), 0, -1)
    centers, sizes = [(6, 5, 5), (13, 6, 10), (9, 12, 8), (14, 13, 4)], [3, 2, 2.5, 1.5]
    data = sum(np.exp(-np.sum((at - c) ** 2, axis=-1) / s**2) for c, s in zip(centers, sizes, strict=True))
    return jv.Volume(np.asarray(data, np.float32), (1.0, 1.1, 1.2), (30, -20, 10), direction=turn)


VOLUME = blobs()
TRANSFER = jv.TransferFunction([0, 2], np.ones((2, 3)), [0, 0.2])
CENTER = np.asarray(VOLUME.center)
VIEWS = [jv.Camera(CENTER + away, CENTER, (0, 0, 1), 20, size=SIZE) for away in ([60, -20, 5], [-10, -70, 9])]
MARCH = jv.March(1.0, (jv.AlphaCorrection(),), "midpoint")
TURN, SHIFT = np.array([0.1, -0.12, 0.08]), np.array([1.5, -1.0, 0.8])


def moved(camera):
    """The camera, moved by the turn and the shift."""
    turn = Rotation.from_rotvec(TURN)
    ends = (np.asarray(point) - CENTER for point in (camera.position, camera.focal_point))
    position, focal_point = (turn.apply(end) + CENTER + SHIFT for end in ends)
    return jv.Camera(position, focal_point, turn.apply(np.asarray(camera.view_up)), 20, size=SIZE)


@jax.jit
def xray(camera):
    return jv.render(VOLUME, TRANSFER, camera, MARCH, compositing="integral").rgba[..., 0]


def test_the_motion_of_both_cameras_is_found_from_every_start_past_what_a_mask_hides():
    """In images of another brightness and contrast, whose sides no level divides."""
    images = [7 - 3 * np.asarray(xray(moved(camera))) for camera in VIEWS]
    masks = [np.ones(SIZE[::-1]) for _ in VIEWS]
    masks[0][:5, :6], images[0][:5, :6] = 0, 1e3
    views = [(camera, 7 - image) for camera, image in zip(VIEWS, images, strict=True)]
    turns, shifts = [[0, 0, 0], -0.5 * TURN, [0.3, 0.1, -0.2]], [[0, 0, 0], -SHIFT, 2 * SHIFT]
    starts = jv.RigidMotion(turns, shifts, CENTER)
    how: Any = {"weights": masks, "march": MARCH}
    found = jv.register(VOLUME, TRANSFER, views, starts, levels=(3, 1), **how)
    assert found.similarity > 0.9999
    assert np.all(found.similarities[:, 0] < 0.9)
    for turn, shift in zip(found.ends.rotation, found.ends.translation, strict=True):
        np.testing.assert_allclose(turn, TURN, atol=2e-3)
        np.testing.assert_allclose(shift, SHIFT, atol=2e-2)
    assert found.similarity == found.similarities[:, 1].max()
    for camera, expected in zip(found.cameras, map(moved, VIEWS), strict=True):
        np.testing.assert_allclose(camera.position, expected.position, atol=0.2)
        np.testing.assert_allclose(camera.view_up, expected.view_up, atol=2e-3)
    table = str(found).splitlines()
    assert [line.split()[0] for line in table[1:]] == [
        str(at) for at in np.argsort(-found.similarities[:, 1])
    ]


BLANK = np.zeros(SIZE[::-1])
RAMP = BLANK + np.arange(SIZE[0])
SMALL = jv.Camera(CENTER + 9, CENTER, (0, 0, 1), size=(3, 3))


def given(views: Any = ((VIEWS[0], RAMP),), **how: Any):
    return lambda: jv.register(VOLUME, TRANSFER, views, **how)


BAD = [
    (given(()), "views must be a list of at least one"),
    (given([BLANK]), r"views\[0\] must be a pair"),
    (given([(VIEWS[0], BLANK[1:])]), r"views\[0\]: the image must have shape \(16, 20\)"),
    (given([(VIEWS[0], BLANK), (SMALL, BLANK[:3, :3])]), "views must have cameras of one size and kind"),
    (given(similarity="ssd"), 'similarity must be "gradient_ncc" or "ncc"; got \'ssd\''),
    (given(weights=[-1.0]), r"weights\[0\] must not be negative"),
    (given(levels=()), "levels must hold at least one"),
    (given([(VIEWS[0], BLANK + 1)]), r"views\[0\]: the image must not be constant"),
    (given([(VIEWS[0], RAMP)], weights=[0 * BLANK]), "got one of 0 equal pixels"),
    (given(levels=(2, 0.5)), "levels must be an integer of at least 1"),
    (given(starts=3), "starts must be a RigidMotion; got 3"),
    (given(starts=jv.RigidMotion(TURN, SHIFT, CENTER)), r"starts.rotation must have shape \(n, 3\)"),
    (given(march=3), "march must be a jaxvol March"),
]


@pytest.mark.parametrize(("call", "message"), BAD)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
