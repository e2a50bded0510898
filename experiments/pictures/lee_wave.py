"""Snell's law between two media (Lee, Kwon and Shin 2016, Fig. 5 and Equation 6): how are the photons of a
template distributed where another, denser medium begins near the sample?

Each photon is moved by the library itself, as an image has it: `PhotonShading.refracted`, at a sample beside
the plane between a medium A and a medium B. Wave fronts are photons evenly around the sample.
"""

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol._util.vec3 import Vec3, apart
from jaxvol.lighting import DirectionalLight, ScattererTemplate, ScattererTemplates, scatterer_template
from jaxvol.lighting.photons import PhotonShading
from jaxvol.lighting.shading import Sample, Surroundings
from jaxvol.scene.space import Affine

from ..scenes import on_cube


INDICES = (1.02, 1.4)
"""Of A and B: their ratio, 0.7286, is that of the paper's example."""
PLANE = 0.15
"""Where B begins, along x; the sample is at the origin, and the cube reaches from -1 to 1."""
FRONTS = np.arange(0.1, 0.75, 0.1)
AROUND = 240
FREE_PATH = 0.12


class Wave(NamedTuple):
    """Places (n, 2), in the plane z = 0, before and after refraction, and whether the place before is in B.
    `fronts`: (fronts, AROUND, 2); `photons`: of a template, with their `intensity`."""

    fronts: np.ndarray
    moved_fronts: np.ndarray
    photons: np.ndarray
    moved_photons: np.ndarray
    intensity: np.ndarray


def moved(offset: np.ndarray) -> np.ndarray:
    """Where photons at these offsets from the sample count, (n, 3)."""
    x = np.broadcast_to(np.linspace(-1, 1, 81)[:, None, None], (81, 81, 81))
    volume = on_cube((1.5 + np.clip((x - PLANE) / 0.05, -0.5, 0.5)).astype(np.float32))
    transfer = jv.TransferFunction([0.0, 2.0], [(0.5, 0.5, 0.5)] * 2, [1.0, 1.0])
    a, b = (
        jv.Material(0.5, FREE_PATH, n, values=v)
        for n, v in zip(INDICES, [(0.5, 1.5), (1.5, 2.5)], strict=True)
    )
    nothing = ScattererTemplate(jnp.zeros((2, 1, 1, 3)), jnp.zeros((2, 1, 1)))
    lighting = ScattererTemplates([a, b], DirectionalLight((1, 0, 0)), given=nothing, occlusion="hard")
    around = Surroundings(volume, transfer, Affine(volume))
    shading = lighting.for_image(around)
    assert isinstance(shading, PhotonShading)
    origin, zero = apart(jnp.zeros(3)), jnp.zeros((), jnp.int32)
    measured = around.classification.at(around.space.coordinate(origin))
    classified, extinction = around.classification.classify(measured)
    color = cast(Vec3, classified)
    sample = Sample(origin, origin, measured, color, extinction, jnp.ones(()), (zero, zero))
    shared = shading.begin(around, sample)

    @jax.jit
    @jax.vmap
    def refracted(offset: jax.Array) -> jax.Array:
        return jnp.stack(shading.refracted(around, sample, shared, apart(offset))[0])

    return np.asarray(refracted(jnp.asarray(offset, jnp.float32)))


def wave(seed: int = 0) -> Wave:
    """Fronts of equal travel time, and the photons of a template grown in A."""
    angle = np.linspace(0, 2 * np.pi, AROUND)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(AROUND)], axis=-1)
    fronts = FRONTS[:, None, None] * circle
    material = jv.Material(0.5, FREE_PATH, INDICES[0])
    template = scatterer_template(material, seed, packets=16, threshold_on="level", threshold=0.0005)
    photons, intensity = np.asarray(template.offset), np.asarray(template.intensity)
    photons = photons[intensity > 0]
    both = moved(np.concatenate([fronts.reshape(-1, 3), photons]))
    of_fronts, of_photons = both[: fronts.size // 3], both[fronts.size // 3 :]
    return Wave(
        fronts[..., :2],
        of_fronts.reshape(fronts.shape)[..., :2],
        photons[:, :2],
        of_photons[:, :2],
        intensity[intensity > 0],
    )
