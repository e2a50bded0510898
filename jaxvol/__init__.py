"""Differentiable direct volume rendering in JAX.

A camera generates rays; a march steps along them, and each of its transforms changes one aspect of
it. A volume gives values, a transfer function maps them to colour and extinction, and the cells are
composited front to back into a `Rendering`.
"""

from . import bricks as bricks, datasets as datasets, lighting as lighting, metrics as metrics
from .automatic import automatic_transfer as automatic_transfer
from .bricks import BudgetPlan as BudgetPlan, plan as plan, render_bricks as render_bricks
from .camera import Camera as Camera
from .compositing import Compositing as Compositing, Over as Over, Weighting as Weighting
from .display import (
    from_srgb as from_srgb,
    save_image as save_image,
    save_png as save_png,
    show_images as show_images,
    to_srgb as to_srgb,
)
from .fitting import (
    Candidate as Candidate,
    Choice as Choice,
    Fit as Fit,
    Fixed as Fixed,
    ImageResidual as ImageResidual,
    Pose as Pose,
    Positive as Positive,
    ProbeGeometry as ProbeGeometry,
    Unconstrained as Unconstrained,
    UnitInterval as UnitInterval,
    choose as choose,
    fit as fit,
    fit_coarse_to_fine as fit_coarse_to_fine,
    flat_grey as flat_grey,
    nested_materials as nested_materials,
    nested_points as nested_points,
    read_transfer as read_transfer,
    read_views as read_views,
    refined as refined,
    write_transfer as write_transfer,
)
from .formats import load as load, load_ultrasound as load_ultrasound, save as save
from .isosurface import Isosurface as Isosurface
from .labels import LabelTransferFunction as LabelTransferFunction
from .lighting import (
    Material as Material,
    scatterer_template as scatterer_template,
)
from .march import March as March, Transform as Transform
from .path_tracing import PathTraced as PathTraced, path_trace as path_trace
from .phantoms import (
    colon_path as colon_path,
    phantom as phantom,
    toroidal_phantom as toroidal_phantom,
)
from .planning import Plan as Plan
from .presets import PRESETS as PRESETS, colormap as colormap, preset as preset
from .programs import keep_programs as keep_programs
from .projections import Average as Average, Maximum as Maximum, Minimum as Minimum
from .reference import render_ray_reference as render_ray_reference
from .render import render as render, render_rays as render_rays
from .rendering import Rendering as Rendering
from .scan_conversion import scan_convert as scan_convert
from .selection import FirstVisible as FirstVisible, Selection as Selection
from .transfer import TransferFunction as TransferFunction
from .transfer2d import TransferFunction2D as TransferFunction2D
from .transforms import (
    AdaptiveSampling as AdaptiveSampling,
    AlphaCorrection as AlphaCorrection,
    Clip as Clip,
    EarlyTermination as EarlyTermination,
    EmptySpaceJitter as EmptySpaceJitter,
    Jitter as Jitter,
    SpaceLeaping as SpaceLeaping,
    ToroidalMap as ToroidalMap,
)
from .viewer import serve as serve, view as view
from .volume import Field as Field, Volume as Volume
