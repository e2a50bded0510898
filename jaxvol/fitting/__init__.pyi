"""Public names of `jaxvol.fitting`, each of which is imported when it is first used."""

from .bijections import (
    Bijection as Bijection,
    Fixed as Fixed,
    Pose as Pose,
    Positive as Positive,
    ProbeGeometry as ProbeGeometry,
    RigidMotion as RigidMotion,
    Unconstrained as Unconstrained,
    UnitInterval as UnitInterval,
)
from .constraints import unconstrain as unconstrain
from .driver import Fit as Fit, Outcome as Outcome, fit as fit
from .files import read_transfer as read_transfer, read_views as read_views, write_transfer as write_transfer
from .path_traced import PathTracedResidual as PathTracedResidual
from .registration import Registration as Registration, register as register
from .residuals import ImageResidual as ImageResidual
from .starts import flat_grey as flat_grey
from .uncertainty import Uncertainty as Uncertainty
