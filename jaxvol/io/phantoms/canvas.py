"""Rasterisation of shapes at the nodes of the cube [-1, 1]³, near their boxes and slab by slab for the cache;
and textures. A *field* is a canvas of signed distances, `FAR` in empty space."""

from collections.abc import Callable, Iterable, Iterator

import numpy as np
from jaxtyping import Float

from .shapes import Block, Point, Shape


SLAB = 2**18  # nodes evaluated at once: a handful of float32 temporaries stay in the cache
RAMP = 2.0  # width of a boundary's ramp, voxels; narrower ones show terraces when shaded
FAR = 10.0  # world units; more than any distance in the cube


class Canvas:
    """Values, or signed distances, at the nodes of [-1, 1]³."""

    def __init__(self, resolution: int, fill: float = 0.0):
        self.axis: Float[np.ndarray, " nodes"] = np.linspace(-1, 1, resolution, dtype=np.float32)
        self.spacing = 2 / (resolution - 1)
        self.values = np.full((resolution,) * 3, fill, np.float32)

    def field(self, build: Callable[..., None]) -> "Canvas":
        """Field of distances at the same nodes, to which `build` joins shapes."""
        field = Canvas(len(self.axis), FAR)
        build(field)
        return field

    def slabs(
        self, low: Point = (-1.0,) * 3, high: Point = (1.0,) * 3, reach: float = 0.0
    ) -> Iterator[tuple[tuple[slice, slice, slice], tuple[Block, Block, Block]]]:
        """Indices and world coordinates (an open mesh) of the nodes within `reach` of a box, by slabs."""
        first = np.searchsorted(self.axis, np.array(low, np.float32) - reach)
        last = np.searchsorted(self.axis, np.array(high, np.float32) + reach, side="right")
        if np.any(last <= first):
            return
        y, z = (self.axis[first[i] : last[i]] for i in (1, 2))
        thick = max(1, SLAB // (len(y) * len(z)))
        for start in range(first[0], last[0], thick):
            stop = min(start + thick, last[0])
            index = (slice(start, stop), slice(first[1], last[1]), slice(first[2], last[2]))
            yield index, (self.axis[start:stop, None, None], y[None, :, None], z[None, None, :])

    def join(self, shapes: Shape | Iterable[Shape], blend: float = 0.0, sign: int = 1) -> None:
        """Add shapes to a field of distances, seams rounded over `blend`. Shapes are evaluated up to 2
        `blend` outside their boxes: the first needs the widest blend of all."""
        for shape in [shapes] if isinstance(shapes, Shape) else shapes:
            for index, points in self.slabs(shape.low, shape.high, 2 * blend + 2 * self.spacing):
                distance = shape.distance(*points)
                self.values[index] = sign * smooth_min(sign * self.values[index], distance, blend)

    def carve(self, shapes: Shape | Iterable[Shape], blend: float = 0.0) -> None:
        """Subtract shapes from a field of distances, edges rounded over `blend`."""
        self.join(shapes, blend, -1)

    def paint(
        self,
        value: float | int | Callable[..., Block],
        shape: "Shape | Canvas",
        width: float | None = None,
        grown: float = 0.0,
    ) -> None:
        """Paint a number or function of (x, y, z, distance) on a `grown` shape, with a ramp of a width."""
        width = RAMP * self.spacing if width is None else width
        field = isinstance(shape, Canvas)
        for index, points in self.slabs() if field else self.slabs(shape.low, shape.high, width + grown):
            distance = (shape.values[index] if field else shape.distance(*points)) - grown
            cover = np.clip(0.5 - distance / width, 0, 1)
            if cover.any():
                values = self.values[index]
                values += cover * ((value(*points, distance) if callable(value) else value) - values)

    def as_uint8(self) -> np.ndarray:
        return np.rint(np.clip(self.values, 0, 255, out=self.values), out=self.values).astype(np.uint8)


def smooth_min(a: Block, b: Block, blend: float) -> Block:
    if not blend:
        return np.minimum(a, b)
    overlap = np.maximum(blend - abs(a - b), 0)
    return np.minimum(a, b) - overlap**2 / (4 * blend)


def plane_waves(rng: np.random.Generator, shortest: float, longest: float) -> Callable[..., Block]:
    """Random texture of variance 1, independent of the resolution: 32 plane waves between two wavelengths."""
    direction = rng.normal(size=(32, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    wave_vector = 2 * np.pi * direction / rng.uniform(shortest, longest, (32, 1))
    phase = rng.uniform(0, 2 * np.pi, 32)

    def texture(x: Block, y: Block, z: Block) -> Block:
        # the cosine as the real part of a product of three exponentials: one matrix product sums all waves
        ex, ey, ez = (
            np.exp(1j * np.outer(v.ravel(), k)).astype(np.complex64)
            for v, k in zip((x, y, z), wave_vector.T, strict=True)
        )
        ex = ex * (np.exp(1j * phase) * np.sqrt(2 / 32)).astype(np.complex64)
        exy = (ex[:, None, :] * ey).reshape(-1, 32)
        real, imaginary = exy.real @ ez.real.T, exy.imag @ ez.imag.T
        return (real - imaginary).reshape(x.size, y.size, z.size)

    return texture
