"""Synthetic ultrasound volumes of scenes in mm, sampled with speckle at the nodes of a swept probe: its motor
axis is the x axis, and its middle beam points along z."""

from collections.abc import Iterable, Sequence
from functools import reduce

import numpy as np
from jaxtyping import Float

from ..._util.checks import Flag, flag, integer
from ...march.transforms.toroidal_map import ToroidalMap
from ...scene.volume import Volume
from .bodies import parts
from .canvas import SLAB, smooth_min
from .shapes import Block, ellipsoid, shapes_of


SOFT = 1.2  # width of a boundary's ramp, mm
GRAIN = 0.35  # correlation length of speckle along a beam, mm: half the pulse length


def toroidal_phantom(
    name: str,
    shape: Sequence[int] = (64, 96, 160),
    *,
    probe: ToroidalMap | None = None,
    speckle: Flag = True,
    seed: int = 0,
) -> tuple[Volume, ToroidalMap]:
    """Make a synthetic ultrasound volume as acquired by a swept probe, and the map that places it in the
    world.

    | name | content | mean echo |
    |---|---|---|
    | `shells` | reverberation: echoes 2 mm thick, 12 mm apart along every beam | 220, falling by 15 % from \
    shell to shell; 8 between |
    | `spheres` | rows of spheres in tissue: cysts (y < 0) and targets (y > 0), of radius 6, 9 and 12 mm | \
    tissue 60; cysts 4; targets 130, 160, 190 |
    | `wires` | the spheres, and between them wires 3 mm thick, along x, along y and obliquely in depth | as \
    spheres; wires 255 |
    | `fetus` | a fetus on its back in amniotic fluid: crown to rump along x, head at -x, face to the probe, \
    90 mm long | fluid 4, uterus 30, body 70, skin 120, skull and long bones 170 |

    Boundaries are ramps 1.2 mm wide. The speckle depends on the shape and the probe; the scene does not.

    Args:
        name: of the table.
        shape: numbers of nodes along (β, σ, γ), at least 8.
        probe: by default a = 20 mm, b = 30 mm, β within 90° ± 35°, σ within 90° ± 40°, γ from 0 to 100 mm.
        speckle: multiply the echo by fully developed speckle, of mean 1: the modulus of a complex Gaussian
            (Rayleigh), correlated over 0.35 mm along each beam and independent from beam to beam.
        seed: of the speckle.

    Returns:
        A uint8 volume as acquired, `data[β, σ, γ]`, whose spacing has no meaning, and the probe.

    Raises:
        ValueError: for an unknown name and for arguments of other types.
    """
    if name not in SCENES:
        raise ValueError(f"name must be one of {', '.join(SCENES)}; got {name!r}.")
    if not isinstance(shape, tuple | list) or len(shape) != 3:
        raise ValueError(f"shape must be three numbers of nodes, along (β, σ, γ); got {shape!r}.")
    n_beta, n_sigma, n_gamma = (integer("shape", n, 8) for n in shape)
    rng, speckle = np.random.default_rng(integer("seed", seed, 0)), flag("speckle", speckle)
    if probe is None:
        beta, sigma = np.deg2rad([[55, 125], [50, 130]]).tolist()
        probe = ToroidalMap(20.0, 30.0, beta, sigma, (0.0, 100.0))
    if not isinstance(probe, ToroidalMap):
        raise ValueError(f"probe must be a ToroidalMap; got {probe!r}.")
    data = np.empty((n_beta, n_sigma, n_gamma), np.uint8)
    beta, sigma, gamma = (
        np.linspace(float(ends[0]), float(ends[1]), n, dtype=np.float32)
        for ends, n in zip((probe.beta_range, probe.sigma_range, probe.gamma_range), data.shape, strict=True)
    )
    thick = max(1, SLAB // (n_sigma * n_gamma))
    for start in range(0, n_beta, thick):
        nodes = np.stack(np.meshgrid(beta[start : start + thick], sigma, gamma, indexing="ij"), axis=-1)
        x, y, z = np.moveaxis(np.asarray(probe.to_world(nodes), np.float32), -1, 0)
        echo = SCENES[name](x, y, z, nodes[..., 2])
        if speckle:
            echo = echo * _speckle(rng, echo.shape, GRAIN / float(gamma[1] - gamma[0]))
        data[start : start + thick] = np.rint(np.clip(echo, 0, 255)).astype(np.uint8)
    return Volume(data), probe


def _speckle(
    rng: np.random.Generator, shape: tuple[int, ...], grain: float
) -> Float[np.ndarray, "beta sigma gamma"]:
    """Rayleigh-distributed numbers of mean 1, correlated over `grain` nodes of the last axis."""
    from scipy.ndimage import gaussian_filter1d  # slow to import

    impulse = np.zeros(shape[-1])
    impulse[shape[-1] // 2] = 1
    # standard deviation of filtered white noise of variance 1
    deviation = np.float32(np.sqrt(np.sum(gaussian_filter1d(impulse, grain, mode="wrap") ** 2)))
    noise = (rng.standard_normal(shape, np.float32) for _ in range(2))
    re, im = (gaussian_filter1d(white, grain, mode="wrap") / deviation for white in noise)
    return np.sqrt(re * re + im * im) * np.float32(np.sqrt(2 / np.pi))


def _painted(echo: Block, layers: Iterable[tuple[float, Block]]) -> Block:
    """Paint layers (value, signed distance) over the echo, later ones over earlier ones."""
    for value, distance in layers:
        echo += np.clip(0.5 - distance / SOFT, 0, 1) * (value - echo)
    return echo


def _shells(x: Block, y: Block, z: Block, gamma: Block) -> Block:
    period, thickness = 12.0, 2.0
    number = np.maximum(np.rint(gamma / period), 1)
    echo = 220 * 0.85 ** (number - 1)
    return 8 + (echo - 8) * np.exp(-(((gamma - period * number) / (thickness / 2)) ** 2))


def _spheres(x: Block, y: Block, z: Block, gamma: Block) -> Block:
    spheres = ((value, *shapes_of([sphere])) for value, sphere in parts()["spheres"])
    return _painted(np.full_like(x, 60), ((value, sphere.distance(x, y, z)) for value, sphere in spheres))


def _wires(x: Block, y: Block, z: Block, gamma: Block) -> Block:
    wires = shapes_of(parts()["wires"])
    return _painted(_spheres(x, y, z, gamma), ((255, wire.distance(x, y, z)) for wire in wires))


def _fetus(x: Block, y: Block, z: Block, gamma: Block) -> Block:
    # origin at the navel; x from crown to rump, y from right to left, z from back to front
    points = x, y, 100 - z
    mirrored = x, abs(y), points[2]
    head, limbs = _joined("head", points, 4), _joined("limbs", mirrored, 2)
    body = _joined("trunk", points, 8)
    face = smooth_min(_joined("face", mirrored, 1), _joined("ears", mirrored, 1), 1)
    body = smooth_min(smooth_min(face, head, 2), body, 4)
    body = smooth_min(smooth_min(limbs, body, 4), _joined("cord", points, 0), 2)
    fluid = ellipsoid((0, 0, 0), (60, 40, 34)).distance(*points)
    skull = (170, head + 2.5), (40, head + 4.5)
    bones = (170, _joined("spine", points, 0)), (170, _joined("bones", mirrored, 0))
    return _painted(np.full_like(x, 30), [(4, fluid), (120, body), (70, body + 2), *skull, *bones])


def _joined(part: str, points: tuple[Block, Block, Block], blend: float) -> Block:
    """Distance to the blended shapes of a part of the fetus; for pairs, only those at y > 0 are listed."""
    distances = (shape.distance(*points) for shape in shapes_of(parts()[f"fetus {part}"]))
    return reduce(lambda a, b: smooth_min(a, b, blend), distances)


SCENES = {"shells": _shells, "spheres": _spheres, "wires": _wires, "fetus": _fetus}
"""Functions from world points x, y, z and depths γ, all in mm, to the mean echo, 0 to 255."""
