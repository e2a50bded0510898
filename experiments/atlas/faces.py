"""Where do faces fail? Those that the box cuts, those of labels, and those behind what is cut out."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxvol as jv
from jaxvol.metrics import boundary_noise

from ..scenes import on_cube
from .entry import along_z, colors, cube, entry, opacities, ray_opacities, rms, signed, uniform


@cache
def cut_block(resolution: int = 64) -> jv.Volume:
    return jv.phantom("cut_block", resolution)


def cut_face(step: float, size: int, jitter: str) -> np.ndarray:
    """Image of the cut block from its cut face, for a step in voxels."""
    shade = np.tile(np.array([0.3, 0.33, 0.33, 0.9])[:, None], 3)
    transfer = jv.TransferFunction([0.0, 0.04999, 0.05, 1.0], shade, [0.0, 0.0, 1.5, 30.0])
    march = jv.March(step * float(cut_block().spacing[0]), (JITTERS[jitter], jv.AlphaCorrection()))
    return colors(cut_block(), transfer, along_z(size), march)


JITTERS = {
    "Jitter": jv.Jitter(0),
    "Jitter, front residual": jv.Jitter(0, front_residual=True),
    "EmptySpaceJitter": jv.EmptySpaceJitter(0),
}


@entry(
    "jaxvol.Jitter",
    "step, voxels",
    (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0),
    "noise on the face, standard deviation",
    "Jitter",
    picture=lambda step, size: cut_face(step, size, "Jitter"),
    shows="the block under Jitter; its left half is the cut face",
    size=64,
)
def jitter_on_cut_faces(step: float, size: int) -> dict[str, float]:
    """From which step on does Jitter show as noise where the box cuts material?

    Jitter leaves out the first ξ d of the material. With front_residual the noise is smaller; under
    EmptySpaceJitter, rays on the face are not shifted before they leave the material, and it stays smooth."""
    on_face = np.asarray(along_z(size).rays()[0])[..., 0] < -0.05
    return {name: float(np.sqrt(boundary_noise(cut_face(step, size, name), on_face) / 3)) for name in JITTERS}


@cache
def halves(side: int = 9) -> jv.Volume:
    """Label 1 in the far half of the cube, 0 in the near one; the face between them lies at z = -1/8."""
    labels = np.zeros((side,) * 3, np.uint8)
    labels[:, :, side // 2 :] = 1
    with jax.ensure_compile_time_eval():  # kept, although it may be made inside `jax.jit`
        return on_cube(np.ones((side,) * 3, np.float32), labels)


NEAR, FAR = 0.875, 1.125
"""Thickness of label 0, in front, and of label 1, behind it."""


def label_face(depth: float, size: int, *, cut: bool) -> np.ndarray:
    """Error of the opacity of the far half, of extinction 1, for steps of this optical depth."""
    transfer = jv.LabelTransferFunction([None, uniform(1.0)])
    march = jv.March(depth, (jv.EmptySpaceJitter(0), jv.AlphaCorrection(labels=cut)))
    return opacities(halves(), transfer, along_z(size), march) - (1 - np.exp(-FAR))


@entry(
    "jaxvol.AlphaCorrection",
    "optical depth of a step",
    (0.003, 0.01, 0.03, 0.1, 0.3, 1.0),
    "RMSE of the opacity behind the face",
    "AlphaCorrection()",
    picture=lambda depth, size: signed(label_face(depth, size, cut=False), 0.2),
    shows="error of the opacity without labels=True, ± 0.2 from blue to red",
    size=32,
)
def jitter_at_label_faces(depth: float, size: int) -> dict[str, float]:
    """From which step on does jitter show as noise at the faces of a segmentation?

    Without labels=True a structure is as thick as its whole cells, which jitter moves. With it, cells are cut
    at the face, and the error is that of rounding."""
    return {
        "AlphaCorrection()": float(np.std(label_face(depth, size, cut=False))),
        "AlphaCorrection(labels=True)": rms(label_face(depth, size, cut=True)),
    }


FRONT = 0.5
"""Extinction of label 0."""
ANGLE = 0.3


@jax.jit
def _slopes(contrast: Array) -> tuple[Array, Array, Array]:
    """Derivative of the opacity of a ray by its angle to the face of the labels, with cells cut there and
    without, and by differences."""

    def opacity(angle: Array, cut: bool) -> Array:
        functions = [uniform(extinction) for extinction in (jnp.full_like(contrast, FRONT), FRONT * contrast)]
        rays = jnp.array([[-0.8, 0.1, -2.0]]), jnp.stack([jnp.sin(angle), 0 * angle, jnp.cos(angle)])[None]
        march = jv.March(0.13, (jv.AlphaCorrection(labels=cut),))
        return ray_opacities(halves(), jv.LabelTransferFunction(functions), rays, march)[0]

    angle, h = jnp.asarray(ANGLE), 0.01
    difference = (opacity(angle + h, True) - opacity(angle - h, True)) / (2 * h)
    return jax.grad(opacity)(angle, True), jax.grad(opacity)(angle, False), difference


@entry(
    "jaxvol.AlphaCorrection",
    "extinction behind the face / in front of it",
    (1.0, 1.02, 1.05, 1.1, 1.2, 1.5, 2.0, 5.0),
    "relative error of the derivative by the angle of a ray",
    "AlphaCorrection()",
    limit=0.1,
)
def gradients_at_label_faces(contrast: float, size: int) -> dict[str, float]:
    """How much may extinction jump at the face of a label before the gradient of the rays is wrong?

    Without labels=True, the image jumps where a sample crosses the face, and the gradient gives all motion to
    the exit. Of cells that are cut at the face, it is right, as finite differences of the same image are."""
    depth = FRONT * (NEAR + contrast * FAR) / np.cos(ANGLE)
    exact = depth * np.tan(ANGLE) * np.exp(-depth)
    found = (float(slope) for slope in _slopes(jnp.asarray(contrast, jnp.float32)))
    names = "AlphaCorrection(labels=True)", "AlphaCorrection()", "finite differences"
    return {name: abs(slope - exact) / exact for name, slope in zip(names, found, strict=True)}


OUT = jv.Clip((-2, 2, -2, 2, -0.49, 0.35), inside_out=True)
"""Cuts a layer out of the cube: 0.51 are left in front, and 0.65 behind, no multiple of any step below."""


@cache
def hollowed(depth: float, size: int, *, cut: bool) -> np.ndarray:
    """Error of the opacity of what is left of a cube of extinction 1, for steps of this optical depth."""
    aligned = (jv.AlphaCorrection(),) if cut else ()
    march = jv.March(depth, (OUT, jv.EmptySpaceJitter(0), *aligned))
    return opacities(cube(), uniform(1.0), along_z(size), march) - (1 - np.exp(-1.16))


@entry(
    "jaxvol.Clip",
    "optical depth of a step",
    (0.004, 0.012, 0.02, 0.04, 0.12, 0.4, 1.2),
    "noise of the opacity, standard deviation; with AlphaCorrection, its RMSE",
    "EmptySpaceJitter",
    picture=lambda depth, size: signed(hollowed(depth, size, cut=False), 0.1),
    shows="error of the opacity without AlphaCorrection, ± 0.1 from blue to red",
    size=32,
)
def jitter_behind_cuts(depth: float, size: int) -> dict[str, float]:
    """From which step on does jitter show as noise on the far side of what is cut out?

    Rays are shifted in the gap, so that the face behind it lies where the next sample happens to be, and
    material there is as thick as its whole cells. AlphaCorrection cuts them at the face, and the error is
    that of rounding. Cut faces that a ray meets first are smooth without it."""
    return {
        "EmptySpaceJitter": float(np.std(hollowed(depth, size, cut=False))),
        "EmptySpaceJitter, AlphaCorrection": rms(hollowed(depth, size, cut=True)),
    }
