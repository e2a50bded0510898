"""What would a scene look like without any error, and how far from that is the image taken for it?

The reference is our image at a fraction of the step, by the midpoint rule (under a thin peak pre-integrated),
cells cut at the exit, rays not ended early; of a lit scene every sample is lit, by many templates. Its own
error is estimated twice: by the difference to the image of twice the step, and, at some pixels, to
`render_ray_reference` in float64 by the midpoint rule, at half the step (under a thin peak at an eighth). In
lit scenes both take one template only, and a third estimate follows from the difference to half as many
templates from another seed.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.lighting import Lighting
from jaxvol.march.march import Quadrature
from jaxvol.metrics import rmse

from .pareto_programs import Image, lighting_of, program
from .pareto_scenes import Case, Row


TEMPLATES = 256
"""Two images of 32 templates each differ by 0.07 on the lit head, as much as they differ from those of some
settings."""
PIXELS = 256
SEEDS = 1001, 2002
"""Of the reference's templates: not those of the settings."""


def march(case: Case, finer: float, quadrature: Quadrature = "midpoint") -> jv.March:
    transforms = *case.placed, jv.AlphaCorrection(), jv.SpaceLeaping()
    return jv.March(case.scene.step / finer, transforms, quadrature)


def converged(case: Case, row: Row, count: int = TEMPLATES, seed: int = SEEDS[0]) -> Image:
    """The reference, over white. `row`: how fine it is; `count`: of templates."""
    how = {"templates": count, "blend": True, "seed": seed} if row.noisy else {}
    lighting = None if case.lighting is None else lighting_of(case, **how)
    return program(case, march(case, row.finer, row.quadrature), lighting).image()


def own_error(case: Case, row: Row, truth: Image, count: int = TEMPLATES) -> dict[str, Any]:
    """What is estimated of the reference's own error: `rmse` in total, and its parts."""
    few: Lighting | None = None if case.lighting is None or row.noisy else lighting_of(case)
    image, exactly = truth, row.finer * (2 if row.quadrature == "midpoint" else 8)
    fine, coarse = (march(case, n, row.quadrature) for n in (row.finer, row.finer / 2))
    if row.noisy:
        # grown once: in float64, random numbers are others
        grown = lighting_of(case, templates=1, photons=8, seed=SEEDS[0]).simulated(blend=False)
        few = lighting_of(case, given=grown)
        image = program(case, fine, few).image()
    pixels = visible_pixels(image)
    exact = in_float64(case, march(case, exactly), few, pixels)
    there = image[pixels[:, 1], pixels[:, 0]]
    found: dict[str, Any] = {
        "steps in a voxel": row.finer,
        "quadrature": row.quadrature,
        "difference to twice the step": rmse(image, program(case, coarse, few).image()),
        "pixels in float64": len(pixels),
        "steps in a voxel, float64": exactly,
        "difference to float64": float(np.sqrt(np.mean((there - exact) ** 2))),
        "largest difference to float64": float(np.abs(there - exact).max()),
    }
    if row.noisy:
        found["templates"] = count
        coarse = row._replace(finer=1)
        one, other = (
            converged(case, coarse, n, seed) for n, seed in zip((count, count // 2), SEEDS, strict=True)
        )
        # of images with the variances v and 2 v
        found["error by the number of templates"] = rmse(one, other) / np.sqrt(3)
    errors = found["difference to float64"], found.get("error by the number of templates", 0)
    return {"rmse": float(np.hypot(*errors)), **found}


def visible_pixels(image: Image) -> np.ndarray:
    """(column, row) of some pixels that show something, drawn at random; of any if none does."""
    rows, columns = np.nonzero(np.any(image != 1, axis=-1))
    if len(rows) == 0:
        rows, columns = (index.ravel() for index in np.indices(image.shape[:2]))
    drawn = np.random.default_rng(0).permutation(len(rows))[:PIXELS]
    return np.column_stack([columns[drawn], rows[drawn]])


def in_float64(case: Case, march: jv.March, lighting: Lighting | None, pixels: np.ndarray) -> np.ndarray:
    """What `render_ray_reference` sees in float64 through these pixels, over white."""
    with jax.enable_x64(True):
        volume, transfer, camera, march, lighting = jax.tree.map(
            doubled, (case.scene.volume, case.scene.transfer, case.scene.camera, march, lighting)
        )

        # voxels keep their type
        volume = eqx.tree_at(lambda v: v.data, volume, case.scene.volume.data)

        def one(pixel: jax.Array) -> jax.Array:
            origin, direction = (jnp.stack(part) for part in camera.ray(pixel[0], pixel[1]))
            how = {"pixel": (pixel[0], pixel[1]), "lighting": lighting, "compositing": case.compositing}
            return jv.render_ray_reference(volume, transfer, origin, direction, march, **how).image()

        return np.asarray(jax.vmap(one)(jnp.asarray(pixels, jnp.int32)))


def doubled(leaf: Any) -> Any:
    """A leaf in float64, if it is of floats."""
    if eqx.is_inexact_array(leaf):
        return jnp.asarray(np.asarray(leaf, np.float64))
    return leaf
