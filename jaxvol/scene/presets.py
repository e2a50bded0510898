"""Transfer functions by name: presets for kinds of data, and any matplotlib colormap."""

import json
import re
from pathlib import Path
from typing import Any, SupportsIndex, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from .._util.checks import Arrayable, described, finite_array, integer, number, unit_interval
from .._util.srgb import from_srgb
from .._util.texts import near
from .transfer import TransferFunction, extinction_of


# Unlit surfaces show their shape if the foot of their opacity ramp is dark and thin, and the rest bright and
# dense: a grazing ray stays in the foot and draws a dark contour.
#
# name: (purpose, range of values, control points (value, linear rgb, opacity per mm))
Preset: TypeAlias = tuple[str, tuple[float, float], list[tuple[float, tuple[float, float, float], float]]]

PRESETS: dict[str, Preset] = {}
SHADED: set[str] = set()
"""Presets that the command line shades: gradients of magnetic resonance images are mostly noise."""

SLICER = "3D Slicer"


def _add_presets(file: str) -> None:
    """Add the presets of a file: ours, or 3D Slicer's
    (Modules/Loadable/VolumeRendering/Resources/presets.xml) at the points of both curves, with linear
    colours and without the gradient opacity, which is 1."""
    for name, entry in json.loads(Path(__file__).with_name(file).read_text("utf-8")).items():
        points = [(value, (r, g, b), opacity) for value, r, g, b, opacity in entry["points"]]
        low, high = entry.get("range") or (points[0][0], points[-1][0])
        if "range" not in entry and name.startswith("MR"):
            low, high = 0.0, points[-2][0]
        PRESETS[name] = entry.get("purpose", f"{SLICER}'s {name}"), (low, high), points
        SHADED.update({name} if entry["shaded"] else ())


_add_presets("presets.json")
_add_presets("slicer_presets.json")


def preset(name: str, clim: Arrayable | None = None, unit_distance: Arrayable = 1.0) -> TransferFunction:
    """A transfer function by name.

    Args:
        name: a key of `jaxvol.PRESETS`, which lists each preset's purpose and range of values: ours, and
            those of 3D Slicer ("CT-AAA", "MR-Default", …). Case and word separators are ignored, except to
            distinguish "ct_bone" (ours) and "CT-Bone".
        clim: (low, high) in the volume's values, to which the preset's range is stretched linearly. CT stored
            as Hounsfield units + 1000 needs (0, 4000).
        unit_distance: world length to which the opacities refer, by design 1 mm; a `Volume` for the size of
            its voxels.

    Returns:
        The `TransferFunction`, its colours linear.

    Raises:
        ValueError: for an unknown name, and a `clim` that does not increase.
    """
    _, own_range, points = PRESETS[preset_name(name)]
    values, colors, opacities = zip(*points, strict=True)
    low, high = _range(own_range if clim is None else clim)
    stretched = low + (np.array(values) - own_range[0]) * ((high - low) / (own_range[1] - own_range[0]))
    return TransferFunction(stretched, colors, extinction_of(opacities, unit_distance))


def preset_name(name: str) -> str:
    """The key of `PRESETS` for any case and separators. **Raises** `ValueError` for an unknown name."""

    def plain(text: str) -> str:
        return re.sub("[^a-z0-9]", "", text.lower())

    keys = {plain(key): key for key in PRESETS} | {key: key for key in PRESETS}
    for spelling in (name, plain(str(name))):
        if isinstance(name, str) and spelling in keys:
            return keys[spelling]
    raise ValueError(f"preset must be one of {', '.join(PRESETS)}; got {name!r}.{near(str(name), PRESETS)}")


def fitted_range(
    name: str, values: Shaped[np.ndarray, "..."]
) -> tuple[tuple[float, float] | None, str | None]:
    """Default `clim` of a preset for the values of a volume, None for the preset's range; and a warning if
    that does not fit. MR values have no unit, CT values are Hounsfield units."""
    name, low, maximum = preset_name(name), float(values.min()), float(values.max())
    high = maximum if name.endswith("MIP") else float(np.percentile(values, 99.9))
    first, last = PRESETS[name][1]
    if name.upper().startswith("MR") and high > 0 and not last / 2 <= high <= 2 * last:
        warning = f"{name} is for values from {first:g} to {last:g}; it was stretched to 0 to {high:g}"
        return (0.0, high), f"{warning}. Another clim stretches it otherwise."
    if name.upper().startswith("CT") and (low >= 0 or high < 200):
        warning = f"{name} is for Hounsfield units, with air at -1000; the values run from {low:g} to"
        hint = f"If stored + 1024, pass clim=({first + 1024:g}, {last + 1024:g})."
        hint = hint if maximum > 1000 else "Another preset, or clim, suits them."
        return None, f"{warning} {maximum:g}. {hint}"
    return None, None


def attenuation(water: Arrayable) -> TransferFunction:
    """A transfer function of X-ray attenuation for CT in Hounsfield units and `compositing="integral"`:
    white, with the extinction μ = water (1 + HU / 1000), 0 below -1000.

    Args:
        water: attenuation of water at the energy of the image, 1/length in the unit of the volume, > 0:
            0.0206 /mm at 60 keV, 0.0171 /mm at 100 keV (NIST, tables of X-ray mass attenuation coefficients).
            Bone attenuates relatively more at energies below that of the CT.

    Returns:
        The `TransferFunction`.

    Raises:
        ValueError: for a `water` that is not positive and finite.
    """
    densest = 31_000.0  # Hounsfield units of 16-bit integers end at 32767
    water = number("water", water, above=0)
    return TransferFunction([-1000.0, densest], jnp.ones((2, 3)), water * jnp.array([0, 1 + densest / 1000]))


def colormap(
    cmap: str | Arrayable,
    clim: Arrayable,
    opacity: str | Arrayable = "linear",
    unit_distance: Arrayable | None = None,
    n_colors: SupportsIndex = 256,
) -> TransferFunction:
    """A transfer function from a matplotlib colormap and an opacity ramp, as in PyVista's `add_volume`.

    Args:
        cmap: a matplotlib colormap or its name; or one colour, such as `"tomato"` or (1, 0.39, 0.28); or a
            list of colours, evenly spaced and interpolated in sRGB. All are sRGB; their alpha is ignored.
        clim: (low, high), the volume's values at which the colormap begins and ends.
        opacity: `"linear"`, from 0 to 1 over the range; `"sigmoid"`, `1/(1 + exp(-x))` for x from -10 to 10;
            or an array of evenly spaced opacities, in [0, 1].
        unit_distance: thickness, in world length, of a layer with these opacities; or a `Volume`, for the
            size of its voxels (the geometric mean of its spacing). By default, the voxel size of the volume
            that is rendered (`TransferFunction.per_voxel`).
        n_colors: number of control points, at least 2.

    Returns:
        The `TransferFunction`, its colours linear.

    Raises:
        ValueError: for an unknown colormap, colour or opacity, opacities outside [0, 1], and a `clim` that
            does not increase.
    """
    n_colors = integer("n_colors", n_colors, 2)
    colors = _display_colors(cmap, np.linspace(0, 1, n_colors))
    low, high = _range(clim)
    linear = from_srgb(colors)
    values, per_voxel = np.linspace(low, high, n_colors), unit_distance is None
    extinction = extinction_of(_ramp(opacity, n_colors), 1.0 if unit_distance is None else unit_distance)
    return TransferFunction(values, linear, extinction, per_voxel=per_voxel)


def _display_colors(cmap: Any, at: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """sRGB colours at fractions of the range."""
    from matplotlib import colormaps, colors

    if isinstance(cmap, str) and cmap in colormaps:
        cmap = colormaps[cmap]
    if isinstance(cmap, colors.Colormap):
        return cmap(at)[:, :3]
    cmap = jax.tree.map(lambda leaf: np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf, cmap)
    try:
        rgb = colors.to_rgba_array(cmap)[:, :3]
        if len(rgb) == 0 or rgb.min() < 0 or rgb.max() > 1:
            raise ValueError
    except (ValueError, TypeError) as fault:
        hint = near(cmap, colormaps) if isinstance(cmap, str) else ""
        got = repr(cmap) if isinstance(cmap, list | tuple) else described(cmap)
        raise ValueError(
            f"cmap must be a matplotlib colormap, or colours by name or sRGB in [0, 1]; got {got}.{hint}"
        ) from fault
    return np.stack([np.interp(at, np.linspace(0, 1, len(rgb)), channel) for channel in rgb.T], axis=-1)


def _ramp(opacity: Any, n: int) -> Float[Array | np.ndarray, " n"]:
    if isinstance(opacity, str):
        ramps = {"linear": np.linspace(0, 1, n), "sigmoid": 1 / (1 + np.exp(-np.linspace(-10, 10, n)))}
        if opacity not in ramps:
            raise ValueError(f'opacity must be "linear", "sigmoid" or an array; got {opacity!r}.')
        return ramps[opacity]
    opacities = unit_interval("opacity", opacity, (None,))
    if opacities.shape[0] < 2:
        raise ValueError(f"opacity must hold at least 2 values; got {opacities.shape[0]}.")
    return jnp.interp(jnp.linspace(0, 1, n), jnp.linspace(0, 1, opacities.shape[0]), opacities)


def _range(clim: Any) -> tuple[float, float]:
    low, high = np.asarray(finite_array("clim", clim, (2,))).tolist()
    if not low < high:
        raise ValueError(f"clim must be (low, high) with low < high; got {clim}.")
    return low, high
