"""How far is the gradient to the transfer function from the converged one, and what does it take?

The gradient is that of the mean square of all premultiplied pixels, by `adjoint="replay"`, to the colours and
to the extinction of all control points. Extinctions of 0, whose gradient leaping leaves out by design, do not
count.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.xla.compiling import OPTIONS

from . import timing
from .pareto_points import BASE, GRADIENTS, Setting
from .pareto_programs import program
from .pareto_reference import march
from .pareto_scenes import Case


FINER = 8

Gradient = tuple[np.ndarray, np.ndarray]
"""To the colours and to the extinction."""


def measure(case: Case, settings: dict[str, Setting], repetitions: int) -> dict[str, Any]:
    """By setting, where one is compared: relative errors, seconds, and their ratio to the base's image."""
    transfer = case.scene.transfer
    truth = gradient(program(case, march(case, FINER)).of_transfer, transfer)[1]()
    coarser = gradient(program(case, march(case, FINER / 2)).of_transfer, transfer)[1]()
    rows, programs = {}, {"image": settings[BASE].make(case).draw}
    for name in (name for name in GRADIENTS if name in settings):
        draw, found = gradient(settings[name].make(case).of_transfer, transfer)
        programs[name], rows[name] = draw, relative(found(), truth, transfer)
    seconds = timing.interleaved(programs, repetitions)
    for name, row in rows.items():
        row["seconds"] = round(float(np.median(seconds[name])), 5)
        row["over the base's image"] = timing.ratio(seconds[name], seconds["image"])
    own = relative(coarser, truth, transfer)
    return {"steps in a voxel": FINER, "reference to twice its step": own, "points": rows}


def gradient(
    rgba: Callable[[jv.TransferFunction], jax.Array] | None, transfer: jv.TransferFunction
) -> tuple[Callable[[], Any], Callable[[], Gradient]]:
    """A program of the image and its gradient, as it is timed; and the gradient."""
    assert rgba is not None

    def loss(leaf: Any) -> jax.Array:
        return jnp.mean(rgba(eqx.tree_at(lambda t: (t.colors, t.extinction), transfer, leaf)) ** 2)

    # compiled as one program, like the image
    both = jax.jit(jax.value_and_grad(loss), compiler_options=OPTIONS)
    at = transfer.colors, transfer.extinction

    def found() -> Gradient:
        colors, extinction = both(at)[1]
        return np.asarray(colors, np.float64), np.asarray(extinction, np.float64)

    return lambda: both(at), found


def relative(found: Gradient, truth: Gradient, transfer: jv.TransferFunction) -> dict[str, Any]:
    """|g - g*| / |g*|, of colours and of extinctions."""
    visible = np.asarray(transfer.extinction) > 0
    kinds = zip(("colours", "extinction"), found, truth, strict=True)
    return {
        kind: float(np.linalg.norm((g - exact)[visible]) / np.linalg.norm(exact[visible]))
        for kind, g, exact in kinds
    }
