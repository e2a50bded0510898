"""Random numbers of pixels, and the samples that they shift."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.march import Cell
from jaxvol.space import Affine, enter

from ..scenes import anisotropic_noise, around, counting, soft_transfer, uniform_transfer


BOX = jv.Volume(np.ones((5, 5, 5), np.float32), spacing=[0.5] * 3)  # 2 long
STEP = 0.3
SIDE = 128
PIXEL = jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)


@jax.jit
def numbers(noise, origin=(0, 0)):
    """A SIDE x SIDE image of the pixels' random numbers, its first pixel at `origin`."""
    row, column = jnp.meshgrid(jnp.arange(SIDE), jnp.arange(SIDE), indexing="ij")
    return drawn(noise, column + origin[0], row + origin[1])


def drawn(noise, column, row):
    return jnp.vectorize(lambda c, r: noise((c, r), jnp.float32))(column, row)


def spectrum(image):
    """Power spectrum, and its frequencies in cycles per pixel."""
    power = np.abs(np.fft.fft2(image - image.mean())) ** 2
    frequency = np.fft.fftfreq(SIDE)
    return power, np.hypot(*np.meshgrid(frequency, frequency))


@pytest.mark.parametrize("pattern", ["white", "blue"])
@pytest.mark.parametrize("kind", [jv.Jitter, jv.EmptySpaceJitter])
def test_numbers_are_uniform_in_0_1(kind, pattern):
    for seed in range(3):
        image = np.asarray(numbers(kind(seed, pattern).noise))
        assert image.min() >= 0
        assert image.max() < 1
        counts = np.histogram(image, bins=16, range=(0, 1))[0]
        # chi-squared with 15 degrees of freedom exceeds 45 with probability 1e-4
        assert ((counts - SIDE**2 / 16) ** 2 / (SIDE**2 / 16)).sum() < 45


def test_white_numbers_are_independent_of_neighbours_seeds_and_streams():
    image = np.asarray(numbers(jv.Jitter(0).noise))
    others = {
        "next pixel": np.roll(image, 1, axis=1),
        "next row": np.roll(image, 1, axis=0),
        "transposed": image.T,
        "next seed": numbers(jv.Jitter(1).noise),
        "other transform": numbers(jv.EmptySpaceJitter(0).noise),
    }
    for name, other in others.items():
        assert abs(np.corrcoef(image.ravel(), np.ravel(other))[0, 1]) < 0.03, name
    power, frequency = spectrum(image)
    bands = [power[(frequency >= low) & (frequency < low + 0.1)].mean() for low in (0.02, 0.1, 0.2, 0.3, 0.4)]
    np.testing.assert_allclose(bands, np.mean(bands), rtol=0.15)


def test_blue_noise_has_little_energy_in_the_lowest_eighth_of_frequencies():
    def low_energy(pattern):
        power, frequency = spectrum(np.asarray(numbers(jv.Jitter(0, pattern).noise)))
        return power[frequency < 0.5 / 8].sum()

    assert low_energy("blue") < low_energy("white") / 5


def test_a_number_depends_on_seed_and_pixel_alone():
    for pattern in ("white", "blue"):
        noise = jv.Jitter(7, pattern).noise
        whole, part = numbers(noise), numbers(noise, (5, 9))
        np.testing.assert_array_equal(whole[9:, 5:], part[:-9, :-5])
        np.testing.assert_array_equal(whole, numbers(jv.Jitter(7, pattern).noise))
        assert np.abs(np.asarray(whole - numbers(jv.Jitter(8, pattern).noise))).mean() > 0.2


def see(transforms, extinction=1.0, count=200):
    """Render many rays along x through the box."""
    origins = np.tile([-1.0, 1.0, 1.0], (count, 1))
    directions = np.tile([1.0, 0.0, 0.0], (count, 1))
    march = jv.March(STEP, transforms)
    return jv.render_rays(BOX, uniform_transfer(extinction), origins, directions, march)


def parts(transform, count=200):
    place = jnp.arange(count)
    return np.asarray(drawn(transform.noise, place, 0 * place), np.float64)


def test_jitter_starts_each_ray_a_part_of_a_step_in():
    jitter = jv.Jitter(1)
    missing = parts(jitter) * STEP
    np.testing.assert_allclose(
        see((jitter, jv.AlphaCorrection())).rgba[:, 3], 1 - np.exp(missing - 2), atol=1e-6
    )
    cells = np.ceil((2 - missing) / STEP)
    np.testing.assert_array_equal(see((jitter,)).samples, cells)
    np.testing.assert_allclose(see((jitter,)).rgba[:, 3], 1 - np.exp(-cells * STEP), atol=1e-6)


@pytest.mark.parametrize("pattern", [pytest.param("white", marks=pytest.mark.slow), "blue"])
def test_front_residual_gives_back_what_jitter_leaves_out(pattern):
    jitter = jv.Jitter(1, pattern, front_residual=True)
    rendering = see((jitter, jv.AlphaCorrection()))
    np.testing.assert_allclose(rendering.rgba[:, 3], 1 - np.exp(-2), atol=1e-6)
    narrow = parts(jitter) * STEP
    np.testing.assert_array_equal(rendering.samples, 1 + np.ceil((2 - narrow) / STEP))


def test_front_residual_of_an_empty_piece_is_empty():
    """Of one that another transform left before the entry."""
    piece = Cell(jnp.asarray(-0.2), jnp.asarray(0.0), jnp.asarray(False))
    ray = enter(Affine(BOX), apart(jnp.asarray([-1.0, 1, 1])), apart(jnp.asarray([1.0, 0, 0])), PIXEL)
    (cut,) = jv.Jitter(3, front_residual=True).cut(piece, ray, BOX)
    assert float(cut.width) == 0


@pytest.mark.slow
def test_empty_space_jitter_leaves_rays_without_empty_space_alone():
    for field in ("rgba", "samples"):
        np.testing.assert_array_equal(getattr(see((jv.EmptySpaceJitter(1),)), field), getattr(see(()), field))


def test_empty_space_jitter_shortens_one_step_at_the_first_transparent_sample():
    """Material, gaps, material again: samples up to the first gap stay, those behind it are shifted once."""
    data = np.ones((41, 2, 2), np.float32)  # 40 long
    data[10:20] = 0
    data[25:30] = 0
    volume = jv.Volume(data)
    transfer = jv.TransferFunction([0.4999, 0.5], np.ones((2, 3)), [0.0, 0.05])  # visible from 0.5 on
    jitter = jv.EmptySpaceJitter(2)
    count = 50
    rays = np.tile([-1.0, 0.5, 0.5], (count, 1)), np.tile([1.0, 0.0, 0.0], (count, 1))
    march = jv.March(1.0, (jitter, jv.AlphaCorrection()))
    rendering = jv.render_rays(volume, transfer, *rays, march)
    shift = parts(jitter, count)
    # whole steps up to sample 10, the first transparent one, then whole steps from 10 + ξ
    samples = [np.concatenate([np.arange(11.0), np.arange(10 + part, 40)]) for part in shift]
    inside = [np.interp(s, np.arange(41), data[:, 0, 0]) >= 0.5 for s in samples]
    widths = [np.minimum(1, 40 - s) for s in samples]
    opacity = [1 - np.exp(-0.05 * (w * i).sum()) for w, i in zip(widths, inside, strict=True)]
    np.testing.assert_allclose(rendering.rgba[:, 3], opacity, atol=1e-5)
    np.testing.assert_array_equal(rendering.samples, [len(s) for s in samples])


def test_seeds_may_be_keys_and_traced():
    words = {int(jv.Jitter(seed).noise.seed) for seed in (0, 2**32 - 1, np.uint32(7), jnp.asarray(7))}
    assert words == {0, 2**32 - 1, 7}
    for key in (jax.random.key(3), jax.random.PRNGKey(3)):
        drawn = jv.EmptySpaceJitter(key).noise.seed
        assert drawn == jax.random.bits(key, (), jnp.uint32)
    keys = jax.random.split(jax.random.key(0), 3)
    for seeds in (jnp.arange(3), jnp.arange(3, dtype=jnp.uint32), keys, jax.random.key_data(keys)):
        mapped = jax.vmap(lambda seed: jv.Jitter(seed).noise.seed)(seeds)
        np.testing.assert_array_equal(mapped, [jv.Jitter(seed).noise.seed for seed in seeds])
    with pytest.raises(ValueError, match=r"seed must be an integer.*got a traced array .* float32"):
        jax.jit(lambda seed: jv.Jitter(seed).noise.seed)(0.5)


def test_seeds_do_not_compile_again_and_images_differ_by_noise_alone():
    Counting = counting()
    volume = anisotropic_noise()
    transfer = Counting(*jax.tree.leaves(soft_transfer()))
    camera = around(volume)
    images = [
        np.asarray(jv.render(volume, transfer, camera, jv.March(0.07, (jv.Jitter(seed),))).rgba)
        for seed in range(8)
    ]
    assert Counting.traces == 1
    assert np.abs(images[0] - images[1]).max() > 1e-3
    exact = np.asarray(jv.render(volume, transfer, camera, jv.March(0.002)).rgba)
    single = np.sqrt(np.mean((images[0] - exact) ** 2))
    assert np.sqrt(np.mean((np.mean(images, axis=0) - exact) ** 2)) < 0.6 * single


BAD = {
    "negative seed": (lambda: jv.Jitter(-1), "seed must be an integer from 0 to 4294967295.*; got -1"),
    "33 bits": (lambda: jv.Jitter(2**32), "or a key of jax.random; got 4294967296"),
    "two seeds": (lambda: jv.Jitter([1, 2]), "seed must be an integer .*; got a list"),
    "two keys": (lambda: jv.Jitter(jax.random.split(jax.random.key(0))), r"seed must .* of shape \(2,\)"),
    "half a seed": (lambda: jv.EmptySpaceJitter(0.5), "seed must be an integer"),
    "pattern": (lambda: jv.Jitter(0, "pink"), 'pattern must be "white" or "blue"; got \'pink\''),
    "twice": (lambda: jv.March(0.1, (jv.Jitter(0), jv.Jitter(1))), "got Jitter 2 times"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("pattern", ["white", pytest.param("blue", marks=pytest.mark.slow)])
def test_a_crop_is_jittered_as_its_part_of_the_image(pattern):
    volume = jv.phantom("sphere", 16)
    transfer = jv.TransferFunction.from_points([(0, (0, 0, 0), 0.0), (255, (1, 1, 1), 0.9)], 0.5)
    camera = jv.Camera.looking_at(volume, size=(24, 20))
    march = jv.March(0.1, (jv.Jitter(3, pattern),))
    whole = jv.render(volume, transfer, camera, march).rgba
    part = jv.render(volume, transfer, camera.crop(9, 5, 11, 8), march).rgba
    np.testing.assert_allclose(part, whole[5:13, 9:20], atol=1e-6)
    again = jv.render(volume, transfer, camera.crop(4, 2, 18, 14).crop(5, 3, 11, 8), march).rgba
    np.testing.assert_allclose(again, part, atol=1e-6)
