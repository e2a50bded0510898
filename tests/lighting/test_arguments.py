"""Is a bad argument of a light, a material, a template or a lighting named, and what would do?"""

from typing import Any

import jax
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.lighting import (
    ConstantLight,
    DirectionalLight,
    HeadLight,
    Material,
    Phong,
    PointLight,
    ScattererTemplate,
    ScattererTemplates,
    scatterer_template,
    scatterer_templates,
)
from jaxvol.lighting.lights import lights_of
from jaxvol.lighting.materials import materials_of
from jaxvol.lighting.packet_tree import PacketTree

from ..scenes import slow
from .samples import shaded


HALF, FAINT, SUN = Material(0.5, 1.0), Material(0.031, 1.0), DirectionalLight((0, 0, -1.0))
VOLUME, TRANSFER = (
    jv.Volume(np.zeros((9, 9, 9), np.float32)),
    jv.colormap("gray", (0.0, 1.0), unit_distance=1.0),
)


def photons(place):
    """Two photons at this place along all axes."""
    offset, intensity = np.full((1, 1, 2, 3), place, np.float32), np.ones((1, 1, 2), np.float32)
    return ScattererTemplate(*jax.device_put((offset, intensity)))


PAIR = photons(0)


def grown(material=HALF, **how):
    return lambda: scatterer_template(material, 0, **how)


def lit(materials: Any = HALF, lights: Any = SUN, **how):
    return lambda: ScattererTemplates(materials, lights, **how)


def render_far_away():
    volume = jv.Volume(np.zeros((4, 4, 4), np.float32), (0.05,) * 3, (615_840.0, 5_846_926.0, 758.0))
    camera = jv.Camera.looking_at(volume, size=(2, 2))
    jv.render(volume, TRANSFER, camera, jv.March(0.05), lighting=lit(given=photons(1))())


def render_colors(lighting):
    volume = jv.Volume(np.zeros((4, 4, 4, 4), np.float32), labels=np.zeros((4, 4, 4), np.uint8))
    camera = jv.Camera.looking_at(volume, size=(3, 2))
    return jv.render(volume, jv.RadianceField(), camera, jv.March(0.1), lighting=lighting).rgba


BAD = {
    "world points of float32": (render_far_away, "reads at world points, which lie 0.7 apart at 5.85e.06"),
    # templates
    "packets": (grown(packets=0), "packets must be an integer of at least 1"),
    "threshold on": (grown(threshold_on="tree"), "threshold_on must be one of photon, level; got 'tree'"),
    "too many photons": (
        grown(Material(0.1, 1.0), packets=1, threshold_on="level"),
        'threshold_on="level" keeps 22 levels of packets=1 whole, more than 4096 photons',
    ),
    "levels of other materials": (lit(levels=(1, 2)), r"levels must be one number, or 1; got \(1, 2\)"),
    "threshold 0": (grown(threshold=0.0), "threshold must be"),
    "threshold 1": (grown(threshold=1.0), "threshold must be"),
    "opacity too low": (
        grown(FAINT),
        "opacity 0.031 leaves no photon above threshold=0.01.*packets=4.*a threshold below 0.00775",
    ),
    "opacity too low, levels given": (grown(FAINT, levels=3), "opacity 0.031 leaves no photon"),
    "one opacity too low": (
        lambda: scatterer_templates([HALF, Material(0.2, 1.0)], 0, threshold=0.1, levels=2),
        "opacity 0.2 leaves no photon above threshold=0.1",
    ),
    "opacity 0": (grown(Material(0.0, 1.0)), "opacity 0 leaves no photon .*give one above 0"),
    "traced": (
        lambda: jax.eval_shape(lambda a: scatterer_template(Material(a, 1.0), 0).intensity, 0.5),
        "levels must be given where opacity is traced",
    ),
    "count": (lambda: scatterer_templates(HALF, 0, count=0), "count must be an integer of at least 1"),
    "photons kept": (lambda: PAIR.brightest(0), "photons must be an integer"),
    # materials
    "opacity below 0": (lambda: Material(-0.1, 1.0), r"opacity must be in \[0, 1\]; got -0.1"),
    "opacity above 1": (lambda: Material(1.1, 1.0), r"opacity must be in \[0, 1\]"),
    "no path": (lambda: Material(0.5, 0.0), "mean_free_path must be greater than 0"),
    "an endless path": (lambda: Material(0.5, np.inf), "mean_free_path must be finite"),
    "no index": (lambda: Material(0.5, 1.0, 0.0), "refractive_index must be greater than 0"),
    "values": (lambda: Material(0.5, 1.0, values=(2, 2)), "values must be .* low < high"),
    "label": (lambda: Material(0.5, 1.0, label=-1), "label must be an integer of at least 0"),
    "both": (lambda: Material(0.5, 1.0, values=(0, 1), label=1), "values and label must not both be given"),
    "no materials": (lambda: materials_of([]), "materials must hold at least one Material"),
    "no material": (lambda: materials_of([HALF, "skin"]), "materials must hold jaxvol materials; got 'skin'"),
    # lights
    "direction": (lambda: DirectionalLight((0, 0, 0)), "direction must not have length 0"),
    "direction's shape": (lambda: DirectionalLight((0, 1)), "direction must have shape"),
    "irradiance": (lambda: DirectionalLight((0, 0, 1), (1, 1, -1)), "irradiance must not be negative"),
    "irradiance of a head light": (lambda: HeadLight((1, -1, 1)), "irradiance must not be negative"),
    "position": (lambda: PointLight((0, 0, np.nan)), "position must be finite"),
    "intensity": (lambda: PointLight((0, 0, 0), (-1, 1, 1)), "intensity must not be negative"),
    "radiance": (lambda: ConstantLight((1, 1)), "radiance must have shape"),
    "dark radiance": (lambda: ConstantLight((1, -1, 1)), "radiance must not be negative"),
    "no lights": (lambda: lights_of(()), "lights must be a light or a tuple"),
    "no light": (lambda: lights_of((ConstantLight(), 3)), "lights must hold jaxvol lights.*got 3"),
    # lighting by templates
    "templates": (lit(templates=0), "templates must be an integer"),
    "photons": (lit(photons=0), "photons must be an integer"),
    "occlusion": (lit(occlusion="some"), "occlusion must be one of soft, h"),
    "reach": (lit(reach=(1.0, 2.0)), "reach must be multiples above 1"),
    "reach's order": (lit(reach=(4.0, 2.0)), "reach must be multiples"),
    "cutoff": (lit(cutoff=1.0), "cutoff must be"),
    "seed": (lit(seed=-1), "seed must be an integer"),
    "nodes": (lit(form="transport", nodes=1), "nodes must be an integer of at least 2"),
    "nodes as published": (lit(nodes=9), 'nodes=9 needs form="transport"'),
    "a fine grid": (
        lambda: lit(form="transport", nodes=10**5)().baked(VOLUME, TRANSFER, jv.March(0.1)),
        "nodes for nodes=100000.*asks for .* GiB",
    ),
    "faint": (lit(FAINT), "opacity 0.031 leaves no photon"),
    "given": (lit([HALF, HALF], given=PAIR), "templates of 2 materials"),
    "given by a number": (lit(given=3), "given must be a ScattererTemplate; got 3"),
    "lights": (lit(lights=()), "lights must be a light"),
    "materials": (lit(()), "materials must hold at least one Material"),
    "labels": (
        lambda: jax.eval_shape(
            lambda points: shaded(lit(Material(0.5, 1.0, label=1), given=PAIR)(), VOLUME, TRANSFER, points),
            np.zeros((1, 3), np.float32),
        ),
        "labels are needed here",
    ),
    # other lightings
    "lighting": (
        lambda: jv.render(VOLUME, TRANSFER, jv.Camera.looking_at(VOLUME), jv.March(0.1), lighting=3),
        "lighting must be None or a Lighting; got 3",
    ),
    "constant light": (
        lambda: Phong(ConstantLight()),
        "lights must hold jaxvol lights, of any kind but ConstantLight",
    ),
    "colours whose materials are values": (
        lambda: render_colors(lit(Material(0.5, 1.0, values=(0, 1)))()),
        "lighting: a ScattererTemplates needs a single volume of one channel",
    ),
    "colours by Phong": (
        lambda: render_colors(Phong()),
        "lighting: a Phong needs a single volume of one channel",
    ),
    "Phong without lights": (lambda: Phong(()), "lights must be"),
    "Phong by a name": (lambda: Phong("sun"), "lights must be"),
    "ambient": (lambda: Phong(ambient=-0.1), "ambient must not be negative"),
    "diffuse": (lambda: Phong(diffuse=np.nan), "diffuse must be finite"),
    "specular": (lambda: Phong(specular=(1, 2)), "specular must have shape"),
    "specular power": (lambda: Phong(specular_power=0), "specular_power must be greater than 0"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("form", ["published", *slow("transport")])
def test_volumes_of_colours_are_lit_if_materials_are_labels(form):
    lighting = lit(Material(0.5, 1.0, label=1), form=form)()
    assert jax.eval_shape(lambda: render_colors(lighting)).shape == (2, 3, 4)


def test_the_threshold_that_is_advised_leaves_photons():
    assert PacketTree(threshold=0.0077).levels(0.031) > 1


def test_a_lighting_keeps_as_many_photons_as_its_levels_hold():
    """Of an opacity that is not traced, no more than there are."""
    one, two = (lit(levels=levels)() for levels in (1, 2))
    assert (one.photons, two.photons) == (4, 12)

    def shape(opacity):
        lighting = lit(Material(opacity, 1.0), levels=2)()
        assert lighting.photons >= two.photons
        return lighting.simulated().intensity

    assert jax.eval_shape(shape, 0.5).shape[:2] == (1, two.templates)
    blended = jax.eval_shape(lambda: lit(blend=True)().simulated().intensity)
    assert blended.shape[:2] == (1, 1)


def test_light_by_transport_is_read_at_any_distance():
    assert lit(form="transport")().farthest_read is None
    farthest = lit(given=photons(1))().farthest_read
    assert farthest is not None
    assert 0 < farthest < np.inf


def test_defaults():
    """Of Phong VTK's. By templates, faint photons are left out under hard occlusion alone, as published."""
    phong = Phong()
    values = phong.ambient, phong.diffuse, phong.specular, phong.specular_power
    assert [float(value) for value in values] == pytest.approx([0.1, 0.7, 0.2, 10])
    assert isinstance(phong.lights[0], HeadLight)
    assert lit(occlusion="hard")().cutoff == np.float32(0.02)
    assert lit()().cutoff is None
