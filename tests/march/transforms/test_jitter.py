"""Random numbers of pixels, and the samples that they shift. (`test_agreement` has their images.)"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.engine.rays import lines
from jaxvol.march.march import Cell
from jaxvol.scene.space import Affine, enter

from ... import oracle
from ...scenes import around, random_numbers


EXAMPLES = {
    "jitter": lambda values: jv.Jitter(values.seed),
    "residual": lambda values: jv.Jitter(values.seed, "blue", front_residual=True),
    "shift": lambda values: jv.EmptySpaceJitter(values.seed),
}


def jittered(jitter, camera):
    """The first sample lies so many steps past the entry; a front residual is a cell of its own before it."""
    numbers = random_numbers(jitter, camera)
    if not jitter.front_residual:
        return oracle.Meaning(start=numbers)
    return oracle.Meaning(
        start=numbers - 1, cut=lambda begin, end, rays: [(np.maximum(begin, rays.t_in), end)]
    )


def shifted(jitter, camera):
    return oracle.Meaning(jump=random_numbers(jitter, camera))


MEANINGS = {jv.Jitter: jittered, jv.EmptySpaceJitter: shifted}
BOX = jv.Volume(np.ones((5, 5, 5), np.float32), spacing=[0.5] * 3)  # 2 long
SIDE = 128


@jax.jit
def numbers(noise, origin=(0, 0)):
    """A SIDE x SIDE image of the pixels' random numbers, its first pixel at `origin`."""
    row, column = jnp.meshgrid(jnp.arange(SIDE), jnp.arange(SIDE), indexing="ij")
    return jnp.vectorize(lambda c, r: noise((c, r), jnp.float32))(column + origin[0], row + origin[1])


def image(jitter, origin=(0, 0)):
    return np.asarray(numbers(jitter.noise, origin))


def spectrum(image):
    """Power spectrum, and its frequencies in cycles per pixel."""
    power = np.abs(np.fft.fft2(image - image.mean())) ** 2
    return power, np.hypot(*np.meshgrid(*[np.fft.fftfreq(SIDE)] * 2))


@pytest.mark.parametrize("pattern", ["white", "blue"])
def test_numbers_are_uniform_and_depend_on_seed_stream_and_pixel_alone(pattern):
    for kind in (jv.Jitter, jv.EmptySpaceJitter):
        for seed in range(3):
            drawn = image(kind(seed, pattern))
            assert drawn.min() >= 0
            assert drawn.max() < 1
            counts = np.histogram(drawn, bins=16, range=(0, 1))[0]
            # chi-squared with 15 degrees of freedom exceeds 45 with probability 1e-4
            assert ((counts - SIDE**2 / 16) ** 2 / (SIDE**2 / 16)).sum() < 45
    whole, part = image(jv.Jitter(7, pattern)), image(jv.Jitter(7, pattern), (5, 9))
    np.testing.assert_array_equal(whole[9:, 5:], part[:-9, :-5])
    for other in (jv.Jitter(8, pattern), jv.EmptySpaceJitter(7, pattern)):
        assert np.abs(whole - image(other)).mean() > 0.2


def test_white_numbers_are_independent_and_blue_ones_have_no_low_frequencies():
    white = image(jv.Jitter(0))
    others = {
        "next pixel": np.roll(white, 1, axis=1),
        "next row": np.roll(white, 1, axis=0),
        "transposed": white.T,
        "next seed": image(jv.Jitter(1)),
        "other transform": image(jv.EmptySpaceJitter(0)),
    }
    for name, other in others.items():
        assert abs(np.corrcoef(white.ravel(), other.ravel())[0, 1]) < 0.03, name
    power, frequency = spectrum(white)
    bands = [power[(frequency >= low) & (frequency < low + 0.1)].mean() for low in (0.02, 0.1, 0.2, 0.3, 0.4)]
    np.testing.assert_allclose(bands, np.mean(bands), rtol=0.15)
    lowest = frequency < 0.5 / 8
    assert spectrum(image(jv.Jitter(0, "blue")))[0][lowest].sum() < power[lowest].sum() / 5


@jax.jit
def of_pixels(transforms):
    """Start, shift, and first two cells of 200 rays along x through the box, at a step of 0.3; what is left
    of an empty piece before the entry."""

    def one(column):
        line = apart(jnp.array([-1.0, 1, 1])), apart(jnp.array([1.0, 0, 0])), (column, jnp.int32(0))
        ray, march = enter(Affine(BOX), *line), jv.March(0.3, transforms)
        start = march.start(ray)
        no = jnp.zeros((), bool)
        cells = [march.cut(Cell((start + i) * march.step, march.step, no), ray, BOX)[0] for i in range(2)]
        (nothing,) = transforms[0].cut(Cell(jnp.asarray(-0.2), jnp.asarray(0.0), no), ray, BOX)
        return start, march.shift(ray), [(cell.front, cell.width) for cell in cells], nothing.width

    return jax.vmap(one)(jnp.arange(200))


def parts(jitter):
    """The random numbers of the first 200 pixels of row 0, in two rows of SIDE."""
    return np.concatenate([image(jitter)[0], image(jitter, (SIDE, 0))[0]])[:200].astype(float)


def test_jitter_starts_a_part_of_a_step_in_and_empty_space_jitter_shifts_by_one():
    jitter, empty = jv.Jitter(1), jv.EmptySpaceJitter(2)
    start, shift, cells, _ = of_pixels((jitter, empty))
    np.testing.assert_allclose(start, parts(jitter), atol=1e-7)
    np.testing.assert_allclose(shift, parts(empty) - 1, atol=1e-7)
    np.testing.assert_allclose(cells[0], [0.3 * parts(jitter), np.full(200, 0.3)], atol=1e-6)


def test_front_residual_is_a_narrow_cell_of_its_own():
    jitter = jv.Jitter(1, "blue", front_residual=True)
    _, _, (first, second), left_of_nothing = of_pixels((jitter,))
    narrow = 0.3 * parts(jitter)
    np.testing.assert_allclose(first, [0 * narrow, narrow], atol=1e-6)
    np.testing.assert_allclose(second, [narrow, np.full(200, 0.3)], atol=1e-6)
    # of an empty piece, which another transform left before the entry, nothing is left
    assert not np.any(left_of_nothing)


def test_seeds_may_be_keys_and_traced():
    words = {int(jv.Jitter(seed).noise.seed) for seed in (0, 2**32 - 1, np.uint32(7), jnp.asarray(7))}
    assert words == {0, 2**32 - 1, 7}

    @jax.jit
    def of_keys():
        """Seeds of keys, and what they are; of several at once, and of each."""
        both = jax.random.key(3), jax.random.PRNGKey(3)
        own = [(jv.EmptySpaceJitter(key).noise.seed, jax.random.bits(key, (), jnp.uint32)) for key in both]
        several = jnp.arange(3), jax.random.split(jax.random.key(0), 3)
        seed_of = lambda seed: jv.Jitter(seed).noise.seed  # noqa: E731
        return own + [(jax.vmap(seed_of)(seeds), jnp.stack([*map(seed_of, seeds)])) for seeds in several]

    for found, expected in of_keys():
        np.testing.assert_array_equal(found, expected)
    with pytest.raises(ValueError, match=r"seed must be an integer.*got a traced array .* float32"):
        jax.jit(lambda seed: jv.Jitter(seed).noise.seed)(0.5)


def test_a_crop_has_the_rays_and_the_pixels_of_its_part_of_the_image():
    """So that it is jittered as this part is."""
    camera = around(BOX, (24, 20))
    row, column = jax.device_put([*np.mgrid[:8, :11].astype(np.int32)])

    @jax.jit
    def rays():
        crops = (9, 5, camera.crop(9, 5, 11, 8)), (5, 4, camera.crop(4, 2, 18, 14).crop(1, 2, 11, 8))
        seen = lambda camera, x, y: lines(camera, x, y, jnp.zeros((), bool))  # noqa: E731
        return [(seen(part, column, row), seen(camera, column + x, row + y)) for x, y, part in crops]

    for found, expected in rays():
        np.testing.assert_array_equal(found.pixel, expected.pixel)
        np.testing.assert_allclose(found.direction, expected.direction, atol=1e-6)


BAD = {
    "negative seed": (lambda: jv.Jitter(-1), "seed must be an integer from 0 to 4294967295.*; got -1"),
    "33 bits": (lambda: jv.Jitter(2**32), "or a key of jax.random; got 4294967296"),
    "two seeds": (lambda: jv.Jitter([1, 2]), "seed must be an integer .*; got a list"),
    "half a seed": (lambda: jv.EmptySpaceJitter(0.5), "seed must be an integer"),
    "pattern": (lambda: jv.Jitter(0, "pink"), 'pattern must be "white" or "blue"; got \'pink\''),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()
