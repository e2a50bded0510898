"""What does each photon add to a sample, if the nearest voxel tells what is at its place?

The published form: hard occlusion, tested at voxels. A place takes one fetch and one look-up in a table by
the voxel's value, where `photons` interpolates eight voxels and classifies the result.
"""

import functools
import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from .._util.vec3 import Scalar, Vec3, along, scaled
from ..xla.memory import gather
from .photons import PhotonShading, PhotonsOfSample
from .shading import Sample, Shading, Surroundings


VISIBLE = 128
"""Bit of a voxel's class that tells that something is visible there; below it is the material's number."""

HIDDEN = VISIBLE << 1
"""Bit that tells that something is visible at any of a photon's places."""

VALUE = 9
"""The voxel's value is in the bits from this one on."""


class _Shared(NamedTuple):
    """`material`: its number; of none, how many there are. `row`: of the table of photons."""

    photons: PhotonsOfSample
    material: Int[Array, ""]
    row: Int[Array, ""]


class VoxelPhotons(Shading):
    """The photons of a `PhotonShading` of hard occlusion. `table`: x, y, z and intensity, each of which runs
    over photons and, fastest, rows: materials times templates, and one of no photons. `classes`: by the value
    of a voxel, from its type's lowest on."""

    photons: PhotonShading
    table: Float[Array, "4 entries"]
    classes: UInt8[Array, " values"]

    @classmethod
    def of(cls, photons: PhotonShading, around: Surroundings) -> "VoxelPhotons":
        """**Raises** `ValueError` where a voxel's value does not tell what is there."""
        volume, kind = around.volume, around.volume.data.dtype
        if not jnp.issubdtype(kind, jnp.integer) or kind.itemsize > 2 or volume.field is not None:
            raise ValueError(f'interpolation="nearest" takes voxels of 8- or 16-bit integers; got {kind}.')
        if around.transfer.reads_more:
            name = type(around.transfer).__name__
            raise ValueError(
                f'interpolation="nearest" takes transfer functions of the value alone; got {name}.'
            )
        if any(material.label is not None for material in photons.materials):
            raise ValueError('interpolation="nearest" takes materials by values, not by label.')
        templates = photons.templates
        rows = jnp.concatenate([templates.offset, templates.intensity[..., None]], axis=-1)
        rows = jnp.pad(rows.reshape(-1, *rows.shape[2:]), ((0, 1), (0, 0), (0, 0)))
        values = jnp.arange(jnp.iinfo(kind).min, jnp.iinfo(kind).max + 1).astype(volume.spacing.dtype)

        def class_of(value: Scalar) -> UInt8[Array, ""]:
            of_materials = photons.shares(around, (value, value, value), value)
            _, extinction = around.classification.classify(around.classification.searched((value,)))
            visible = jnp.where(extinction > 0, VISIBLE, 0)
            return (_number(of_materials) + visible).astype(jnp.uint8)

        return cls(photons, rows.transpose(2, 1, 0).reshape(4, -1), jax.vmap(class_of)(values))

    @property
    def terms(self) -> int:
        return self.photons.terms

    def thresholds(self) -> Float[Array, " photons"]:
        return self.photons.thresholds()

    @property
    def skips_hidden(self) -> bool:
        return self.photons.skips_hidden

    def begin(self, around: Surroundings, sample: Sample) -> _Shared:
        photons = self.photons.begin(around, sample)
        count, templates, _ = self.photons.templates.intensity.shape
        material = _number(photons.shares)
        row = material * templates + (0 if photons.template is None else photons.template)
        return _Shared(photons, material, jnp.minimum(row, count * templates))

    def term(self, around: Surroundings, sample: Sample, shared: _Shared, number: Int[Array, ""]) -> Any:
        of, none = self.photons, len(self.photons.materials)
        *at, intensity = around.stored(lambda: self._photon(sample, shared, number))
        offset, material = (at[0], at[1], at[2]), None
        speed = ratio = jnp.ones_like(intensity)
        if none > 1:
            index = around.stored(lambda: self._voxel(around, sample, offset))
            material = around.stored(lambda: self._class(around, index)[0] & VISIBLE - 1)
            speed, ratio = around.stored(lambda: self._ratios(shared.material, material))

        def places() -> list[Int[Array, ""]]:
            return [self._voxel(around, sample, scaled(offset, speed * t)) for t in (1.0, *of.reach)]

        def found() -> Int[Array, ""]:
            (here, value), *others = (self._class(around, index) for index in indices)
            any_ = functools.reduce(operator.or_, (each for each, _ in others), here)
            return value << VALUE | (any_ & VISIBLE) << 1 | here

        def weights() -> tuple[list[Scalar], Scalar]:
            there = what & VISIBLE - 1 if material is None else material
            seen = jnp.where(what & HIDDEN == 0, intensity, 0)
            shows = jnp.where((what & VISIBLE == VISIBLE) & (there != none), intensity, 0)
            seen, shows = of.counted(seen, shows, ratio)
            return [seen * of.lit_side(offset, light) for light in shared.photons.lights], shows

        indices = around.stored(places)
        what = around.stored(found)
        brightness, shows = around.stored(weights)
        value = (what >> VALUE).astype(intensity.dtype)
        color, _ = around.classification.classify(around.classification.searched((value,)))
        return tuple(brightness), scaled(color, shows)

    def color(self, sample: Sample, shared: _Shared, sums: Any) -> Vec3:
        return self.photons.color(sample, shared.photons, sums)

    def _photon(self, sample: Sample, shared: _Shared, number: Int[Array, ""]) -> tuple[Scalar, ...]:
        """Offset and intensity of a photon; of intensity 0 if it is skipped."""
        index = number * (self.table.shape[1] // self.terms) + shared.row
        x, y, z, intensity = (gather(each, index) for each in self.table)
        return x, y, z, self.photons.unless_skipped(sample, intensity)

    def _ratios(self, own: Int[Array, ""], there: Int[Array, ""]) -> tuple[Scalar, Scalar]:
        """The ratios of the speed of light and of the opacity there to the sample's; 1 if either is of no
        material."""
        optics, none = self.photons.optics, len(self.photons.materials)
        index = [self._of(optics.refractive_index, material) for material in (own, there)]
        opacity = [self._of(optics.opacity, material) for material in (own, there)]
        plain = (own == none) | (there == none)
        ratio = opacity[1] / jnp.where(opacity[0] == 0, 1, opacity[0])
        return jnp.where(plain, 1, index[0] / index[1]), jnp.where(plain, 1, ratio)

    @staticmethod
    def _of(each: Float[Array, " materials"], number: Int[Array, ""]) -> Scalar:
        """A property of a material, without a gather; 1 of none."""
        return functools.reduce(
            lambda found, m: jnp.where(number == m, each[m], found), range(each.size), jnp.ones_like(each[0])
        )

    def _voxel(self, around: Surroundings, sample: Sample, offset: Vec3) -> Int[Array, ""]:
        """Flat index of the voxel nearest to a place; -1 outside of the volume."""
        place = along(sample.point, offset, jnp.ones_like(offset[0]))
        return around.volume.fetch.nearest(around.volume.data, around.space.coordinate(place))

    def _class(self, around: Surroundings, index: Int[Array, ""]) -> tuple[Int[Array, ""], Int[Array, ""]]:
        """Class and value of the voxel of this index; outside of the volume the class of no material."""
        data = around.volume.data
        value = gather(data.reshape(-1), jnp.maximum(index, 0)).astype(jnp.int32)
        found = gather(self.classes, value - int(jnp.iinfo(data.dtype).min)).astype(jnp.int32)
        return jnp.where(index < 0, len(self.photons.materials), found), value


def _number(shares: tuple[Scalar, ...]) -> Int[Array, ""]:
    """Number of the material that has a share; of none, how many there are."""
    count = len(shares)
    return count + functools.reduce(
        jnp.add, ((n - count) * share.astype(jnp.int32) for n, share in enumerate(shares))
    )
