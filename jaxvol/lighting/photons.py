"""Light that the photons of a template add to a sample, by the steps that `ScattererTemplates` lists."""

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
"""With soft occlusion, photons up to this cosine beyond the lit side count in part."""

WHITE = 4 / (3 * math.pi)
"""Factor from irradiance to radiance. Opaque white matter that absorbs nothing is then as bright as the light
around it: half of the photons of a sample on its face are inside, so that E b (c + s) = 3/4 π L c."""


class PhotonsOfSample(NamedTuple):
    """Values shared by a sample's photons. `mixture`: shares of sum 1. `template`: index, of several."""

    shares: tuple[Scalar, ...]
    mixture: tuple[Scalar, ...]
    optics: Optics
    template: Int[Array, ""] | None
    lights: tuple[Arriving, ...]


class Medium(NamedTuple):
    """Medium at a photon. `share`: of all materials. `ratio`: opacity there over opacity at the sample."""

    share: Scalar
    ratio: Scalar
    mean_free_path: Scalar
    refractive_index: Scalar


class PhotonShading(Shading):
    """Shading by the templates of one image. `blended`: number of templates in each, for `cutoff`."""

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
        brightest = jax.lax.cummax(jnp.max(intensity, axis=(0, 1)), reverse=True)  # of this and later photons
        thresholds = jnp.zeros_like(brightest)
        if self.cutoff is not None:
            # lowered, so that rounding leaves out no photon that `_photon` does not skip
            thresholds = (1 - 1e-5) * jax.lax.stop_gradient(self.cutoff) / (brightest * self.blended)
        return jnp.where(brightest <= 0, jnp.inf, thresholds)  # padding

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
        # Stages are stored, since XLA would compute them again for each of their uses. Only the photon of a
        # single template costs nothing, as it is the same for all samples.
        mixed, medium = len(self.materials) > 1, None
        if mixed or shared.template is not None:
            offset, intensity = around.stored(lambda: self._photon(sample, shared, number))
        else:
            offset, intensity = self._photon(sample, shared, number)
        if mixed:
            offset, medium = self.refracted(around, sample, shared, offset)

        def places() -> list[Vec3]:
            return [_displaced(sample, offset, factor) for factor in (1.0, *self.reach)]

        def weights() -> tuple[Scalar, Scalar]:
            """Visible intensity of the photon, and weight of the colour at its place."""
            points = list(map(around.classified, places(), measured))
            photon_medium = self._medium(around, shared, points[0]) if medium is None else medium
            extinctions = [point.extinction for point in points]
            if self._soft:  # the opacity of one mean free path
                matter = -jnp.expm1(-extinctions[0] * photon_medium.mean_free_path)
            else:
                matter = step(extinctions[0], 0.0)
            visible = intensity * self._visible(offset, extinctions)
            return self.counted(visible, intensity * matter * photon_medium.share, photon_medium.ratio)

        measured = around.stored(lambda: [around.measured(place) for place in places()])
        visible, shows = around.stored(weights)
        brightness = tuple(visible * self.lit_side(offset, light) for light in shared.lights)
        color, _ = around.classification.classify(measured[0])
        return brightness, scaled(cast(Vec3, color), shows)

    def color(self, sample: Sample, shared: PhotonsOfSample, sums: tuple[tuple[Scalar, ...], Vec3]) -> Vec3:
        brightness, inner = sums
        # 1 from the middle of a material's soft edge inwards: unlit colour would look like emission
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
        """One channel of a sample's light, by a brightness and an irradiance per light."""
        return (color + inner) * sum(b * light for b, light in zip(brightness, irradiance, strict=True))

    def counted(self, visible: Scalar, shows: Scalar, ratio: Scalar) -> tuple[Scalar, Scalar]:
        """Weights of a photon for brightness and inner colour. `ratio`: see `Medium`."""
        return visible, shows * ratio

    def _photon(self, sample: Sample, shared: PhotonsOfSample, number: Int[Array, ""]) -> tuple[Vec3, Scalar]:
        """Offset and intensity of a photon, blended by the materials' shares; intensity 0 if skipped."""

        def of_sample(of_templates: Float[Array, " templates"]) -> Scalar:
            return of_templates[0] if shared.template is None else gather(of_templates, shared.template)

        offset, light = self.templates.offset, self.templates.intensity
        photons = [
            [*(of_sample(offset[m, :, number, i]) for i in range(3)), of_sample(light[m, :, number])]
            for m in range(len(self.materials))
        ]
        x, y, z, intensity = photons[0]
        if len(photons) > 1:
            x, y, z, intensity = (
                _sum([share * value for share, value in zip(shared.mixture, values, strict=True)])
                for values in zip(*photons, strict=True)
            )
        return (x, y, z), self.unless_skipped(sample, intensity)

    def unless_skipped(self, sample: Sample, intensity: Scalar) -> Scalar:
        """The intensity of a photon, or 0 below the cut-off."""
        if self.cutoff is None:
            return intensity
        return jnp.where(sample.transmittance * intensity * self.blended < self.cutoff, 0, intensity)

    def refracted(
        self, around: Surroundings, sample: Sample, shared: PhotonsOfSample, offset: Vec3
    ) -> tuple[Vec3, Medium]:
        """Refract the offset of a photon into the material at its place; and the medium at that place."""
        measured = around.stored(lambda: around.measured(_displaced(sample, offset)))

        def moved() -> tuple[Vec3, Medium]:
            medium = self._medium(around, shared, around.classified(_displaced(sample, offset), measured))
            # the template is stretched by the ratio of the speeds of light
            return scaled(offset, shared.optics.refractive_index / medium.refractive_index), medium

        return around.stored(moved)

    def _medium(self, around: Surroundings, shared: PhotonsOfSample, point: ClassifiedPoint) -> Medium:
        """The medium at a point; outside of the volume, materials have no share."""
        fractions = self.shares(around, point.coordinate, point.value)
        fractions = tuple(point.inside * fraction for fraction in fractions)
        optics, opacity = _blend(self.optics, fractions, shared.optics), shared.optics.opacity
        ratio = jnp.ones_like(opacity)
        if len(self.materials) > 1:
            exists = opacity != 0
            ratio = jnp.where(exists, optics.opacity / jnp.where(exists, opacity, 1), 0)
        return Medium(_sum(fractions), ratio, optics.mean_free_path, optics.refractive_index)

    def shares(self, around: Surroundings, coordinate: Vec3, value: Scalar) -> tuple[Scalar, ...]:
        def labelled(label: int) -> Scalar:
            if self._soft:
                return around.volume.label_share(coordinate, label)
            return (around.volume.label(coordinate) == label).astype(value.dtype)

        return shares_of(self.materials, labelled, value, edge=EDGE if self._soft else 0.0)

    def _visible(self, offset: Vec3, extinctions: list[Scalar]) -> Scalar:
        """Visibility of a photon from the sample, by the extinctions at its place and at `reach`."""
        if not self._soft:
            return 1 - step(_sum(extinctions), 0.0)
        pieces = np.diff([0.0, 1.0, *self.reach])
        depth = sum(piece * extinction for piece, extinction in zip(pieces, extinctions, strict=True))
        return jnp.exp(-depth * _norm(offset))

    def lit_side(self, offset: Vec3, light: Arriving) -> Scalar:
        """1 for a photon nearer to the light than the sample, else 0; with a ramp if soft."""
        if light.toward is None:
            return jnp.ones_like(offset[0])
        # for a light at a finite distance r: r - |r d - p|, in a form without cancellation
        near = dot(offset, light.toward) - dot(offset, offset) / (2 * light.distance)
        if not self._soft:
            return step(near, 0.0)
        return smoothstep(0.5 + near / _norm(offset) / (2 * LIT_SIDE_COSINE))


def _sum(terms: Sequence[Scalar]) -> Scalar:
    return functools.reduce(jnp.add, terms)


def _displaced(sample: Sample, offset: Vec3, factor: float = 1.0) -> Vec3:
    return along(sample.point, offset, jnp.full_like(offset[0], factor))


def _matter(shares: tuple[Scalar, ...]) -> Scalar:
    return jnp.minimum(2 * sum(shares), 1)


def _norm(offset: Vec3) -> Scalar:
    return jnp.sqrt(jnp.maximum(dot(offset, offset), jnp.finfo(offset[0].dtype).tiny ** 0.5))


def _blend(optics: Optics, shares: tuple[Scalar, ...], default: Optics) -> Optics:
    """Mean optics of materials, weighted by their shares; `default` has the remaining share."""
    remaining = 1 - sum(shares)
    blended = (
        sum(share * values[m] for m, share in enumerate(shares)) + remaining * value
        for values, value in zip(optics, default, strict=True)
    )
    return Optics(*blended)
