"""When can a ray stop before its exit? Early ray termination (KISTI report 2005)."""

from typing import Any

from jaxtyping import Array, Bool, Float

from .._util.checks import number
from .._util.vec3 import Scalar
from ..march import Transform


class EarlyTermination(Transform):
    """End a ray once its transmittance is at most `opacity_left`.

    Everything behind is left out: the error of a colour channel is at most `opacity_left` times the
    brightest colour behind, that of the accumulated opacity at most `opacity_left`. The gradient with
    respect to what is left out is taken as 0, an error of the same order. If the sample at which a ray
    ends changes, the image jumps by as much; gradients do not include these jumps.

    **Arguments:**

    - `opacity_left`: in (0, 1); 1/255 is one level of an 8-bit image.

    **Raises:** `ValueError` outside that range.

    Source: KISTI report 2005, which tests once per 16 slices, since testing every slice cost more than it
    saved. Here the test is part of the definition of the image, and how often to test is up to the engine.
    """

    opacity_left: Float[Array, ""]

    def __init__(self, opacity_left: Any = 1 / 255):
        self.opacity_left = number("opacity_left", opacity_left, above=0, below=1)

    def stop(self, stopped: Bool[Array, ""], transmittance: Scalar) -> Bool[Array, ""]:
        return stopped | (transmittance <= self.opacity_left)
