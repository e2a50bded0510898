"""The methods that a march calls on its transforms, and custom transforms."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.march.march import Cell
from jaxvol.scene.space import Affine

from ..scenes import rendered_rays, soft_transfer, uniform_transfer
from ..switch import switch


class Shift(jv.Transform):
    """Puts the first sample half a step in."""

    def start(self, steps, ray):
        return steps + 0.5


class Late(jv.Transform):
    """Shifts the samples behind empty space by a fraction of a step."""

    by: jax.Array

    def __init__(self, by):
        self.by = jax.device_put(np.float32(by))  # an array, so that all values share one program

    def shift(self, ray):
        return jnp.broadcast_to(self.by, ray.length.shape)


class Halves(jv.Transform):
    """Splits each cell into halves, sampled separately."""

    def cut(self, cell, ray, volume):
        half = cell.width / 2
        return Cell(cell.front, half, cell.cut), Cell(cell.front + half, half, cell.cut)


class Moved(jv.Transform):
    """Places the volume elsewhere in the world."""

    def locate(self, space, volume):
        return Affine(jv.Volume(volume.data, volume.spacing, volume.origin + 10.0))


BOX = jv.Volume(np.ones((5, 5, 5), np.float32), spacing=[0.5] * 3)  # 2 long
RAY = ([[-1.0, 1.0, 1.0]], [[1.0, 0.0, 0.0]])


@eqx.filter_jit
def by_both_engines(transfer, fast, limited):
    origin, direction = (jnp.asarray(part[0]) for part in RAY)
    reference = jv.render_ray_reference(BOX, transfer, origin, direction, limited)
    found = jv.render_rays(BOX, transfer, *RAY, fast), reference
    return [(each.rgba[..., 3].sum(), each.samples.sum(), each.aligned.any()) for each in found]


OPAQUE = uniform_transfer(1.0)


def opacity(quadrature="left", step=0.3, *, most=80, transfer=OPAQUE, **on):
    """Opacity, number of samples, and whether the last cell was cut, by both engines, with these transforms;
    all of which are in one program."""
    every = {
        "shift": Shift(),
        "late": Late(on.get("late", 0.0)),
        "halves": Halves(),
        "aligned": jv.AlphaCorrection(),
        "ended": jv.EarlyTermination(on.get("ended", 0.5)),
    }
    transforms = tuple(switch(each, name in on) for name, each in every.items())
    marches = (jv.March(step, transforms, quadrature, max_samples=limit) for limit in (None, most))
    found = jax.tree.map(np.ndarray.item, jax.device_get(by_both_engines(transfer, *marches)))
    assert found[0][0] == pytest.approx(found[1][0], abs=1e-6)
    assert found[0][1:] == found[1][1:]
    return found[0]


def seen(length):
    return pytest.approx(1 - np.exp(-length), abs=1e-6)


def test_cells_reach_past_the_exit_unless_they_are_cut_there():
    assert opacity() == (seen(7 * 0.3), 7, False)  # samples at 0, 0.3, … 1.8
    assert opacity(aligned=True) == (seen(2), 7, True)
    assert opacity(shift=True) == (seen(7 * 0.3), 7, False)  # at 0.15, … 1.95
    assert opacity(shift=True, aligned=True) == (seen(2 - 0.15), 7, True)


def test_midpoint_samples_only_inside():
    assert opacity("midpoint") == (seen(7 * 0.3), 7, False)  # at 0.15, … 1.95
    assert opacity("midpoint", 0.55) == (seen(4 * 0.55), 4, False)  # 1.925; the next would be 2.475
    assert opacity("midpoint", 0.6) == (seen(3 * 0.6), 3, False)  # 1.5; the next would be 2.1
    assert opacity("midpoint", 0.6, aligned=True) == (seen(2), 4, True)


def test_cut_may_divide_a_cell():
    assert opacity(halves=True) == (seen(2.1), 14, False)  # half cells at 0, 0.15, … 1.95
    length, _, aligned = opacity(halves=True, aligned=True)
    assert length == seen(2)
    assert aligned


def test_early_termination_stops_where_little_is_left():
    # exp(-0.7) is the first below one half
    assert opacity(step=0.1, ended=0.5)[:2] == (seen(0.7), 7)


@pytest.mark.parametrize(("by", "samples"), [(0.0, 7), (-0.5, 8), (-3.0, 8), (0.5, 7)])
def test_a_shift_is_made_once_and_within_the_cell_that_is_known_to_be_empty(by, samples):
    clear = jv.TransferFunction(np.linspace(0, 1, 8), np.ones((8, 3)), np.zeros(8))
    # at 0, and on from 0.3 (1 + by), limited to between 0 and 0.3
    assert opacity(late=by, transfer=clear)[1] == samples
    assert opacity(late=by)[1] == 7, "where nothing is transparent"


def test_locate_replaces_the_space():
    origins, directions = np.array(RAY)
    march = jv.March(0.3, (Moved(), jv.AlphaCorrection()))
    rays = np.concatenate([origins, origins + 10]), directions.repeat(2, 0)
    rgba = np.asarray(rendered_rays(BOX, OPAQUE, *rays, march).rgba)
    np.testing.assert_allclose(rgba[:, 3], [0, 1 - np.exp(-2)], atol=1e-5)


def test_a_march_that_runs_out_of_samples_says_so():
    march = jv.March(0.3, max_samples=5)
    rays = [RAY[0][0]] * 2, [[1, 0, 0], [0, 1, 0]]
    rendering = jv.render_rays(BOX, OPAQUE, *rays, march)
    np.testing.assert_array_equal(rendering.exhausted, [True, False])
    assert np.asarray(rendering.samples)[0] == 5
    assert not np.asarray(jv.render_rays(BOX, OPAQUE, *rays, jv.March(0.3)).exhausted).any()


def test_whole_numbers_of_any_library_are_taken():
    for given in (5, np.int64(5), np.array(5), jax.device_put(np.int32(5))):
        assert type(jv.March(0.3, max_samples=given).max_samples) is int
    for step in (np.float64(0.25), np.array(0.25), jax.device_put(np.float16(0.25))):
        assert float(jv.March(step).step) == 0.25


BAD = {
    "step 0": (lambda: jv.March(0), "step must be greater than 0; got 0"),
    "negative step": (lambda: jv.March(-0.1), "step must be greater than 0; got -0.1"),
    "NaN step": (lambda: jv.March(np.nan), "step must be finite; got nan"),
    "text": (lambda: jv.March("half"), "step must be a number"),
    "two steps": (lambda: jv.March([0.1, 0.2]), "step must have shape"),
    "a transform twice": (
        lambda: jv.March(0.1, (jv.AlphaCorrection(), jv.EarlyTermination(0.1), jv.AlphaCorrection())),
        "transforms must each be given once; got AlphaCorrection 2 times",
    ),
    "a class": (lambda: jv.March(0.1, (jv.AlphaCorrection,)), "transforms must hold jaxvol transforms"),
    "one transform, bare": (lambda: jv.March(0.1, jv.AlphaCorrection()), "transforms must be a tuple"),
    "quadrature": (lambda: jv.March(0.1, quadrature="right"), "quadrature must be"),
    **{
        f"max_samples={bad!r}": (
            lambda bad=bad: jv.March(0.1, max_samples=bad),
            rf"max_samples must be an integer from 1 to 16777216; got {shown}\.",
        )
        for bad, shown in [
            (0, "0"),
            (2**31, "2147483648"),
            (2.5, "2.5"),
            (5.0, "5.0"),
            (True, "True"),
            ("5", "'5'"),
            (np.array([5]), r"a NumPy array of shape \(1,\) and type int64"),
        ]
    },
    "beyond float32": (lambda: jv.March(1e300), r"step must be finite in float32; got 1e\+300"),
    "complex": (lambda: jv.March(1j), "step must be a number"),
    "opacity left 0": (
        lambda: jv.EarlyTermination(0),
        "opacity_left must be greater than 0 and less than 1; got 0",
    ),
    "interval 0": (lambda: jv.EarlyTermination(interval=0), "interval must be an integer from 1 to 64"),
    "opacity left 1": (lambda: jv.EarlyTermination(1), "opacity_left must be .*; got 1"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        make()


class Faulty(jv.Transform):
    """Answers one of the seams with `answer`."""

    seam: str = eqx.field(static=True)
    answer: Any = eqx.field(static=True)

    def locate(self, space, volume):
        return self.answer if self.seam == "locate" else space

    def start(self, steps, ray):
        return self.answer if self.seam == "start" else steps

    def shift(self, ray):
        return self.answer if self.seam == "shift" else jnp.zeros_like(ray.length)

    def empty_space(self, occupancy, view):
        return self.answer if self.seam == "empty_space" else None

    def cut(self, cell, ray, volume):
        return self.answer if self.seam == "cut" else (cell,)

    def stop(self, stopped, transmittance):
        return self.answer if self.seam == "stop" else stopped


@pytest.mark.parametrize("seam", ["locate", "start", "shift", "empty_space", "cut", "stop"])
@pytest.mark.parametrize("answer", [3, ()], ids=repr)
def test_a_wrong_answer_of_a_transform_is_named(seam, answer):
    march = jv.March(0.1, (Faulty(seam, answer),))
    with pytest.raises(ValueError, match=f"Faulty.{seam} must return"):
        jv.render_rays(jv.phantom("sphere", 8), soft_transfer(), [[-3.0, 0, 0]], [[1.0, 0, 0]], march)
