"""The transforms of a march: each is one idea from one paper."""

from .alpha_correction import AlphaCorrection as AlphaCorrection
from .clip import Clip as Clip
from .early_termination import EarlyTermination as EarlyTermination
from .jitter import EmptySpaceJitter as EmptySpaceJitter, Jitter as Jitter
from .space_leaping import SpaceLeaping as SpaceLeaping
from .toroidal_map import ToroidalMap as ToroidalMap
