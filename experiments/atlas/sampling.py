"""Where do jitters fail? Rays without an empty sample, faces, thin sheets, offsets near 1."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxvol as jv
from jaxvol.metrics import boundary_noise, wood_grain_energy

from .entry import Entry, colors, cube, grey, shift_of, signed, uniform


LEVEL = 1 / 255
STEP = 2 / 128
SEED = 0


# -- rays without an empty sample -------------------------------------------------------------------------


class Hazy(jv.Field):
    """An inclined plane, exact between voxels, behind haze over a share of the cube."""

    share: Float[Array, ""]

    def value(self, volume: jv.Volume, coordinate: tuple) -> Array:
        x, _, z = (c * volume.spacing[i] + volume.origin[i] for i, c in enumerate(coordinate))
        plane = jax.nn.sigmoid(((z + 1) / 2 - 0.25 - 0.35 * (x + 1) / 2) / 0.004)
        # the image spans x from -1/2 to 1/2
        return jnp.where(x + 0.5 < self.share, jnp.maximum(plane, 0.1), plane)


@cache
def hazy(share: float, size: int, jitter: str) -> np.ndarray:
    field = Hazy(jnp.asarray(share, jnp.float32))
    volume = jv.Volume(np.zeros((8, 8, 8), np.float32), [2 / 7] * 3, [-1.0] * 3, field=field)
    shade = np.tile(np.array([0.3, 0.3, 0.36, 0.36, 0.9])[:, None], 3)
    transfer = jv.TransferFunction([0.0, 0.04, 0.05, 0.1, 1.0], shade, [0.0, 0.0, 0.05, 0.05, 30.0])
    camera = jv.Camera((0, 0, -3), (0, 0, 0), (0, 1, 0), size=(size, size), parallel_scale=0.5)
    if jitter == "converged":
        march = jv.March(STEP / 12, (jv.AlphaCorrection(), jv.EarlyTermination(1e-6)), "midpoint")
    else:
        kinds = {
            "ray casting": (),
            "Jitter": (jv.Jitter(SEED),),
            "EmptySpaceJitter": (jv.EmptySpaceJitter(SEED),),
        }
        march = jv.March(STEP, (*kinds[jitter], jv.AlphaCorrection()))
    return colors(volume, transfer, camera, march)


def haze(share: float, size: int) -> dict[str, float]:
    truth = hazy(share, size, "converged")
    plain = wood_grain_energy(hazy(share, size, "ray casting") - truth)
    return {
        jitter: abs(wood_grain_energy(hazy(share, size, jitter) - truth)) / plain
        for jitter in ("EmptySpaceJitter", "Jitter")
    }


HAZE = Entry(
    name="wood grain without empty samples",
    question="How many rays may begin in visible material before EmptySpaceJitter leaves wood grain?",
    method="jaxvol.EmptySpaceJitter",
    regime="share of rays in haze from their first sample on",
    values=(0.0, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0),
    measure=haze,
    metric="wood grain energy / that of ray casting",
    judged="EmptySpaceJitter",
    limit=0.1,
    outcome="documented",
    does="A ray that meets no transparent sample is not shifted: the wood grain that is left is the share "
    "of such rays. Jitter breaks it there, too.",
    picture=lambda share, size: signed(
        hazy(share, size, "EmptySpaceJitter") - hazy(share, size, "converged"), 0.05
    ),
    shows="error of EmptySpaceJitter, ± 0.05 from blue to red",
    scales=("linear", "log"),
    size=96,
)


# -- cut faces --------------------------------------------------------------------------------------------


@cache
def cut_block(resolution: int = 64) -> jv.Volume:
    return jv.phantom("cut_block", resolution)


def cut_face(step: float, size: int, transform: jv.Transform | None) -> tuple[np.ndarray, np.ndarray]:
    """Image of the cut block from its cut face, for a step in voxels, and where that face is."""
    volume = cut_block()
    shade = np.tile(np.array([0.3, 0.33, 0.33, 0.9])[:, None], 3)
    transfer = jv.TransferFunction([0.0, 0.04999, 0.05, 1.0], shade, [0.0, 0.0, 1.5, 30.0])
    camera = jv.Camera((0, 0, -3), (0, 0, 0), (0, 1, 0), size=(size, size), parallel_scale=0.5)
    transforms = () if transform is None else (transform,)
    march = jv.March(step * float(volume.spacing[0]), (*transforms, jv.AlphaCorrection()))
    x = np.asarray(camera.rays()[0])[..., 0]
    return colors(volume, transfer, camera, march), x < -0.05


JITTERS = {
    "Jitter": jv.Jitter(SEED),
    "Jitter, front residual": jv.Jitter(SEED, front_residual=True),
    "EmptySpaceJitter": jv.EmptySpaceJitter(SEED),
}


def cut_faces(step: float, size: int) -> dict[str, float]:
    """Standard deviation of the noise of one channel on the face."""
    return {
        name: float(np.sqrt(boundary_noise(*cut_face(step, size, jitter)) / 3))
        for name, jitter in JITTERS.items()
    }


CUT = Entry(
    name="jitter on cut faces",
    question="From which step on does Jitter show as noise where the box cuts material?",
    method="jaxvol.Jitter",
    regime="step, voxels",
    values=(0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0),
    measure=cut_faces,
    metric="noise on the face, standard deviation",
    judged="Jitter",
    limit=LEVEL,
    outcome="documented",
    does="Jitter leaves out the first ξ d of the material. With front_residual the noise is smaller; under "
    "EmptySpaceJitter, rays on the face are not shifted before they leave the material, and it stays smooth.",
    picture=lambda step, size: cut_face(step, size, JITTERS["Jitter"])[0],
    shows="the block under Jitter; its left half is the cut face",
    size=64,
)


# -- faces of labels --------------------------------------------------------------------------------------


@cache
def halves(side: int = 9) -> jv.Volume:
    """Label 1 in the far half of the cube, 0 in the near one; the face between them lies at z = -1/8."""
    labels = np.zeros((side,) * 3, np.uint8)
    labels[:, :, side // 2 :] = 1
    with jax.ensure_compile_time_eval():  # kept, although it may be made inside `jax.jit`
        return jv.Volume(np.ones((side,) * 3, np.float32), [2 / (side - 1)] * 3, [-1.0] * 3, labels)


def label_face(depth: float, size: int, *, cut: bool) -> np.ndarray:
    """Opacity of the far half, of extinction 1, for steps of this optical depth."""
    transfer = jv.LabelTransferFunction([None, uniform(1.0)])
    camera = jv.Camera((0, 0, -3), (0, 0, 0), (0, 1, 0), size=(size, size), parallel_scale=0.5)
    march = jv.March(depth, (jv.EmptySpaceJitter(SEED), jv.AlphaCorrection(labels=cut)))
    rendering = jv.render(halves(), transfer, camera, march, outputs="rgba", adjoint="forward")
    return np.asarray(rendering.rgba[..., 3], np.float64)


FAR = 1 - np.exp(-1.125)
"""Opacity of the far half."""


def label_faces(depth: float, size: int) -> dict[str, float]:
    return {
        "AlphaCorrection()": float(np.std(label_face(depth, size, cut=False))),
        "AlphaCorrection(labels=True)": float(
            np.sqrt(np.mean((label_face(depth, size, cut=True) - FAR) ** 2))
        ),
    }


LABELS = Entry(
    name="jitter at label faces",
    question="From which step on does jitter show as noise at the faces of a segmentation?",
    method="jaxvol.AlphaCorrection",
    regime="optical depth of a step",
    values=(0.003, 0.01, 0.03, 0.1, 0.3, 1.0),
    measure=label_faces,
    metric="RMSE of the opacity behind the face",
    judged="AlphaCorrection()",
    limit=LEVEL,
    outcome="documented",
    does="Without labels=True a structure is as thick as its whole cells, which jitter moves. With it, "
    "cells are cut at the face, and the error is that of rounding.",
    picture=lambda depth, size: signed(label_face(depth, size, cut=False) - FAR, 0.2),
    shows="error of the opacity without labels=True, ± 0.2 from blue to red",
    size=32,
)


# -- thin sheets ------------------------------------------------------------------------------------------


class Sheet(jv.Field):
    """1 in an opaque sheet of this thickness across z = 0, inclined a little, 0 elsewhere."""

    thickness: Float[Array, ""]

    def value(self, volume: jv.Volume, coordinate: tuple) -> Array:
        x, y, z = (c * volume.spacing[i] + volume.origin[i] for i, c in enumerate(coordinate))
        return jnp.where(jnp.abs(z - 0.13 * x - 0.07 * y) < self.thickness / 2, 1.0, 0.0).astype(z.dtype)


def sheet(ratio: float, size: int, *, jitter: bool) -> np.ndarray:
    """Opacity of a sheet that is so many steps thick."""
    field = Sheet(jnp.asarray(ratio * STEP, jnp.float32))
    volume = jv.Volume(np.zeros((8, 8, 8), np.float32), [2 / 7] * 3, [-1.0] * 3, field=field)
    transfer = jv.TransferFunction([0.4, 0.6], np.ones((2, 3)), [0.0, 1e4])
    camera = jv.Camera((0, 0, -3), (0, 0, 0), (0, 1, 0), size=(size, size), parallel_scale=0.5)
    march = jv.March(STEP, (jv.Jitter(SEED), jv.AlphaCorrection()) if jitter else (jv.AlphaCorrection(),))
    rendering = jv.render(volume, transfer, camera, march, outputs="rgba", adjoint="forward")
    return np.asarray(rendering.rgba[..., 3], np.float64)


def sheets(ratio: float, size: int) -> dict[str, float]:
    return {
        "Jitter": float(1 - np.mean(sheet(ratio, size, jitter=True))),
        "ray casting": float(1 - np.mean(sheet(ratio, size, jitter=False))),
        "1 - thickness / step": max(0.0, 1 - ratio),
    }


SHEETS = Entry(
    name="sheets thinner than a step",
    question="How thin may an opaque sheet be before rays pass through it?",
    method="jaxvol.March",
    regime="thickness of the sheet, steps",
    values=(4.0, 2.0, 1.25, 1.05, 0.95, 0.8, 0.5, 0.25, 0.1),
    measure=sheets,
    metric="share of pixels that miss the sheet",
    judged="Jitter",
    limit=0.001,
    outcome="documented",
    does="A sheet thinner than a step is met by as many rays as it is thick, in steps: as bands without "
    "jitter, as noise with it. No quadrature sees what lies between two samples alike; a shorter step "
    "does.",
    picture=lambda ratio, size: grey(sheet(ratio, size, jitter=True)),
    shows="opacity of the sheet under Jitter",
    scales=("log", "linear"),
    size=64,
)


# -- offsets near 1 ---------------------------------------------------------------------------------------


def offset_error(left: float, size: int, transform: jv.Transform) -> np.ndarray:
    """Error of the opacity of a cube of optical depth 2, by steps of 1/4, at the offset 1 - `left`."""
    offset = np.float32(1) - np.float32(left)
    camera = jv.Camera((0.1, 0.2, -3), (0, 0, 0), (0, 1, 0), size=(size, size), parallel_scale=0.5)
    march = jv.March(0.25, (shift_of(transform, offset), jv.AlphaCorrection()))
    volume, transfer = cube(), uniform(1.0)
    rendering = jv.render(volume, transfer, camera, march, outputs="rgba", adjoint="forward")
    origins, directions = (np.asarray(part, np.float64) for part in camera.rays())
    near, far = ((face - origins) / directions for face in (-np.sign(directions), np.sign(directions)))
    length = far.min(axis=-1) - near.max(axis=-1)
    return np.asarray(rendering.rgba[..., 3], np.float64) - (1 - np.exp(-length))


BLUE = {
    "Jitter": jv.Jitter(0, "blue"),
    "Jitter, front residual": jv.Jitter(0, "blue", front_residual=True),
    "EmptySpaceJitter": jv.EmptySpaceJitter(0, "blue"),
}


def offsets(left: float, size: int) -> dict[str, float]:
    return {name: float(np.abs(offset_error(left, size, each)).max()) for name, each in BLUE.items()}


OFFSETS = Entry(
    name="jitter offsets near 1",
    question="Does the first cell survive an offset that rounds to a whole step?",
    method="jaxvol.Jitter",
    regime="1 - ξ",
    values=(1.0, 0.5, 0.1, 0.01, 1e-3, 1e-4, 1e-5, 1e-6, 2.0**-24),
    measure=offsets,
    metric="largest error of the opacity of a cube",
    judged="Jitter, front residual",
    limit=1e-5,
    outcome="bounded",
    does="Random numbers have 24 bits, so that ξ is at most 1 - 2⁻²⁴. The front residual and the cells "
    "behind it always cover the whole ray. Without it, Jitter lacks the first ξ d, here up to e⁻² ξ "
    "d.",
    picture=lambda left, size: signed(offset_error(left, size, BLUE["Jitter"]), 0.05),
    shows="error of the opacity under Jitter without front residual, ± 0.05 from blue to red",
    pictured=(1.0, 2.0**-24),
    scales=("log", "log"),
    size=16,
)

ENTRIES = (HAZE, CUT, LABELS, SHEETS, OFFSETS)
