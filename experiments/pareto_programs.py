"""What runs a setting of a method in a scene: a march, with or without light, or another program."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import jaxvol as jv
from jaxvol.bricks.split import COPIES
from jaxvol.lighting import Deferred, Lighting, Phong
from jaxvol.march.march import Quadrature

from . import accuracy, peer_vtk
from .accuracy import LEFT
from .pareto_scenes import Case
from .speed import THREADS


Image = Float[np.ndarray, "height width 3"]


class Program(NamedTuple):
    """A setting in a scene, ready to run.

    - `draw`: renders a frame; this is what is timed.
    - `image`: the frame, linear RGB over white.
    - `seen`: the converged image as this program's display would show it.
    - `of_transfer`: the frame's premultiplied RGBA, as a function of the transfer function; None where it
      cannot be differentiated.
    """

    draw: Callable[[], Any]
    image: Callable[[], Image]
    seen: Callable[[Image], Image] = lambda truth: truth
    of_transfer: Callable[[jv.TransferFunction], jax.Array] | None = None


def program(case: Case, march: jv.March, lighting: Lighting | None = None) -> Program:
    volume, transfer, camera, _ = case.scene

    def render(transfer: jv.TransferFunction) -> jv.Rendering:
        how = {"compositing": case.compositing, "lighting": lighting, "outputs": "rgba"}
        return jv.render(volume, transfer, camera, march, **how)

    def image() -> np.ndarray:
        rendering = render(transfer)
        assert not np.any(rendering.exhausted)
        return np.asarray(rendering.image())

    return Program(lambda: render(transfer).rgba, image, of_transfer=lambda t: render(t).rgba)


def ours(
    *transforms: jv.Transform,
    step: float = 1.0,
    quadrature: Quadrature = "midpoint",
    without: tuple[type[jv.Transform], ...] = (),
    changed: Callable[[Case], Case] = lambda case: case,
    lighting: Callable[[Case], Lighting] | None = None,
) -> Callable[[Case], Program]:
    """The base with what differs: transforms in the place of those of their kind or added, kinds that are
    left out, a changed volume or transfer function, a light."""
    base = jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(LEFT)
    left_out = {*without, *map(type, transforms)}
    kept = (*transforms, *(t for t in base if type(t) not in left_out))

    def make(case: Case) -> Program:
        case = changed(case)
        march = jv.March(step * case.scene.step, (*case.placed, *kept), quadrature)
        return program(case, march, None if lighting is None else lighting(case))

    return make


@cache
def _folder() -> TemporaryDirectory:
    """Where volumes lie that are read brick by brick, until the program ends."""
    return TemporaryDirectory()


def in_bricks(part: float, step: float, case: Case) -> Program:
    """The base by `render_bricks` from a file, within `part` of what the whole volume takes in memory with
    the copies that are made of it. Ranges of values are found once, before."""
    volume, transfer, camera, voxel = case.scene
    transforms = *case.placed, jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(LEFT)
    march = jv.March(step * voxel, transforms, "midpoint")
    memory = int(part * COPIES * volume.data.nbytes)
    path = Path(_folder().name) / f"{len(list(Path(_folder().name).glob('*.npy')))}.npy"
    np.save(path, np.asarray(volume.data))
    source = jv.bricks.source_of(path, spacing=volume.spacing, origin=volume.origin)

    def render() -> jv.Rendering:
        return jv.render_bricks(source, transfer, camera, march, memory=memory, outputs="rgba")

    def image() -> np.ndarray:
        rendering = render()
        assert not np.any(rendering.exhausted)
        return np.asarray(rendering.image())

    return Program(lambda: render().rgba, image)


def tabulated(points: int, case: Case) -> Case:
    """The transfer function as a table of equidistant entries."""
    values = jnp.linspace(case.scene.transfer.values[0], case.scene.transfer.values[-1], points)
    return case._replace(scene=case.scene._replace(transfer=peer_vtk.tabulated(case.scene.transfer, values)))


def stored(kind: str, case: Case) -> Case:
    """The voxels in another type. What does not fit is scaled to the type's range and rounded, and the
    transfer function with it."""
    volume, transfer = case.scene.volume, case.scene.transfer
    data = np.asarray(volume.data)
    if np.issubdtype(kind, np.integer) and not np.can_cast(data.dtype, kind):
        low, high = float(data.min()), float(data.max())
        scale = np.iinfo(kind).max / (high - low)
        data = np.rint((data.astype(np.float64) - low) * scale)
        values = (np.asarray(transfer.values) - low) * scale
        transfer = jv.TransferFunction(values, transfer.colors, transfer.extinction)
    volume = jv.Volume(data.astype(kind), volume.spacing, volume.origin)
    return case._replace(scene=case.scene._replace(volume=volume, transfer=transfer))


def by_vtk(step: float, case: Case) -> Program:
    volume, transfer, camera, voxel = case.scene
    shade = None if case.lighting is None else case.lighting()
    assert isinstance(shade, Phong | None)
    drawn = peer_vtk.prepare(volume, transfer, camera, step * voxel, THREADS, shade=shade)
    return Program(drawn.draw, drawn.image, lambda truth: peer_vtk.as_displayed(truth, drawn.mapper))


def by_drjit(quadrature: Literal["left", "midpoint"], step: float, case: Case) -> Program:
    marcher = accuracy.drjit(case.scene, quadrature, step)

    def image() -> np.ndarray:
        rgba = marcher.rgba()
        return rgba[..., :3] + 1 - rgba[..., 3:]

    return Program(marcher.draw, image)


def lighting_of(case: Case, **how: Any) -> Any:
    assert case.lighting is not None
    return case.lighting(**how)


def deferred(case: Case, **how: Any) -> Lighting:
    return Deferred(lighting_of(case, **how))
