"""Draws a scene by VTK's fixed-point ray caster, under settings that are fair to time.

It differs from a march with the left rule: it rounds an interpolated 8-bit value to a whole number, computes
with 15 bits, stops a ray at a transmittance of 255/32767, writes 8 bits, and counts its steps from the near
plane rather than from the entry. Like our space leaping, it skips blocks of 4³ voxels in which nothing is
visible.
"""

# VTK is optional:
# pyright: reportMissingImports=false

import importlib.util
import os
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxvol as jv


# For machines without a screen. VTK reads it when it makes its first window.
os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkOSOpenGLRenderWindow")

PROBE = """
import vtk
window, renderer, reader = vtk.vtkRenderWindow(), vtk.vtkRenderer(), vtk.vtkWindowToImageFilter()
window.SetOffScreenRendering(1)
window.SetSize(64, 64)
window.AddRenderer(renderer)
renderer.SetBackground(0, 1, 0)
window.Render()
reader.SetInput(window)
reader.ReadFrontBufferOff()
reader.Update()
raise SystemExit(reader.GetOutput().GetPointData().GetScalars().GetTuple3(0) != (0, 255, 0))
"""


def missing() -> str | None:
    """Why VTK cannot draw without a screen here; None if it can."""
    if importlib.util.find_spec("vtk") is None:
        return "vtk is not installed: pip install jaxvol[peers]"
    # in a process of its own, since VTK may crash if a library is missing
    if subprocess.run([sys.executable, "-c", PROBE], capture_output=True, timeout=120).returncode != 0:
        return "VTK cannot draw off screen here: apt-get install libosmesa6"
    return None


def dense(transfer: jv.TransferFunction, volume: jv.Volume) -> jv.TransferFunction:
    """The same transfer function at so many equidistant points that it hardly matters what is interpolated
    between them, opacity (VTK) or extinction (jaxvol): all values of 8-bit data, 1024 over the range of
    others."""
    if volume.data.dtype == jnp.uint8:
        values = jnp.arange(256.0)
    else:
        values = jnp.linspace(transfer.values[0], transfer.values[-1], 1024)
    return tabulated(transfer, values)


def tabulated(transfer: jv.TransferFunction, values: Float[Array, " n"]) -> jv.TransferFunction:
    """The transfer function with these control points, on the same curves."""
    colors, extinction = jax.vmap(transfer)(values)
    return jv.TransferFunction(values, jnp.stack(colors, axis=-1), extinction)


class Drawn:
    """A scene in a VTK window, drawn once, by so many threads (by default one for each core). `shade`: with
    these coefficients, under a head light. VTK shades nodes, by their own gradients, and interpolates what
    that gives."""

    def __init__(
        self,
        volume: jv.Volume,
        transfer: jv.TransferFunction,
        camera: jv.Camera,
        step: float,
        threads: int | None = None,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),
        shade: jv.lighting.Phong | None = None,
    ):
        import vtk
        from vtkmodules.util.numpy_support import numpy_to_vtk

        data, lowest = np.asarray(volume.data), 0
        if np.issubdtype(data.dtype, np.integer):
            # VTK's faster loops need values that begin at 0; CT that begins at -1000 takes a third longer
            lowest = int(data.min())
            data = (data.astype(int) - lowest).astype(np.min_scalar_type(int(data.max()) - lowest))
        grid = vtk.vtkImageData()
        grid.SetDimensions(*volume.shape)
        grid.SetSpacing(*volume.spacing.tolist())
        grid.SetOrigin(*volume.origin.tolist())
        grid.GetPointData().SetScalars(numpy_to_vtk(data.ravel(order="F"), deep=True))

        transfer = dense(transfer, volume)
        colors, opacities = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
        points = transfer.values.tolist(), transfer.colors.tolist(), transfer.opacity(step).tolist()
        for value, color, opacity in zip(*points, strict=True):
            colors.AddRGBPoint(value - lowest, *color)
            opacities.AddPoint(value - lowest, opacity)
        look = vtk.vtkVolumeProperty()
        look.SetColor(colors)
        look.SetScalarOpacity(opacities)
        look.SetScalarOpacityUnitDistance(step)
        look.SetInterpolationTypeToLinear()
        look.ShadeOff()
        if shade is not None:
            look.ShadeOn()
            look.SetAmbient(float(shade.ambient))
            look.SetDiffuse(float(shade.diffuse))
            look.SetSpecular(float(shade.specular))
            # (n·h)^4p, which is what VTK computes, is nearly (r·v)^p
            look.SetSpecularPower(4 * float(shade.specular_power))
        look.DisableGradientOpacityOn()

        mapper = vtk.vtkFixedPointVolumeRayCastMapper()
        mapper.SetInputData(grid)
        mapper.SetBlendModeToComposite()
        mapper.IntermixIntersectingGeometryOff()
        # by default VTK draws a coarser image where time is short
        mapper.AutoAdjustSampleDistancesOff()
        mapper.LockSampleDistanceToInputSpacingOff()
        mapper.SetSampleDistance(step)
        mapper.SetInteractiveSampleDistance(step)
        mapper.SetImageSampleDistance(1)
        if threads is not None:
            mapper.SetNumberOfThreads(threads)
        prop = vtk.vtkVolume()
        prop.SetMapper(mapper)
        prop.SetProperty(look)

        renderer, window = vtk.vtkRenderer(), vtk.vtkRenderWindow()
        renderer.AddVolume(prop)
        light = vtk.vtkLight()
        light.SetLightTypeToHeadlight()
        light.SetAmbientColor(1, 1, 1)  # by default a light has none
        renderer.AddLight(light)
        renderer.SetBackground(*background)
        window.SetOffScreenRendering(1)
        window.SetMultiSamples(0)
        window.SetSize(*camera.size)
        window.AddRenderer(renderer)
        aim(renderer.GetActiveCamera(), camera)
        renderer.ResetCameraClippingRange()
        window.Render()
        self.window, self.view, self.mapper = window, renderer.GetActiveCamera(), mapper

    def draw(self) -> None:
        """Cast all rays, and show the image in the window."""
        self.view.Modified()
        self.window.Render()

    def cast(self) -> None:
        """Cast the same rays as `draw`, without the window."""
        self.mapper.RenderSubVolume()

    def image(self) -> Float[np.ndarray, "height width 3"]:
        """The image in the window, in [0, 1], top row first."""
        import vtk
        from vtkmodules.util.numpy_support import vtk_to_numpy

        reader = vtk.vtkWindowToImageFilter()
        reader.SetInput(self.window)
        reader.ReadFrontBufferOff()
        reader.Update()
        width, height = self.window.GetSize()
        pixels = vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars())
        return pixels.reshape(height, width, 3)[::-1] / 255


def aim(view: Any, camera: jv.Camera) -> None:
    """Give VTK's camera the view of ours."""
    left, right, bottom, top = camera.window.tolist()
    half_width, half_height = (right - left) / 2, (top - bottom) / 2
    if not np.isclose(half_width / half_height, camera.size[0] / camera.size[1]):
        raise ValueError(f"camera.window must make square pixels, as VTK does; got {camera.window}.")
    view.SetPosition(*camera.position.tolist())
    view.SetFocalPoint(*camera.focal_point.tolist())
    view.SetViewUp(*camera.view_up.tolist())
    view.SetWindowCenter((left + right) / 2 / half_width, (bottom + top) / 2 / half_height)
    slope = np.tan(np.deg2rad(float(camera.view_angle)) / 2)
    view.SetViewAngle(float(np.rad2deg(2 * np.arctan(half_height * slope))))
    if camera.parallel_scale is not None:
        view.ParallelProjectionOn()
        view.SetParallelScale(float(camera.parallel_scale) * half_height)


def as_displayed(image: np.ndarray, mapper: Any) -> np.ndarray:
    """An image as VTK's display would show it: slightly enlarged, by a texture's linear interpolation.

    VTK casts one ray through the middle of every pixel, as we do, for the n x m pixels that the volume may
    cover. It then stretches the range between the middles of the first and the last texel over these pixels.
    This is half a pixel off at the borders, which is more than all other differences together.
    """
    cast = mapper.GetRayCastImage()
    blends = []
    spans = zip(image.shape[1::-1], cast.GetImageOrigin(), cast.GetImageInUseSize(), strict=True)
    for length, first, n in spans:
        pixel = np.arange(length)
        at = pixel.astype(float)
        at[first : first + n] = first + (np.arange(n) + 0.5) * (n - 1) / n
        blends.append(np.maximum(0, 1 - abs(at[:, None] - pixel)))
    across, up = blends
    return np.einsum("ri,cj,ijk->rck", up, across, image[::-1], optimize=True)[::-1]
