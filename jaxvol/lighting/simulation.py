"""Simulation of scatterer templates as published, of one material or of several."""

from collections.abc import Sequence
from typing import SupportsIndex

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray

from .._util.checks import Arrayable, integer
from .materials import Material, Optics, materials_of, optics_of
from .packet_tree import MERGE, PacketTree, ThresholdOn
from .template import ScattererTemplate


def scatterer_template(
    material: Material,
    key: PRNGKeyArray | int,
    *,
    packets: SupportsIndex = 4,
    threshold: Arrayable = 0.01,
    threshold_on: ThresholdOn = "photon",
    merge: float = MERGE,
    levels: SupportsIndex | None = None,
) -> ScattererTemplate:
    """Simulate the spread of light around a point inside a material.

    A packet of energy I travels Δx = -λ ln u in its direction, u uniform. Where it arrives, in a material of
    opacity α, αI is absorbed and becomes a photon; of the remaining I' = (1 - α) I, `I' cos θ'` is refracted
    by an angle θ', into a direction uniformly distributed over the cone within the critical angle of total
    reflection between the material and air; and `I' (1 - cos θ')` is reflected into any direction of the
    half-space it came from. Packets, or whole levels of the tree, end at the threshold.

    All parts add up to I, so the energy of a template is 1 less what the threshold cuts off. The paper's
    tables were made in this way; by its equations (1) to (3) as printed, αI goes on instead
    (`experiments/printed_templates.py`). Its count of 56 to 63 photons, at an opacity of 50 % and a threshold
    of 0.01, is that of `threshold_on="level"`: 63 of one packet (six levels), 60 of four (four levels each,
    whose photons are a quarter as bright), less those that were merged.

    Limits: `experiments/stability.py`, "lopsided templates", "energy of templates as printed".

    Args:
        material: opacity, mean free path λ and refractive index.
        key: a JAX key, or an integer seed. All draws depend on it alone, so offsets are λ times fixed ones.
        packets: number of packets that share the light, of energy 1, at the origin. Their directions are
            spread evenly and rotated at random. One packet makes a lopsided template.
        threshold: least intensity of a photon, in (0, 1). The first photons are the brightest, of
            α / `packets`: above 1.25 times that (by levels, above that), a template is empty.
        threshold_on: `"photon"`: the threshold is compared with each photon, which fades out between it and
            0.8 times it, instead of vanishing at once. `"level"`: it is compared with the brightest possible
            photon of level k, α (1 - α)^k / `packets`; levels below it are left out, others kept whole, as in
            the paper. Nothing fades, and the number of levels does not depend on traced numbers.
        merge: photons closer than this fraction of λ are merged, as in the paper's tables.
        levels: levels of the tree; required if the opacity is traced. By default as many as may hold photons
            above the threshold.

    Returns:
        A `ScattererTemplate`, differentiable in the material's mean free path, opacity and refractive index
        (at an index of 1, where the critical angle has no derivative, the derivative used is 0).

    Raises:
        ValueError: for numbers out of range, missing `levels`, whole levels of more than 4096 photons, and if
            all photons are below the threshold (if the opacity is traced, intensities are then NaN).
    """
    tree = PacketTree(packets, threshold, threshold_on)
    (count,) = tree.levels_of((material,), levels)
    return tree.template(material.optics, _key(key), count, merge)


def scatterer_templates(
    materials: Material | Sequence[Material],
    key: PRNGKeyArray | int,
    *,
    count: SupportsIndex = 8,
    packets: SupportsIndex = 4,
    threshold: Arrayable = 0.01,
    threshold_on: ThresholdOn = "photon",
    merge: float = MERGE,
    levels: SupportsIndex | Sequence[SupportsIndex] | None = None,
) -> ScattererTemplate:
    """Simulate several templates for each of several materials at once.

    Args:
        materials: one or several.
        key: as for `scatterer_template`. The draws are also keyed by the indices of material and template.
        count: templates per material.
        packets: as for `scatterer_template`.
        threshold: as for `scatterer_template`.
        threshold_on: as for `scatterer_template`.
        merge: as for `scatterer_template`.
        levels: as for `scatterer_template`; one number for all materials, or a number for each.

    Returns:
        A `ScattererTemplate` with leading axes (materials, count).

    Raises:
        ValueError: as `scatterer_template` does.
    """
    materials, count, key = materials_of(materials), integer("count", count, 1), _key(key)
    tree = PacketTree(packets, threshold, threshold_on)
    counts = tree.levels_of(materials, levels)

    def simulate(
        optics: Optics, material_levels: Int[Array, ""], material: Int[Array, ""], template: Int[Array, ""]
    ) -> ScattererTemplate:
        draws = jax.random.fold_in(jax.random.fold_in(key, material), template)
        kept = material_levels if tree.whole_levels else None
        return tree.template(optics, draws, max(counts), merge, kept)

    simulate_all = jax.vmap(jax.vmap(simulate, in_axes=(None, None, None, 0)), in_axes=(0, 0, 0, None))
    numbers = jnp.arange(len(materials))
    return simulate_all(optics_of(materials), jnp.asarray(counts), numbers, jnp.arange(count))


def _key(key: PRNGKeyArray | int) -> PRNGKeyArray:
    return jax.random.key(key) if isinstance(key, int | np.integer) else key
