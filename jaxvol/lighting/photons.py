"""What does each photon of a template add to the light of a sample? `ScattererTemplates` lists the steps."""

import functools
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._util.noise import hashed_uniforms
from .._util.vec3 import Scalar, Vec3, along, dot, scaled
from ..scene.transfer import Measured
from ..xla.memory import gather
from .lights import ConstantLight, Light, LocatedLight
from .materials import Material, Optics, shares, smoothstep, step
from .shading import ClassifiedPoint, Sample, Shading, Surroundings
from .template import ScattererTemplate


Occlusion = Literal["soft", "hard"]

EDGE = 0.1
"""With soft occlusion, a material fades in and out over this fraction of its value range."""

LIT_SIDE_COSINE = 0.25
"""With soft occlusion, the cosine up to which a photon beyond the lit side still counts in part."""

WHITE = 4 / (3 * math.pi)
"""Factor from irradiance to radiance, by which opaque white matter that absorbs nothing is as bright as the
light around it: half of the photons of a sample on its face are inside, so that E b (c + s) = 3/4 π L c."""


class _Shared(NamedTuple):
    """What is common to all photons of a sample: the materials' shares, and the same normalized to sum to 1;
    its optics; which template it uses, if there are several; and of each light the direction to it (None:
    from all sides), its distance and irradiance."""

    shares: tuple[Scalar, ...]
    mixture: tuple[Scalar, ...]
    optics: Optics
    template: Int[Array, ""] | None
    lights: tuple[tuple[Vec3 | None, Scalar, Vec3], ...]


class _Photon(NamedTuple):
    """A photon of a sample; where there are several materials, also the factor by which the colour at its
    place counts, and the mean free path there."""

    offset: Vec3
    intensity: Scalar
    inner: Scalar | None = None
    mean_free_path: Scalar | None = None


class PhotonShading(Shading):
    """Templates prepared for one image.

    - `templates`: (materials, templates, photons). `blended`: how many were blended into each; their photons
      are skipped as they would be in their own templates.
    - `cutoff`: None: no photon is skipped.
    """

    materials: tuple[Material, ...]
    lights: tuple[Light, ...]
    templates: ScattererTemplate
    optics: Optics
    cutoff: Float[Array, ""] | None
    blended: int = eqx.field(static=True)
    occlusion: Occlusion = eqx.field(static=True)
    reach: tuple[float, ...] = eqx.field(static=True)
    seed: int = eqx.field(static=True)

    @property
    def terms(self) -> int:
        return self.templates.intensity.shape[-1]

    @property
    def _soft(self) -> bool:
        return self.occlusion == "soft"

    def thresholds(self) -> Float[Array, " photons"]:
        intensity = jax.lax.stop_gradient(self.templates.intensity)
        brightest = jax.lax.cummax(jnp.max(intensity, axis=(0, 1)), reverse=True)  # of all that are left
        least = jnp.zeros_like(brightest)
        if self.cutoff is not None:
            # a little less, so that rounding leaves out no photon that `_photon` does not skip
            least = (1 - 1e-5) * jax.lax.stop_gradient(self.cutoff) / (brightest * self.blended)
        return jnp.where(brightest <= 0, jnp.inf, least)  # padding

    @property
    def skips_hidden(self) -> bool:
        return self.cutoff is not None

    def begin(self, around: Surroundings, sample: Sample) -> _Shared:
        material_shares = self._shares(around, around.space.coordinate(sample.point), sample.measured[0])
        template = None
        if (count := self.templates.intensity.shape[1]) > 1:
            u, _, _ = hashed_uniforms(*sample.pixel, jnp.uint32(self.seed), jnp.float32)
            template = (u * count).astype(jnp.int32)
        lights = []
        for light in self.lights:
            if isinstance(light, ConstantLight):
                r, g, b = (jnp.pi * radiance for radiance in light.radiance)
                lights.append((None, jnp.full_like(sample.extinction, jnp.inf), (r, g, b)))
            elif isinstance(light, LocatedLight):
                lights.append(tuple(light.at(sample.point)))
        total = sum(material_shares)
        mixture = tuple(share / jnp.where(total > 0, total, 1) for share in material_shares)
        optics = _blend(self.optics, mixture, Optics(*(jnp.ones_like(total),) * 3))
        return _Shared(material_shares, mixture, optics, template, tuple(lights))

    def term(self, around: Surroundings, sample: Sample, shared: _Shared, number: Int[Array, ""]) -> Any:
        # In stages, each of which is stored, since XLA would compute it again for each of its uses. Only the
        # photon of a single template costs nothing, as it is the same for all samples.
        several = len(self.materials) > 1
        if several or shared.template is not None:
            photon = around.stored(lambda: self._photon(sample, shared, number))
        else:
            photon = self._photon(sample, shared, number)
        if several:
            photon = self._refracted(around, sample, shared, photon)

        def places() -> list[Vec3]:
            return [_displaced(sample, photon.offset, times) for times in (1.0, *self.reach)]

        read = around.stored(lambda: [around.measured(place) for place in places()])
        seen, shows = around.stored(lambda: self._weights(around, shared, photon, places(), read))
        brightness = tuple(seen * self._lit_side(photon.offset, *light[:2]) for light in shared.lights)
        color, _ = around.classification.classify(read[0])
        return brightness, scaled(color, shows)

    def color(self, sample: Sample, shared: _Shared, sums: Any) -> Vec3:
        brightness, inner = sums
        # 1 from a material's soft edge inwards, since an unlit part of the colour would look like emission
        matter = _matter(shared.shares)
        scale = matter * WHITE * shared.optics.reflectance
        red, green, blue = (
            c * (1 - matter)
            + scale
            * (c + s)
            * sum(b * irradiance[i] for b, (_, _, irradiance) in zip(brightness, shared.lights, strict=True))
            for i, (c, s) in enumerate(zip(sample.color, inner, strict=True))
        )
        return red, green, blue

    def _photon(self, sample: Sample, shared: _Shared, number: Int[Array, ""]) -> _Photon:
        """A photon of the sample's materials, blended by their shares; of intensity 0 if it is skipped."""

        def of_sample(of_templates: Float[Array, " templates"]) -> Scalar:
            return of_templates[0] if shared.template is None else gather(of_templates, shared.template)

        offset, light = self.templates.offset, self.templates.intensity
        each = [
            [*(of_sample(offset[m, :, number, i]) for i in range(3)), of_sample(light[m, :, number])]
            for m in range(len(self.materials))
        ]
        x, y, z, intensity = each[0]
        if len(each) > 1:
            x, y, z, intensity = (
                _sum([share * one for share, one in zip(shared.mixture, several, strict=True)])
                for several in zip(*each, strict=True)
            )
        if self.cutoff is not None:
            skipped = sample.transmittance * intensity * self.blended < self.cutoff
            intensity = jnp.where(skipped, 0, intensity)
        return _Photon((x, y, z), intensity)

    def _refracted(self, around: Surroundings, sample: Sample, shared: _Shared, photon: _Photon) -> _Photon:
        """The photon, moved by refraction into the material at its place."""
        own = shared.optics
        read = around.stored(lambda: around.measured(_displaced(sample, photon.offset)))

        def moved() -> _Photon:
            there = around.classified(_displaced(sample, photon.offset), read)
            shares = self._shares_at(around, there)
            optics = _blend(self.optics, shares, own)
            # the template is stretched by the ratio of the speeds of light
            offset = scaled(photon.offset, own.refractive_index / optics.refractive_index)
            ratio = optics.opacity / jnp.where(own.opacity == 0, 1, own.opacity)
            inner = jnp.where(own.opacity == 0, 0, ratio) * _sum(shares)
            return _Photon(offset, photon.intensity, inner, optics.mean_free_path)

        return around.stored(moved)

    def _weights(
        self,
        around: Surroundings,
        shared: _Shared,
        photon: _Photon,
        places: list[Vec3],
        read: list[Measured],
    ) -> tuple[Scalar, Scalar]:
        """How much of a photon is seen, and how much the colour at its place counts. `read`: at `places`."""
        points = [around.classified(*each) for each in zip(places, read, strict=True)]
        inner, path = photon.inner, photon.mean_free_path
        if inner is None or path is None:
            shares = self._shares_at(around, points[0])
            inner, path = _sum(shares), _blend(self.optics, shares, shared.optics).mean_free_path
        extinctions = [point.extinction for point in points]
        # soft: the opacity of one mean free path there
        matter = -jnp.expm1(-extinctions[0] * path) if self._soft else step(extinctions[0], 0.0)
        return photon.intensity * self._visible(photon.offset, extinctions), photon.intensity * inner * matter

    def _shares(self, around: Surroundings, coordinate: Vec3, value: Scalar) -> tuple[Scalar, ...]:
        edge = EDGE if self._soft else 0.0
        return shares(self.materials, around.volume, coordinate, value, edge=edge)

    def _shares_at(self, around: Surroundings, there: ClassifiedPoint) -> tuple[Scalar, ...]:
        """Shares of the materials at a place, which fall to 0 outside of the volume."""
        return tuple(there.inside * share for share in self._shares(around, there.coordinate, there.value))

    def _visible(self, offset: Vec3, extinctions: list[Scalar]) -> Scalar:
        """Visibility of a photon from the sample, from the extinctions at its place and at `reach`."""
        if not self._soft:
            return 1 - step(_sum(extinctions), 0.0)
        pieces = np.diff([0.0, 1.0, *self.reach])
        depth = sum(piece * extinction for piece, extinction in zip(pieces, extinctions, strict=True))
        return jnp.exp(-depth * _norm(offset))

    def _lit_side(self, offset: Vec3, toward: Vec3 | None, distance: Scalar) -> Scalar:
        """Whether a photon is nearer to the light than the sample is: 0 or 1, with a ramp if soft."""
        if toward is None:
            return jnp.ones_like(offset[0])
        length = _norm(offset)
        # for a light at a finite distance r: r - |r d - p|, in a form without cancellation
        near = dot(offset, toward) - length**2 / (2 * distance)
        if not self._soft:
            return step(near, 0.0)
        return smoothstep(0.5 + near / length / (2 * LIT_SIDE_COSINE))


def _sum(terms: Sequence[Scalar]) -> Scalar:
    return functools.reduce(jnp.add, terms)


def _displaced(sample: Sample, offset: Vec3, times: float = 1.0) -> Vec3:
    return along(sample.point, offset, jnp.full_like(offset[0], times))


def _matter(shares: tuple[Scalar, ...]) -> Scalar:
    return jnp.minimum(2 * sum(shares), 1)


def _norm(offset: Vec3) -> Scalar:
    return jnp.sqrt(jnp.maximum(dot(offset, offset), jnp.finfo(offset[0].dtype).tiny ** 0.5))


def _blend(optics: Optics, shares: tuple[Scalar, ...], rest: Optics) -> Optics:
    """Optics averaged over the materials at a point, weighted by their shares; `rest` fills up to 1."""
    remaining = 1 - sum(shares)
    blended = (
        sum(share * each[m] for m, share in enumerate(shares)) + remaining * other
        for each, other in zip(optics, rest, strict=True)
    )
    return Optics(*blended)
