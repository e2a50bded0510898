"""Fits parameters so that rendered images match reference images."""

from .bijections import (
    Bijection as Bijection,
    Fixed as Fixed,
    Pose as Pose,
    Positive as Positive,
    Unconstrained as Unconstrained,
    UnitInterval as UnitInterval,
)
from .candidates import (
    Candidate as Candidate,
    nested_materials as nested_materials,
    nested_points as nested_points,
)
from .choice import Choice as Choice, Evidence as Evidence, choose as choose
from .coarse_to_fine import fit_coarse_to_fine as fit_coarse_to_fine
from .driver import Fit as Fit, Outcome as Outcome, fit as fit
from .files import read_transfer as read_transfer, read_views as read_views, write_transfer as write_transfer
from .probe_geometry import ProbeGeometry as ProbeGeometry
from .residuals import ImageResidual as ImageResidual
from .starts import flat_grey as flat_grey, refined as refined
