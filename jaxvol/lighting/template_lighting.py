"""Lighting by scatterer templates: its options, and the templates in use. `photons` adds the light of photons
to a sample, `transport` carries light by random walks.

Lee, Kwon and Shin: Scattered light representation in accordance with the material using scatterer template in
volume rendering (2016), sections 3.3 and 3.4.
"""

import inspect
from collections.abc import Sequence
from typing import Any, Literal, SupportsIndex, get_args

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from .._util.checks import Arrayable, flag, integer, number
from ..march.march import March
from ..scene.transfer import Transfer
from ..scene.volume import Volume, without_voxels
from ..xla.compiling import computed_now
from ..xla.memo import memoized
from ..xla.platform import is_traced
from .lights import Light, lights_of
from .materials import Material, materials_of, optics_of
from .medium import MediumTransfer
from .packet_tree import PacketTree, ThresholdOn
from .photons import Occlusion, PhotonShading
from .random_walks import scatterings
from .shading import Lighting, Shading, Surroundings
from .simulation import scatterer_templates
from .template import ScattererTemplate
from .transport import Transport


Form = Literal["published", "transport"]

NODES = 48
"""Nodes of the grid of `form="transport"`, along the volume's longest side."""


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
    5. or in another one, of refractive index n' and opacity α': a photon there lies at n / n' times its
       offset, and adds its colour with α' / α times its intensity.
    6. Photons are skipped if the ray's transmittance times their intensity is below `cutoff`.

    Steps 4 and 5 as printed differ: a photon adds the light's colour times its intensity, however little
    light reaches the sample, and in another material its intensity itself is scaled. Here s is lit like c, so
    that shadows stay dark, and only s is scaled, so that no sample gets more light than arrives.
    (`experiments/printed_templates.py` has the printed steps, `paper_figs` shows both.)

    A sample in no material keeps its colour. With soft edges, a material's share is ½ at its edge; from there
    inwards, a sample is lit entirely as that material.

    **Scale.** The paper's sum E b (c + s) has no unit. Here the intensities of a template sum to 1 (except
    for `given` ones), and k R turns the sum into radiance on the scale of `path_trace`: k = 4 / (3π), and R
    is the `Optics.reflectance` of the sample's material. Under soft occlusion, white half-spaces have 0.9 to
    1.6 times the exact radiance of multiple scattering, white spheres 0.7 to 0.9 times (`docs/methods.md`),
    and a head 1.3 times that of path tracing; under hard occlusion the head has 0.4 to 0.5 times. For darker
    colours, templates are too bright: in path tracing the colour darkens each of many scatterings, here it
    darkens the sum once. Limits: `experiments/stability.py`, "long mean free paths", "short mean free paths",
    "one template for each pixel", "thin parts between tests".

    **`form="transport"`**, which is ours, carries light as `path_trace` does, for images without noise. (Mean
    free paths are fitted to path-traced images in less time, and in thick matter with less error, by a
    `PathTracedResidual`.) The medium is that of `path_trace` with these materials, for light and
    camera rays alike: wherever the transfer function shows anything in a material, the extinction is 1/λ, and
    the albedo its colour · (1 - opacity); elsewhere they are the transfer function's, and samples in no
    material are lit, too. The paper's photons become the vertices of random walks: the sample
    itself counts; directions are uniform, not refracted; a photon counts only if all its ancestors are
    inside; and the scale is that of scattering, not of a half-space's reflectance. The lengths of flights
    follow the extinction at 16 places in front of them. Light that was scattered before is computed on a grid
    of `nodes`, by a template rotated at random at each node, once for all images of a scene; direct light at
    each sample. Steps 1 to 6, refractive indices, `blend`, `photons`, `occlusion`, `reach`, `cutoff` and
    `given` belong to the published form alone.

    Bias of this form: the light after the last of `levels`, at most `threshold` of all light in materials;
    the grid, which blurs light where nodes are farther apart than the mean free path (thick matter shows
    blotches of nodes whose walks differ, fewer with more `packets`); and the places of flights, whose
    distances grow with that from the start. Scattering is isotropic: for a material of anisotropy g, pass the
    mean free path λ / (1 - g), which spreads light as far (similarity). Steps of the march should be short
    against the mean free path, too: steps of a third of it make images up to 3 % too bright. Agreement with
    path tracing: `experiments/results/transport.json`.

    Its derivatives are those of the mean over all walks: places of walks are constant, and their weights
    change. The image itself has small jumps, since the ends of walks cross surfaces as λ changes, so that
    finite differences show the derivative only over some 10 % of λ. If voxels change, edges of materials move
    under the derivative, but not the surface at which the extinction becomes 0.

    Templates are simulated for each image from the materials' current parameters, so that these have
    gradients. At points of extinction 0, the gradient by the extinction lacks the light that the points would
    show, since invisible points are not lit.

    Args:
        materials: one or several. Where two overlap, the first counts. In a volume of colours
            (`RadianceField`), they are distinguished by labels.
        lights: one or several, of any kind but `HeadLight`.
        templates: number of templates per material, by default 8. Each pixel uses one, chosen at random,
            which shows as noise (the paper blends them). A single one has no noise, takes less time, and is
            lopsided in the same way everywhere. With `"transport"`, each node of the grid uses one of 256, by
            default, and more take no more time.
        blend: use all templates for every sample, as the paper does against noise; the time grows with their
            number.
        photons: number of the brightest photons of each template to keep, scaled to the energy of all; by
            default all.
        occlusion: `"soft"`: v_j is the transmittance along p_j and on through `reach`, with the extinction of
            each segment taken at its far end; materials and the lit side have soft edges, and the image is
            differentiable. `"hard"`, as published: a photon is hidden if anything is visible at one of the
            points. The gradient with respect to λ, the light and the camera is then wrong, since it misses
            photons that become hidden or change their material.
        reach: multiples of a photon's offset, above 1 and increasing, at which occlusion is tested as well;
            for thin parts in front of others.
        cutoff: of step 6, in [0, 1); by default 0.02 with hard occlusion, as published, and 0 with soft.
            Above 0, the gradient misses the photons that are skipped.
        seed: seed of the templates, and of their choice for each pixel.
        nodes: number of nodes of the grid of `"transport"` along the volume's longest side; by default 48.
        packets: packets of a template, see `scatterer_template`; walks of a template of `"transport"`.
        threshold: as for `scatterer_template`.
        threshold_on: as for `scatterer_template`; `"level"` in the paper.
        levels: as for `scatterer_template`; one number, or a number for each material (published form only).
        given: templates to use unchanged instead of simulated ones, with leading axes (materials, templates).
            Nothing then depends on the materials' mean free paths.
        form: `"published"`, or `"transport"`: see above.

    Raises:
        ValueError: for invalid arguments, missing `levels`, a material without photons above the threshold
            (if its opacity is traced, the image is NaN), and a grid that does not fit into memory.
    """

    materials: tuple[Material, ...]
    lights: tuple[Light, ...]
    given: ScattererTemplate | None
    cutoff: Float[Array, ""] | None
    templates: int = eqx.field(static=True)
    blend: bool = eqx.field(static=True)
    photons: int = eqx.field(static=True)
    occlusion: Occlusion = eqx.field(static=True)
    reach: tuple[float, ...] = eqx.field(static=True)
    seed: int = eqx.field(static=True)
    packets: int = eqx.field(static=True)
    threshold: float = eqx.field(static=True)
    threshold_on: ThresholdOn = eqx.field(static=True)
    levels: tuple[int, ...] = eqx.field(static=True)
    nodes: int = eqx.field(static=True)
    form: Form = eqx.field(static=True)

    def __init__(
        self,
        materials: Material | Sequence[Material],
        lights: Light | Sequence[Light],
        *,
        templates: SupportsIndex | None = None,
        blend: bool = False,
        photons: SupportsIndex | None = None,
        occlusion: Occlusion = "soft",
        reach: Sequence[float] = (2.0, 4.0),
        cutoff: Arrayable | None = None,
        seed: SupportsIndex = 0,
        nodes: SupportsIndex | None = None,
        packets: SupportsIndex = 4,
        threshold: Arrayable = 0.01,
        threshold_on: ThresholdOn = "photon",
        levels: SupportsIndex | Sequence[SupportsIndex] | None = None,
        given: ScattererTemplate | None = None,
        form: Form = "published",
    ):
        if form not in get_args(Form):
            raise ValueError(f"form must be one of {', '.join(get_args(Form))}; got {form!r}.")
        if form == "transport":
            options: dict[str, Any] = {"threshold_on": threshold_on, "blend": blend, "photons": photons}
            options |= {"occlusion": occlusion, "reach": tuple(reach), "cutoff": cutoff, "given": given}
            known = inspect.signature(ScattererTemplates.__init__).parameters
            for name, value in options.items():
                if value is not (default := known[name].default) and value != default:
                    raise ValueError(f'{name}={value!r} needs form="published"; got form="transport".')
        elif nodes is not None:
            raise ValueError(f'nodes={nodes!r} needs form="transport"; got form="published".')
        templates = (256 if form == "transport" else 8) if templates is None else templates
        self.form = form
        self.materials, self.lights = materials_of(materials), lights_of(lights)
        self.templates, self.blend = integer("templates", templates, 1), flag("blend", blend)
        if occlusion not in get_args(Occlusion):
            raise ValueError(f"occlusion must be one of {', '.join(get_args(Occlusion))}; got {occlusion!r}.")
        multiples = np.asarray(reach, float)
        if multiples.ndim != 1 or not np.all(np.diff(multiples, prepend=1.0, append=np.inf) > 0):
            raise ValueError(f"reach must be multiples above 1, in increasing order; got {reach!r}.")
        self.occlusion, self.reach, self.seed = occlusion, tuple(multiples.tolist()), integer("seed", seed, 0)
        cutoff = 0.02 * (occlusion == "hard") if cutoff is None else cutoff
        skips = is_traced(cutoff) or cutoff != 0
        self.cutoff = number("cutoff", cutoff, above=0, below=1) if skips else None
        self.nodes = NODES if nodes is None else integer("nodes", nodes, 2)
        tree = PacketTree(packets, threshold, threshold_on)
        self.packets, self.threshold, self.threshold_on = tree.packets, tree.threshold, tree.threshold_on
        self.given = given
        if form == "transport":
            self.photons = 0
            self.levels = (scatterings(self.materials, self.threshold, levels),)
            return
        if given is None:
            self.levels = tree.levels_of(self.materials, levels)
            available = tree.capacity(max(self.levels))
            if not tree.whole_levels and not is_traced([m.opacity for m in self.materials]):
                opacities = [float(m.opacity) for m in self.materials]
                available = min(available, max(tree.capacity(tree.levels(a), a) for a in opacities))
        else:
            if not isinstance(given, ScattererTemplate):
                raise ValueError(f"given must be a ScattererTemplate; got {given!r}.")
            shape = given.intensity.shape
            if len(shape) != 3 or shape[0] != len(self.materials):
                raise ValueError(
                    f"given must hold templates of {len(self.materials)} materials, intensities of shape "
                    f"(materials, templates, n); got {shape}."
                )
            self.templates, self.levels, available = shape[1], (), shape[-1]
        self.photons = available if photons is None else min(available, integer("photons", photons, 1))

    @property
    def reads_value(self) -> bool:
        return any(material.values is not None for material in self.materials)

    @property
    def farthest_read(self) -> float | None:
        if self.form == "transport":
            return None
        offset = np.asarray(self.simulated().offset)
        indices = [float(material.refractive_index) for material in self.materials]
        stretched = max(indices) / min(indices)  # by refraction
        return float(np.max(np.linalg.norm(offset, axis=-1))) * max(1.0, *self.reach) * stretched

    def medium(self, transfer: Transfer) -> Transfer:
        return transfer if self.form == "published" else MediumTransfer(transfer, self.materials)

    def for_image(self, around: Surroundings) -> Shading:
        if self.form == "transport":
            sizes = self.seed, self.templates, self.packets, *self.levels
            return Transport(around, self.lights, *sizes).solved(self.nodes)
        return PhotonShading(
            *(self.materials, self.lights, self.simulated(), optics_of(self.materials), self.cutoff),
            blended=self.templates if self.blend else 1,
            occlusion=self.occlusion,
            reach=self.reach,
            seed=self.seed,
        )

    def simulated(self) -> ScattererTemplate:
        """Templates in use, (materials, templates, photons); with `blend`, one template per material."""
        templates = self.given
        if templates is None:
            templates = scatterer_templates(
                self.materials,
                self.seed,
                count=self.templates,
                packets=self.packets,
                threshold=self.threshold,
                threshold_on=self.threshold_on,
                levels=self.levels,
            ).normalized()  # restores the energy that the threshold has cut off
        if not self.blend:
            return templates.brightest(self.photons)
        blended = jax.tree.map(lambda leaf: leaf[:, None], templates.blended())
        return blended.brightest(self.photons * self.templates)

    def baked(self, volume: Volume, transfer: Transfer, march: March) -> Lighting:
        """The lighting, with light on a grid computed once for all images of a scene. If an input is traced,
        the light is computed for this image, by a separate program, which JAX differentiates."""
        if self.form == "published":
            return self
        # only transforms of the march that locate points affect the light
        spaces = march.overriding("locate")
        inputs = jax.tree.flatten((self, without_voxels(volume), transfer, spaces))
        if is_traced(inputs, volume.data):
            return _solved(self, Surroundings(volume, transfer, march.locate(volume)))
        cache = memoized(volume.data, _light_cache)
        if not cache or not _equal(cache["inputs"], inputs):
            with jax.ensure_compile_time_eval():  # the cached light must outlive an enclosing `jax.jit`
                around = Surroundings(volume, transfer, march.locate(volume))
            cache.update(inputs=inputs, light=computed_now(_solved, self, around))
        return cache["light"]


@eqx.filter_jit
def _solved(lighting: ScattererTemplates, around: Surroundings) -> Shading:
    return lighting.for_image(around)


def _light_cache(_: Array) -> dict[str, Any]:
    """Empty cache of a volume's last light on a grid, and of its inputs."""
    return {}


def _equal(a: tuple[list[Any], Any], b: tuple[list[Any], Any]) -> bool:
    """Compare two flattened trees. Large leaves, such as labels, must be the same array."""
    return a[1] == b[1] and all(
        x is y or (np.size(x) <= 2**16 and np.array_equal(np.asarray(x), np.asarray(y)))
        for x, y in zip(a[0], b[0], strict=True)
    )
