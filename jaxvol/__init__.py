"""Differentiable direct volume rendering in JAX.

A camera makes rays; a march steps along them, with transforms that each change one of its answers;
a volume gives values, a transfer function their colour and extinction; the cells blend front to
back into a `Rendering`.
"""

from . import lighting as lighting, metrics as metrics
from .alignment import AlphaCorrection as AlphaCorrection
from .camera import Camera as Camera
from .display import (
    from_srgb as from_srgb,
    save_image as save_image,
    save_png as save_png,
    to_srgb as to_srgb,
)
from .engine import render as render, render_rays as render_rays
from .fitting import (
    Fit as Fit,
    Fixed as Fixed,
    ImageResidual as ImageResidual,
    Pose as Pose,
    Positive as Positive,
    Unconstrained as Unconstrained,
    UnitInterval as UnitInterval,
    fit as fit,
    flat_grey as flat_grey,
    read_transfer as read_transfer,
    read_views as read_views,
    write_transfer as write_transfer,
)
from .formats import load as load
from .jitter import EmptySpaceJitter as EmptySpaceJitter, Jitter as Jitter
from .labels import LabelTransferFunction as LabelTransferFunction
from .leaping import SpaceLeaping as SpaceLeaping
from .lighting import (
    Material as Material,
    PathTraced as PathTraced,
    path_trace as path_trace,
    scatterer_template as scatterer_template,
)
from .march import March as March, Transform as Transform
from .phantoms import (
    colon_path as colon_path,
    phantom as phantom,
    toroidal_phantom as toroidal_phantom,
)
from .presets import PRESETS as PRESETS, colormap as colormap, preset as preset
from .reference import render_ray_reference as render_ray_reference
from .rendering import Picture as Picture, Rendering as Rendering
from .termination import EarlyTermination as EarlyTermination
from .toroidal import ToroidalMap as ToroidalMap
from .transfer import TransferFunction as TransferFunction
from .volume import Volume as Volume
