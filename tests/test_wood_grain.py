"""Does jitter break wood grain, keep cut faces smooth and leave the error unchanged? Kye 2013, measured."""

from functools import cache
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import nibabel
import numpy as np
import pytest
from jaxtyping import Array, Bool

import jaxvol as jv
from jaxvol.lighting import Phong
from jaxvol.march.transforms.jitter import Noise
from jaxvol.metrics import boundary_noise, comb_frequency, rmse, wood_grain_energy

from . import scenes
from .switch import switch


KINDS = {"jitter": jv.Jitter, "empty space": jv.EmptySpaceJitter}
NO_SHIFT = {"jitter": 0.0, "empty space": 1.0}
"""Numbers by which these move no sample."""
NEVER = 1e-7
"""Transmittance at which rays end whose colour lacks nothing by it."""


class SwitchedNoise(eqx.Module):
    """A transform's random numbers where `on` is true, elsewhere the number by which it moves no sample. The
    transform stays the library's own, which the engine turns into numbers of its fast path."""

    noise: Noise
    on: Bool[Array, ""]
    otherwise: float = eqx.field(static=True)

    def __call__(self, pixel, dtype):
        return jnp.where(self.on, self.noise(pixel, dtype), jnp.asarray(self.otherwise, dtype))


def rendered(scene, kind="", seed=0, refined=1, *, leaps=False, left=NEVER, quadrature="left", lighting=None):
    """Colour over black, with alpha correction, so that exits make no difference. Jitters and leaps are
    switched on and off, so that all images of a scene share a program."""
    volume, transfer, camera, step = scene
    transforms = []
    for name, made in KINDS.items():
        jitter = made(seed)
        noise = SwitchedNoise(jitter.noise, jax.device_put(np.asarray(name == kind)), NO_SHIFT[name])
        transforms.append(eqx.tree_at(lambda transform: transform.noise, jitter, noise))
    transforms += [jv.AlphaCorrection(), switch(jv.SpaceLeaping(), leaps), jv.EarlyTermination(left)]
    march = jv.March(step / refined, tuple(transforms), quadrature)
    rgba = scenes.rendered(volume, transfer, camera, march, lighting=lighting, outputs="rgba").rgba
    return np.asarray(rgba, np.float64)[..., :3]


# -- an inclined plane, and a block that the box cuts -----------------------------------------------------
# The scene is stated for the unit cube and rendered as [-1, 1]³, so that a step of 1/128 becomes 2/128 and an
# extinction of 60 value becomes 30 value. Images are of 256 x 256 pixels: with fewer, noise hides the comb.

SLOPE, SIDE, STEP = 0.35, 256, 2 / 128


def plane(x, z):
    return ((z + 1) / 2 - 0.25 - SLOPE * (x + 1) / 2) / 0.004


class CutPlane(jv.Field):
    """The field of `jv.phantom("plane")`, or of "cut_block", evaluated exactly instead of from voxels."""

    cut: Bool[Array, ""]

    def value(self, volume, coordinate):
        x, _, z = (c * volume.spacing[i] + volume.origin[i] for i, c in enumerate(coordinate))
        block = 0.5 + 0.1 * jnp.sin(20 * (z + 1))
        return jnp.where(self.cut & (x < 0), block, jax.nn.sigmoid(plane(x, z)))


def surface_transfer():
    """Transparent below 0.05; above it, colour 0.3 + 0.6 value and extinction 30 value."""
    values = np.array([0, 0.04999, 0.05, 1])
    colors = np.tile((0.3 + 0.6 * values)[:, None], 3)
    return jv.TransferFunction(values, colors, [0, 0, 1.5, 30])


def scene_of(*, cut=False, start=-3.0):
    """Orthographic, along z; a pixel is 1/256 wide. `start`: of the rays, which is z."""
    field = CutPlane(jnp.asarray(cut))
    volume = jv.Volume(np.zeros((8, 8, 8), np.float32), [2 / 7] * 3, [-1.0] * 3, field=field)
    camera = jv.Camera((0, 0, start), (0, 0, start + 3), (0, 1, 0), size=(SIDE, SIDE), parallel_scale=0.5)
    return volume, surface_transfer(), camera, STEP


@cache
def columns():
    return np.asarray(scene_of()[2].rays()[0], np.float64)[0, :, 0]


@cache
def exact_plane():
    """The image of the plane, all of whose rows are alike, by a fine quadrature in NumPy."""
    z = np.linspace(-1, 1, 2**13 + 1)
    width = z[1] - z[0]
    value = 1 / (1 + np.exp(-plane(columns()[:, None], z[:-1] + width / 2)))
    depth = width * np.where(value > 0.05, 30 * value, 0)
    weight = np.exp(-np.cumsum(depth, 1) + depth) * -np.expm1(-depth)
    row = np.sum(weight * (0.3 + 0.6 * value), 1)
    return np.tile(row[:, None], (SIDE, 1, 3))


def comb_of(error):
    # x falls along the columns in this view, and so does the depth
    return wood_grain_energy(error, comb_frequency(STEP, (-SLOPE, 0), 1 / SIDE))


@pytest.fixture(scope="module")
def plain():
    return rendered(scene_of())


@pytest.mark.parametrize("kind", KINDS)
def test_jitter_breaks_the_comb_of_an_inclined_plane_and_leaves_the_error(kind, plain):
    before = plain - exact_plane()
    # the rings are more than half of the error's variance
    assert comb_of(before) > 0.5 * np.sum(np.var(before, axis=(0, 1)))
    for seed in (0, 1):
        error = rendered(scene_of(), kind, seed) - exact_plane()
        assert comb_of(error) <= comb_of(before) / 500, seed
        assert abs(wood_grain_energy(error)) <= wood_grain_energy(before) / 10, seed
        assert rmse(error, 0 * error) == pytest.approx(rmse(before, 0 * before), rel=0.05), seed


def test_one_shift_for_all_pixels_moves_the_comb_and_does_not_break_it(plain):
    """The metric responds to jitter, not to a common shift: here all rays begin half a step later."""
    later = rendered(scene_of(start=-1 + STEP / 2))
    assert comb_of(later - exact_plane()) == pytest.approx(comb_of(plain - exact_plane()), rel=0.05)


# mean square error of colours up to 1, rounded to float32
ROUNDING = 3 * (2.0**-23) ** 2


def assert_smooth(scene, face):
    """A cut face is smooth under empty-space jitter, and noisy under jitter."""
    assert face.mean() > 0.25
    plain = boundary_noise(rendered(scene), face)
    for seed in (0, 1):
        jittered, spared = (boundary_noise(rendered(scene, kind, seed), face) for kind in KINDS)
        assert spared <= 1.05 * plain + ROUNDING, seed
        assert jittered >= 5 * plain + 1e-6, seed


def test_a_cut_face_is_smooth_under_empty_space_jitter_and_noisy_under_jitter():
    assert_smooth(scene_of(cut=True), np.tile(columns() < -0.05, (SIDE, 1)))


# -- blue noise -------------------------------------------------------------------------------------------


def slow_energy(noise, below=1 / 16):
    """Mean square of an image's variation under `below` cycles per pixel."""
    frequency = np.hypot(*np.meshgrid(*(np.fft.fftfreq(n) for n in noise.shape), indexing="ij"))
    spectrum = np.fft.fft2(np.asarray(noise, np.float64))[(frequency > 0) & (frequency < below)]
    return np.sum(np.abs(spectrum) ** 2) / noise.size**2


def test_the_blue_pattern_holds_a_fifth_of_the_slow_energy_of_the_white():
    row, column = (jnp.asarray(axis) for axis in np.indices((SIDE, SIDE), np.int32))

    @eqx.filter_jit
    def drawn(noise):
        return jnp.vectorize(lambda x, y: noise((x, y), jnp.float32))(column, row)

    for seed in (0, 1):
        white, blue = (slow_energy(drawn(Noise(seed, p, stream=0))) for p in ("white", "blue"))
        assert blue <= white / 5, seed


# -- the random number of each ray -----------------------------------------------------------------------
# Values are 0, 5, 10, … at the layers of voxels along z, so that a colour tells the depth of a sample.
# Volumes, transfer functions and images have the shapes of the scenes below, and so share their programs.

LAYERS, SMALL = 48, (64, 64)
SPACING = 2 / (LAYERS - 1)
OPAQUE = 1e5  # per length: one sample hides all behind it


def ramp_scene(points, extinction, level):
    """A view along z into the values' ramp, by steps of 20 values."""
    data = np.broadcast_to(5 * np.arange(LAYERS, dtype=np.uint8), (LAYERS,) * 3)
    volume = jv.Volume(data, [SPACING] * 3, [-1.0] * 3)
    colors = np.tile(np.array(level, np.float32)[:, None] / 255, 3)
    camera = jv.Camera((0.1, 0.2, -9), (0.1, 0.2, 0), (0, 1, 0), 4.0, size=SMALL)
    return volume, jv.TransferFunction(points, colors, extinction), camera, 4 * SPACING


def steps_to_first_sample(scene, kind, seed=0, before=1.0):
    """How many steps past the entry of each ray its first opaque sample lies, behind a transmittance."""
    directions = np.asarray(scene[2].rays()[1], np.float64)
    value = rendered(scene, kind, seed)[..., 0] * 255 / before
    return value / 20 / directions[..., 2]  # the front face is perpendicular to z


def assert_uniform(numbers):
    """Numbers are uniform in [0, 1): with their mean and variance, within four standard deviations, and
    hardly two alike."""
    n = numbers.size
    assert numbers.min() > -1e-3
    assert numbers.max() < 1 + 1e-3
    assert numbers.mean() == pytest.approx(1 / 2, abs=4 * (1 / 12 / n) ** 0.5)
    assert numbers.var() == pytest.approx(1 / 12, abs=4 * (1 / 180 / n) ** 0.5)
    thousandths = np.unique(np.floor(1000 * numbers)).size
    assert thousandths > 0.95 * 1000 * (1 - np.exp(-n / 1000))


def test_each_ray_begins_by_its_own_uniform_part_of_a_step():
    solid = ramp_scene([0, 1, 2, 3, 4, 255], [OPAQUE] * 6, [0, 1, 2, 3, 4, 255])
    for seed in (0, 1):
        assert_uniform(steps_to_first_sample(solid, "jitter", seed))
    # empty-space jitter moves no sample where none is transparent
    np.testing.assert_allclose(steps_to_first_sample(solid, "empty space"), 0, atol=1e-5)


@pytest.mark.parametrize("front", [0, 30])
def test_each_ray_shifts_once_at_its_first_transparent_sample(front):
    """Be that its first sample, or one behind material that it begins in (Kye 2013, Fig. 6)."""
    dense = 5.0 if front else 0.0
    points, level = [0, 30, 30.01, 69.99, 70, 255], [0, 0, 0, 70, 70, 255]
    scene = ramp_scene(points, [dense, dense, 0, 0, OPAQUE, OPAQUE], level)
    directions = np.asarray(scene[2].rays()[1], np.float64)
    seen_through = 2 if front else 0  # samples of 0 and 20
    before = np.exp(-dense * seen_through * scene[3])
    plain = steps_to_first_sample(scene, "", before=before)
    np.testing.assert_allclose(plain, np.ceil(3.5 / directions[..., 2]), atol=1e-4)
    numbers = []
    for seed in (0, 1):
        steps = steps_to_first_sample(scene, "empty space", seed, before)
        assert steps.min() > 3.49
        assert steps.max() < 4.51
        numbers.append(steps % 1)
        assert_uniform(numbers[-1])
    assert abs(np.corrcoef(numbers[0].ravel(), numbers[1].ravel())[0, 1]) < 4 / 64


# -- voxels, without files of data ------------------------------------------------------------------------

SKIN_COLORS = [(0.1, 0.04, 0.03), (0.85, 0.5, 0.35), (0.75, 0.3, 0.22), (0.9, 0.75, 0.6), (1, 0.95, 0.85)]
SKIN_COLORS.append((1, 1, 1))


def skin(values, unit_distance):
    """Air is transparent, all else nearly opaque."""
    opacities = [0, 0.9, 0.9, 0.9, 0.95, 0.95]
    points = list(zip(values, SKIN_COLORS, opacities, strict=True))
    return jv.TransferFunction.from_points(points, unit_distance)


def phantom_head():
    volume = jv.phantom("head", LAYERS)
    camera = jv.Camera.looking_at(volume, (0.5, -1, 0.3), size=SMALL).zoom(3, (0.46, 0.5))
    return volume, skin((40, 78, 100, 130, 185, 255), 0.03), camera, 2 * SPACING


def mr_head():
    """Slices of a head by magnetic resonance, from the tests of nibabel: every second voxel of a slice, and
    each slice twice, which gives the shape of the phantom."""
    path = Path(nibabel.__file__).parent / "tests" / "data" / "example4d.nii.gz"
    if not path.is_file():
        pytest.skip("this nibabel was installed without the data of its tests")
    image: Any = nibabel.load(path)
    data = np.asarray(image.dataobj)[16:112:2, ::2, :, 0].repeat(2, axis=2)
    volume = jv.Volume(np.clip(data // 4, 0, 255).astype(np.uint8), (4.0, 4.0, 1.1))
    camera = jv.Camera.looking_at(volume, (-1, 0.6, 0.1), size=SMALL).zoom(3.6, (0.5, 0.55))
    return volume, skin((30, 60, 90, 120, 150, 255), 1.0), camera, 4.0


MARCHES = {
    "plain": {},
    "lit": {"lighting": Phong()},
    "integrated": {"quadrature": "preintegrated"},
    "leaps and early ends": {"leaps": True, "left": 1 / 255},
}


@pytest.mark.parametrize(("make", "less", "rel"), [(phantom_head, 8, 0.05), (mr_head, 3, 0.25)])
@pytest.mark.parametrize("march", MARCHES)
def test_jitter_breaks_wood_grain_of_voxels_and_leaves_the_error(march, make, less, rel):
    """The slices' surface is bumpy: edges, which count as structure, remain, and the samples of its few rings
    do not lie as evenly as jittered ones."""
    scene, how = make(), MARCHES[march]
    reference = rendered(scene, refined=FINE, **how | {"leaps": False, "left": NEVER})
    before = rendered(scene, **how) - reference
    structure = wood_grain_energy(before)
    assert structure > 0.1 * np.sum(np.var(before, axis=(0, 1)))
    for kind in KINDS:
        for seed in (0, 1):
            error = rendered(scene, kind, seed, **how) - reference
            assert abs(wood_grain_energy(error)) <= structure / less, (kind, seed)
            assert rmse(error, 0 * error) == pytest.approx(rmse(before, 0 * before), rel=rel), (kind, seed)


# -- any scene --------------------------------------------------------------------------------------------

SIZE = (128, 128)
FINE = 16
"""Times by which steps of the references are shorter: they have less than a hundredth of the wood grain."""


def engine(real_volume):
    volume = jv.load(real_volume("engine_256x256x128_uint8.raw.gz"))
    return volume, jv.preset("engine"), jv.Camera.looking_at(volume, size=SIZE).zoom(2), 2.0


def airway(real_volume):
    """A magnified view down the trachea, from inside."""
    volume = jv.load(
        real_volume("lidc0314_airway_256x192x200_int16le.raw.gz"), spacing=(0.78125, 0.78125, 1.0)
    )
    camera = jv.Camera((99.5, 43.7, 182), (99.0, 73.7, 150), (0, 1, 0), 70.0, size=SIZE).zoom(2)
    return volume, jv.preset("ct_airway"), camera, 0.5


@pytest.mark.parametrize("make", [engine, pytest.param(airway, marks=pytest.mark.slow)])
def test_jitter_breaks_wood_grain_in_real_volumes(make, real_volume):
    scene = make(real_volume)
    reference = rendered(scene, refined=FINE)
    before = rendered(scene) - reference
    structure = wood_grain_energy(before)
    # there is wood grain: more than a tenth of the error's variance
    assert structure > 0.1 * np.sum(np.var(before, axis=(0, 1)))
    for kind in KINDS:
        assert abs(wood_grain_energy(rendered(scene, kind) - reference)) <= structure / 10, kind


def cut_head():
    """The head with its face cut off, so that the boundary cuts skin, bone and brain."""
    whole, first = jv.phantom("head", 128), 40
    origin = np.asarray(whole.origin) + np.array([0, first * 2 / 127, 0], np.float32)
    return jv.Volume(np.asarray(whole.data)[:, first:, :], whole.spacing, origin)


@pytest.mark.slow
def test_empty_space_jitter_spares_a_cut_head_and_its_wood_grain_behind_material():
    """Its limitation: a ray that meets no transparent sample is not jittered."""
    volume = cut_head()
    # fine enough for the anatomy on the cut face to be smooth from pixel to pixel
    camera = jv.Camera((0, -3.2, 0.1), (0, 0, 0.1), (0, 0, 1), size=(192, 192), parallel_scale=0.6)
    scene = volume, jv.preset("head", unit_distance=0.01), camera, 2 / 128
    origins = np.asarray(camera.rays()[0], np.float64)
    x, z = (np.round((origins[..., axis] + 1) / (2 / 127)).astype(int) for axis in (0, 2))
    inside = (x >= 0) & (x <= 127) & (z >= 0) & (z <= 127)
    material = np.asarray(volume.data)[np.clip(x, 0, 127), 0, np.clip(z, 0, 127)] > 60
    assert_smooth(scene, inside & material)
    reference = rendered(scene, refined=FINE)
    plain, jitter, spared = (wood_grain_energy(rendered(scene, k) - reference) for k in ("", *KINDS))
    assert abs(jitter) <= plain / 10
    assert 0.5 * plain < spared < 1.1 * plain
