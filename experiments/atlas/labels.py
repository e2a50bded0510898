"""Where do faces of labels fail? Their motion along a ray, which gradients leave out."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxvol as jv

from .entry import Entry, uniform
from .sampling import halves


FRONT = 0.5
"""Extinction of label 0."""
NEAR, FAR = 0.875, 1.125
"""Thickness of label 0, in front, and of label 1, behind it."""
ANGLE = 0.3


def _opacities(origins: Array, angle: Array, contrast: Array, *, cut: bool, adjoint: str) -> Array:
    """Opacity of parallel rays at this angle to the face of the labels."""
    functions = [uniform(extinction) for extinction in (jnp.full_like(contrast, FRONT), FRONT * contrast)]
    directions = jnp.broadcast_to(jnp.stack([jnp.sin(angle), 0 * angle, jnp.cos(angle)]), origins.shape)
    march = jv.March(0.13, (jv.AlphaCorrection(labels=cut),))
    transfer = jv.LabelTransferFunction(functions)
    rendering = jv.render_rays(
        halves(), transfer, origins, directions, march, outputs="rgba", adjoint=adjoint
    )
    return rendering.rgba[..., 3]


@jax.jit
def _slopes(contrast: Array) -> tuple[Array, Array, Array]:
    """Derivative of the opacity by the angle, with cells cut at labels and without, and by differences."""
    origin = jnp.array([[-0.8, 0.1, -2.0]])

    def opacity(angle: Array, cut: bool) -> Array:
        return _opacities(origin, angle, contrast, cut=cut, adjoint="replay")[0]

    angle, h = jnp.asarray(ANGLE), 0.01
    difference = (opacity(angle + h, True) - opacity(angle - h, True)) / (2 * h)
    return jax.grad(opacity)(angle, True), jax.grad(opacity)(angle, False), difference


def face(contrast: float, size: int) -> dict[str, float]:
    """`contrast`: extinction behind the face, over that in front of it."""
    depth = FRONT * (NEAR + contrast * FAR) / np.cos(ANGLE)
    exact = depth * np.tan(ANGLE) * np.exp(-depth)
    found = (float(slope) for slope in _slopes(jnp.asarray(contrast, jnp.float32)))
    names = "AlphaCorrection(labels=True)", "AlphaCorrection()", "finite differences"
    return {name: abs(slope - exact) / exact for name, slope in zip(names, found, strict=True)}


FACES = Entry(
    name="gradients at label faces",
    question="How much may extinction jump at the face of a label before the gradient of the rays is wrong?",
    method="jaxvol.AlphaCorrection",
    regime="extinction behind the face / in front of it",
    values=(1.0, 1.02, 1.05, 1.1, 1.2, 1.5, 2.0, 5.0),
    measure=face,
    metric="relative error of the derivative by the angle of a ray",
    judged="AlphaCorrection(labels=True)",
    limit=0.1,
    outcome="documented",
    does="Gradients take the depth of a label's face along a ray as fixed, and so give all motion to the "
    "exit. Finite differences of the same image, whose cells are cut at the face, are right.",
    scales=("linear", "log"),
)

ENTRIES = (FACES,)
