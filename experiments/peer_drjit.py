"""Marches a scene in Dr.Jit: the same rays and the same samples, compiled by LLVM, or for JAX's GPU by CUDA.

This is the best that a compiler does without skipping: every sample between a ray's entry and its exit or
early termination is visited. The gradient is the replay adjoint of Mitsuba's own integrators (Vicini,
Speierer, Jakob 2021): after the image, a second march computes every sample again and propagates its gradient
at once, so that memory does not grow with the number of samples.

Importing this file raises ImportError, with the reason, where Dr.Jit cannot run.
"""

from importlib import import_module
from typing import Any, Literal, TypeAlias

import jax
import numpy as np
from jaxtyping import Float

import jaxvol as jv

from .peer_vtk import dense


try:
    dr: Any = import_module("drjit")
    mi: Any = import_module("mitsuba")
except ImportError as fault:
    raise ImportError("mitsuba is not installed: pip install jaxvol[peers]") from fault
ON_GPU = jax.default_backend() == "gpu"
if ON_GPU and not dr.has_backend(dr.JitBackend.CUDA):
    raise ImportError("Dr.Jit finds no CUDA")
if not ON_GPU and not dr.has_backend(dr.JitBackend.LLVM):
    raise ImportError(
        "Dr.Jit finds no LLVM: apt-get install libllvm19, and name its .so in DRJIT_LIBLLVM_PATH"
    )
VARIANT = "cuda_ad_rgb" if ON_GPU else "llvm_ad_rgb"
mi.set_variant(VARIANT)

Drjit: TypeAlias = Any
"""One of Dr.Jit's arrays: a lane for each ray."""


class Marcher:
    """A scene in Dr.Jit, drawn once.

    Args:
        volume: of the scene.
        transfer: of the scene.
        camera: of the scene.
        step: as for `jaxvol.March`.
        quadrature: as for `jaxvol.March`.
        opacity_left: as for `jaxvol.EarlyTermination`; 0 ends rays only at their exit.
        threads: number of Dr.Jit's threads in this process.
    """

    def __init__(
        self,
        volume: jv.Volume,
        transfer: jv.TransferFunction,
        camera: jv.Camera,
        step: float,
        quadrature: Literal["left", "midpoint"],
        opacity_left: float,
        threads: int,
    ):
        dr.set_thread_count(threads)
        origins, directions = (np.asarray(points).reshape(-1, 3).T for points in camera.rays())
        self.rays: Any = mi.Ray3f(mi.Point3f(origins), mi.Vector3f(directions))
        self.size = camera.size

        # voxels as float32: 8-bit and half-precision textures are slower, by half and by four fifths
        data = np.asarray(volume.data, np.float32).transpose(2, 1, 0)[..., None]
        self.grid = mi.TensorXf(np.ascontiguousarray(data))
        self.voxels = mi.Texture3f(self.grid)
        self.box: Any = mi.BoundingBox3f(*(corner.tolist() for corner in volume.corners))
        self.origin, self.spacing, self.shape = (
            mi.Vector3f(*axes) for axes in (volume.origin.tolist(), volume.spacing.tolist(), volume.shape)
        )

        transfer = dense(transfer, volume)
        self.first, self.last = float(transfer.values[0]), float(transfer.values[-1])
        self.table = mi.TensorXf(np.column_stack([transfer.colors, transfer.extinction]))
        self.transfer = mi.Texture1f(self.table)

        # variables, not constants, so that another step or threshold does not compile the program again
        self.step, self.opacity_left = dr.opaque(mi.Float, step), dr.opaque(mi.Float, opacity_left)
        self.sampled = dr.opaque(mi.Float, step / 2 if quadrature == "midpoint" else 0.0)
        dr.eval(self.rays, self.voxels, self.transfer)
        self.draw()

    def draw(self) -> None:
        """March all rays, and wait for the image."""
        self.color, self.left = self._march()
        dr.eval(self.color, self.left)
        dr.sync_thread()

    def rgba(self) -> Float[np.ndarray, "height width 4"]:
        """The last image, premultiplied."""
        width, height = self.size
        channels = [*np.array(self.color), 1 - np.array(self.left)]
        return np.stack(channels, axis=-1).reshape(height, width, 4)

    def differentiate(self, of: Literal["transfer", "voxels"]) -> Drjit:
        """March all rays, and wait for the gradient of `mean(rgba²)`, in Dr.Jit's layout: to (r, g, b,
        extinction) of each point of the transfer function, as made dense here; or to the voxels."""
        leaf, texture = (self.table, self.transfer) if of == "transfer" else (self.grid, self.voxels)
        dr.enable_grad(leaf)
        dr.clear_grad(leaf)
        texture.set_tensor(leaf)
        self.color, self.left = self._march()
        image = mi.Vector4f(*self.color, 1 - self.left)
        cotangent = 2 * image / (4 * dr.width(self.rays))
        dr.eval(self.color, self.left, cotangent)
        self._march_again(cotangent)
        gradient = dr.grad(leaf)
        dr.eval(gradient)
        dr.sync_thread()
        dr.disable_grad(leaf)
        texture.set_tensor(leaf)
        return gradient

    def gradient(self, of: Literal["transfer", "voxels"]) -> Float[np.ndarray, "..."]:
        """The same: (points, 4), or (nx, ny, nz)."""
        found = np.array(self.differentiate(of))
        return found if of == "transfer" else found[..., 0].transpose(2, 1, 0)

    @dr.syntax
    def _march(self) -> tuple[Drjit, Drjit]:
        """Colour, and the transmittance that is left."""
        with dr.suspend_grad():
            start, rate, length = self._enter()
            index, depth = mi.UInt32(0), mi.Float(self.sampled)
            color, transmittance = mi.Color3f(0), mi.Float(1)
            live = depth < length
            while live:
                emitted, extinction = self._classify(start + depth * rate)
                passed = dr.exp(-extinction * self.step)
                color += transmittance * (1 - passed) * emitted
                transmittance *= passed
                index += 1
                depth = dr.fma(mi.Float(index), self.step, self.sampled)
                live &= (depth < length) & (transmittance > self.opacity_left)
        return color, transmittance

    @dr.syntax
    def _march_again(self, cotangent: Drjit) -> None:
        """The same loop, in which every sample adds its gradient to that of the table."""
        with dr.suspend_grad():
            start, rate, length = self._enter()
            index, depth = mi.UInt32(0), mi.Float(self.sampled)
            behind, transmittance = mi.Color3f(self.color), mi.Float(1)
            to_color, to_opacity = mi.Color3f(cotangent.x, cotangent.y, cotangent.z), cotangent.w
            live = depth < length
            while live:
                with dr.resume_grad():
                    emitted, extinction = self._classify(start + depth * rate)
                    passed = dr.exp(-extinction * self.step)
                    added = transmittance * (1 - passed) * emitted
                    behind -= dr.detach(added)
                    # a cell's extinction also attenuates everything behind it, in proportion
                    dimmed = dr.dot(to_color, behind) - to_opacity * self.left
                    dr.backward_from(dr.dot(to_color, added) - dimmed * extinction * self.step)
                transmittance *= dr.detach(passed)
                index += 1
                depth = dr.fma(mi.Float(index), self.step, self.sampled)
                live &= (depth < length) & (transmittance > self.opacity_left)

    def _enter(self) -> tuple[Drjit, Drjit, Drjit]:
        """Entry point and rate per depth of each ray, both in texture coordinates, and its length."""
        hit, near, far = self.box.ray_intersect(self.rays)
        near = dr.maximum(near, 0)
        # n texels span a texture coordinate of 1; our nodes are their centres
        start = ((self.rays(near) - self.origin) / self.spacing + 0.5) / self.shape
        return start, self.rays.d / self.spacing / self.shape, dr.select(hit, far - near, 0)

    def _classify(self, place: Drjit) -> tuple[Drjit, Drjit]:
        """Colour and extinction at a texture coordinate."""
        (value,) = self.voxels.eval(place)
        n = self.table.shape[0]
        fraction = (value - self.first) / (self.last - self.first)
        r, g, b, extinction = self.transfer.eval(mi.Float((fraction * (n - 1) + 0.5) / n))
        return mi.Color3f(r, g, b), extinction
