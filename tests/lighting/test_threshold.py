"""The paper's own numbers: how many photons a template has, and which intensities come from merging."""

import jax
import numpy as np
import pytest

from jaxvol.lighting import (
    DirectionalLight,
    Material,
    ScattererTemplates,
    scatterer_template,
    template_capacity,
)


INDEX = 1.4


def grow(material, key, **how):
    return jax.jit(lambda key: scatterer_template(material, key, **how))(key)


def filled(template):
    """Photons of a template, brightest first, without padding."""
    intensity = np.asarray(template.intensity)
    return intensity[intensity > 0]


def full_tree(key, **how):
    """A template at an opacity of a half, from one packet, with a threshold on levels."""
    how = {"packets": 1, "threshold": 0.01, "threshold_on": "level", **how}
    return grow(Material(0.5, 1.0, INDEX), jax.random.key(key), **how)


def test_a_threshold_on_levels_gives_the_papers_count():
    """Six levels, of which the last one's brightest possible photon holds 0.5^6: a full tree of 63 photons,
    the most that the paper counts. Merging leaves fewer."""
    whole = filled(full_tree(0, merge=0))
    assert len(whole) == 63
    assert whole.min() < 0.01 < 0.5**6
    counts = [len(filled(full_tree(key))) for key in range(8)]
    assert all(56 <= count <= 63 for count in counts)
    assert min(counts) < 63
    # at a threshold just above a level's brightest possible photon, that level is left out
    assert len(filled(full_tree(0, merge=0, threshold=0.0157))) == 31
    assert template_capacity(Material(0.5, 1.0), packets=1, threshold_on="level") == 63


def test_a_threshold_on_photons_leaves_out_the_faint_ones():
    whole, some = filled(full_tree(0, merge=0)), filled(full_tree(0, merge=0, threshold_on="photon"))
    assert len(some) < len(whole)
    assert some.min() < 0.01  # faded
    np.testing.assert_allclose(some[0], whole[0], rtol=1e-6)


def test_levels_that_are_kept_whole_lose_only_the_energy_that_goes_on():
    """Half of the energy is absorbed in each level."""
    np.testing.assert_allclose(filled(full_tree(0)).sum(), 1 - 0.5**6, rtol=1e-5)


@pytest.mark.parametrize(
    ("opacity", "packets", "paper"), [(0.7, 4, 0.22145), (0.5, 1, 0.72760)], ids=["Table 3, B", "Table 1"]
)
def test_merging_makes_the_papers_brightest_photons(opacity, packets, paper):
    """0.22145 = 0.175 + 0.04645, and 0.72760 = 0.5 + 0.2276: a photon of the first level, of α / packets, and
    the refracted one of the second that landed near it, of α (1 - α) cos θ' / packets. The cosines in the
    paper's tables are 0.88 to 0.92."""
    first, second = opacity / packets, opacity * (1 - opacity) / packets

    def grown(merge):
        def one(key):
            return scatterer_template(
                Material(opacity, 1.0, INDEX), key, packets=packets, merge=merge, levels=2
            )

        return np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 512)).intensity)

    apart, near = grown(0), grown(0.1)
    np.testing.assert_allclose(apart[:, :packets], first, rtol=1e-5)
    np.testing.assert_allclose(near.sum(-1), apart.sum(-1), rtol=1e-5)
    merged = near[:, 0] > 1.01 * first
    assert 0.05 < merged.mean() < 0.5
    # the brightest is the sum of a first one, and one that was among the fainter
    added = near[merged, :1] - first
    assert np.isclose(added, apart[merged, packets:], rtol=1e-3).any(-1).mean() > 0.8  # others of two such
    cosines = added[:, 0] / second
    assert np.any(np.abs(cosines - (paper - first) / second) < 0.01)
    assert 0.88 < (paper - first) / second < 0.92


def test_lighting_takes_whole_levels_too():
    lighting = ScattererTemplates(
        Material(0.5, 1.0, INDEX), DirectionalLight((0, 0, 1)), packets=1, threshold_on="level", templates=1
    )
    found = jax.jit(lambda: lighting.grown(blend=False))().intensity
    assert found.shape == (1, 1, 63)
    np.testing.assert_allclose(found.sum(), 1, rtol=1e-5)  # scaled to the energy of all


@pytest.mark.parametrize("of", [scatterer_template, lambda *a, **how: template_capacity(a[0], **how)])
def test_bad_input_is_named(of):
    with pytest.raises(ValueError, match="threshold_on must be one of photon, level; got 'tree'"):
        of(Material(0.5, 1.0), 0, threshold_on="tree")
    with pytest.raises(ValueError, match=r"opacity 0.03 leaves no photon above .*of at most 0.0075"):
        of(Material(0.03, 1.0), 0, threshold_on="level")
