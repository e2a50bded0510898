"""Lighting by scatterer templates: which templates, and how are they used? `photons` says what each photon
adds to a sample.

Lee, Kwon and Shin: Scattered light representation in accordance with the material using scatterer template in
volume rendering (2016), sections 3.3 and 3.4.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._util.checks import flag, integer, is_flag, number
from ..march.march import March, Transform
from ..scene.transfer import Transfer
from ..scene.volume import Volume, without_voxels
from ..xla.compiling import computed_now
from ..xla.memo import memoized
from ..xla.platform import is_traced
from .baked import BakedLighting, bake, nodes_for
from .deferred import Deferred
from .growth import scatterer_templates
from .lights import Light, lights_of
from .materials import Material, Optics, materials_of
from .photons import Occlusion, TemplateShading
from .shading import Lighting, Shading, Simpler, Surroundings
from .template import ScattererTemplate
from .threshold import Energy, Threshold, ThresholdOn


Choice = Literal["pixel", "material"]


class ScattererTemplates(Lighting):
    """Light scattered inside materials, by templates.

    A sample at x in a material is surrounded by the photons of one of the material's templates: photon j lies
    at x + p_j and has intensity a_j. Under lights of irradiance E, a sample of colour c gets the radiance

        k R Σ_lights E b (c + s)    b = Σ_lit side a_j v_j    s = Σ_in matter a_j c(x + p_j)

    1. The lit side consists of the photons nearer to the light than x. Constant light has an irradiance of π
       times its radiance, and comes from all sides.
    2. The visibility v_j is 0 for a hidden photon and 1 for others, tested at x + p_j and at the multiples
       `reach` of p_j.
    3. b, the brightness, grows with the intensities of the photons that are not hidden.
    4. s, the inner colour that shines through, comes from photons in the same material,
    5. or in another one: a photon there lies at n / n' times its offset, and adds its colour with α' / α
       times its intensity. Here n is the refractive index, α the opacity, and primes mark the photon's
       material.
    6. Photons are skipped if the ray's transmittance times their intensity is below `cutoff`. As they are
       sorted, the loop over them ends where all that remain are skipped, of all samples that are shaded
       together.

    A sample in no material keeps its colour. With soft edges, a material's share is ½ at its edge; from there
    inwards, a sample is lit entirely as that material, and keeps nothing of its own colour.

    **Scale.** The paper's sum is E b (c + s), without a unit. Here the intensities of a template sum to 1
    (except for `given` templates and printed energy, which are used as they are), and k R turns the sum into
    radiance on the scale of `path_trace`: k = 4 / (3π) is a constant, and R is the `Optics.reflectance` of
    the sample's material, which falls from 1 to 0 as its opacity rises. So ratios between pixels of one
    material are the paper's if its template held all energy before it was scaled; if the threshold cut some
    off, s weighs more here. To get the paper's sum, divide by k R. A flat face of white matter, of which only
    the surface is visible, has a radiance of R L under a `ConstantLight` of radiance L.

    Measured relative to the exact radiance of multiple scattering, on white half-spaces of opacities from
    0.05 to 0.9, seen along the normal: 0.91 to 1.13 in constant light, 0.88 to 1.27 in parallel light along
    the normal, and 1.05 to 1.55 at an incidence of 60°, where light from beside the face is not yet hidden.
    The lower half of each range is for an extinction of 1/λ, the upper for 10/λ.
    For a white sphere of opacities 0.1 to 0.7, seen whole, 0.67 to 0.76 of the radiance in constant light,
    and 0.67 to 0.92 in parallel light (with steps of optical depth 2; a fifth of the step turned 0.72 into
    0.74).
    For colours darker than white, templates are too bright: in path tracing the colour darkens each of many
    scatterings, in templates it darkens the sum once.

    **Arguments:**

    - `materials`: one or several. Where two overlap, the first counts.
    - `lights`: one or several.
    - `templates`: number per material. `choice`: which of them a sample uses (the paper does not say):
      `"pixel"`: one for each pixel, chosen at random. `"material"`: the first one, for all samples of the
      material. It has no noise, takes less time, and is as lopsided everywhere as that one template is.
      `blend`: use all of them for every sample, instead, whatever `choice` says. This has less noise than one
      for each pixel, and takes as much longer as there are templates.
    - `photons`: keep this many of each template's brightest photons, scaled to the energy of all. By default
      all.
    - `occlusion`: `"soft"`: v_j is the transmittance along p_j and on through `reach`, with the extinction of
      each segment taken at its far end; materials and the lit side have soft edges, and the image is
      differentiable. `"hard"`: as published: a photon is hidden if anything is visible at one of these
      points. The gradient with respect to λ, the light and the camera is then wrong, since it misses photons
      that become hidden or change their material.
    - `reach`: multiples of a photon's offset, above 1 and increasing, at which occlusion is tested as well;
      for thin parts in front of others.
    - `cutoff`: by default 0.02 with hard occlusion, as published, and 0 with soft. Above 0, the gradient
      misses the photons that are skipped.
    - `seed`: of the templates, and of their choice for each pixel.
    - `packets`, `threshold`, `threshold_on`, `energy`, `critical_angle`: of the templates, see
      `scatterer_template`.
    - `baked`: False, or the number of nodes, along the volume's longest side, of a grid on which the light is
      computed once and then fetched, as long as volume, transfer function and lighting stay the same. All
      templates are blended there, and no photon is skipped for the ray's transmittance. It carries no
      gradient. If lighting, volume or transfer function is traced, it is computed for each image.
    - `levels`: of the templates' trees; required if an opacity is traced.
    - `given`: templates to use instead of grown ones, with leading axes (materials, templates). Their lengths
      and intensities are used as they are, so that nothing depends on the materials' mean free paths.

    Templates are grown anew for each image from the materials' current parameters, so that these have
    gradients.

    At points of extinction 0, the gradient of the extinction lacks the light that the points would show,
    since invisible points are not lit.

    Where it fails, and where not: `experiments/stability.py`, "long mean free paths",
    "short mean free paths".

    **Raises:** `ValueError` for invalid arguments, if `levels` are required but missing, for a material of
    which no photon is above the threshold (if its opacity is traced, the image is NaN), and for templates or
    a grid that do not fit into memory.
    """

    materials: tuple[Material, ...]
    lights: tuple[Light, ...]
    given: ScattererTemplate | None
    cutoff: Float[Array, ""] | None
    critical_angle: Float[Array, ""] | None
    templates: int = eqx.field(static=True)
    choice: Choice = eqx.field(static=True)
    blend: bool = eqx.field(static=True)
    photons: int = eqx.field(static=True)
    occlusion: Occlusion = eqx.field(static=True)
    reach: tuple[float, ...] = eqx.field(static=True)
    seed: int = eqx.field(static=True)
    threshold: Threshold = eqx.field(static=True)
    levels: int = eqx.field(static=True)
    baked: int = eqx.field(static=True)

    def __init__(
        self,
        materials: Material | Sequence[Any],
        lights: Light | tuple[Light, ...] | Any,
        *,
        templates: int = 8,
        choice: Choice | Any = "pixel",
        blend: bool | Any = False,
        photons: int | None = None,
        occlusion: Occlusion | Any = "soft",
        reach: Sequence[float] = (2.0, 4.0),
        cutoff: float | None = None,
        seed: int = 0,
        baked: int | bool | Any = False,
        packets: int = 4,
        threshold: float = 0.01,
        threshold_on: ThresholdOn | Any = "photon",
        energy: Energy | Any = "conserving",
        critical_angle: float | None = None,
        levels: int | None = None,
        given: ScattererTemplate | Any | None = None,
    ):
        self.materials, self.lights = materials_of(materials), lights_of(lights)
        self.templates, self.blend = integer("templates", templates, 1), flag("blend", blend)
        for name, given_, allowed in (("occlusion", occlusion, Occlusion), ("choice", choice, Choice)):
            if given_ not in get_args(allowed):
                raise ValueError(f"{name} must be one of {', '.join(get_args(allowed))}; got {given_!r}.")
        self.occlusion, self.choice, self.seed = occlusion, choice, integer("seed", seed, 0)
        try:
            self.reach = tuple(float(r) for r in reach)
            grows = all(b > a for a, b in zip((1.0, *self.reach), (*self.reach, math.inf), strict=True))
        except TypeError:
            grows = False
        if not grows:
            raise ValueError(f"reach must be multiples above 1, in increasing order; got {reach!r}.")
        if cutoff is None:
            cutoff = 0.02 if occlusion == "hard" else 0.0
        self.cutoff = None
        if is_traced(cutoff) or cutoff != 0:
            self.cutoff = number("cutoff", cutoff, above=0, below=1)
        self.critical_angle = None
        if critical_angle is not None:
            self.critical_angle = number("critical_angle", critical_angle, above=0, below=90.001)
        self.threshold = Threshold.checked(packets, threshold, threshold_on, energy)
        # True: 64 nodes, fine enough for light that scatters over several voxels
        self.baked = 64 * bool(baked) if is_flag(baked) else integer("baked", baked, 2)
        self.given = given
        if not isinstance(given, ScattererTemplate | None):
            raise ValueError(f"given must be a ScattererTemplate; got {given!r}.")
        if given is not None:
            available = given.intensity.shape[-1]
            if given.intensity.ndim != 3 or given.intensity.shape[0] != len(self.materials):
                raise ValueError(
                    f"given must hold templates of {len(self.materials)} materials, "
                    f"with intensities of shape (materials, templates, n); got {given.intensity.shape}."
                )
            self.templates, levels = given.intensity.shape[1], 0
        else:
            self.threshold.require_photons(self.materials)
            if levels is None:
                levels = max(map(self.threshold.levels, self.materials))
            opacities = [each.opacity for each in self.materials]
            available = self.threshold.capacity(levels)
            if not is_traced(opacities):
                available = min(available, max(map(self.threshold.photons, self.materials)))
        self.levels = levels
        self.photons = available if photons is None else min(available, integer("photons", photons, 1))

    def grown(self, *, blend: bool) -> ScattererTemplate:
        """The templates that are used, of shape (materials, templates or 1, photons)."""
        ends = self.threshold
        count = self.templates if blend or self.choice == "pixel" else 1
        if self.given is not None:
            templates = jax.tree.map(lambda leaf: leaf[:, :count], self.given)
        else:
            templates = scatterer_templates(
                self.materials,
                self.seed,
                count=count,
                packets=ends.packets,
                threshold=ends.value,
                threshold_on=ends.on,
                energy=ends.energy,
                critical_angle=self.critical_angle,
                levels=self.levels,
            )
            if ends.energy == "conserving":  # restores the energy that the threshold has cut off
                templates = templates.normalized()
        if blend:
            templates = jax.tree.map(lambda leaf: leaf[:, None], templates.blended())
        return templates.brightest(self.photons * (count if blend else 1))

    @property
    def smooth(self) -> Lighting:
        return self._with(blend=True, photons=None, baked=False)

    @property
    def simpler(self) -> tuple[Simpler, ...]:
        baked = self._with(baked=self.baked or True)
        grid = f"computed on a grid of {baked.baked} nodes"
        few = self._with(templates=min(2, self.templates), blend=True, photons=8, baked=False)
        return (
            Simpler(Deferred(baked), f"{grid}, fetched once per ray", False),
            Simpler(Deferred(few), "two templates of eight photons, once per ray"),
            Simpler(baked, grid, False),
            Simpler(self._with(photons=4, baked=False), "four photons"),
        )

    def _with(self, **changes: Any) -> "ScattererTemplates":
        """This lighting with other options."""
        own = {
            "templates": self.templates,
            "choice": self.choice,
            "blend": self.blend,
            "photons": self.photons,
            "occlusion": self.occlusion,
            "reach": self.reach,
            "cutoff": 0.0 if self.cutoff is None else self.cutoff,
            "seed": self.seed,
            "baked": self.baked or False,
            "packets": self.threshold.packets,
            "threshold": self.threshold.value,
            "threshold_on": self.threshold.on,
            "energy": self.threshold.energy,
            "critical_angle": self.critical_angle,
            "levels": self.levels or None,
            "given": self.given,
        }
        return ScattererTemplates(self.materials, self.lights, **(own | changes))

    @property
    def farthest_read(self) -> float | None:
        if self.baked:
            return None
        offset = np.asarray(self.grown(blend=self.blend).offset)
        indices = [float(material.refractive_index) for material in self.materials]
        stretched = max(indices) / min(indices)  # by refraction
        return float(np.max(np.linalg.norm(offset, axis=-1))) * max(1.0, *self.reach) * stretched

    def prepared(self, volume: Volume, transfer: Transfer, march: March) -> Lighting:
        if not self.baked:
            return self
        # of the march, only the transforms that locate points affect the light
        spaces = [t for t in march.transforms if type(t).locate is not Transform.locate]
        leaves, tree = jax.tree.flatten((self, without_voxels(volume), transfer, spaces))
        if is_traced(leaves, volume.data):
            return self
        cache = memoized(volume.data, _bake_cache)
        entry = cache.get(tree)
        if entry is None or not all(_same(a, b) for a, b in zip(entry[0], leaves, strict=True)):
            cache.clear()
            with jax.ensure_compile_time_eval():  # the cached light must outlive an enclosing `jax.jit`
                around = Surroundings(volume, transfer, march.locate(volume))
            cache[tree] = entry = leaves, computed_now(_baked, self, around)
        return entry[1]

    def shading(self, around: Surroundings) -> Shading:
        if self.baked:
            return _baked(self, around).shading(around)
        return self._shading(blend=self.blend, cutoff=self.cutoff)

    def _shading(self, *, blend: bool, cutoff: Float[Array, ""] | None) -> TemplateShading:
        optics: Optics = jax.tree.map(lambda *each: jnp.stack(each), *(m.optics for m in self.materials))
        return TemplateShading(
            *(self.materials, self.lights, self.grown(blend=blend), optics, cutoff),
            *(self.templates if blend else 1, self.given is not None),
            *(self.occlusion, self.reach, self.seed),
        )

    def _bake(self, around: Surroundings) -> BakedLighting:
        nodes = nodes_for(around.volume, self.baked)  # checks the memory before templates are grown
        return bake(self._shading(blend=True, cutoff=None), around, nodes)


def _bake_cache(_: Array) -> dict[Any, Any]:
    """Cache of a volume's baked light: the last one only, keyed by its other inputs."""
    return {}


def _same(a: Any, b: Any) -> bool:
    """Whether two leaves are certainly equal; large ones, such as labels, only if they are the same array."""
    return a is b or (np.size(a) <= 2**16 and np.array_equal(np.asarray(a), np.asarray(b)))


@eqx.filter_jit
def _baked(lighting: ScattererTemplates, around: Surroundings) -> BakedLighting:
    return lighting._bake(around)
