"""The result of path tracing: an image with its standard error."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt32


class PathTraced(eqx.Module):
    """A path-traced image, from the paths traced so far.

    - `radiance`: linear RGB of the light that the volume scatters into the camera, mean over all paths,
      without the background.
    - `opacity`: the fraction of camera rays that met anything.
    - `deviations`: sums of the squared deviations of each path's radiance from the mean.
    - `scatterings`: mean number of scatterings of a path.
    - `exhausted`: whether any path was cut off by `max_scatterings`; the pixel lacks what it would have
      contributed.
    - `paths`: per pixel. `seed`: of all random numbers.
    """

    radiance: Float[Array, "height width 3"]
    opacity: Float[Array, "height width"]
    deviations: Float[Array, "height width 3"]
    scatterings: Float[Array, "height width"]
    exhausted: Bool[Array, "height width"]
    seed: UInt32[Array, ""]
    paths: int = eqx.field(static=True)

    @property
    def standard_error(self) -> Float[Array, "height width 3"]:
        """Standard error of `radiance`, from the variance of the pixel's paths; infinite for a single path.

        If a pixel's few paths miss a rare bright one, the pixel is too dark and its error too small.
        """
        return jnp.sqrt(self._variance(self.deviations))

    def image(self, background: Any = (1.0, 1.0, 1.0)) -> Float[Array, "height width 3"]:
        """Linear RGB over a background: one colour (3,), or an image of the same shape."""
        return self.radiance + (1 - self.opacity[..., None]) * self._background(background)

    def image_error(self, background: Any = (1.0, 1.0, 1.0)) -> Float[Array, "height width 3"]:
        """Standard error of `image`, including the noise of `opacity`."""
        background, met = self._background(background), self.opacity[..., None]
        # a path that meets nothing has radiance 0, so the means determine the covariance of the two
        mixed = background * (1 - met) * (background * met - 2 * self.radiance)
        return jnp.sqrt(jnp.maximum(self._variance(self.deviations + self.paths * mixed), 0))

    def joined(self, other: "PathTraced") -> "PathTraced":
        """Combine this result with another one, of other paths of the same scene.

        Source: Chan, Golub and LeVeque 1983.
        """
        paths = self.paths + other.paths
        share = other.paths / paths

        def mean(a: Array, b: Array) -> Array:
            return a + (b - a) * share

        between = jnp.square(other.radiance - self.radiance) * (self.paths * share)
        return PathTraced(
            radiance=mean(self.radiance, other.radiance),
            opacity=mean(self.opacity, other.opacity),
            deviations=self.deviations + other.deviations + between,
            scatterings=mean(self.scatterings, other.scatterings),
            exhausted=self.exhausted | other.exhausted,
            seed=self.seed,
            paths=paths,
        )

    def _variance(self, deviations: Float[Array, "height width 3"]) -> Float[Array, "height width 3"]:
        """Variance of a mean, from the squared deviations of all paths."""
        if self.paths < 2:
            return jnp.full_like(deviations, jnp.inf)
        return deviations / (self.paths * (self.paths - 1))

    def _background(self, background: Any) -> Float[Array, "height width 3"]:
        background = jnp.asarray(background, self.radiance.dtype)
        if background.shape not in ((3,), self.radiance.shape):
            raise ValueError(
                f"background must be one colour (3,) or an image {self.radiance.shape}; "
                f"got shape {background.shape}."
            )
        return jnp.broadcast_to(background, self.radiance.shape)
