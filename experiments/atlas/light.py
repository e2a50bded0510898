"""Where does light fail? Templates of printed energy, of few packets, of long and short mean free paths;
shading of noise."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.lighting import (
    ConstantLight,
    DirectionalLight,
    Phong,
    ScattererTemplates,
    scatterer_templates,
)

from ..printed_templates import printed_templates
from ..scenes import grid, on_cube
from .entry import colors, entry, grey, rms


@entry(
    "jaxvol.scatterer_template",
    "opacity α",
    (0.1, 0.3, 0.45, 0.55, 0.7, 0.8),
    "energy of a template that begins with 1",
    "printed, without flights",
    limit=1.0,
)
def energy_of_templates_as_printed(opacity: float, size: int) -> dict[str, float]:
    """At which opacity does a template hold more light than it was given?

    Equations (1) to (3) of the paper, to the letter, pass on α I where (1 - α) I is left: without the factors
    of flight, energy grows as α / (1 - α). jaxvol's form, conserving, never exceeds 1."""
    material = jv.Material(opacity, 1.0)
    forms = {
        "printed, without flights": printed_templates(material, 0, count=8, merge=0.0, flights=False),
        "printed": printed_templates(material, 0, count=8, merge=0.0),
        "conserving": scatterer_templates(material, 0, count=8, merge=0.0),
    }
    found = {name: float(jnp.mean(jnp.sum(each.intensity, axis=-1))) for name, each in forms.items()}
    return {**found, "α / (1 - α)": opacity / (1 - opacity)}


@entry(
    "jaxvol.scatterer_template",
    "packets",
    (16.0, 8.0, 4.0, 3.0, 2.0, 1.0),
    "distance of the centre of light from the sample, mean free paths",
    "one template",
    limit=1.0,
)
def lopsided_templates(packets: float, size: int) -> dict[str, float]:
    """How many packets does a template need not to lean to one side?

    One packet goes one way, and so does all that comes of it. By default there are four, spread evenly, which
    still lean by 0.6 mean free paths at an opacity of 0.4; blending templates takes off most of that."""
    templates = scatterer_templates(jv.Material(0.4, 1.0), 0, count=32, packets=int(packets))
    light = np.asarray(templates.intensity, np.float64)
    middle = np.einsum("mtn,mtnk->mtk", light, np.asarray(templates.offset)) / light.sum(-1, keepdims=True)
    return {
        "one template": float(np.mean(np.linalg.norm(middle, axis=-1))),
        "blend of 32": float(np.linalg.norm(middle.mean(axis=1))),
    }


RADIUS = 0.7
LIGHTS = DirectionalLight((0.8, 0.5, -0.6), (2.0, 2.0, 2.0)), ConstantLight((0.15, 0.15, 0.15))


@cache
def _ball() -> jv.Volume:
    away = np.sqrt(sum(part**2 for part in grid(32)))
    return on_cube(np.clip((RADIUS - away) * 15.5 + 0.5, 0, 1).astype(np.float32))


@cache
def ball(ratio: float, size: int, *, traced: bool) -> np.ndarray:
    """A white ball whose mean free path is `ratio` times its diameter."""
    path = 2 * RADIUS * ratio
    material = jv.Material(0.2, path, 1.0)
    camera = jv.Camera((0.0, -4.0, 1.0), (0, 0, 0), (0, 0, 1), 26, size=(size, size))
    transfer = jv.TransferFunction([0.4, 0.6], np.ones((2, 3)), [0.0, 1 / path])
    if traced:
        how = {"paths": 32, "key": 0, "materials": material}
        return np.asarray(jv.path_trace(_ball(), transfer, camera, LIGHTS, **how).radiance, np.float64)
    lighting = ScattererTemplates(material, LIGHTS, templates=2, photons=16, levels=4, blend=True)
    march = jv.March(1 / 24, (jv.AlphaCorrection(),), "midpoint")
    return colors(_ball(), transfer, camera, march, lighting=lighting)


def balls(ratio: float, size: int) -> dict[str, float]:
    seen, exact = (ball(ratio, size, traced=traced) for traced in (False, True))
    return {
        "total radiance": float(abs(np.log2(seen.sum() / exact.sum()))),
        "pixels, scaled alike": rms(seen * exact.sum() / seen.sum() - exact) / rms(exact),
    }


def ball_picture(ratio: float, size: int) -> np.ndarray:
    """Templates on the left, path tracing on the right; both as bright as the brightest of the latter."""
    size = max(size, 96)
    seen, exact = (ball(ratio, size, traced=traced) for traced in (False, True))
    white = np.quantile(exact, 0.995)
    return np.concatenate([seen, exact], axis=1) / white


@entry(
    "jaxvol.lighting.ScattererTemplates",
    "mean free path / diameter of a ball",
    (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 50.0),
    "difference from path tracing (radiance: powers of 2)",
    "pixels, scaled alike",
    limit=0.25,
    picture=ball_picture,
    shows="templates, and path tracing beside them, as bright as the brighter of both in the latter",
    size=48,
)
def long_mean_free_paths(ratio: float, size: int) -> dict[str, float]:
    """How long may a mean free path be, against an object, for templates to light it as path tracing does?

    The sum of all radiance stays near that of path tracing. But photons of a template lie outside a ball that
    is thin against the mean free path, on all sides alike, so that its lit side is no longer where it was."""
    return balls(ratio, size)


@entry(
    "jaxvol.lighting.ScattererTemplates",
    "mean free path / diameter of a ball",
    (1.0, 0.5, 0.2, 0.1, 0.05, 0.03),
    "difference from path tracing (radiance: powers of 2)",
    "total radiance",
    limit=0.35,
    picture=ball_picture,
    shows="templates, and path tracing beside them, as bright as the brighter of both in the latter",
    size=32,
)
def short_mean_free_paths(ratio: float, size: int) -> dict[str, float]:
    """How short may a mean free path be, against an object, for templates to be as bright as path tracing is?

    A sphere of white matter is too dark by a quarter to a third, once it is several mean free paths thick:
    the template of a sample near a curved face has more photons outside than on the flat one that set its
    scale."""
    return balls(ratio, size)


PATH = 0.1
"""A mean free path, in a cube of side 2."""
ROOF = 0.15
"""Distance of a roof from the ground under it."""


@cache
def ground(roof: float) -> jv.Volume:
    """Ground under z = 0, below a roof of this thickness, if any."""
    z = grid(128)[2]
    sheet = np.abs(z - ROOF - roof / 2) <= roof / 2
    return on_cube((np.clip(0.5 - 63.5 * z, 0, 1) + sheet).astype(np.float32))


def lit_ground(size: int, roof: float = 0.0, **options: Any) -> np.ndarray:
    """Radiance of the ground, seen from under the roof and lit from above it."""
    lights = DirectionalLight((0.0, 0.0, -1.0), (1.0, 1.0, 1.0))
    options = {
        "levels": 4,
        "packets": 4,
        "threshold_on": "level",
        "occlusion": "hard",
        "cutoff": 0.02,
    } | options
    lighting = ScattererTemplates(jv.Material(0.5, PATH, 1.0), lights, **options)
    transfer = jv.TransferFunction([0.4, 0.6], np.ones((2, 3)), [0.0, 100.0])
    camera = jv.Camera((0, 0, ROOF / 2), (0, 0, -1), (0, 1, 0), size=(size, size), parallel_scale=0.3)
    return colors(ground(roof), transfer, camera, jv.March(1 / 64), lighting=lighting)[..., 0]


TESTS = {
    "at the photon alone": (1.0001,),
    "reach = 2, 4": (2.0, 4.0),
    "reach = 1.25 to 4": (1.25, 1.5, 2.0, 3.0, 4.0),
}


@entry(
    "jaxvol.lighting.ScattererTemplates",
    "thickness of a roof / mean free path",
    (4.0, 2.0, 1.0, 0.5, 0.25),
    "light that passes an opaque roof / light without it",
    "reach = 2, 4",
    limit=0.05,
    size=8,
)
def thin_parts_between_tests(ratio: float, size: int) -> dict[str, float]:
    """How thin may a part be that hides photons, for `reach` to find it?

    Occlusion is tested at multiples of a photon's offset. A part that lies between two of them hides nothing,
    and a photon tested at its own place alone is hidden by nothing else. Measured beside a thick roof that is
    tested densely."""
    blended = {"templates": 8, "blend": True}
    bare, thick = (
        lit_ground(size, roof, **blended, reach=TESTS["reach = 1.25 to 4"]).mean() for roof in (0.0, 0.4)
    )
    light = {n: lit_ground(size, ratio * PATH, **blended, reach=reach).mean() for n, reach in TESTS.items()}
    return {name: float((passed - thick) / bare) for name, passed in light.items()}


@entry(
    "jaxvol.lighting.ScattererTemplates",
    "templates of a material",
    (1.0, 2.0, 4.0, 8.0, 16.0),
    "noise on flat ground / mean",
    "one for each pixel",
    limit=0.05,
    picture=lambda templates, size: grey(lit_ground(size, templates=int(templates)) * 2),
    shows="flat ground, lit by one template for each pixel",
    size=24,
)
def one_template_for_each_pixel(templates: float, size: int) -> dict[str, float]:
    """From how many templates may each pixel take one before their choice shows as noise?

    From a single one. A template is lopsided, so that neighbouring pixels differ by how two templates lean;
    more templates do not lower that. `blend=True` uses all for every sample, as the paper does against
    noise."""
    noise = {
        "one for each pixel": lit_ground(size, templates=int(templates)),
        "blended": lit_ground(size, templates=int(templates), blend=True),
    }
    return {name: float(image.std() / image.mean()) for name, image in noise.items()}


SIDE = 32
RISE = 10.0
"""Value units per voxel, at the surface."""


def noisy_ball(noise: float) -> jv.Volume:
    """A ball whose values fall by `RISE` per voxel from its middle, on [-1, 1]³. The noise has this standard
    deviation, in units of the rise per voxel."""
    axis, random = np.arange(SIDE) - (SIDE - 1) / 2, np.random.default_rng(0).normal(size=(SIDE,) * 3)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    data = RISE * (SIDE / 3 - np.sqrt(x**2 + y**2 + z**2) + noise * random)
    return on_cube(data.astype(np.float32))


def noise_picture(noise: float, size: int) -> np.ndarray:
    volume = noisy_ball(noise)
    transfer = jv.TransferFunction([-10.0, 10.0], np.ones((2, 3)), [0.0, 60.0])
    camera = jv.Camera.looking_at(volume, (0.5, -0.9, 0.4), size=(size, size)).zoom(1.6)
    march = jv.March(0.02, (jv.SpaceLeaping(), jv.EarlyTermination(1e-3)))
    return colors(volume, transfer, camera, march, lighting=Phong())


@entry(
    "jaxvol.lighting.Phong",
    "noise, standard deviation / rise of values per voxel",
    (0.01, 0.03, 0.1, 0.3, 1.0, 3.0),
    "mean angle between a normal and that without noise, degrees",
    "angle",
    limit=10.0,
    picture=noise_picture,
    shows="the ball, under a head light",
    pictured=(0.1, 1.0),
)
def normals_in_noise(noise: float, size: int) -> dict[str, float]:
    """How much noise may values have before the normals of a surface are lost?

    A central difference of noise is as large as that of a rise of 0.7 standard deviations per voxel;
    interpolation halves it. Angles grow by some 28 degrees times the ratio, up to the 57 of random normals:
    what is nearly homogeneous is shaded by its noise. Smooth such volumes."""
    outward = np.random.default_rng(1).normal(size=(4096, 3))
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    points = jnp.asarray((SIDE - 1) / 2 + SIDE / 3 * outward, jnp.float32)
    volume = noisy_ball(noise)

    @jax.jit
    @jax.vmap
    def gradient(at: jax.Array) -> jax.Array:
        return jnp.stack(volume.gradient((at[0], at[1], at[2])))

    found = np.asarray(gradient(points), np.float64)
    cosine = np.abs(np.sum(found * outward, axis=-1)) / np.linalg.norm(found, axis=-1)
    return {"angle": float(np.rad2deg(np.mean(np.arccos(np.minimum(cosine, 1)))))}
