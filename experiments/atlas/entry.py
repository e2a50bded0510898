"""What is an entry of the failure atlas? A regime, swept until a method fails, and what is measured there."""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxvol as jv

from ..scenes import on_cube


Outcome = Literal["bounded", "detected and said", "documented", "fails"]
"""What jaxvol does: the failure cannot occur; or it occurs and jaxvol says so, by an error, a warning or an
output; or a docstring states it; or none of these."""

LEVEL = 1 / 255


class Entry(NamedTuple):
    """One way in which a method fails.

    Attributes:
        name: stable; docstrings point to it.
        question: that the sweep answers.
        does: what jaxvol does, in a sentence; `outcome`: in a word.
        measure: from a value and the number of pixels along a side to the measured numbers, by name.
        method: the object whose docstring states the edge, such as `jaxvol.Jitter`.
        regime: what is swept, with its unit.
        values: of the regime, from harmless to harmful.
        metric: what the measured numbers are.
        judged: the name of the one that finds the edge.
        outcome: what jaxvol does.
        limit: up to which that number counts as good, by default one level of 8 bits; NaN never does.
        picture: linear RGB image at a value, in [0, 1], where an image is measured.
        shows: what the picture shows.
        pictured: the two values; by default the last one within the limit and the last one of all.
        said: the name of the number by which jaxvol says that it fails (1) or not (0).
        size: pixels along a side of the images that are measured; pictures have their own.
    """

    name: str
    question: str
    does: str
    measure: Callable[[float, int], dict[str, float]]
    method: str
    regime: str
    values: tuple[float, ...]
    metric: str
    judged: str
    outcome: Outcome = "documented"
    limit: float = LEVEL
    picture: Callable[[float, int], np.ndarray] | None = None
    shows: str = ""
    pictured: tuple[float, float] | None = None
    said: str | None = None
    size: int = 16


ENTRIES: dict[str, Entry] = {}
"""All entries, by name."""


def entry(*about: Any, **more: Any) -> Callable[[Callable[[float, int], dict[str, float]]], Entry]:
    """Decorator that makes an entry of a function that measures, by whose name it is called. The docstring is
    the question, and, below it, what jaxvol does. The arguments are the entry's, from `method` on."""

    def made(measure: Callable[[float, int], dict[str, float]]) -> Entry:
        question, _, does = (" ".join(part.split()) for part in (measure.__doc__ or "").partition("\n\n"))
        name = measure.__name__.replace("_", " ").replace("16 bit", "16-bit")
        ENTRIES[name] = Entry(name, question, does, measure, *about, **more)
        return ENTRIES[name]

    return made


class Edge(NamedTuple):
    """Neighbouring values of a sweep: the last one at which a method holds, and the first at which it fails.
    `within` is None if it holds nowhere, `beyond` if it holds everywhere."""

    within: float | None
    beyond: float | None


def edge(values: Sequence[float], judged: Sequence[float], limit: float) -> Edge:
    """Where a sweep first exceeds a limit."""
    exceeded = [not number <= limit for number in judged]  # NaN exceeds any limit
    if not any(exceeded):
        return Edge(values[-1], None)
    first = exceeded.index(True)
    return Edge(values[first - 1] if first else None, values[first])


def sweep(entry: Entry, size: int, values: Sequence[float] | None = None) -> dict[str, Any]:
    """Measure an entry: its curves and its edge, as they are recorded."""
    values = entry.values if values is None else values
    rows = [entry.measure(value, size) for value in values]
    curves = {name: [float(row[name]) for row in rows] for name in rows[0]}
    found = edge(values, curves[entry.judged], entry.limit)
    return {"values": list(values), "curves": curves, "edge": found._asdict()}


def rgba(*scene: Any, **how: Any) -> np.ndarray:
    """An image over black, by the adjoint that compiles fastest."""
    return np.asarray(jv.render(*scene, outputs="rgba", adjoint="forward", **how).rgba, np.float64)


def colors(*scene: Any, **how: Any) -> np.ndarray:
    return rgba(*scene, **how)[..., :3]


def opacities(*scene: Any, **how: Any) -> np.ndarray:
    return rgba(*scene, **how)[..., 3]


def ray_opacities(volume: jv.Volume, transfer: Any, rays: tuple[Any, Any], march: jv.March) -> Array:
    """Opacity of rays, (origins, directions)."""
    return jv.render_rays(volume, transfer, *rays, march, outputs="rgba").rgba[..., 3]


def value_and_slope(function: Callable[[Array], Array]) -> Callable[[Any], tuple[np.float64, np.float64]]:
    """A function of one number, and its derivative, compiled."""
    both = jax.jit(jax.value_and_grad(function))

    def of(number: Any) -> tuple[np.float64, np.float64]:
        value, slope = both(jnp.asarray(number, jnp.float32))
        return np.float64(value), np.float64(slope)

    return of


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def along_z(size: int, scale: float = 0.5) -> jv.Camera:
    """An orthographic camera that looks along z at the middle of [-1, 1]³."""
    return jv.Camera((0, 0, -3), (0, 0, 0), (0, 1, 0), size=(size, size), parallel_scale=scale)


def cube(side: int = 8) -> jv.Volume:
    """A volume of ones on [-1, 1]³."""
    return on_cube(np.ones((side,) * 3, np.float32))


def of_field(field: jv.Field) -> jv.Volume:
    """The values of a field on [-1, 1]³."""
    return on_cube(np.zeros((8, 8, 8), np.float32), field=field)


def uniform(extinction: Any, color: tuple[float, ...] = (1.0, 1.0, 1.0)) -> jv.TransferFunction:
    """The same colour and extinction for every value. The extinction may be traced."""
    return jv.TransferFunction([0.0, 1.0], np.tile(color, (2, 1)), jnp.full(2, extinction))


def signed(error: np.ndarray, largest: float) -> np.ndarray:
    """An error as linear RGB: white where it is 0, red where it is positive, blue where it is negative."""
    error = np.mean(error, axis=-1) if error.ndim == 3 else error
    part = np.clip(np.nan_to_num(error, nan=largest) / largest, -1, 1)[..., None]
    red, blue = np.array([0.7, 0.02, 0.02]), np.array([0.02, 0.08, 0.7])
    return np.where(part > 0, 1 + part * (red - 1), 1 - part * (blue - 1))


def grey(values: np.ndarray) -> np.ndarray:
    """Numbers in [0, 1] as linear RGB."""
    return np.repeat(np.clip(np.nan_to_num(values), 0, 1)[..., None], 3, axis=-1)


def shift_of(transform: Any, offset: Any) -> Any:
    """A jitter whose random number is `offset` in all pixels. It must have been made with `"blue"`."""
    tile = jnp.full_like(transform.noise.tile, offset)
    return eqx.tree_at(lambda jitter: jitter.noise.tile, transform, tile)


def finite(tree: Any) -> bool:
    """Whether all float arrays of a tree are finite."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    return all(np.isfinite(leaf).all() for leaf in leaves if np.issubdtype(leaf.dtype, np.inexact))
