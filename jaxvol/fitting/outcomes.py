"""Outcomes of a fit, and the limits that end it."""

from typing import NamedTuple

import optimistix as optx


class Outcome(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """Outcome of a fit: Optimistix's results, and `stalled`."""

    stalled = (
        "No step lowered the loss by more than rtol any more: either a minimum, to the precision of the "
        "float type, or a point where the derivative does not predict how the loss changes."
    )


class Limits(NamedTuple):
    """Limits at which a fit ends: see `fit`."""

    max_steps: int
    patience: int
    rtol: float
    atol: float
