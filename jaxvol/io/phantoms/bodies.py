"""The `head` and `labels` phantoms: a CT-like head, and a frog with the organ that each node belongs to.

Both face -y; the head's crown points to +z, and so does the frog's back. Of the head, skin and bone are
fields; everything else is painted over them. 1 world unit is about 14 cm there.
"""

from typing import Any

import numpy as np

from .canvas import Canvas, plane_waves
from .shapes import Block, Point, Shape, ball, box, capsule, ellipsoid, lengths, pair, tube


BRAIN = (
    ellipsoid((0, 0.08, 0.345), (0.425, 0.565, 0.445)),
    *pair(ellipsoid((0.24, -0.02, 0.05), (0.17, 0.26, 0.15))),  # temporal lobes
    ellipsoid((0, 0.33, -0.01), (0.30, 0.22, 0.18)),  # cerebellum
)
PAINTED = (
    (104, pair(ellipsoid((0.07, 0.02, 0.38), (0.035, 0.2, 0.07), -0.2))),  # ventricles
    (120, tube([(0, 0.20, 0.05), (0, 0.30, -0.3), (0, 0.31, -1.2)], 0.045)),  # cord
    (112, pair(ball((0.205, -0.45, 0.08), 0.083))),  # eyes
    (130, pair(ellipsoid((0.205, -0.51, 0.08), (0.04, 0.018, 0.04)))),  # lenses
    (0, pair(ellipsoid((0.06, -0.41, -0.07), (0.038, 0.21, 0.11)))),  # nasal cavity
    (0, pair(capsule((0.045, -0.60, -0.10), (0.05, -0.735, -0.215), 0.026))),  # nostrils
    (0, pair(ellipsoid((0.165, -0.40, -0.11), (0.06, 0.09, 0.08)))),  # maxillary sinuses
    (0, pair(ellipsoid((0.065, -0.525, 0.265), (0.05, 0.017, 0.04)))),  # frontal sinuses
    (0, pair(ellipsoid((0.055, -0.13, -0.02), (0.045, 0.07, 0.05)))),  # sphenoid sinuses
    (0, [ellipsoid((0, -0.31, -0.30), (0.11, 0.16, 0.025))]),  # mouth, above the tongue
    (
        0,
        tube(
            [(0, -0.22, -0.1), (0, -0.09, -0.2), (0, -0.05, -0.5), (0, -0.08, -0.7), (0, -0.06, -1.2)], 0.055
        ),
    ),
    (0, pair(capsule((0.62, 0.09, 0.0), (0.37, 0.06, 0.0), 0.024))),  # ear canals
    (120, [box((0, -0.42, -0.06), (0.011, 0.24, 0.13), 0.005)]),  # septum
)
"""Values, and the shapes that have them."""


def draw_head(canvas: Canvas, rng: np.random.Generator) -> None:
    tissue, folds = plane_waves(rng, 0.12, 0.5), plane_waves(rng, 0.13, 0.2)
    skin = canvas.field(_skin)
    canvas.paint(lambda x, y, z, d: 78 + (22 + 4 * tissue(x, y, z)) * np.clip(-1 - d / 0.02, 0, 1), skin)
    canvas.paint(lambda x, y, z, d: 205 + 8 * tissue(x, y, z), canvas.field(_bones))

    # two dense tables with the diploë between them
    middle = ellipsoid((0, 0.08, 0.30), (0.46, 0.60, 0.52)).distance
    vault = Shape(
        lambda x, y, z: np.maximum(abs(middle(x, y, z)) - 0.017, 0.2 - 0.25 * y - z),
        (-0.5, -0.6, 0),
        (0.5, 0.8, 0.9),
    )
    canvas.paint(lambda x, y, z, d: 222 - 36 * np.exp(-((middle(x, y, z) / 0.012) ** 2)), vault)

    def brain(x: Block, y: Block, z: Block, d: Block) -> Block:
        # furrows follow the zeros of a wave, and narrow from the surface inwards; grey matter lines both
        wave, depth = folds(x, y, z), np.clip(-d / 0.17, 0, 1)
        furrow = np.exp(-((wave / 0.3) ** 2)) * np.clip(2 - 2.5 * depth, 0, 1)
        midline = np.exp(-((x / 0.016) ** 2)) * np.clip((z - 0.2) / 0.1, 0, 1)
        lining = np.exp(-((wave / 0.75) ** 2)) * np.clip(2 - 2 * depth, 0, 1)
        grey = np.maximum(lining, np.clip(1.5 + d / 0.035, 0, 1))
        return 112 + 15 * grey + 2 * tissue(x, y, z) - 26 * np.maximum(furrow, midline)

    canvas.paint(brain, canvas.field(lambda cavity: cavity.join(BRAIN, 0.05)))
    for value, shapes in (*PAINTED, (255, _teeth())):
        for shape in shapes:
            canvas.paint(value, shape)


def _skin(skin: Canvas) -> None:
    skin.join(ellipsoid((0, 0.08, 0.30), (0.54, 0.68, 0.60)), 0.16)
    skin.join(ellipsoid((0, -0.22, -0.18), (0.39, 0.44, 0.50)), 0.16)
    skin.join(pair(capsule((0.27, -0.07, -0.40), (0.10, -0.45, -0.56), 0.10)), 0.12)  # jaw
    skin.join(pair(ellipsoid((0.29, -0.22, -0.05), (0.165, 0.30, 0.16))), 0.12)  # cheek bones
    skin.join(capsule((0, 0.14, -0.1), (0, 0.17, -1.4), 0.325), 0.16)  # neck
    skin.join(ellipsoid((0, -0.49, -0.565), (0.14, 0.16, 0.11)), 0.10)  # chin
    skin.join(pair(capsule((0.09, -0.555, 0.205), (0.26, -0.475, 0.20), 0.05)), 0.09)  # brows
    skin.carve(pair(ellipsoid((0.205, -0.66, 0.09), (0.12, 0.135, 0.07))), 0.09)  # eye sockets
    skin.join(pair(ellipsoid((0.205, -0.46, 0.08), (0.105, 0.105, 0.08))), 0.03)
    lids = [(0.125, -0.535, 0.066), (0.17, -0.56, 0.055), (0.23, -0.565, 0.055), (0.29, -0.525, 0.072)]
    skin.carve(pair(*tube(lids, 0.012)), 0.015)
    skin.join(capsule((0, -0.60, 0.14), (0, -0.725, -0.125), 0.045, 0.07), 0.07)  # nose
    skin.join(pair(ellipsoid((0.07, -0.68, -0.145), (0.05, 0.07, 0.052))), 0.04)
    lips = [capsule((0, -0.645, -0.325), (0.12, -0.585, -0.345), 0.036, 0.02)]
    lips += [capsule((0, -0.632, -0.39), (0.10, -0.585, -0.37), 0.042, 0.026)]
    skin.join(pair(*lips), 0.06)
    skin.carve(pair(capsule((0, -0.69, -0.355), (0.135, -0.61, -0.352), 0.01)), 0.02)
    skin.carve(capsule((0, -0.73, -0.22), (0, -0.715, -0.29), 0.014), 0.04)  # philtrum
    skin.join(pair(ellipsoid((0.525, 0.10, 0.03), (0.032, 0.12, 0.17), -0.45)), 0.05)  # ears
    skin.join(pair(ellipsoid((0.51, 0.07, -0.10), (0.03, 0.05, 0.06), -0.4)), 0.04)
    skin.carve(pair(ellipsoid((0.555, 0.085, 0.03), (0.025, 0.07, 0.11), -0.45)), 0.03)
    skin.join(pair(ellipsoid((0.515, 0.005, -0.0), (0.022, 0.025, 0.04))), 0.03)


def _bones(bone: Canvas) -> None:
    bone.join(ellipsoid((0, 0.08, 0.30), (0.49, 0.63, 0.55)), 0.09)
    bone.join(ellipsoid((0, 0.31, -0.02), (0.36, 0.28, 0.22)), 0.08)  # occiput
    bone.join(box((0, -0.37, -0.13), (0.25, 0.20, 0.17), 0.12), 0.06)  # upper jaw
    bone.join(pair(ellipsoid((0.31, -0.40, -0.05), (0.085, 0.11, 0.075))), 0.09)
    bone.join(pair(*tube([(0.33, -0.39, -0.05), (0.425, -0.18, -0.05), (0.43, 0.0, -0.03)], 0.03)), 0.03)
    bone.join(ellipsoid((0, -0.50, 0.245), (0.18, 0.085, 0.085)), 0.08)
    bone.join(pair(capsule((0.08, -0.53, 0.21), (0.29, -0.445, 0.20), 0.04)), 0.08)  # brows
    bone.join(pair(capsule((0.315, -0.42, 0.19), (0.33, -0.41, -0.02), 0.04)), 0.06)
    bone.join(pair(capsule((0.42, 0.10, -0.05), (0.39, 0.12, -0.2), 0.07, 0.03)), 0.05)  # mastoids
    bone.carve(BRAIN, 0.03)
    bone.carve(pair(capsule((0.225, -0.66, 0.08), (0.12, -0.24, 0.05), 0.145, 0.035)), 0.02)  # orbits
    bone.join(capsule((0, -0.55, 0.14), (0, -0.655, 0.0), 0.045), 0.03)  # nasal bones
    bone.carve(pair(ellipsoid((0.04, -0.60, -0.085), (0.055, 0.14, 0.10))), 0.02)
    bone.carve(capsule((0, 0.25, -0.1), (0, 0.31, -0.4), 0.08), 0.03)  # foramen magnum
    arch = [(x, _arch(x)) for x in (0.0, 0.07, 0.13, 0.17, 0.195)]
    bone.join(pair(*tube([(x, y + 0.015, -0.265) for x, y in arch], 0.045)), 0.03)
    bone.carve(ellipsoid((0, -0.30, -0.31), (0.13, 0.19, 0.09)), 0.02)  # palate
    jaw = [(0.0, -0.535, -0.555), (0.10, -0.50, -0.55), (0.19, -0.38, -0.52), (0.285, -0.09, -0.42)]
    bone.join(pair(*tube(jaw, 0.05)), 0.04)
    bone.join(pair(*tube([(x, y + 0.02, -0.485) for x, y in arch], 0.04)), 0.05)
    bone.join(pair(*tube([jaw[-1], (0.34, -0.02, -0.2), (0.38, 0.01, -0.08)], 0.035)), 0.04)
    bone.join(pair(capsule((0.30, -0.12, -0.36), (0.335, -0.17, -0.12), 0.035, 0.02)), 0.04)
    for z in np.arange(-0.25, -1.2, -0.13).tolist():
        bone.join(ellipsoid((0, 0.2, z), (0.12, 0.09, 0.065)))
        arches = pair(*tube([(0.10, 0.22, z), (0.10, 0.32, z - 0.01), (0.0, 0.39, z - 0.02)], 0.026))
        wings = pair(capsule((0.08, 0.21, z), (0.18, 0.22, z - 0.01), 0.028))
        bone.join([*arches, *wings, capsule((0, 0.38, z - 0.02), (0, 0.44, z - 0.05), 0.026)], 0.02)
    bone.carve(tube([(0, 0.30, -0.25), (0, 0.31, -1.2)], 0.058))


def _arch(x: Any) -> Any:
    """The dental arch: y of a tooth at x, a number or an array."""
    return -0.585 + 7.5 * x * x


def _teeth() -> list[Shape]:
    fine = np.linspace(0, 0.205, 200)
    length = lengths(np.stack([fine, _arch(fine)], axis=1))
    teeth = []
    for i, place in enumerate(np.linspace(0.028, length[-1], 7)):
        x = float(np.interp(place, length, fine))
        radius = 0.023 + 0.0015 * i
        teeth += [capsule((x, _arch(x), -0.285), (x, _arch(x), -0.352), radius * 0.8, radius)]
        teeth += [capsule((x, _arch(x) + 0.012, -0.400), (x, _arch(x) + 0.012, -0.46), radius, radius * 0.8)]
    return pair(*teeth)


SOFT = 0.06  # world units over which an intensity blends into its neighbour's
ORGANS = (  # label, intensity, shape
    (2, 95, ellipsoid((-0.15, -0.15, 0.06), (0.17, 0.21, 0.13))),  # right lung
    (3, 95, ellipsoid((0.15, -0.15, 0.06), (0.17, 0.21, 0.13))),  # left lung
    (4, 170, ellipsoid((-0.1, 0.15, -0.04), (0.25, 0.24, 0.17))),  # liver
    (5, 215, ellipsoid((0.2, 0.22, 0.0), (0.17, 0.26, 0.16))),  # stomach
)


def draw_frog(canvas: Canvas, rng: np.random.Generator) -> np.ndarray:
    body = canvas.field(_frog)
    canvas.paint(120, body, SOFT)
    labels = (body.values < 0).astype(np.uint8)
    deepest = np.zeros_like(body.values)
    for label, value, organ in ORGANS:
        canvas.paint(value, organ, SOFT)
        for where, at in canvas.slabs(organ.low, organ.high):
            # a node belongs to the organ it is deepest in, so overlapping organs meet in a smooth face
            distance = organ.distance(*at)
            nearer = distance < deepest[where]
            np.copyto(labels[where], label, where=nearer)
            np.copyto(deepest[where], distance, where=nearer)
    return labels


def _frog(body: Canvas) -> None:
    body.join(ellipsoid((0, 0.05, 0), (0.42, 0.6, 0.3)), 0.15)
    body.join(ellipsoid((0, -0.50, 0.04), (0.40, 0.38, 0.21)), 0.15)  # head
    body.join(pair(ball((0.2, -0.56, 0.21), 0.115)), 0.04)  # eyes
    lips = [(0.0, -0.88, 0.0), (0.2, -0.815, 0.0), (0.33, -0.68, 0.01), (0.385, -0.54, 0.03)]
    body.carve(pair(*tube(lips, 0.015)), 0.03)
    hip, knee, heel, foot = (0.26, 0.48, -0.02), (0.73, 0.20, -0.08), (0.48, 0.70, -0.17), (0.72, 0.74, -0.22)
    leg = [capsule(hip, knee, 0.15, 0.10), capsule(knee, heel, 0.115, 0.065), capsule(heel, foot, 0.06, 0.05)]
    hind = _toes(foot, [(0.83, 0.53), (0.91, 0.66), (0.92, 0.80), (0.83, 0.92)])
    shoulder, elbow, wrist = (0.33, -0.28, -0.08), (0.63, -0.22, -0.14), (0.66, -0.54, -0.22)
    arm = [capsule(shoulder, elbow, 0.10, 0.075), capsule(elbow, wrist, 0.08, 0.05)]
    fore = _toes(wrist, [(0.54, -0.68), (0.65, -0.74), (0.76, -0.70), (0.83, -0.60)])
    body.join(pair(*leg, *arm), 0.08)
    body.join(pair(*hind, *fore), 0.03)


def _toes(root: Point, tips: list[tuple[float, float]]) -> list[Shape]:
    """Toes from a foot to tips (x, y) in its plane, each with a pad."""
    ends = [(*tip, root[2]) for tip in tips]
    return [part for end in ends for part in (capsule(root, end, 0.035, 0.025), ball(end, 0.036))]
