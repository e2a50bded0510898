"""Public names of jaxvol, each of which is imported when it is first used."""

from . import bricks as bricks, lighting as lighting, metrics as metrics
from ._util.srgb import from_srgb as from_srgb, to_srgb as to_srgb
from ._util.version import __version__ as __version__
from .app.automatic import automatic_transfer as automatic_transfer, labels_shown as labels_shown
from .app.framing import automatic_camera as automatic_camera
from .app.show import show as show
from .app.viewer import serve as serve, view as view
from .bricks import render_bricks as render_bricks
from .compositing.blending import Compositing as Compositing, Over as Over, Weighting as Weighting
from .compositing.isosurface import Isosurface as Isosurface
from .compositing.line_integral import LineIntegral as LineIntegral
from .compositing.projections import Average as Average, Maximum as Maximum, Minimum as Minimum
from .compositing.selection import FirstVisible as FirstVisible, Selection as Selection
from .fitting import (
    Fit as Fit,
    Fixed as Fixed,
    ImageResidual as ImageResidual,
    PathTracedResidual as PathTracedResidual,
    Pose as Pose,
    Positive as Positive,
    ProbeGeometry as ProbeGeometry,
    Registration as Registration,
    RigidMotion as RigidMotion,
    Uncertainty as Uncertainty,
    Unconstrained as Unconstrained,
    UnitInterval as UnitInterval,
    fit as fit,
    flat_grey as flat_grey,
    read_transfer as read_transfer,
    read_views as read_views,
    register as register,
    unconstrain as unconstrain,
    write_transfer as write_transfer,
)
from .io import datasets as datasets
from .io.display import save_image as save_image, save_png as save_png, show_images as show_images
from .io.formats import load as load, load_ultrasound as load_ultrasound, save as save
from .io.phantoms import colon_path as colon_path, phantom as phantom, toroidal_phantom as toroidal_phantom
from .io.scan_conversion import scan_convert as scan_convert
from .lighting import Material as Material, scatterer_template as scatterer_template
from .march.march import March as March, Transform as Transform
from .march.transforms.alpha_correction import AlphaCorrection as AlphaCorrection
from .march.transforms.clip import Clip as Clip
from .march.transforms.early_termination import EarlyTermination as EarlyTermination
from .march.transforms.jitter import EmptySpaceJitter as EmptySpaceJitter, Jitter as Jitter
from .march.transforms.space_leaping import SpaceLeaping as SpaceLeaping
from .march.transforms.toroidal_map import ToroidalMap as ToroidalMap
from .path_tracing import PathTraced as PathTraced, path_trace as path_trace
from .planning import Plan as Plan, plan as plan
from .reference import render_ray_reference as render_ray_reference
from .render import render as render, render_rays as render_rays
from .scene.camera import Camera as Camera
from .scene.labels import LabelTransferFunction as LabelTransferFunction
from .scene.occupancy import Occupancy as Occupancy
from .scene.presets import (
    PRESETS as PRESETS,
    attenuation as attenuation,
    colormap as colormap,
    preset as preset,
)
from .scene.radiance import RadianceField as RadianceField
from .scene.rendering import RaySamples as RaySamples, Rendering as Rendering
from .scene.space import Gap as Gap, Space as Space
from .scene.transfer import Transfer as Transfer, TransferFunction as TransferFunction
from .scene.transfer2d import TransferFunction2D as TransferFunction2D
from .scene.volume import Field as Field, Volume as Volume
from .xla.persistent_cache import keep_programs as keep_programs
