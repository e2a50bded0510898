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
from ..xla.memory import gather
from .lights import Arriving, Light
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
    """What all photons of a sample have in common. `mixture`: the materials' shares, scaled to sum to 1.
    `template`: the one in use, if there are several."""

    shares: tuple[Scalar, ...]
    mixture: tuple[Scalar, ...]
    optics: Optics
    template: Int[Array, ""] | None
    lights: tuple[Arriving, ...]


class PhotonShading(Shading):
    """Templates prepared for one image: (materials, templates, photons). `blended`: how many were blended
    into each, whose photons are skipped as they would be in their own templates."""

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
        total = sum(material_shares)
        mixture = tuple(share / jnp.where(total > 0, total, 1) for share in material_shares)
        optics = _blend(self.optics, mixture, Optics(*(jnp.ones_like(total),) * 3))
        lights = tuple(light.at(sample.point, sample.direction) for light in self.lights)
        return _Shared(material_shares, mixture, optics, template, lights)

    def term(self, around: Surroundings, sample: Sample, shared: _Shared, number: Int[Array, ""]) -> Any:
        # In stages, each of which is stored, since XLA would compute it again for each of its uses. Only the
        # photon of a single template costs nothing, as it is the same for all samples.
        several, medium = len(self.materials) > 1, None
        if several or shared.template is not None:
            offset, intensity = around.stored(lambda: self._photon(sample, shared, number))
        else:
            offset, intensity = self._photon(sample, shared, number)
        if several:
            offset, medium = self._refracted(around, sample, shared, offset)

        def places() -> list[Vec3]:
            return [_displaced(sample, offset, times) for times in (1.0, *self.reach)]

        def weights() -> tuple[Scalar, Scalar]:
            """How much of the photon is seen, and how much the colour at its place counts."""
            points = [around.classified(*each) for each in zip(places(), read, strict=True)]
            inner, path = self._medium(around, shared, points[0])[:2] if medium is None else medium
            extinctions = [point.extinction for point in points]
            # soft: the opacity of one mean free path there
            matter = -jnp.expm1(-extinctions[0] * path) if self._soft else step(extinctions[0], 0.0)
            return intensity * self._visible(offset, extinctions), intensity * inner * matter

        read = around.stored(lambda: [around.measured(place) for place in places()])
        seen, shows = around.stored(weights)
        brightness = tuple(seen * self._lit_side(offset, light) for light in shared.lights)
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
            * sum(b * light.irradiance[i] for b, light in zip(brightness, shared.lights, strict=True))
            for i, (c, s) in enumerate(zip(sample.color, inner, strict=True))
        )
        return red, green, blue

    def _photon(self, sample: Sample, shared: _Shared, number: Int[Array, ""]) -> tuple[Vec3, Scalar]:
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
        if self.cutoff is not None:
            skipped = sample.transmittance * intensity * self.blended < self.cutoff
            intensity = jnp.where(skipped, 0, intensity)
        return (x, y, z), intensity

    def _refracted(
        self, around: Surroundings, sample: Sample, shared: _Shared, offset: Vec3
    ) -> tuple[Vec3, tuple[Scalar, Scalar]]:
        """The offset of a photon that is moved by refraction into the material at its place; the factor by
        which the colour there counts, and the mean free path there."""
        own = shared.optics
        read = around.stored(lambda: around.measured(_displaced(sample, offset)))

        def moved() -> tuple[Vec3, tuple[Scalar, Scalar]]:
            there = around.classified(_displaced(sample, offset), read)
            matter, path, optics = self._medium(around, shared, there)
            ratio = optics.opacity / jnp.where(own.opacity == 0, 1, own.opacity)
            inner = jnp.where(own.opacity == 0, 0, ratio) * matter
            # the template is stretched by the ratio of the speeds of light
            return scaled(offset, own.refractive_index / optics.refractive_index), (inner, path)

        return around.stored(moved)

    def _medium(
        self, around: Surroundings, shared: _Shared, there: ClassifiedPoint
    ) -> tuple[Scalar, Scalar, Optics]:
        """Total share of the materials at a place, which falls to 0 outside of the volume; mean free path and
        all optics there."""
        each = tuple(there.inside * share for share in self._shares(around, there.coordinate, there.value))
        optics = _blend(self.optics, each, shared.optics)
        return _sum(each), optics.mean_free_path, optics

    def _shares(self, around: Surroundings, coordinate: Vec3, value: Scalar) -> tuple[Scalar, ...]:
        return shares(self.materials, around.volume, coordinate, value, edge=EDGE if self._soft else 0.0)

    def _visible(self, offset: Vec3, extinctions: list[Scalar]) -> Scalar:
        """Visibility of a photon from the sample, from the extinctions at its place and at `reach`."""
        if not self._soft:
            return 1 - step(_sum(extinctions), 0.0)
        pieces = np.diff([0.0, 1.0, *self.reach])
        depth = sum(piece * extinction for piece, extinction in zip(pieces, extinctions, strict=True))
        return jnp.exp(-depth * _norm(offset))

    def _lit_side(self, offset: Vec3, light: Arriving) -> Scalar:
        """Whether a photon is nearer to the light than the sample is: 0 or 1, with a ramp if soft."""
        if light.toward is None:
            return jnp.ones_like(offset[0])
        length = _norm(offset)
        # for a light at a finite distance r: r - |r d - p|, in a form without cancellation
        near = dot(offset, light.toward) - length**2 / (2 * light.distance)
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
