"""What does each photon of a template add to the light of a sample? `ScattererTemplates` lists the steps."""

import functools
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._util.noise import hashed_uniforms
from .._util.vec3 import Scalar, Vec3, along, dot, scaled
from ..xla.memory import gather
from .lights import Arriving, Light
from .materials import EDGE, Material, Optics, shares as shares_of, smoothstep, step
from .shading import ClassifiedPoint, Sample, Shading, Surroundings
from .template import ScattererTemplate


Occlusion = Literal["soft", "hard"]

LIT_SIDE_COSINE = 0.25
"""With soft occlusion, the cosine up to which a photon beyond the lit side still counts in part."""

WHITE = 4 / (3 * math.pi)
"""Factor from irradiance to radiance, by which opaque white matter that absorbs nothing is as bright as the
light around it: half of the photons of a sample on its face are inside, so that E b (c + s) = 3/4 π L c."""


class PhotonsOfSample(NamedTuple):
    """What a sample's photons share. `mixture`: shares of sum 1. `template`: the one in use, of several."""

    shares: tuple[Scalar, ...]
    mixture: tuple[Scalar, ...]
    optics: Optics
    template: Int[Array, ""] | None
    lights: tuple[Arriving, ...]


class Medium(NamedTuple):
    """Medium at a photon: share of all materials, opacity over the sample's, and optics."""

    share: Scalar
    ratio: Scalar
    mean_free_path: Scalar
    refractive_index: Scalar


class PhotonShading(Shading):
    """Templates of one image; each has `blended` ones, whose photons are skipped as in their own."""

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

    def begin(self, around: Surroundings, sample: Sample) -> PhotonsOfSample:
        material_shares = self.shares(around, around.space.coordinate(sample.point), sample.measured[0])
        template = None
        if (count := self.templates.intensity.shape[1]) > 1:
            u, _, _ = hashed_uniforms(*sample.pixel, jnp.uint32(self.seed), jnp.float32)
            template = (u * count).astype(jnp.int32)
        total = sum(material_shares)
        mixture = tuple(share / jnp.where(total > 0, total, 1) for share in material_shares)
        optics = _blend(self.optics, mixture, Optics(*(jnp.ones_like(total),) * 3))
        lights = tuple(light.at(sample.point, sample.direction) for light in self.lights)
        return PhotonsOfSample(material_shares, mixture, optics, template, lights)

    def term(
        self, around: Surroundings, sample: Sample, shared: PhotonsOfSample, number: Int[Array, ""]
    ) -> Any:
        # In stages, each of which is stored, since XLA would compute it again for each of its uses. Only the
        # photon of a single template costs nothing, as it is the same for all samples.
        several, medium = len(self.materials) > 1, None
        if several or shared.template is not None:
            offset, intensity = around.stored(lambda: self._photon(sample, shared, number))
        else:
            offset, intensity = self._photon(sample, shared, number)
        if several:
            offset, medium = self.refracted(around, sample, shared, offset)

        def places() -> list[Vec3]:
            return [_displaced(sample, offset, times) for times in (1.0, *self.reach)]

        def weights() -> tuple[Scalar, Scalar]:
            """How much of the photon is seen, and how much the colour at its place counts."""
            points = [around.classified(*each) for each in zip(places(), read, strict=True)]
            there = self._medium(around, shared, points[0]) if medium is None else medium
            extinctions = [point.extinction for point in points]
            # soft: the opacity of one mean free path there
            matter = (
                -jnp.expm1(-extinctions[0] * there.mean_free_path)
                if self._soft
                else step(extinctions[0], 0.0)
            )
            seen = intensity * self._visible(offset, extinctions)
            return self.counted(seen, intensity * matter * there.share, there.ratio)

        read = around.stored(lambda: [around.measured(place) for place in places()])
        seen, shows = around.stored(weights)
        brightness = tuple(seen * self.lit_side(offset, light) for light in shared.lights)
        color, _ = around.classification.classify(read[0])
        return brightness, scaled(cast(Vec3, color), shows)

    def color(self, sample: Sample, shared: PhotonsOfSample, sums: Any) -> Vec3:
        brightness, inner = sums
        # 1 from a material's soft edge inwards, since an unlit part of the colour would look like emission
        matter = _matter(shared.shares)
        scale = matter * WHITE * shared.optics.reflectance
        irradiance = [[light.irradiance[i] for light in shared.lights] for i in range(3)]
        red, green, blue = (
            c * (1 - matter) + scale * self.lit(c, s, brightness, arriving)
            for c, s, arriving in zip(sample.color, inner, irradiance, strict=True)
        )
        return red, green, blue

    def lit(
        self, color: Scalar, inner: Scalar, brightness: Sequence[Scalar], irradiance: Sequence[Scalar]
    ) -> Scalar:
        """One channel of a sample's light. Brightness and irradiance are those of each light."""
        return (color + inner) * sum(b * light for b, light in zip(brightness, irradiance, strict=True))

    def counted(self, seen: Scalar, shows: Scalar, ratio: Scalar) -> tuple[Scalar, Scalar]:
        """How much a photon counts for brightness and inner colour, by the `ratio` of opacities there."""
        return seen, shows * ratio

    def _photon(self, sample: Sample, shared: PhotonsOfSample, number: Int[Array, ""]) -> tuple[Vec3, Scalar]:
        """Offset and intensity of a photon, blended by the materials' shares; of intensity 0 if skipped."""

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
        return (x, y, z), self.unless_skipped(sample, intensity)

    def unless_skipped(self, sample: Sample, intensity: Scalar) -> Scalar:
        """The intensity of a photon; 0 where it is below the cut-off."""
        if self.cutoff is None:
            return intensity
        return jnp.where(sample.transmittance * intensity * self.blended < self.cutoff, 0, intensity)

    def refracted(
        self, around: Surroundings, sample: Sample, shared: PhotonsOfSample, offset: Vec3
    ) -> tuple[Vec3, "Medium"]:
        """Offset of a photon, refracted into the material at its place, and the medium there."""
        read = around.stored(lambda: around.measured(_displaced(sample, offset)))

        def moved() -> tuple[Vec3, Medium]:
            there = self._medium(around, shared, around.classified(_displaced(sample, offset), read))
            # the template is stretched by the ratio of the speeds of light
            return scaled(offset, shared.optics.refractive_index / there.refractive_index), there

        return around.stored(moved)

    def _medium(self, around: Surroundings, shared: PhotonsOfSample, there: ClassifiedPoint) -> "Medium":
        """What scatters light at a place; the volume's outside has none of the materials."""
        each = tuple(there.inside * share for share in self.shares(around, there.coordinate, there.value))
        own, optics = shared.optics, _blend(self.optics, each, shared.optics)
        ratio = jnp.ones_like(own.opacity)
        if len(self.materials) > 1:
            exists = own.opacity != 0
            ratio = jnp.where(exists, optics.opacity / jnp.where(exists, own.opacity, 1), 0)
        return Medium(_sum(each), ratio, optics.mean_free_path, optics.refractive_index)

    def shares(self, around: Surroundings, coordinate: Vec3, value: Scalar) -> tuple[Scalar, ...]:
        how: Any = {"edge": EDGE, "labels": "linear"} if self._soft else {}
        return shares_of(self.materials, around.volume, coordinate, value, **how)

    def _visible(self, offset: Vec3, extinctions: list[Scalar]) -> Scalar:
        """Visibility of a photon from the sample, from the extinctions at its place and at `reach`."""
        if not self._soft:
            return 1 - step(_sum(extinctions), 0.0)
        pieces = np.diff([0.0, 1.0, *self.reach])
        depth = sum(piece * extinction for piece, extinction in zip(pieces, extinctions, strict=True))
        return jnp.exp(-depth * _norm(offset))

    def lit_side(self, offset: Vec3, light: Arriving) -> Scalar:
        """Whether a photon is nearer to the light than the sample is: 0 or 1, with a ramp if soft."""
        if light.toward is None:
            return jnp.ones_like(offset[0])
        # for a light at a finite distance r: r - |r d - p|, in a form without cancellation
        near = dot(offset, light.toward) - dot(offset, offset) / (2 * light.distance)
        if not self._soft:
            return step(near, 0.0)
        return smoothstep(0.5 + near / _norm(offset) / (2 * LIT_SIDE_COSINE))


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
