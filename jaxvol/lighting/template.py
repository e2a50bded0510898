"""Scatterer templates: how light spreads inside a material, as a few photons around a point.

`growth.scatterer_template` simulates one. Lee, Kwon and Shin: Scattered light representation in accordance
with the material using scatterer template in volume rendering (2016), section 3.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._util.checks import integer
from .._util.npy import read_arrays


class ScattererTemplate(eqx.Module):
    """Photons around a sample, brightest first; or several such sets, along leading axes.

    - `offset`: from the sample, world length.
    - `intensity`: the fraction of the light that each photon holds; 0 for padding.
    """

    offset: Float[Array, "*templates n 3"]
    intensity: Float[Array, "*templates n"]

    def sorted(self) -> "ScattererTemplate":
        """The same photons, brightest first."""
        order = jnp.argsort(-jax.lax.stop_gradient(self.intensity), axis=-1, stable=True)
        return ScattererTemplate(
            jnp.take_along_axis(self.offset, order[..., None], axis=-2),
            jnp.take_along_axis(self.intensity, order, axis=-1),
        )

    def brightest(self, photons: int) -> "ScattererTemplate":
        """The `photons` brightest photons, scaled to hold the energy of all."""
        count = min(integer("photons", photons, 1), self.intensity.shape[-1])
        kept, energy = self.intensity[..., :count], jnp.sum(self.intensity, axis=-1, keepdims=True)
        kept_energy = jnp.sum(kept, axis=-1, keepdims=True)
        scale = energy / jnp.where(kept_energy > 0, kept_energy, 1)
        return ScattererTemplate(self.offset[..., :count, :], kept * scale)

    def normalized(self) -> "ScattererTemplate":
        """The same photons, scaled so that each template has energy 1. NaN for a template without energy."""
        return ScattererTemplate(self.offset, self.intensity / self.intensity.sum(axis=-1, keepdims=True))

    def blended(self) -> "ScattererTemplate":
        """Merge the templates along the last leading axis into one with all their photons and mean energy."""
        *rest, templates, n = self.intensity.shape
        offset = self.offset.reshape(*rest, templates * n, 3)
        intensity = self.intensity.reshape(*rest, templates * n) / templates
        return ScattererTemplate(offset, intensity).sorted()

    def save(self, path: str | Path) -> None:
        """Write the template to a NumPy file, `.npz`.

        **Raises:** `ValueError` for another ending; `OSError` for a path that cannot be written."""
        path = Path(path)
        if path.suffix != ".npz":
            raise ValueError(f"path must end in .npz; got {path}.")
        np.savez(path, offset=np.asarray(self.offset), intensity=np.asarray(self.intensity))

    @classmethod
    def load(cls, path: str | Path) -> "ScattererTemplate":
        """Read a template written by `save`.

        **Raises:** `ValueError` naming what is wrong with the file."""
        arrays = read_arrays(Path(path), ("offset", "intensity"))
        offset, intensity = arrays["offset"], arrays["intensity"]
        if offset.shape != (*intensity.shape, 3) or intensity.ndim < 1:
            raise ValueError(
                f"path: {path} must hold offset (*templates, n, 3) and intensity (*templates, n); "
                f"got {offset.shape} and {intensity.shape}."
            )
        if not (np.isfinite(offset).all() and np.isfinite(intensity).all() and (intensity >= 0).all()):
            raise ValueError(f"path: {path} must hold finite offsets and finite intensities of at least 0.")
        return cls(jnp.asarray(offset, float), jnp.asarray(intensity, float))
