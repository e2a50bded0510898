"""Several volumes in one image, `render([ct, pet], [of_ct, of_pet], …)`: a grid that just holds them, whose
field (`Several`) reads each at its place, and one transfer function (`Together`), of added extinctions."""

import math
from collections.abc import Callable, Sequence
from typing import Any

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


ROUNDING = 1e-3
"""By how much a place may be wrong, in voxels, where emptiness is asked for."""


def together(volume: Any, transfer: Any) -> tuple[Any, Any]:
    """One volume and transfer function for lists of them; anything else as it is. Lengths counted in voxels
    are those of each volume. **Raises** `ValueError` for lists of other things, or of different lengths."""
    if (pairs := pairs_of(volume, transfer)) is None:
        return volume, sized(transfer, volume)
    volume, transfer = zip(*pairs, strict=True)
    if len(volume) == 1:
        return volume[0], transfer[0]
    grid = _holding(max(volume, key=lambda each: math.prod(each.shape)), volume)
    return grid, Together(transfer, tuple(each.channels for each in volume))


def pairs_of(volume: Any, transfer: Any) -> list[tuple[Volume, Transfer]] | None:
    """Each volume with its transfer function, as `together` has them; None if they are no lists."""
    listed = isinstance(volume, list | tuple), isinstance(transfer, list | tuple)
    if not any(listed):
        return None
    kinds = (("volume", volume, Volume), ("transfer", transfer, Transfer))
    for (name, given, kind), is_list in zip(kinds, listed, strict=True):
        expected = f"{name} must be a list of a {kind.__name__} for each volume, where either is a list"
        if not is_list or not given:
            got = described(given) if given or not is_list else "none"
            raise ValueError(f"{expected}; got {got}.")
        for number, each in enumerate(given):
            if not isinstance(each, kind) or (kind is Volume and type(each) is not Volume):
                raise ValueError(f"{expected}; {name}[{number}] is {described(each)}.")
    if len(volume) != len(transfer):
        raise ValueError(
            f"volume and transfer must have as many entries; got {len(volume)} and {len(transfer)}."
        )
    for number, (each, own) in enumerate(zip(volume, transfer, strict=True)):
        if own.channels not in (None, each.channels):
            raise ValueError(
                f"transfer[{number}] reads {own.channels} channels; volume[{number}] has {each.channels}."
            )
    return [(each, sized(own, each)) for own, each in zip(transfer, volume, strict=True)]


def with_others(
    volume: Volume, transfer: Transfer, others: Sequence[tuple[Volume, Transfer]]
) -> tuple[Any, Any]:
    """What `together` takes: a volume and its transfer function, or lists, if there are others."""
    return tuple(map(list, zip((volume, transfer), *others, strict=True))) if others else (volume, transfer)


def _holding(largest: Volume, volumes: Sequence[Volume]) -> Volume:
    """A grid along the axes of the largest volume, with as many nodes, that just holds all of them."""
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
    """The values of several volumes, each at its own place, in a grid that holds them all."""

    volumes: tuple[Volume, ...]

    def value(self, volume: Volume, coordinate: Vec3) -> tuple[Scalar, ...]:
        read = zip(self.volumes, self.coordinates(volume, coordinate), strict=True)
        return tuple(value for each, at in read for value in each.values(at))

    def coordinates(self, volume: Volume, coordinate: Vec3) -> list[Vec3]:
        """A coordinate of `volume` in each grid, clamped: a divided cell is sampled in its middle."""
        at = [GridMap.between(volume, each)(coordinate) for each in self.volumes]
        return [_within(place, each.shape) for place, each in zip(at, self.volumes, strict=True)]


def _within(coordinate: Vec3, shape: tuple[int, ...]) -> Vec3:
    # not by minima and maxima: inside loops on CPU, XLA loses their derivatives (jaxlib 0.10)
    above = [jnp.where(c > 0, c, 0) for c in coordinate]
    x, y, z = (jnp.where(c < n - 1, c, n - 1) for c, n in zip(above, shape, strict=True))
    return x, y, z


class GridMap(eqx.Module):
    """From grid coordinates of one volume to those of another."""

    offset: Vec3
    rates: tuple[Vec3, Vec3, Vec3]
    """Of each coordinate, by those along x, y, z."""

    @classmethod
    def between(cls, source: Volume, target: Volume) -> "GridMap":
        # from origin to origin, where numbers are small: many origins are far away
        there = source.origin - target.origin
        frame = target.frame
        across = jnp.eye(3, dtype=source.spacing.dtype) if source.direction is None else source.direction
        columns = (frame.components(apart(across[:, axis])) for axis in range(3))
        rates = jnp.stack([jnp.stack(column) for column in columns], axis=1)
        rates = rates * source.spacing[None, :] / target.spacing[:, None]
        offset = jnp.stack(frame.components(apart(there))) / target.spacing
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
    for each in volumes:
        place = GridMap.between(each, largest)
        last = [float(n - 1) for n in each.shape]
        for corner in np.ndindex(2, 2, 2):
            at = [jnp.asarray(side * n, each.spacing.dtype) for side, n in zip(corner, last, strict=True)]
            ends.append(jnp.stack(place((at[0], at[1], at[2]))))
    low, high = jnp.min(jnp.stack(ends), axis=0), jnp.max(jnp.stack(ends), axis=0)
    cells = jnp.asarray(largest.shape, low.dtype) - 1
    shift = low * largest.spacing
    if largest.direction is not None:
        shift = jnp.sum(largest.direction * shift[None, :], axis=1)
    return largest.origin + shift, largest.spacing * ((high - low) / cells)


class SeveralBlocks(eqx.Module):
    """The ranges of several volumes' blocks, and where these lie."""

    each: list[Blocks]
    grid: Volume
    """That of `together`, and `grids`, those of the volumes; without values."""
    grids: list[Volume]

    @classmethod
    def of(cls, volume: Volume, *, slopes: bool = False) -> "SeveralBlocks":
        assert isinstance(volume.field, Several)
        own = volume.field.volumes
        return cls([Blocks.of(each, slopes=slopes) for each in own], _empty(volume), list(map(_empty, own)))

    @property
    def side(self) -> int:
        """As that of `Blocks`."""
        return BLOCK

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of blocks along x, y, z, of the grid that holds all."""
        return tuple(-(-(n - 1) // BLOCK) for n in self.grid.shape)

    @property
    def unordered(self) -> Bool[Array, "bx by bz"]:
        """Blocks that meet one which holds NaN."""
        return self.meeting([blocks.unordered for blocks in self.each])

    def meeting(self, found: list[Bool[Array, "..."]]) -> Bool[Array, "bx by bz"]:
        """Blocks that meet a block of a volume for which `found` is true."""
        parts = zip(self.grids, found, strict=True)
        return jnp.any(jnp.stack([self._meeting(own, each) for own, each in parts]), axis=0)

    def _meeting(self, own: Volume, found: Bool[Array, "..."]) -> Bool[Array, "bx by bz"]:
        place, half, dtype = GridMap.between(self.grid, own), BLOCK / 2, own.spacing.dtype
        middles = [BLOCK * jnp.arange(n, dtype=dtype) + half for n in self.shape]
        x, y, z = jnp.meshgrid(*middles, indexing="ij")
        first, last, meets = [], [], jnp.ones(self.shape, bool)
        for at, rates, n, blocks in zip(place((x, y, z)), place.rates, own.shape, found.shape, strict=True):
            reach = half * sum(jnp.abs(rate) for rate in rates) + ROUNDING
            meets &= (at + reach >= 0) & (at - reach <= n - 1)
            for end, ends in ((at - reach, first), (at + reach, last)):
                ends.append(jnp.clip(jnp.floor(end / BLOCK), 0, blocks - 1).astype(jnp.int32))
        return meets & Sums.of(found).any_between((first[0], first[1], first[2]), (last[0], last[1], last[2]))


class Together(Transfer):
    """The transfer functions of several volumes. Measured are the values of all; a tuple of what each reads
    besides; the share of the cell that lies in each; and what each one's search found."""

    transfers: tuple[Transfer, ...]
    counts: tuple[int, ...] = eqx.field(static=True)
    """How many channels each volume has."""

    @property
    def bands(self) -> int | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        return 3 if all(each.bands == 3 for each in self.transfers) else None

    @property
    def channels(self) -> int:
        return sum(self.counts)

    @property
    def valid(self) -> Bool[Array, ""]:
        return jnp.all(jnp.stack([jnp.asarray(each.valid) for each in self.transfers]))

    @property
    def reads_more(self) -> bool:
        return any(each.reads_more for each in self.transfers)

    @property
    def reads_gradient(self) -> bool:
        return any(each.reads_gradient for each in self.transfers)

    def attributes(self, volume: Volume, coordinate: Vec3) -> Measured:
        assert isinstance(volume.field, Several)
        places = zip(volume.field.volumes, volume.field.coordinates(volume, coordinate), strict=True)
        read = zip(self.transfers, places, strict=True)
        return (tuple(each.attributes(*place) for each, place in read),)

    def search(self) -> Callable[[Measured], Measured] | None:
        searches = [each.search() for each in self.transfers]
        if not any(searches):
            return None

        def search(measured: Measured) -> Measured:
            own, _ = self._own(measured)
            return (tuple(() if f is None else f(part) for f, part in zip(searches, own, strict=True)),)

        return search

    def classifier(self) -> Classify:
        each = [transfer.classifier() for transfer in self.transfers]

        def classify(measured: Measured) -> tuple[Color, Scalar]:
            own, shares = self._own(measured)
            classified = [function(part) for function, part in zip(each, own, strict=True)]
            return _mixed([(color, share * e) for (color, e), share in zip(classified, shares, strict=True)])

        return classify

    def majorant(self, blocks: Any) -> Float[Array, "bx by bz"]:
        return jnp.where(self.visible(blocks), jnp.inf, 0)

    def visible(self, blocks: Any) -> Bool[Array, "bx by bz"]:
        both = zip(self.transfers, blocks.each, strict=True)
        return blocks.meeting([transfer.visible(own) for transfer, own in both])

    def emission_vjp(
        self, measured: Measured, emission: Color, extinction: Scalar
    ) -> tuple["Together", Measured]:
        """As `vjp`, by cotangents of emission and extinction, which suffice where the extinction is 0."""
        own, shares = self._own(measured)
        of_transfers, of_values, of_attributes, of_shares = [], [], [], []
        for transfer, count, part, share in zip(self.transfers, self.counts, own, shares, strict=True):
            classify = transfer.classifier()
            for _ in range(share.ndim):
                classify = jax.vmap(classify)
            color, own_extinction = classify(part)
            of_extinction = extinction + sum(of * c for of, c in zip(emission, color, strict=True))
            of_color = tuple(of * share * own_extinction for of in emission)
            of_transfer, of_part = transfer.vjp(part, of_color, share * of_extinction)
            of_transfers.append(of_transfer)
            of_values += of_part[:count]
            attributes = measured[self.channels][len(of_attributes)]
            of_attributes.append(tuple(of_part[count : count + len(attributes)]))
            of_shares.append(own_extinction * of_extinction)
        found = (*of_values, tuple(of_attributes), tuple(of_shares))
        return eqx.tree_at(lambda t: t.transfers, self, tuple(of_transfers)), found

    def _own(self, measured: Measured) -> tuple[list[Measured], tuple[Scalar, ...]]:
        """What each transfer function reads, and the shares."""
        begin = np.cumsum((0, *self.counts))
        attributes, shares, *more = measured[self.channels :]
        found = more[0] if more else ((),) * len(self.counts)
        parts = zip(begin, begin[1:], attributes, found, strict=False)
        return [(*measured[a:b], *own, *searched) for a, b, own, searched in parts], shares


def _mixed(classified: list[tuple[Color, Scalar]]) -> tuple[Color, Scalar]:
    """Colour and extinction of all together; where nothing is visible, the mean of the colours."""
    whole = jnp.sum(jnp.stack([extinction for _, extinction in classified]), axis=0)
    empty, count = whole == 0, len(classified)
    safe = jnp.where(empty, 1, whole)
    mixed = [jnp.zeros_like(whole)] * len(classified[0][0])
    for color, extinction in classified:
        weight = jnp.where(empty, 1 / count, extinction / safe)
        mixed = [sum_ + weight * part for sum_, part in zip(mixed, color, strict=True)]
    return tuple(mixed), whole
