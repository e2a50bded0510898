"""The `engine` phantom.

Three cylinders in a row along x, with the crankshaft below them; the block is cut open towards -y.
Later fields cover earlier ones: pipes, the cast block, steel parts.
"""

import numpy as np

from .canvas import Canvas
from .shapes import box, capsule, cylinder, ellipsoid, ring, tube


BORES, CRANK = (-0.42, 0.0, 0.42), -0.52  # x of the cylinders, z of the crankshaft
PORTS = [capsule((x, s * 0.37, 0.405), (x, s * 0.09, 0.33), 0.05) for x in BORES for s in (-1, 1)]


def draw_engine(canvas: Canvas, rng: np.random.Generator) -> None:
    for value, build in ((90, _pipes), (150, _cast), (240, _steel)):
        canvas.paint(value, canvas.field(build))


def _cast(cast: Canvas) -> None:
    cast.join(box((0, 0, -0.87), (0.72, 0.56, 0.06)), 0.04)  # base plate
    cast.join(box((0, 0, -0.55), (0.66, 0.38, 0.30), 0.08), 0.04)
    cast.join(box((0, 0, 0.0), (0.66, 0.27, 0.30), 0.04), 0.04)
    cast.join([box((x, 0, -0.0), (0.018, 0.33, 0.24)) for x in (-0.63, -0.21, 0.21, 0.63)], 0.02)
    cast.join(box((0, 0, 0.37), (0.68, 0.33, 0.09), 0.03))  # cylinder head
    cast.join([box((x, 0, 0.53), (0.03, 0.17, 0.12)) for x in (-0.63, -0.21, 0.21, 0.63)], 0.02)
    cast.join([cylinder(2, (x, y, -0.80), 0.075, 0.04) for x in (-0.62, 0.62) for y in (-0.46, 0.46)], 0.02)
    cast.carve([cylinder(2, (x, 0, 0.02), 0.17, 0.29) for x in BORES])
    cast.carve([ellipsoid((x, 0, 0.30), (0.15, 0.15, 0.07)) for x in BORES])
    cast.carve(box((0, 0, -0.53), (0.58, 0.29, 0.24), 0.05), 0.02)  # crankcase
    cast.carve(cylinder(0, (0, 0.22, -0.12), 0.025, 0.60))  # oil gallery
    cast.carve(PORTS)
    cast.carve(box((0.42, -0.42, 0.0), (0.175, 0.42, 0.25), 0.03), 0.02)  # the cut-away
    cast.carve(box((0.0, -0.52, -0.52), (0.54, 0.32, 0.17), 0.05), 0.02)
    cast.carve([box((0, y, 0.285), (0.72, 0.02, 0.008), 0.004) for y in (-0.31, 0.31)])  # gasket line


def _pipes(pipes: Canvas) -> None:
    inside = []
    exhaust = [[(x, 0.30, 0.40), (x, 0.52, 0.38), (x, 0.66, 0.26), (x, 0.69, 0.1)] for x in BORES]
    exhaust += [[(-0.42, 0.69, 0.1), (0.42, 0.69, 0.1), (0.52, 0.69, 0.05), (0.55, 0.69, -0.1)]]
    exhaust += [[(0.55, 0.69, -0.1), (0.55, 0.69, -0.75)]]
    for line, radius in zip(exhaust, (0.075,) * 3 + (0.095,) * 2, strict=True):
        pipes.join(tube(line, radius), 0.05)
        inside += tube(line, radius - 0.035)
    pipes.join(capsule((-0.5, -0.66, 0.56), (0.5, -0.66, 0.56), 0.12))
    inside += [capsule((-0.5, -0.66, 0.56), (0.5, -0.66, 0.56), 0.085)]
    for x in BORES:
        line = [(x, -0.30, 0.41), (x, -0.48, 0.44), (x, -0.60, 0.52)]
        pipes.join(tube(line, 0.072), 0.04)
        inside += tube(line, 0.04)
    pipes.join([cylinder(1, (x, s * 0.345, 0.405), 0.11, 0.018) for x in BORES for s in (-1, 1)])  # flanges
    pipes.join(cylinder(2, (0.55, 0.69, -0.72), 0.13, 0.02))
    pipes.carve([*inside, *PORTS, capsule((0.55, 0.69, -0.6), (0.55, 0.69, -0.9), 0.06)])


def _steel(steel: Canvas) -> None:
    steel.join(cylinder(0, (0, 0, CRANK), 0.065, 0.92))
    for x, angle in zip(BORES, (0.5, 0.5 + 2 * np.pi / 3, 0.5 + 4 * np.pi / 3), strict=True):
        py, pz = 0.11 * float(np.sin(angle)), CRANK + 0.11 * float(np.cos(angle))
        crown = pz + 0.40
        steel.carve(cylinder(0, (x, 0, CRANK), 0.12, 0.07))
        steel.join(cylinder(0, (x, py, pz), 0.05, 0.06))
        for side in (-0.075, 0.075):
            web = [cylinder(0, (x + side, -0.4 * py, CRANK - 0.4 * (pz - CRANK)), 0.16, 0.022)]
            steel.join([*web, cylinder(0, (x + side, py, pz), 0.075, 0.022)], 0.02)
        steel.join(cylinder(0, (x, py, pz), 0.078, 0.035))
        steel.join(capsule((x, py, pz), (x, 0, crown - 0.02), 0.045, 0.03), 0.03)
        steel.join(cylinder(2, (x, 0, crown), 0.158, 0.085))
        steel.carve(cylinder(2, (x, 0, crown - 0.08), 0.12, 0.06))
        steel.join(capsule((x, 0, crown - 0.12), (x, 0, crown), 0.035))
        steel.join(cylinder(0, (x, 0, crown), 0.03, 0.14))
        steel.carve([ring((x, 0, crown + z), 0.163, 0.012) for z in (0.055, 0.02, -0.015)])
        for y in (-0.09, 0.09):
            steel.join(cylinder(2, (x, y, 0.45), 0.017, 0.17))
            steel.join(capsule((x, y, 0.288), (x, y, 0.34), 0.06, 0.017))
            steel.carve(box((x, y, 0.21), (0.08, 0.08, 0.05), 0.005))
            steel.join([ring((x, y, 0.475 + 0.03 * i), 0.045, 0.011) for i in range(4)])
            steel.join(cylinder(2, (x, y, 0.595), 0.055, 0.014))
            turn = angle / 2 + (0.6 if y > 0 else -0.6)
            lobe = (x, y + 0.03 * float(np.sin(turn)), 0.66 + 0.03 * float(np.cos(turn)))
            steel.join(cylinder(0, lobe, 0.052, 0.045))
        steel.join([cylinder(2, (x, 0, 0.52), 0.028, 0.22), cylinder(2, (x, 0, 0.52), 0.05, 0.03, sides=6)])
    steel.join([cylinder(0, (0.02, y, 0.66), 0.032, 0.74) for y in (-0.09, 0.09)])
    steel.join([cylinder(0, (0.76, y, 0.66), 0.088, 0.03, wave=22) for y in (-0.09, 0.09)])
    steel.join(cylinder(0, (-0.80, 0, CRANK), 0.36, 0.05, wave=72))  # flywheel
    steel.carve(cylinder(0, (-0.86, 0, CRANK), 0.28, 0.03))
    for angle in (np.arange(6) * (np.pi / 3)).tolist():
        steel.carve(cylinder(0, (-0.8, 0.19 * np.cos(angle), CRANK + 0.19 * np.sin(angle)), 0.055, 0.1))
    steel.join([cylinder(0, (0.78, 0, CRANK), 0.19, 0.018), cylinder(0, (0.86, 0, CRANK), 0.19, 0.018)])
    steel.join(cylinder(0, (0.82, 0, CRANK), 0.15, 0.05))
    bolts = [(x, y, 0.475) for x in (-0.63, -0.21, 0.21, 0.63) for y in (-0.26, 0.26)]
    bolts += [(x, y, -0.745) for x in (-0.62, 0.62) for y in (-0.46, 0.46)]
    for x, y, z in bolts:
        steel.join([cylinder(2, (x, y, z), 0.042, 0.03, sides=6), cylinder(2, (x, y, z - 0.1), 0.02, 0.1)])
