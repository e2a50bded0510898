"""2D/3D registration by X-ray images, from many starts. Images are compared from coarse to fine, since a
derivative only describes features that move by less than their size. For images of mean 0 and length 1 with
correlation c, half the squared difference is 1 - c, so that few Levenberg–Marquardt steps maximise c."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple, cast, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .._util.checks import Arrayable, described, finite_array, integer
from ..march.march import March
from ..march.transforms.alpha_correction import AlphaCorrection
from ..metrics import standardized
from ..ray import check_arguments
from ..render import Adjoint, render
from ..scene.camera import Camera
from ..scene.transfer import Transfer, sized
from ..scene.volume import Volume, check_one_channel
from .bijections import RigidMotion
from .constraints import Free
from .damping import LevenbergMarquardt
from .driver import allow_promotion
from .noise import pixel_values
from .references import camera_and_image
from .residuals import Problem


Similarity = Literal["gradient_ncc", "ncc"]

NEAR = 0.01
"""Tolerance: a search ends at a step that moves voxels by less than this fraction of a pixel."""


class Registration(NamedTuple):
    """Result of `register`; `print(result)` shows a table of the starts, the most similar first.

    Attributes:
        motion: the motion of the cameras whose images are the most similar.
        cameras: cameras of the views after this motion, from which the volume looks as in the images.
        similarity: similarity after this motion, averaged over the views.
        starts: motions at which searches began.
        ends: motions at which searches ended, in the same order.
        similarities: similarity at starts and ends, (n, 2), of images of the last level.
    """

    motion: RigidMotion
    cameras: list[Camera]
    similarity: float
    starts: RigidMotion
    ends: RigidMotion
    similarities: Float[np.ndarray, "n 2"]

    def __str__(self) -> str:
        turns, shifts = (np.linalg.norm(np.asarray(vectors), axis=1) for vectors in self.ends[:2])
        rows = ["start  similarity   after  turned by    moved by"]
        for at in np.argsort(-self.similarities[:, 1]):
            before, after = self.similarities[at]
            rows.append(f"{at:5}{before:12.4f}{after:8.4f}{np.rad2deg(turns[at]):10.2f}°{shifts[at]:12.4g}")
        return "\n".join(rows)


def register(
    volume: Volume,
    transfer: Transfer,
    views: Sequence[tuple[Camera, Arrayable]] | Any,
    starts: RigidMotion | Any | None = None,
    *,
    similarity: Similarity | str = "gradient_ncc",
    weights: Arrayable | Sequence[Arrayable | None] | None = None,
    levels: Arrayable = (8, 2, 1),
    march: March | Any | None = None,
    max_steps: int = 20,
) -> Registration:
    """Register a volume with X-ray images of it: find the rigid motion of their cameras under which line
    integrals through the volume are the most similar to the images.

    Searches go from each start to a maximum of the similarity, on images averaged over fewer pixels from
    level to level, and through voxels averaged to about a pixel's size. `experiments/register.py` measures
    from how far searches succeed. All starts run in one program for each level, on concrete arrays (not under
    `jax.jit`).

    Args:
        volume: a CT, for example.
        transfer: white, and the attenuation, such as `jaxvol.attenuation(0.02)`, whose scale doesn't matter.
        views: pairs (camera, image), at least one; cameras of one size and kind, which are moved together. An
            image is (height, width), of line integrals in any unit: -log(I / I₀) of an X-ray's intensity.
        starts: initial motions, rotation and translation (n, 3), about any center; by default the identity,
            with rotations about the volume's center.
        similarity: `"gradient_ncc"`, of edges, or `"ncc"`: see `jaxvol.metrics`.
        weights: weights of the pixels of each view, (height, width), as for `ImageResidual`.
        levels: side in pixels of the blocks that are averaged at each level.
        march: march through the volume's voxels; through averaged voxels, steps grow with them. By default,
            steps of the smallest spacing by the midpoint rule, with `AlphaCorrection`.
        max_steps: maximum number of steps from each start at each level.

    Returns:
        A `Registration`: the best motion, the cameras after it, and the ends of all searches.

    Raises:
        ValueError: for arguments of another kind, shape or range, and views of several sizes or kinds.
    """
    transfer = sized(transfer, volume)
    check_arguments("register(volume, transfer, views)", volume=volume, transfer=transfer)
    check_one_channel(volume, "register")
    if similarity not in get_args(Similarity):
        raise ValueError(f'similarity must be "gradient_ncc" or "ncc"; got {similarity!r}.')
    if not isinstance(views, list | tuple) or not views:
        raise ValueError(f"views must be a list of at least one (camera, image); got {described(views)}.")
    read = [camera_and_image(number, view) for number, view in enumerate(views)]
    cameras, shape = [camera for camera, _ in read], read[0][0].size[::-1]
    if len({jax.tree.structure(camera) for camera in cameras}) > 1:
        raise ValueError("views must have cameras of one size and kind; got several. Pass those of one kind.")
    images = [finite_array(f"views[{at}]: the image", image, shape) for at, (_, image) in enumerate(read)]
    counted = [
        np.ones(shape) if weight is None else weight[..., 0]
        for weight in pixel_values("weights", weights, [(*shape, 1)] * len(read))
    ]
    for number, (image, weight) in enumerate(zip(images, counted, strict=True)):
        if len(np.unique(np.asarray(image)[weight > 0])) < 2:
            raise ValueError(
                f"views[{number}]: the image must not be constant where its weights are positive; got one of "
                f"{np.count_nonzero(weight > 0)} equal pixels. Remove this view."
            )
    factors = [integer("levels", level, 1) for level in np.ravel(levels).tolist()]
    if not factors:
        raise ValueError("levels must hold at least one, such as 1; got none.")
    if starts is None:
        starts = RigidMotion(np.zeros((1, 3)), np.zeros((1, 3)), volume.center)
    if not isinstance(starts, RigidMotion):
        raise ValueError(f"starts must be a RigidMotion; got {described(starts)}.")
    turns = np.asarray(finite_array("starts.rotation", starts.rotation, (None, 3)))
    shifts = np.asarray(finite_array("starts.translation", starts.translation, turns.shape))
    if not len(turns):
        raise ValueError("starts must hold at least one motion; got none.")
    center = finite_array("starts.center", starts.center, (3,))
    march = March(np.min(volume.spacing), (AlphaCorrection(),), "midpoint") if march is None else march
    check_arguments("register(volume, transfer, views, march=...)", march=march)
    assert isinstance(march, March)

    # in NumPy, which compiles nothing
    low, high = map(np.asarray, volume.corners)
    radius = np.linalg.norm(high - low) / 2
    begun = ends = np.concatenate([turns, shifts / radius], axis=1)
    max_steps, level = integer("max_steps", max_steps, 1), cast(Any, None)
    for factor in factors:
        averaged = [_averaged(*view, factor) for view in zip(cameras, images, counted, strict=True)]
        stacked: Any = jax.tree.map(lambda *leaves: np.stack(leaves), *averaged)
        pixel = min(_pixel(camera, center) for camera, *_ in averaged)
        coarse = _coarser(volume, pixel)
        step = np.asarray(march.step) * (np.asarray(coarse.spacing).min() / np.asarray(volume.spacing).min())
        scene = coarse, transfer, eqx.tree_at(lambda m: m.step, march, step)
        fields: Any = jax.device_put((scene, stacked, center, radius, NEAR * pixel / radius))
        level = _Level(*fields, gradient=similarity == "gradient_ncc")
        with allow_promotion():
            ends = np.asarray(_search(level, ends, max_steps))
    table = np.asarray(_similarities(level, np.stack([begun, ends], axis=1)))
    reached = RigidMotion(ends[:, :3], ends[:, 3:] * radius, center)
    at = int(np.nanargmax(table[:, 1]))
    best = RigidMotion(reached.rotation[at], reached.translation[at], center)
    move = eqx.filter_jit(RigidMotion.camera)
    moved = [move(best, camera) for camera in cameras]
    return Registration(best, moved, float(table[at, 1]), RigidMotion(turns, shifts, center), reached, table)


class _Level(eqx.Module):
    """Residual of a level as a function of a motion: a rotation vector, and a translation in radii."""

    scene: tuple[Volume, Transfer, March]
    views: tuple[Camera, Float[Array, "views height width"], Float[Array, "views height width"]]
    """Cameras, images and weights."""
    center: Float[Array, "3"]
    radius: Float[Array, ""]
    near: Float[Array, ""]
    gradient: bool = eqx.field(static=True)

    def __call__(self, motion: Float[Array, "6"], adjoint: Adjoint = "forward") -> Float[Array, "views ..."]:
        volume, transfer, march = self.scene
        moved = RigidMotion(motion[:3], motion[3:] * self.radius, self.center)

        def view_residual(view: tuple[Camera, Array, Array]) -> Array:
            camera, image, weight = view
            options: Any = {"compositing": "integral", "outputs": "rgba", "adjoint": adjoint}
            rendered = render(volume, transfer, moved.camera(camera), march, **options).rgba[..., 0]
            standard = partial(standardized, weights=weight, gradient=self.gradient)
            return standard(rendered) - standard(image)

        difference = jax.lax.map(view_residual, self.views)
        return difference / math.sqrt(len(self.views[1]))


@eqx.filter_jit
def _search(level: _Level, starts: Arrayable, max_steps: int) -> Float[Array, "n 6"]:
    """Ends of the searches from the starts, one in each row."""
    free, _ = Free.of(np.zeros(6), None, None)

    def search(start: Float[Array, "6"]) -> Float[Array, "6"]:
        problem = Problem.of(level, free, (start,), 2**30, True)
        solver = eqx.tree_at(lambda s: s.atol, LevenbergMarquardt(1e-3, 0.0), level.near)
        options: Any = {"has_aux": True, "max_steps": max_steps, "throw": False}
        return optx.least_squares(problem, solver, (start,), **options).value[0]

    return jax.lax.map(search, starts)


@eqx.filter_jit
def _similarities(level: _Level, motions: Arrayable) -> Float[Array, "n m"]:
    flat = motions.reshape(-1, 6)
    values = jax.lax.map(lambda motion: 1 - jnp.sum(level(motion, "replay") ** 2) / 2, flat)
    return values.reshape(motions.shape[:2])


def _averaged(camera: Camera, image: Array, weight: np.ndarray, factor: int) -> tuple[Camera, Any, Any]:
    """A view averaged over blocks of `factor` x `factor` pixels; blocks at the border may be cut."""
    pads = [(0, -n % factor) for n in image.shape]
    shape = [m for n in image.shape for m in (-(-n // factor), factor)]
    planes = weight * np.asarray(image), weight
    sums, counts = (np.pad(plane, pads).reshape(shape).mean(axis=(1, 3)) for plane in planes)
    x0, x1, y0, y1 = np.asarray(camera.window)
    scale_x, scale_y = (n * factor / m for n, m in zip(sums.shape[::-1], camera.size, strict=True))
    window = x0, x0 + (x1 - x0) * scale_x, y1 - (y1 - y0) * scale_y, y1
    larger = replace(camera, window=window, size=sums.shape[::-1], corner=None)
    averages = sums / np.where(counts > 0, counts, 1)
    return larger, averages.astype(image.dtype), counts.astype(image.dtype)


def _pixel(camera: Camera, at: Float[Array, "3"]) -> float:
    """Height of a pixel in the plane through a point, world length."""
    low, high = np.asarray(camera.window)[2:]
    half = camera.parallel_scale
    if half is None:
        distance = np.linalg.norm(np.asarray(camera.position) - np.asarray(at))
        half = distance * np.tan(np.deg2rad(float(camera.view_angle)) / 2)
    return float(half) * float(high - low) / camera.size[1]


def _coarser(volume: Volume, size: float) -> Volume:
    """The volume averaged over blocks of voxels of at most the size; a field stays as it is."""
    spacing = np.asarray(volume.spacing)
    blocks = np.clip(size / spacing, 1, np.array(volume.shape) // 2).astype(int)
    if volume.field is not None or np.all(blocks == 1):
        return volume
    pads = [(0, -n % block) for n, block in zip(volume.shape, blocks, strict=True)]
    data = np.pad(np.asarray(volume.data, np.float32), pads, mode="edge")
    shape = [m for n, block in zip(data.shape, blocks, strict=True) for m in (n // block, block)]
    shift = (blocks - 1) / 2 * spacing
    if volume.direction is not None:
        shift = np.asarray(volume.direction) @ shift
    origin = np.asarray(volume.origin) + shift
    return Volume(
        data.reshape(shape).mean(axis=(1, 3, 5)), spacing * blocks, origin, direction=volume.direction
    )
