"""How do scatterers light a sample? By the photons of a template, laid around it.

Each photon tells where light comes from that is scattered on to the sample: those on the lit side, and not
hidden, make it bright; those inside matter give it their colour.

Lee, Kwon and Shin: Scattered light representation in accordance with the material using scatterer template in
volume rendering (2016), sections 3.3 and 3.4.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._util.checks import integer, is_traced, number
from .._util.memo import kept
from .._util.noise import hashed_uniforms
from .._util.vec3 import Scalar, Vec3, along
from ..march import March, Transform
from ..transfer import Transfer
from ..volume import Volume, without_voxels
from .baked import BakedLighting, bake, nodes_for
from .lights import ConstantLight, Light, LocatedLight, lights_of
from .materials import Material, Optics, materials_of, shares, smoothstep, step
from .shading import Lighting, Sample, Shading, Surroundings
from .template import (
    Energy,
    ScattererTemplate,
    photons_above,
    require_photons,
    scatterer_templates,
    settings,
    template_levels,
)


Occlusion = Literal["soft", "hard"]

EDGE = 0.1
"""Under soft occlusion a material comes and goes over this part of its range of values."""

TWILIGHT = 0.25
"""Under soft occlusion, the cosine up to which a photon beyond the lit side still counts in part."""


WHITE = 4 / (3 * math.pi)
"""What makes radiance of irradiance, so that opaque white matter that absorbs nothing is as bright as the
light around it. Of the photons around a sample in a flat face, half are outside, from where light comes,
and half are inside, and add their colour: b = 1/2, s = c/2, and E b (c + s) = 3/4 π L c, in light of
radiance L."""


class ScattererTemplates(Lighting):
    """Light scattered inside materials, by templates.

    A sample x of a material has around it the photons of one of the material's templates, photon j at x + p_j
    with intensity a_j. Under lights of irradiance E, a sample of colour c gets the radiance

        k R Σ_lights E b (c + s)    b = Σ_lit side a_j v_j    s = Σ_in matter a_j c(x + p_j)

    1. On the lit side are photons nearer to the light than x. Constant light has an irradiance of π times its
       radiance, and comes from all sides.
    2. v_j is 0 for a photon that is hidden, 1 for others, tested at x + p_j and at its multiples `reach`.
    3. b, the brightness, grows with the intensities of photons that are not hidden.
    4. s, the colour that shines through from inside, comes from photons in the same material,
    5. or in another one: a photon there lies at n / n' times its offset, and adds its colour with α' / α
       times its intensity, n being refractive indices, α opacities, and those of its material primed.
    6. Photons are left out where the ray's transmittance times their intensity is below `cutoff`.

    What belongs to no material keeps its colour. Where a material comes in softly, half of it is there at its
    edge; all that is within is lit as matter of it, and keeps nothing of its own colour.

    **Scale.** The paper's sum is E b (c + s), in no unit. Here the intensities of a template sum to 1 (but
    for `given` ones, and printed energy, which are taken as they are), and k R makes it radiance, on the
    scale of `path_trace`: k = 4 / (3π) is a constant, and R = `Optics.reflectance` that of the sample's
    material, which falls from 1 to 0 as its opacity rises. So ratios between pixels of one material are
    the paper's where its template held all energy before it was scaled; where the threshold cut some off, s
    counts for more here. To have the paper's sum, divide by k R. A flat face of white matter, of which
    nothing is seen but its surface, has a radiance of R L under a `ConstantLight` of radiance L.

    Measured on white half-spaces of opacities from 0.05 to 0.9, seen along the normal, against the exact
    radiance of multiple scattering: 0.91 to 1.13 times as bright in constant light, 0.88 to 1.27 in
    parallel light along the normal, and 1.05 to 1.55 at an incidence of 60°, where light from beside the
    face is not yet hidden; of each the lower half where extinction is 1/λ, the upper where it is 10/λ.
    Of a white sphere of opacities 0.1 to 0.7, seen whole, templates had 0.67 to 0.76 of the radiance in
    constant light, and 0.67 to 0.92 in parallel light (in samples an optical depth of 2 apart; a fifth of
    the step made 0.74 of 0.72).
    Where colours are darker than white, templates are too bright: in path tracing a colour darkens each of
    many scatterings, and in templates the whole once.

    **Arguments:**

    - `materials`: one or several. Where a place belongs to two, the first counts.
    - `lights`: one or several.
    - `templates`: for each material. `blend`: use all of them for every sample, rather than one, chosen at
      random for each pixel (our choice: the paper does not say which sample takes which): less noise, at as
      many times the cost.
    - `photons`: of each template keep so many of the brightest, which hold the energy of all. By default all.
    - `occlusion`: `"soft"`: v_j is the transmittance of the way to x + p_j and on through `reach`, were each
      stretch of it like its far end; materials meet in ramps, the lit side ends in one, and the image is
      differentiable. `"hard"`: as published: a photon is hidden where anything is seen at one of these
      places. Its gradient with respect to λ, the light and the camera is wrong, since it does not see
      photons that become hidden, or change their material.
    - `reach`: multiples of a photon's offset, above 1 and increasing, against thin parts before others.
    - `cutoff`: by default 0.02 under hard occlusion, as published, and 0 under soft. Above 0 the gradient
      does not see photons that are left out.
    - `seed`: of templates, and of their choice for each pixel.
    - `packets`, `threshold`, `energy`, `critical_angle`: of the templates, see `scatterer_template`.
    - `baked`: False, or how many nodes a grid has along the volume's longest side on which the light is
      computed once, and fetched from then on: for a volume, a transfer function and a lighting as they are.
      All templates are blended there, and nothing is left out for the ray's transmittance. It carries no
      gradient. Where lighting, volume or transfer function are traced, it is computed in each image.
    - `levels`: of their trees; needed where an opacity is traced.
    - `given`: templates to be used instead of grown ones, with leading axes (materials, templates); lengths
      stay as they are, so that nothing depends on the materials' mean free paths, and so do intensities.

    Templates are grown anew in each image, from the materials' numbers as they are, so that these have
    gradients.

    The gradient of extinction lacks, at places where the extinction is 0, what light they would show: nothing
    is lit that is not seen.

    **Raises:** `ValueError` for arguments of other kinds, where `levels` are needed, for a material of
    which the threshold leaves no photon (where its opacity is traced, the image is NaN), and for templates
    or a grid that do not fit into memory.
    """

    materials: tuple[Material, ...]
    lights: tuple[Light, ...]
    given: ScattererTemplate | None
    cutoff: Float[Array, ""] | None
    critical_angle: Float[Array, ""] | None
    templates: int = eqx.field(static=True)
    blend: bool = eqx.field(static=True)
    photons: int = eqx.field(static=True)
    occlusion: Occlusion = eqx.field(static=True)
    reach: tuple[float, ...] = eqx.field(static=True)
    seed: int = eqx.field(static=True)
    growth: tuple[int, float, Energy, int] = eqx.field(static=True)
    baked: int = eqx.field(static=True)

    def __init__(
        self,
        materials: Material | Sequence[Any],
        lights: Light | tuple[Light, ...] | Any,
        *,
        templates: int = 8,
        blend: bool = False,
        photons: int | None = None,
        occlusion: Occlusion | Any = "soft",
        reach: Sequence[float] = (2.0, 4.0),
        cutoff: float | None = None,
        seed: int = 0,
        baked: int | bool = False,
        packets: int = 4,
        threshold: float = 0.01,
        energy: Energy | Any = "conserving",
        critical_angle: float | None = None,
        levels: int | None = None,
        given: ScattererTemplate | None = None,
    ):
        self.materials, self.lights = materials_of(materials), lights_of(lights)
        self.templates, self.blend = integer("templates", templates, 1), bool(blend)
        if occlusion not in get_args(Occlusion):
            raise ValueError(f"occlusion must be one of {', '.join(get_args(Occlusion))}; got {occlusion!r}.")
        self.occlusion, self.seed = occlusion, integer("seed", seed, 0)
        try:
            self.reach = tuple(float(r) for r in reach)
            grows = all(b > a for a, b in zip((1.0, *self.reach), (*self.reach, math.inf), strict=True))
        except TypeError:
            grows = False
        if not grows:
            raise ValueError(f"reach must be multiples above 1 that increase; got {reach!r}.")
        if cutoff is None:
            cutoff = 0.02 if occlusion == "hard" else 0.0
        self.cutoff = None
        if is_traced(cutoff) or cutoff != 0:
            self.cutoff = number("cutoff", cutoff, above=0, below=1)
        self.critical_angle = None
        if critical_angle is not None:
            self.critical_angle = number("critical_angle", critical_angle, above=0, below=90.001)
        packets, threshold, energy = settings(packets, threshold, energy)
        # True: fine enough for what scatters over several voxels
        self.baked = 64 if baked is True else 0 if baked is False else integer("baked", baked, 2)
        self.given = given
        if not isinstance(given, ScattererTemplate | None):
            raise ValueError(f"given must be a ScattererTemplate; got {given!r}.")
        if given is not None:
            whole = given.intensity.shape[-1]
            if given.intensity.ndim != 3 or given.intensity.shape[0] != len(self.materials):
                raise ValueError(
                    f"given must hold templates of {len(self.materials)} materials, "
                    f"(materials, templates, n); got {given.intensity.shape}."
                )
            self.templates, levels = given.intensity.shape[1], 0
        else:
            require_photons(self.materials, packets, threshold)
            how: Any = {"packets": packets, "threshold": threshold, "energy": energy}
            opacities = [each.opacity for each in self.materials]
            if levels is None:
                levels = max(template_levels(each, **how) for each in self.materials)
            if is_traced(opacities):
                whole = packets * (2**levels - 1)
            else:
                whole = max(photons_above(each, **how) for each in self.materials)
        self.growth = (packets, threshold, energy, levels)
        self.photons = whole if photons is None else min(whole, integer("photons", photons, 1))

    def grown(self, *, blend: bool) -> ScattererTemplate:
        """The templates as they are used: (materials, templates or 1, photons)."""
        packets, threshold, energy, levels = self.growth
        if self.given is not None:
            templates = self.given
        else:
            templates = scatterer_templates(
                self.materials,
                self.seed,
                count=self.templates,
                packets=packets,
                threshold=threshold,
                energy=energy,
                critical_angle=self.critical_angle,
                levels=levels,
            )
            if energy == "conserving":  # with what the threshold has cut off
                templates = templates.normalized()
        if blend:
            templates = jax.tree.map(lambda leaf: leaf[:, None], templates.blended())
        return templates.brightest(self.photons * (self.templates if blend else 1))

    def prepared(self, volume: Volume, transfer: Transfer, march: March) -> Lighting:
        if not self.baked:
            return self
        # of a march, light depends on how places are found alone
        spaces = [t for t in march.transforms if type(t).locate is not Transform.locate]
        leaves, tree = jax.tree.flatten((self, without_voxels(volume), transfer, spaces))
        if is_traced(leaves, volume.data):
            return self
        memory = kept(volume.data, _memory)
        known = memory.get(tree)
        if known is None or not all(_same(a, b) for a, b in zip(known[0], leaves, strict=True)):
            memory.clear()
            with jax.ensure_compile_time_eval():  # what is kept must outlive a `jax.jit` around
                around = Surroundings(volume, transfer, march.locate(volume))
                memory[tree] = known = leaves, _baked(self, around)
        return known[1]

    def over(self, around: Surroundings) -> Shading:
        if self.baked:
            return _baked(self, around).over(around)
        return TemplateShading(self, self.grown(blend=self.blend), self._optics, self.cutoff)

    @property
    def _optics(self) -> Optics:
        return jax.tree.map(lambda *each: jnp.stack(each), *(m.optics for m in self.materials))

    def _bake(self, around: Surroundings) -> BakedLighting:
        nodes = nodes_for(around.volume, self.baked)  # before templates are grown
        return bake(TemplateShading(self, self.grown(blend=True), self._optics, None), around, nodes)


def _memory(_: Array) -> dict:
    """Light baked for a volume: the last one, under what else it was made of."""
    return {}


def _same(a: Any, b: Any) -> bool:
    """Whether two leaves are known to be equal: large ones, such as labels, only if they are one array."""
    return a is b or (np.size(a) <= 2**16 and np.array_equal(np.asarray(a), np.asarray(b)))


@eqx.filter_jit
def _baked(lighting: ScattererTemplates, around: Surroundings) -> BakedLighting:
    return lighting._bake(around)


class _Notes(NamedTuple):
    """What all photons of a sample have in common."""

    shares: tuple[Scalar, ...]
    parts: tuple[Scalar, ...]
    """The shares, made to sum to 1 if there are any."""
    optics: Optics
    template: Int[Array, ""]
    lights: tuple[tuple[Vec3 | None, Scalar, Vec3], ...]
    """Of each: the direction to it and the distance, and the irradiance. No direction: from all sides."""


class TemplateShading(Shading):
    """Templates ready for one image."""

    how: ScattererTemplates
    templates: ScattererTemplate
    optics: Optics
    cutoff: Float[Array, ""] | None

    @property
    def terms(self) -> int:
        return self.templates.intensity.shape[-1]

    @property
    def _soft(self) -> bool:
        return self.how.occlusion == "soft"

    def _shares(self, around: Surroundings, coordinate: Vec3, value: Scalar) -> tuple[Scalar, ...]:
        edge = EDGE if self._soft else 0.0
        return shares(self.how.materials, around.volume, coordinate, value, edge=edge)

    def about(self, around: Surroundings, sample: Sample) -> _Notes:
        found = self._shares(around, around.space.coordinate(sample.point), sample.measured[0])
        choice = jnp.zeros((), jnp.int32)
        if (count := self.templates.intensity.shape[1]) > 1:
            u, _, _ = hashed_uniforms(*sample.pixel, jnp.uint32(self.how.seed), jnp.float32)
            choice = (u * count).astype(jnp.int32)
        lights = []
        for light in self.how.lights:
            if isinstance(light, ConstantLight):
                r, g, b = (jnp.pi * radiance for radiance in light.radiance)
                lights.append((None, jnp.full_like(sample.extinction, jnp.inf), (r, g, b)))
            elif isinstance(light, LocatedLight):
                lights.append(tuple(light.at(sample.point)))
        whole = sum(found)
        parts = tuple(share / jnp.where(whole > 0, whole, 1) for share in found)
        none = Optics(*(jnp.ones_like(whole),) * 3)
        return _Notes(found, parts, _blend(self.optics, parts, none), choice, tuple(lights))

    def term(self, around: Surroundings, sample: Sample, notes: _Notes, number: Int[Array, ""]) -> Any:
        offset, intensity = self._photon(notes, number)
        if self.cutoff is not None:
            alone = intensity * (self.how.templates if self.how.blend else 1)
            intensity = jnp.where(sample.transmittance * alone < self.cutoff, 0, intensity)
        place = around.at(_beside(sample, offset))
        there = self._shares(around, place.coordinate, place.value)
        there = tuple(place.inside * share for share in there)
        optics, scale = _blend(self.optics, there, notes.optics), intensity
        if len(self.how.materials) > 1:
            # another material bends light, and stretches the template with it
            speed = notes.optics.refractive_index / optics.refractive_index
            x, y, z = offset
            offset = x * speed, y * speed, z * speed
            place = around.at(_beside(sample, offset))
            own = notes.optics.opacity
            scale = intensity * jnp.where(own == 0, 0, optics.opacity / jnp.where(own == 0, 1, own))
        if self._soft:  # as much as is there over the distance from one scattering to the next
            matter = -jnp.expm1(-place.extinction * optics.mean_free_path)
        else:
            matter = step(place.extinction, 0.0)
        r, g, b = (scale * sum(there) * matter * c for c in place.color)

        seen = intensity * self._visible(around, sample, offset, place.extinction)
        brightness = tuple(seen * self._lit_side(offset, *light[:2]) for light in notes.lights)
        return brightness, (r, g, b)

    def color(self, sample: Sample, notes: _Notes, sums: Any) -> Vec3:
        brightness, inner = sums
        # all of what is at a material's edge: were a part left, it would shine by itself
        matter = jnp.minimum(2 * sum(notes.shares), 1)
        scale = matter * WHITE * notes.optics.reflectance
        red, green, blue = (
            c * (1 - matter)
            + scale
            * (c + s)
            * sum(b * irradiance[i] for b, (_, _, irradiance) in zip(brightness, notes.lights, strict=True))
            for i, (c, s) in enumerate(zip(sample.color, inner, strict=True))
        )
        return red, green, blue

    def _photon(self, notes: _Notes, number: Int[Array, ""]) -> tuple[Vec3, Scalar]:
        """Offset and intensity of a photon, of the sample's material; or between those of several."""
        x = y = z = intensity = jnp.zeros_like(notes.parts[0])
        for m, part in enumerate(notes.parts):
            offset = self.templates.offset[m, notes.template, number]
            intensity = intensity + part * self.templates.intensity[m, notes.template, number]
            x, y, z = x + part * offset[0], y + part * offset[1], z + part * offset[2]
        return (x, y, z), intensity

    def _visible(self, around: Surroundings, sample: Sample, offset: Vec3, first: Scalar) -> Scalar:
        """How much of a photon is seen from the sample, of which extinction it has itself being known."""
        further = [around.extinction(_beside(sample, offset, k)) for k in self.how.reach]
        places = [first, *further]
        if not self._soft:
            clear = (1 - step(extinction, 0.0) for extinction in places)
            return functools.reduce(jnp.multiply, clear)
        pieces = np.diff([0.0, 1.0, *self.how.reach])
        depth = sum(piece * extinction for piece, extinction in zip(pieces, places, strict=True))
        return jnp.exp(-depth * _norm(offset))

    def _lit_side(self, offset: Vec3, toward: Vec3 | None, distance: Scalar) -> Scalar:
        """Whether a photon is nearer to the light than the sample is."""
        if toward is None:
            return jnp.ones_like(offset[0])
        length = _norm(offset)
        closer = sum(p * d for p, d in zip(offset, toward, strict=True))
        # of a light at a finite distance r, r - |r d - p|, in a form that loses no digits
        near = closer - length**2 / (2 * distance)
        if not self._soft:
            return step(near, 0.0)
        return smoothstep(0.5 + near / length / (2 * TWILIGHT))


def _beside(sample: Sample, offset: Vec3, times: float = 1.0) -> Vec3:
    return along(sample.point, offset, jnp.full_like(offset[0], times))


def _norm(offset: Vec3) -> Scalar:
    x, y, z = offset
    return jnp.sqrt(jnp.maximum(x * x + y * y + z * z, jnp.finfo(x.dtype).tiny ** 0.5))


def _blend(optics: Optics, shares: tuple[Scalar, ...], rest: Optics) -> Optics:
    """The optics of a place by the shares of materials there; what no material has is like the rest."""
    left = 1 - sum(shares)
    blended = (
        sum(share * each[m] for m, share in enumerate(shares)) + left * other
        for each, other in zip(optics, rest, strict=True)
    )
    return Optics(*blended)
