"""How is a volume shown of which nothing is known? Guesses of its transfer function (`transfer.py`, by the
thresholds of `histogram.py`), the colours of its labels, and its place in the picture."""

from .framing import FRONT as FRONT, framed as framed, visible_points as visible_points
from .labels import labels_shown as labels_shown
from .transfer import automatic_transfer as automatic_transfer, transfer_by_copy as transfer_by_copy
