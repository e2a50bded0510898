"""Where do clips fail? Faces behind what is cut out, which lie where the next sample happens to be."""

from functools import cache

import numpy as np

import jaxvol as jv

from .entry import Entry, cube, signed, uniform


LEVEL = 1 / 255
SEED = 0

OUT = jv.Clip((-2, 2, -2, 2, -0.49, 0.35), inside_out=True)
"""Cuts a layer out of the cube: 0.51 are left in front, and 0.65 behind, no multiple of any step below."""

EXACT = 1 - np.exp(-1.16)


@cache
def hollowed(depth: float, size: int, *, cut: bool) -> np.ndarray:
    """Opacity of what is left of a cube of extinction 1, for steps of this optical depth."""
    camera = jv.Camera((0, 0, -3), (0, 0, 0), (0, 1, 0), size=(size, size), parallel_scale=0.5)
    aligned = (jv.AlphaCorrection(),) if cut else ()
    march = jv.March(depth, (OUT, jv.EmptySpaceJitter(SEED), *aligned))
    rendering = jv.render(cube(), uniform(1.0), camera, march, outputs="rgba", adjoint="forward")
    return np.asarray(rendering.rgba[..., 3], np.float64)


def behind_cuts(depth: float, size: int) -> dict[str, float]:
    return {
        "EmptySpaceJitter": float(np.std(hollowed(depth, size, cut=False))),
        "EmptySpaceJitter, AlphaCorrection": float(
            np.sqrt(np.mean((hollowed(depth, size, cut=True) - EXACT) ** 2))
        ),
    }


BEHIND = Entry(
    name="jitter behind cuts",
    question="From which step on does jitter show as noise on the far side of what is cut out?",
    method="jaxvol.Clip",
    regime="optical depth of a step",
    values=(0.004, 0.012, 0.02, 0.04, 0.12, 0.4, 1.2),
    measure=behind_cuts,
    metric="noise of the opacity, standard deviation; with AlphaCorrection, its RMSE",
    judged="EmptySpaceJitter",
    limit=LEVEL,
    outcome="documented",
    does="Rays are shifted in the gap, so that the face behind it lies where the next sample happens to be, "
    "and material there is as thick as its whole cells. AlphaCorrection cuts them at the face, and the error "
    "is that of rounding. Cut faces that a ray meets first are smooth without it.",
    picture=lambda depth, size: signed(hollowed(depth, size, cut=False) - EXACT, 0.1),
    shows="error of the opacity without AlphaCorrection, ± 0.1 from blue to red",
    size=32,
)

ENTRIES = (BEHIND,)
