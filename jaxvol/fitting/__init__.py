"""Which parameters make rendered images agree with given ones?"""

from .bijections import (
    Bijection as Bijection,
    Fixed as Fixed,
    Pose as Pose,
    Positive as Positive,
    Unconstrained as Unconstrained,
    UnitInterval as UnitInterval,
)
from .driver import Fit as Fit, fit as fit
from .residuals import ImageResidual as ImageResidual
