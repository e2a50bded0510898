"""How coarse must an image be to follow a drag? What the last one took decides."""

from dataclasses import dataclass


BUDGET = 0.06
"""Seconds that a coarse image may take: of the 150 ms in which it is to follow the pointer, what is left
once a tile that was being drawn is finished, and the image was encoded and sent to the browser."""

LADDER = ((1, 4.0), (1, 2.0), (1, 1.0), (2, 1.0), (4, 1.0), (6, 1.0), (9, 1.0), (16, 1.0))
"""Coarse images, from the coarsest on: tiles, and how many times as long their steps are. One takes up to
some two times as long as the one before."""

BEGIN = 2


@dataclass
class Pace:
    """The coarse image that is just fast enough, found by steps along `LADDER`."""

    budget: float = BUDGET
    rung: int = BEGIN

    @property
    def tiles(self) -> int:
        """How many tiles the next one has."""
        return LADDER[self.rung][0]

    @property
    def coarser(self) -> float:
        """How many times as long its steps are."""
        return LADDER[self.rung][1]

    def took(self, seconds: float, most: int) -> None:
        """What the last one took, after the programs were compiled. `most`: tiles of the fine image, of which
        a coarse one has no more than half."""
        if seconds > self.budget:
            self.rung -= 2 if seconds > 2 * self.budget else 1
        elif seconds < self.budget / 2.5:
            self.rung += 1
        enough = sum(tiles <= max(1, most // 2) for tiles, _ in LADDER)
        self.rung = min(max(self.rung, 0), enough - 1)
