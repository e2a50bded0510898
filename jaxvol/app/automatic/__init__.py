"""How does a volume look of which nothing is known? Its transfer function, the colours of its labels, its
place in the picture and what is up are guessed.

Values: `thresholds.py` parts them, `body.py` says whether those in the middle are worth to be shown,
`transfer.py` and `labels.py` show them, in colours of `colors.py`. Place: `framing.py`, `upright.py`. All
look at the voxels that `sampling.py` chooses.
"""

from .framing import framed as framed, visible_points as visible_points
from .labels import labels_shown as labels_shown
from .transfer import automatic_transfer as automatic_transfer, transfer_by_copy as transfer_by_copy
from .upright import FRONT as FRONT, front_of as front_of, upright as upright
