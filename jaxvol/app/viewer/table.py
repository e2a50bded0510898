"""A transfer function of value and gradient magnitude in a viewer: its values are moved and stretched."""

from dataclasses import dataclass

import numpy as np

from ...scene.transfer2d import TransferFunction2D
from .look import Ranged


@dataclass(frozen=True, eq=False)
class Table(Ranged):
    """Lines of a table, each of one value. `function`: that has the rest."""

    function: TransferFunction2D

    @classmethod
    def of(cls, transfer: TransferFunction2D) -> "Table":
        """The lines of a transfer function."""
        return cls(tuple(map(float, np.asarray(transfer.values))), transfer)

    @property
    def count(self) -> str:
        return f"{len(self.values)} x {self.function.magnitudes.shape[0]} points"

    def transfer(self) -> TransferFunction2D:
        own = self.function
        return TransferFunction2D(self.values, own.magnitudes, own.colors, own.extinction)
