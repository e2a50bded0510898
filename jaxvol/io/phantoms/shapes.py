"""Shapes: signed distances (negative inside, exact for round ones, else to first order) and their boxes."""

from collections.abc import Callable, Sequence
from functools import reduce
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float


Point: TypeAlias = Sequence[float | int] | Float[np.ndarray, "3"]
Block: TypeAlias = Float[np.ndarray, "_ _ _"]


class Shape(NamedTuple):
    """Signed distance on an open mesh (x, y, z), and two corners of the bounding box."""

    distance: Callable[[Block, Block, Block], Block]
    low: Point
    high: Point


def _around(distance: Callable[[Block, Block, Block], Block], center: Point, half: Point) -> Shape:
    return Shape(distance, np.subtract(center, half, dtype=float), np.add(center, half, dtype=float))


def ellipsoid(center: Point, radii: Point, yaw: float = 0.0) -> Shape:
    """Ellipsoid, rotated by `yaw` (radians) about the z axis through its centre."""
    (cx, cy, cz), (rx, ry, rz) = center, radii
    c, s, small = float(np.cos(yaw)), float(np.sin(yaw)), min(radii)

    def distance(x: Block, y: Block, z: Block) -> Block:
        x, y, z = x - cx, y - cy, z - cz
        if yaw:
            x, y = c * x + s * y, c * y - s * x
        level = np.sqrt((x / rx) ** 2 + (y / ry) ** 2 + (z / rz) ** 2)
        slope = np.sqrt((x / rx**2) ** 2 + (y / ry**2) ** 2 + (z / rz**2) ** 2)
        # level / slope is 0 / 0 at the centre; the added terms make it the smallest radius there
        return (level - 1) * (level + 1e-3) / (slope + 1e-3 / small)

    wide = max(rx, ry)
    return _around(distance, center, (wide, wide, rz) if yaw else radii)


def ball(center: Point, radius: float) -> Shape:
    return ellipsoid(center, (radius,) * 3)


def to_segment(x: Block, y: Block, z: Block, a: Point, b: Point) -> tuple[Block, Block]:
    """Distance to the segment a b, and the position of the nearest point on it, 0 to 1."""
    dx, dy, dz = (float(q - p) for p, q in zip(a, b, strict=True))
    x, y, z = x - float(a[0]), y - float(a[1]), z - float(a[2])
    square = dx * dx + dy * dy + dz * dz
    t = np.clip(x * (dx / square) + y * (dy / square) + z * (dz / square), 0, 1)
    return np.sqrt((x - t * dx) ** 2 + (y - t * dy) ** 2 + (z - t * dz) ** 2), t


def capsule(a: Point, b: Point, radius: float, end_radius: float | None = None) -> Shape:
    """Capsule along the segment a b, its radius linear from `radius` to `end_radius`."""
    end = radius if end_radius is None else end_radius

    def distance(x: Block, y: Block, z: Block) -> Block:
        to_axis, t = to_segment(x, y, z, a, b)
        return to_axis - (radius + t * (end - radius))

    wide = max(radius, end)
    return Shape(distance, np.minimum(a, b) - wide, np.maximum(a, b) + wide)


def tube(points: Sequence[Point], radius: float) -> list[Shape]:
    return [capsule(a, b, radius) for a, b in pairwise(points)]


def box(center: Point, half: Point, rounding: float = 0.02) -> Shape:
    def distance(x: Block, y: Block, z: Block) -> Block:
        q = [abs(v - c) - (h - rounding) for v, c, h in zip((x, y, z), center, half, strict=True)]
        outside = np.sqrt(sum(np.maximum(v, 0) ** 2 for v in q))
        return outside + np.minimum(np.maximum(np.maximum(q[0], q[1]), q[2]), 0) - rounding

    return _around(distance, center, half)


def cylinder(axis: int, center: Point, radius: float, half: float, sides: int = 0, wave: int = 0) -> Shape:
    """Cylinder along a coordinate axis, or prism with `sides`; `wave`: number of gear teeth around it."""
    tooth = 0.012 if wave else 0.0
    turns = (np.arange(sides) * (2 * np.pi / max(sides, 1))).tolist()

    def distance(x: Block, y: Block, z: Block) -> Block:
        p = [v - float(c) for v, c in zip((x, y, z), center, strict=True)]
        height = p.pop(axis)
        u, v = p
        if sides:
            side = reduce(np.maximum, (float(np.cos(t)) * u + float(np.sin(t)) * v for t in turns)) - radius
        else:
            side = np.sqrt(u * u + v * v) - radius
        if wave:
            side = side + tooth * np.sin(wave * np.arctan2(u, v))
        return np.maximum(side, abs(height) - half)

    wide = radius / float(np.cos(np.pi / sides)) if sides else radius + tooth
    return _around(distance, center, tuple(half if i == axis else wide for i in range(3)))


def ring(center: Point, radius: float, thickness: float) -> Shape:
    """Torus about the z direction."""
    cx, cy, cz = center

    def distance(x: Block, y: Block, z: Block) -> Block:
        across = np.sqrt((x - cx) ** 2 + (y - cy) ** 2) - radius
        return np.sqrt(across**2 + (z - cz) ** 2) - thickness

    return _around(distance, center, (radius + thickness, radius + thickness, thickness))


def pair(*shapes: Shape) -> list[Shape]:
    """Shapes and their mirror images in the plane x = 0."""

    def mirrored(shape: Shape) -> Shape:
        low, high = (-shape.high[0], *shape.low[1:]), (-shape.low[0], *shape.high[1:])
        return Shape(lambda x, y, z: shape.distance(-x, y, z), low, high)

    return [side for shape in shapes for side in (shape, mirrored(shape))]


def lengths(line: Float[np.ndarray, "points axes"]) -> Float[np.ndarray, " points"]:
    """Lengths of a polyline from its first point to all of its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


KINDS: dict[str, Callable[..., Shape]] = {
    kind.__name__: kind for kind in (ellipsoid, ball, capsule, box, cylinder, ring)
}


def shapes_of(specs: Sequence[Any]) -> list[Shape]:
    """Shapes from JSON: their kinds and arguments; the arguments of `pair` are shapes."""
    shapes = []
    for kind, *args in specs:
        shapes += pair(*shapes_of(args)) if kind == "pair" else [KINDS[kind](*args)]
    return shapes
