"""Several volumes in one image, `render([ct, pet], [of_ct, of_pet], …)`: their bounding grid, whose field
(`Several`) reads all volumes, and a transfer function (`Together`) that adds extinctions."""

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._util.checks import described
from .._util.vec3 import Color, Scalar, Vec3, apart
from ..xla.trees import is_none
from .occupancy import BLOCK, Blocks, Sums
from .transfer import Classify, Measured, Transfer, sized
from .volume import Field, Volume
from .voxel_fetch import Extent, Fetch


T = TypeVar("T")

ROUNDING = 1e-3
"""Bound on the rounding error of a grid coordinate, in voxels, for conservative empty space."""


def together(volume: object, transfer: object) -> tuple[Any, Any]:
    """Combine lists of volumes and transfer functions into one of each, with extinctions in world length.
    **Raises** `ValueError` for lists with other entries or of different lengths."""
    if (pairs := pairs_of(volume, transfer)) is None:
        return volume, sized(transfer, volume)
    volumes, transfers = zip(*pairs, strict=True)
    if len(volumes) == 1:
        return pairs[0]
    grid = _holding(max(volumes, key=lambda v: math.prod(v.shape)), volumes)
    return grid, Together(transfers, tuple(v.channels for v in volumes))


def pairs_of(volume: object, transfer: object) -> list[tuple[Volume, Transfer]] | None:
    """Checked pairs of a volume and its transfer function from two lists; None if neither is a list."""
    if not isinstance(volume, list | tuple) and not isinstance(transfer, list | tuple):
        return None
    volumes, transfers = _entries("volume", volume, Volume), _entries("transfer", transfer, Transfer)
    if len(volumes) != len(transfers):
        got = f"got {len(volumes)} and {len(transfers)}"
        raise ValueError(f"volume and transfer must have the same number of entries; {got}.")
    pairs = list(zip(volumes, transfers, strict=True))
    for k, (grid, function) in enumerate(pairs):
        if function.channels not in (None, grid.channels):
            raise ValueError(
                f"transfer[{k}] reads {function.channels} channels; volume[{k}] has {grid.channels}."
            )
    return [(grid, sized(function, grid)) for grid, function in pairs]


def _entries(name: str, value: object, kind: type[T]) -> Sequence[T]:
    """The entries of a list, checked."""
    expected = f"{name} must be a list of a {kind.__name__} for each volume, where either is a list"
    is_list = isinstance(value, list | tuple)
    if not is_list or not value:
        raise ValueError(f"{expected}; got {'none' if is_list else described(value)}.")
    for number, entry in enumerate(value):
        if not isinstance(entry, kind) or (kind is Volume and type(entry) is not Volume):
            raise ValueError(f"{expected}; {name}[{number}] is {described(entry)}.")
    return value


def with_others(
    volume: Volume, transfer: Transfer, pairs: Sequence[tuple[Volume, Transfer]]
) -> tuple[Any, Any]:
    """Arguments of `together`: a volume and its transfer function, or lists that include further pairs."""
    return tuple(map(list, zip((volume, transfer), *pairs, strict=True))) if pairs else (volume, transfer)


def _holding(largest: Volume, volumes: Sequence[Volume]) -> Volume:
    """The bounding grid of all volumes, along the axes of the largest one and with its number of nodes."""
    grid = _empty(largest)
    parts = *_around(grid, list(map(_empty, volumes))), Several(tuple(volumes))
    return eqx.tree_at(lambda v: (v.origin, v.spacing, v.field), grid, parts, is_leaf=is_none)


def _empty(volume: Volume) -> Volume:
    """The grid of a volume, without values."""
    return eqx.tree_at(
        lambda v: (v.data, v.labels, v.field, v.fetch),
        volume,
        (None, None, None, Extent(volume.shape)),
        is_leaf=lambda leaf: leaf is None or isinstance(leaf, Fetch | Field),
    )


class Several(Field):
    """The values of several volumes, in their bounding grid."""

    volumes: tuple[Volume, ...]

    def value(self, volume: Volume, coordinate: Vec3) -> tuple[Scalar, ...]:
        pairs = zip(self.volumes, self.coordinates(volume, coordinate), strict=True)
        return tuple(value for part, at in pairs for value in part.values(at))

    def coordinates(self, volume: Volume, coordinate: Vec3) -> list[Vec3]:
        """A coordinate of `volume` in each grid, clamped: a divided cell is sampled in its middle."""
        return [_within(GridMap.between(volume, part)(coordinate), part.shape) for part in self.volumes]


def _within(coordinate: Vec3, shape: tuple[int, ...]) -> Vec3:
    # not by minima and maxima: inside loops on CPU, XLA loses their derivatives (jaxlib 0.10)
    above = [jnp.where(c > 0, c, 0) for c in coordinate]
    x, y, z = (jnp.where(c < n - 1, c, n - 1) for c, n in zip(above, shape, strict=True))
    return x, y, z


class GridMap(eqx.Module):
    """The affine map from grid coordinates of one volume to those of another."""

    offset: Vec3
    rates: tuple[Vec3, Vec3, Vec3]
    """Derivatives of the target's coordinates by the source's: `rates[target axis][source axis]`."""

    @classmethod
    def between(cls, source: Volume, target: Volume) -> "GridMap":
        # the difference of origins first, since it is small where both are far from 0
        shift = source.origin - target.origin
        frame = target.frame
        across = jnp.eye(3, dtype=source.spacing.dtype) if source.direction is None else source.direction
        columns = (frame.components(apart(across[:, axis])) for axis in range(3))
        rates = jnp.stack([jnp.stack(column) for column in columns], axis=1)
        rates = rates * source.spacing[None, :] / target.spacing[:, None]
        offset = jnp.stack(frame.components(apart(shift))) / target.spacing
        return cls(apart(offset), (apart(rates[0]), apart(rates[1]), apart(rates[2])))

    def __call__(self, coordinate: Vec3) -> Vec3:
        x, y, z = (
            start + sum(c * rate for c, rate in zip(coordinate, rates, strict=True))
            for start, rates in zip(self.offset, self.rates, strict=True)
        )
        return x, y, z


@jax.jit
def _around(largest: Volume, volumes: list[Volume]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Origin and spacing of the grid of `_holding`."""
    ends = []
    for volume in volumes:
        place = GridMap.between(volume, largest)
        last = [float(n - 1) for n in volume.shape]
        for corner in np.ndindex(2, 2, 2):
            at = [jnp.asarray(side * n, volume.spacing.dtype) for side, n in zip(corner, last, strict=True)]
            ends.append(jnp.stack(place((at[0], at[1], at[2]))))
    low, high = jnp.min(jnp.stack(ends), axis=0), jnp.max(jnp.stack(ends), axis=0)
    cells = jnp.asarray(largest.shape, low.dtype) - 1
    shift = low * largest.spacing
    if largest.direction is not None:
        shift = jnp.sum(largest.direction * shift[None, :], axis=1)
    return largest.origin + shift, largest.spacing * ((high - low) / cells)


class SeveralBlocks(eqx.Module):
    """The blocks of several volumes, and their grids."""

    parts: list[Blocks]
    grid: Volume
    """The bounding grid of `together`, without values."""
    grids: list[Volume]
    """The grids of the volumes, without values."""
    side: int = eqx.field(static=True, default=BLOCK)

    @classmethod
    def of(cls, volume: Volume, *, slopes: bool = False) -> "SeveralBlocks":
        assert isinstance(volume.field, Several)
        volumes = volume.field.volumes
        parts = [Blocks.of(part, slopes=slopes) for part in volumes]
        return cls(parts, _empty(volume), list(map(_empty, volumes)))

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of blocks of the bounding grid along x, y, z."""
        return tuple(-(-(n - 1) // BLOCK) for n in self.grid.shape)

    @property
    def unordered(self) -> Bool[Array, "bx by bz"]:
        """Blocks that overlap a volume's block with NaN."""
        return self.meeting([blocks.unordered for blocks in self.parts])

    def meeting(self, marked: list[Bool[Array, "..."]]) -> Bool[Array, "bx by bz"]:
        """Blocks that overlap a `marked` block of any volume."""
        return jnp.any(jnp.stack(list(map(self._meeting, self.grids, marked))), axis=0)

    def _meeting(self, grid: Volume, marked: Bool[Array, "..."]) -> Bool[Array, "bx by bz"]:
        place, half, dtype = GridMap.between(self.grid, grid), BLOCK / 2, grid.spacing.dtype
        middles = [BLOCK * jnp.arange(n, dtype=dtype) + half for n in self.shape]
        x, y, z = jnp.meshgrid(*middles, indexing="ij")
        lows, highs, meets = [], [], jnp.ones(self.shape, bool)
        for at, rates, n, blocks in zip(place((x, y, z)), place.rates, grid.shape, marked.shape, strict=True):
            reach = half * sum(jnp.abs(rate) for rate in rates) + ROUNDING
            meets &= (at + reach >= 0) & (at - reach <= n - 1)
            for end, ends in ((at - reach, lows), (at + reach, highs)):
                ends.append(jnp.clip(jnp.floor(end / BLOCK), 0, blocks - 1).astype(jnp.int32))
        first, last = ((ends[0], ends[1], ends[2]) for ends in (lows, highs))
        return meets & Sums.of(marked).any_between(first, last)


class Together(Transfer):
    """The transfer functions of several volumes. `Measured` is (values of all volumes, attributes by volume,
    fraction of the cell inside each volume, search results by volume)."""

    transfers: tuple[Transfer, ...]
    counts: tuple[int, ...] = eqx.field(static=True)
    """Number of channels of each volume."""

    @property
    def bands(self) -> int | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        return 3 if all(transfer.bands == 3 for transfer in self.transfers) else None

    @property
    def channels(self) -> int:
        return sum(self.counts)

    @property
    def valid(self) -> Bool[Array, ""]:
        return jnp.all(jnp.stack([jnp.asarray(transfer.valid) for transfer in self.transfers]))

    @property
    def reads_more(self) -> bool:
        return any(transfer.reads_more for transfer in self.transfers)

    @property
    def reads_gradient(self) -> bool:
        return any(transfer.reads_gradient for transfer in self.transfers)

    def attributes(self, volume: Volume, coordinate: Vec3) -> Measured:
        assert isinstance(volume.field, Several)
        places = zip(volume.field.volumes, volume.field.coordinates(volume, coordinate), strict=True)
        pairs = zip(self.transfers, places, strict=True)
        return (tuple(transfer.attributes(*place) for transfer, place in pairs),)

    def search(self) -> Callable[[Measured], Measured] | None:
        searches = [transfer.search() for transfer in self.transfers]
        if not any(searches):
            return None

        def search(measured: Measured) -> Measured:
            parts, _ = self._divided(measured)
            return (tuple(() if f is None else f(part) for f, part in zip(searches, parts, strict=True)),)

        return search

    def classifier(self) -> Classify:
        classifiers = [transfer.classifier() for transfer in self.transfers]

        def classify(measured: Measured) -> tuple[Color, Scalar]:
            parts, shares = self._divided(measured)
            classified = [function(part) for function, part in zip(classifiers, parts, strict=True)]
            return _mixed([(color, share * e) for (color, e), share in zip(classified, shares, strict=True)])

        return classify

    def majorant(self, blocks: Any) -> Float[Array, "bx by bz"]:
        return jnp.where(self.visible(blocks), jnp.inf, 0)

    def visible(self, blocks: Any) -> Bool[Array, "bx by bz"]:
        pairs = zip(self.transfers, blocks.parts, strict=True)
        return blocks.meeting([transfer.visible(part) for transfer, part in pairs])

    def emission_vjp(
        self, measured: Measured, emission: Color, extinction: Scalar
    ) -> tuple["Together", Measured]:
        """`vjp` from cotangents of emission and extinction, which suffice where the extinction is 0."""
        parts, shares = self._divided(measured)
        of_transfers, of_values, of_attributes, of_shares = [], [], [], []
        for transfer, count, part, share in zip(self.transfers, self.counts, parts, shares, strict=True):
            classify = transfer.classifier()
            for _ in range(share.ndim):
                classify = jax.vmap(classify)
            color, part_extinction = classify(part)
            of_extinction = extinction + sum(e * c for e, c in zip(emission, color, strict=True))
            of_color = tuple(e * share * part_extinction for e in emission)
            of_transfer, of_part = transfer.vjp(part, of_color, share * of_extinction)
            of_transfers.append(of_transfer)
            of_values += of_part[:count]
            attributes = measured[self.channels][len(of_attributes)]
            of_attributes.append(tuple(of_part[count : count + len(attributes)]))
            of_shares.append(part_extinction * of_extinction)
        of_measured = (*of_values, tuple(of_attributes), tuple(of_shares))
        return eqx.tree_at(lambda t: t.transfers, self, tuple(of_transfers)), of_measured

    def _divided(self, measured: Measured) -> tuple[list[Measured], tuple[Scalar, ...]]:
        """`Measured` of each transfer function, and the fractions of the cell inside each volume."""
        begin = np.cumsum((0, *self.counts))
        attributes, shares, *more = measured[self.channels :]
        searches = more[0] if more else ((),) * len(self.counts)
        parts = zip(begin, begin[1:], attributes, searches, strict=False)
        return [(*measured[a:b], *read, *searched) for a, b, read, searched in parts], shares


def _mixed(classified: list[tuple[Color, Scalar]]) -> tuple[Color, Scalar]:
    """Sum of the extinctions and the colour mixed by them; where the sum is 0, the mean of the colours."""
    total = jnp.sum(jnp.stack([extinction for _, extinction in classified]), axis=0)
    empty, count = total == 0, len(classified)
    safe = jnp.where(empty, 1, total)
    mixed = [jnp.zeros_like(total)] * len(classified[0][0])
    for color, extinction in classified:
        weight = jnp.where(empty, 1 / count, extinction / safe)
        mixed = [sum_ + weight * part for sum_, part in zip(mixed, color, strict=True)]
    return tuple(mixed), total
