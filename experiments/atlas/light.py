"""Where do scatterer templates fail? Printed energy, few packets, long and short mean free paths."""

from functools import cache

import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.lighting import ConstantLight, DirectionalLight, ScattererTemplates, scatterer_templates

from ..printed_templates import printed_templates
from .entry import Entry, colors


COUNT = 8
"""Templates over which numbers are averaged."""


# -- energy as printed ------------------------------------------------------------------------------------


def energy(opacity: float, size: int) -> dict[str, float]:
    material = jv.Material(opacity, 1.0)
    forms = {
        "printed, without flights": printed_templates(material, 0, count=COUNT, merge=0.0, flights=False),
        "printed": printed_templates(material, 0, count=COUNT, merge=0.0),
        "conserving": scatterer_templates(material, 0, count=COUNT, merge=0.0),
    }
    found = {name: float(jnp.mean(jnp.sum(each.intensity, axis=-1))) for name, each in forms.items()}
    return {**found, "α / (1 - α)": opacity / (1 - opacity)}


ENERGY = Entry(
    name="energy of templates as printed",
    question="At which opacity does a template hold more light than it was given?",
    method="jaxvol.scatterer_template",
    regime="opacity α",
    values=(0.1, 0.3, 0.45, 0.55, 0.7, 0.8),
    measure=energy,
    metric="energy of a template that begins with 1",
    judged="printed, without flights",
    limit=1.0,
    does="Equations (1) to (3) of the paper, to the letter, pass on α I where (1 - α) I is left: without the "
    "factors of flight, energy grows as α / (1 - α). jaxvol's form, conserving, never exceeds 1.",
    scales=("linear", "log"),
)


# -- few packets ------------------------------------------------------------------------------------------


def lopsided(packets: float, size: int) -> dict[str, float]:
    templates = scatterer_templates(jv.Material(0.4, 1.0), 0, count=32, packets=int(packets))
    light = np.asarray(templates.intensity, np.float64)
    middle = np.einsum("mtn,mtnk->mtk", light, np.asarray(templates.offset)) / light.sum(
        axis=-1, keepdims=True
    )
    return {
        "one template": float(np.mean(np.linalg.norm(middle, axis=-1))),
        "blend of 32": float(np.linalg.norm(middle.mean(axis=1))),
    }


LOPSIDED = Entry(
    name="lopsided templates",
    question="How many packets does a template need not to lean to one side?",
    method="jaxvol.scatterer_template",
    regime="packets",
    values=(16.0, 8.0, 4.0, 3.0, 2.0, 1.0),
    measure=lopsided,
    metric="distance of the centre of light from the sample, mean free paths",
    judged="one template",
    limit=1.0,
    does="One packet goes one way, and so does all that comes of it. By default there are four, spread "
    "evenly, which still lean by 0.6 mean free paths at an opacity of 0.4; blending templates takes "
    "off most of that.",
)


# -- mean free paths far from an object's size ------------------------------------------------------------

RADIUS = 0.7
LIGHTS = DirectionalLight((0.8, 0.5, -0.6), (2.0, 2.0, 2.0)), ConstantLight((0.15, 0.15, 0.15))
WHITE = (1.0, 1.0, 1.0)


@cache
def _ball() -> jv.Volume:
    line = np.linspace(-1, 1, 32)
    away = np.sqrt(sum(part**2 for part in np.meshgrid(line, line, line, indexing="ij")))
    return jv.Volume(np.clip((RADIUS - away) * 15.5 + 0.5, 0, 1).astype(np.float32), [2 / 31] * 3, [-1.0] * 3)


@cache
def ball(ratio: float, size: int, *, traced: bool, paths: int = 32) -> np.ndarray:
    """A white ball whose mean free path is `ratio` times its diameter."""
    path = 2 * RADIUS * ratio
    material = jv.Material(0.2, path, 1.0)
    camera = jv.Camera((0.0, -4.0, 1.0), (0, 0, 0), (0, 0, 1), 26, size=(size, size))
    transfer = jv.TransferFunction([0.4, 0.6], [WHITE, WHITE], [0.0, 1 / path])
    if traced:
        image = jv.path_trace(
            _ball(), transfer, camera, LIGHTS, paths=paths, key=0, materials=material
        ).radiance
        return np.asarray(image, np.float64)
    lighting = ScattererTemplates(material, LIGHTS, templates=2, photons=16, levels=4, blend=True)
    march = jv.March(1 / 24, (jv.AlphaCorrection(),), "midpoint")
    return colors(_ball(), transfer, camera, march, lighting=lighting)


def balls(ratio: float, size: int) -> dict[str, float]:
    seen, exact = (ball(ratio, size, traced=traced) for traced in (False, True))
    return {
        "total radiance": float(abs(np.log2(seen.sum() / exact.sum()))),
        "pixels, scaled alike": float(
            np.sqrt(np.mean((seen * exact.sum() / seen.sum() - exact) ** 2)) / np.sqrt(np.mean(exact**2))
        ),
    }


def ball_picture(ratio: float, size: int) -> np.ndarray:
    """Templates on the left, path tracing on the right; both as bright as the brightest of the latter."""
    size = max(size, 96)
    seen, exact = (ball(ratio, size, traced=traced) for traced in (False, True))
    white = np.quantile(exact, 0.995)
    return np.concatenate([seen, exact], axis=1) / white


LONG = Entry(
    name="long mean free paths",
    question="How long may a mean free path be, against an object, for templates to light it as path tracing "
    "does?",
    method="jaxvol.lighting.ScattererTemplates",
    regime="mean free path / diameter of a ball",
    values=(0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 50.0),
    measure=balls,
    metric="difference from path tracing (radiance: powers of 2)",
    judged="pixels, scaled alike",
    limit=0.25,
    does="The sum of all radiance stays near that of path tracing. But photons of a template lie outside a "
    "ball that is thin against the mean free path, on all sides alike, so that its lit side is no "
    "longer where it was.",
    picture=ball_picture,
    shows="templates, and path tracing beside them, as bright as the brighter of both in the latter",
    size=48,
)

SHORT = Entry(
    name="short mean free paths",
    question="How short may a mean free path be, against an object, for templates to be as bright as path "
    "tracing is?",
    method="jaxvol.lighting.ScattererTemplates",
    regime="mean free path / diameter of a ball",
    values=(1.0, 0.5, 0.2, 0.1, 0.05, 0.03),
    measure=balls,
    metric="difference from path tracing (radiance: powers of 2)",
    judged="total radiance",
    limit=0.35,
    does="A sphere of white matter is too dark by a quarter to a third, once it is several mean free paths "
    "thick: the template of a sample near a curved face has more photons outside than on the flat one "
    "that set its scale.",
    picture=ball_picture,
    shows="templates, and path tracing beside them, as bright as the brighter of both in the latter",
    size=32,
)

ENTRIES = (ENERGY, LOPSIDED, LONG, SHORT)
