"""What is timed: a scene under a march, with or without light, or in another program; and the error of its
image."""

import os
from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

import jaxvol as jv
from jaxvol.lighting import Lighting
from jaxvol.metrics import rmse

from . import harness, peer_vtk, timing
from .scenes import Scene


try:
    from . import peer_drjit
except ImportError as fault:
    peer_drjit, NO_DRJIT = None, str(fault)

VTK, DRJIT = "VTK", "Dr.Jit"
THREADS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
"""Of peers: as many as JAX has cores."""
LEFT = 1e-4
"""Transmittance at which rays end: 1/255 would be the error of the most accurate images."""
QUADRATURES = ("left", "midpoint", "preintegrated")

Image: TypeAlias = Float[np.ndarray, "height width 3"]
Quadrature: TypeAlias = Literal["left", "midpoint", "preintegrated"]


class Case(NamedTuple):
    """A scene, the transforms without which it cannot be rendered, its light, and its compositing mode.
    `lighting` makes the light, templates from their options or `Phong`; None where the scene is unlit."""

    scene: Scene
    placed: tuple[jv.Transform, ...] = ()
    lighting: Callable[..., Lighting] | None = None
    compositing: Any = "over"


class Program(NamedTuple):
    """A setting in a scene, ready to run.

    Attributes:
        draw: renders a frame; this is what is timed.
        image: the frame, linear RGB over white.
        seen: the converged image as this program's display would show it.
        samples: mean number of a ray's samples; None where that is not known.
    """

    draw: Callable[[], Any]
    image: Callable[[], Image]
    seen: Callable[[Image], Image] = lambda truth: truth
    samples: Callable[[], float] | None = None


def program(case: Case, march: jv.March, lighting: Lighting | None = None) -> Program:
    def render(outputs: Any = "rgba") -> jv.Rendering:
        how = {"compositing": case.compositing, "lighting": lighting, "outputs": outputs}
        return jv.render(*case.scene[:3], march, **how)

    return Program(
        draw=lambda: render().rgba,
        image=lambda: np.asarray(render().image()),
        samples=lambda: float(np.mean(render("all").samples)),
    )


def ours(
    *transforms: jv.Transform,
    step: float = 1.0,
    quadrature: Quadrature = "midpoint",
    without: tuple[type[jv.Transform], ...] = (),
    changed: Callable[[Case], Case] = lambda case: case,
    lighting: Callable[[Case], Lighting] | None = None,
) -> Callable[[Case], Program]:
    """The base with what differs: transforms in the place of those of their kind or added, kinds that are
    left out, a changed volume or transfer function, a light. The base: cells cut at the exit, leaps, and rays
    that end at `LEFT`."""
    base = jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(LEFT)
    left_out = {*without, *map(type, transforms)}
    kept = (*transforms, *(t for t in base if type(t) not in left_out))

    def make(case: Case) -> Program:
        case = changed(case)
        march = jv.March(step * case.scene.step, (*case.placed, *kept), quadrature)
        return program(case, march, None if lighting is None else lighting(case))

    return make


def converged(scene: Scene, finer: int) -> Image:
    """By the midpoint rule; rays leap, and do not end early."""
    march = jv.March(scene.step / finer, (jv.AlphaCorrection(), jv.SpaceLeaping()), "midpoint")
    return program(Case(scene), march).image()


def lighting_of(case: Case, **how: Any) -> Any:
    assert case.lighting is not None
    return case.lighting(**how)


def peers() -> dict[str, str]:
    """The version of each peer, or why it is left out."""
    reason = peer_vtk.missing()
    return {
        VTK: f"not here: {reason}" if reason else version("vtk"),
        DRJIT: f"mitsuba {version('mitsuba')}, drjit {version('drjit')}, {peer_drjit.VARIANT}"
        if peer_drjit
        else f"not here: {NO_DRJIT}",
    }


def is_here(there: Mapping[str, str], peer: str) -> bool:
    """Whether a peer is here, of what `peers` tells; so is whatever is not a peer."""
    return not there.get(peer, "").startswith("not here")


def of_vtk(drawn: peer_vtk.Drawn) -> Program:
    return Program(drawn.draw, drawn.image, lambda truth: peer_vtk.as_displayed(truth, drawn.mapper))


def by_vtk(step: float, case: Case) -> Program:
    volume, transfer, camera, voxel = case.scene
    shade: Any = None if case.lighting is None else case.lighting()
    return of_vtk(peer_vtk.Drawn(volume, transfer, camera, step * voxel, THREADS, shade=shade))


def marcher(scene: Scene, quadrature: Literal["left", "midpoint"] = "left", left: float = LEFT) -> Any:
    """The scene in Dr.Jit."""
    assert peer_drjit is not None
    return peer_drjit.Marcher(*scene, quadrature, left, THREADS)


def of_drjit(there: Any) -> Program:
    return Program(there.draw, lambda: there.rgba()[..., :3] + 1 - there.rgba()[..., 3:])


def by_drjit(quadrature: Any, step: float, case: Case) -> Program:
    return of_drjit(marcher(case.scene._replace(step=step * case.scene.step), quadrature))


def measured(programs: Mapping[Any, Program], truth: Image, repetitions: int) -> dict[Any, dict[str, Any]]:
    """Time and error of each program, timed in turn. Ratios are to the first."""
    seconds = timing.interleaved({name: each.draw for name, each in programs.items()}, repetitions)
    base = next(iter(seconds.values()))
    return {
        name: harness.row(seconds[name], base, rmse(each.image(), each.seen(truth)))
        for name, each in programs.items()
    }
