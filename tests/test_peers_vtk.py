"""Does an independent renderer draw the same image? VTK's fixed-point ray caster.

Both interpolate linearly, classify after interpolation, do not shade, and step by half a voxel with the left
rule. The remaining difference is VTK's arithmetic: it rounds an interpolated 8-bit value to an integer,
computes with 15 bits, stops a ray at a transmittance of 255/32767, writes 8 bits, and counts steps from the
near plane, where ours are counted from the entry. Together this is about 1/255 on average, and less than
0.5/255 once the rounding of values, the stop and the near plane are imitated.
"""

import functools
from typing import Any, NamedTuple

import numpy as np
import pytest

import jaxvol as jv
from experiments import peer_vtk
from jaxvol.lighting import DirectionalLight, Phong


BACKGROUND = (0.2, 0.4, 0.6)  # 51, 102 and 153 of 255: exact, and different in each channel
AGREED = 2 / 255
SHADED_AGREED = 3 / 255
STEP = 0.5  # voxels


@pytest.fixture(scope="module", autouse=True)
def vtk():
    """Skip unless VTK is installed and can render off screen."""
    if reason := peer_vtk.missing():
        pytest.skip(reason)


class Scene(NamedTuple):
    volume: jv.Volume
    transfer: jv.TransferFunction
    camera: jv.Camera

    @property
    def voxel(self) -> float:
        return float(self.volume.spacing[0])

    def drawn_by_vtk(self, shade: Phong | None = None) -> tuple[np.ndarray, Any]:
        """VTK's image over the background, (height, width, 3) in [0, 1], top row first, and its mapper."""
        step = STEP * self.voxel
        drawn = peer_vtk.Drawn(*self, step, background=BACKGROUND, shade=shade)
        return drawn.image(), drawn.mapper

    def drawn(self, mapper: Any, lighting: Phong | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Our image over the background as VTK would display it, and which pixels show the object."""
        rendering = jv.render(*self, jv.March(STEP * self.voxel), lighting=lighting)
        image, opacity = rendering.image(BACKGROUND), np.asarray(rendering.rgba)[..., 3]
        return peer_vtk.as_displayed(np.asarray(image), mapper), opacity > 0.01


HEAD = [(40, (0.1, 0.05, 0.03), 0.0), (78, (0.8, 0.5, 0.4), 0.03), (110, (0.7, 0.3, 0.25), 0.02)]
HEAD += [(160, (0.5, 0.4, 0.3), 0.05), (200, (0.95, 0.9, 0.8), 0.5), (255, (1.0, 1.0, 1.0), 0.9)]
VIEW: dict[str, Any] = {
    "position": (1.5, -3.0, 1.2),
    "focal_point": (0.1, 0.0, 0.05),
    "view_up": (0.3, 0.1, 1.0),
    "size": (160, 120),
}
PERSPECTIVE, PARALLEL = {"view_angle": 40.0}, {"parallel_scale": 1.1}
ASPECT = 120 / 160
MISREAD: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "view_angle from left to right": (
        PERSPECTIVE,
        {"view_angle": np.rad2deg(2 * np.arctan(ASPECT * np.tan(np.deg2rad(40) / 2)))},
    ),
    "view_angle from the middle up": (PERSPECTIVE, {"view_angle": 80.0}),
    "view_up left at the z axis": (PERSPECTIVE, {"view_up": (0, 0, 1)}),
    "view_up that points down": (PERSPECTIVE, {"view_up": (-0.3, -0.1, -1)}),
    "parallel_scale as half the width": (PARALLEL, {"parallel_scale": 1.1 * ASPECT}),
    "parallel_scale as the whole height": (PARALLEL, {"parallel_scale": 0.55}),
}


@functools.cache
def head_volume() -> jv.Volume:
    return jv.phantom("head", 96)


def head(**view: Any) -> Scene:
    transfer = jv.TransferFunction.from_points(HEAD, unit_distance=0.02)
    return Scene(head_volume(), transfer, jv.Camera(**(VIEW | view)))


def difference(image: np.ndarray, other: np.ndarray, inside: np.ndarray) -> float:
    return float(np.abs(image - other)[inside].mean())


@pytest.mark.parametrize("name", ["perspective", "parallel", "engine"])
def test_vtk_draws_the_same_picture_to_the_pixel(real_volume, name):
    view = {"perspective": PERSPECTIVE, "parallel": PARALLEL}.get(name)
    if view is None:
        volume = jv.load(real_volume("engine_256x256x128_uint8.raw.gz"))
        scene = Scene(volume, jv.preset("engine"), jv.Camera.looking_at(volume, size=(256, 256)))
    else:
        scene = head(**view)
    theirs, mapper = scene.drawn_by_vtk()
    ours, inside = scene.drawn(mapper)
    assert inside.mean() > 0.1
    right = difference(ours, theirs, inside)
    assert right < AGREED
    # images that are off by a single pixel differ much more
    moved = {"right": (0, 1), "left": (0, -1), "down": (1, 0), "up": (-1, 0)}
    wrong = {f"one pixel {where}": np.roll(ours, by, axis=(0, 1)) for where, by in moved.items()}
    wrong |= {"upside down": ours[::-1], "mirrored": ours[:, ::-1], "blue for red": ours[..., ::-1]}
    for what, image in wrong.items():
        assert difference(image, theirs, inside) > 3 * right, what
    # and so does a camera whose numbers are read in another way, or a volume half a voxel away
    for what, (given, change) in MISREAD.items():
        if given is view:
            assert difference(head(**(given | change)).drawn(mapper)[0], theirs, inside) > 10 * right, what
    n, volume = scene.volume.shape[0], scene.volume
    in_cells = jv.Volume(volume.data, spacing=(2 / n,) * 3, origin=(1 / n - 1,) * 3)
    half_off = jv.Volume(volume.data, volume.spacing, volume.origin + scene.voxel / 2)
    for other in (in_cells, half_off) if view is PERSPECTIVE else ():
        assert difference(scene._replace(volume=other).drawn(mapper)[0], theirs, inside) > 2 * right


def test_vtk_shades_alike(real_volume):
    """VTK shades nodes, by gradients rounded to some 10 000 directions, and interpolates what that gives; its
    head light shines along the camera's axis, ours along each ray."""
    volume = jv.load(real_volume("cthead_256x256x113_uint16le.raw.gz"), spacing=(1, 1, 2))
    points = [(700, (0.8, 0.5, 0.4), 0.0), (1000, (0.8, 0.5, 0.4), 0.04), (1150, (0.9, 0.6, 0.5), 0.02)]
    points += [(1300, (1.0, 0.95, 0.85), 0.5), (3200, (1.0, 1.0, 1.0), 0.9)]
    camera = jv.Camera.looking_at(volume, (0.4, -1, 0.2), (0, 0, -1), size=(256, 256), parallel=True)
    scene, phong = Scene(volume, jv.TransferFunction.from_points(points), camera), Phong()
    axis = np.asarray(camera.focal_point - camera.position)
    theirs, mapper = scene.drawn_by_vtk(phong)
    ours, inside = scene.drawn(mapper, phong)
    assert inside.mean() > 0.1
    right = difference(ours, theirs, inside)
    assert right < SHADED_AGREED
    wrong = {
        "unlit": None,
        "ambient": Phong(ambient=0.3),
        "diffuse": Phong(diffuse=0.5),
        "specular": Phong(specular=1.0),
        "from above": Phong(DirectionalLight(axis + np.linalg.norm(axis) * np.array([0, 0, 1]))),
    }
    for what, lighting in wrong.items():
        assert difference(scene.drawn(mapper, lighting)[0], theirs, inside) > 1.5 * right, what
