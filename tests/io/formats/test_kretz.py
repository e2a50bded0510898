"""Are Kretz ultrasound files read as the voxels and the probe that they hold, and bad ones refused with the
reason?"""

import contextlib
import os
import struct
import time
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util import files


MAGIC = b"KRETZFILE 1.0   "
SHAPE = (4, 5, 6)  # β, σ, γ
BETA, SIGMA = np.linspace(1.1, 2.0, SHAPE[0]), np.linspace(0.9, 2.2, SHAPE[1])
RESOLUTION, FIRST, APEX = 4e-4, 100.0, -50.5  # metres; in samples
ECHO = np.random.default_rng(0).integers(0, 256, SHAPE, np.uint8)
VOXELS, PLANES, BEAMS = (0xD000, 1), (0xC300, 1), (0xC300, 2)
STEP, FIRST_AT, APEX_AT = (0xC100, 1), (0xC200, 1), (0xC200, 2)


def f64(number):
    return struct.pack("<d", number)


GOOD = {
    (0x0110, 2): b"Nobody",
    (0xC000, 1): struct.pack("<H", SHAPE[2]),
    (0xC000, 2): struct.pack("<H", SHAPE[1]),
    (0xC000, 3): struct.pack("<H", SHAPE[0]),
    STEP: f64(RESOLUTION),
    FIRST_AT: f64(FIRST),
    APEX_AT: f64(APEX),
    PLANES: BETA.tobytes(),
    BEAMS: SIGMA.tobytes(),
    VOXELS: ECHO.tobytes(),
    (0xD400, 1): b"\x01\x00",
}


def kretz(items=None, more=()):
    """The bytes of a file of these items, in their order."""
    pairs = [*(GOOD if items is None else items).items(), *more]
    return MAGIC + b"".join(struct.pack("<HHI", *tag, len(content)) + content for tag, content in pairs)


def changed(tag, content):
    return kretz(GOOD | {tag: content})


def without(*tags):
    return kretz({tag: content for tag, content in GOOD.items() if tag not in tags})


def write(folder, content):
    path = folder / "scan.vol"
    path.write_bytes(content)
    return path


def slicer_points(beta, sigma, gamma):
    """World points as `vtkSlicerKretzFileReaderLogic` places them, in its own order of operations."""
    b_mode_radius = -APEX * RESOLUTION * 1000
    r = FIRST * RESOLUTION * 1000 + gamma
    phi, theta = beta - np.pi / 2, sigma - np.pi / 2
    y = -(r * np.cos(theta) - b_mode_radius) * np.sin(phi)
    return np.stack(
        [r * np.sin(theta), y, b_mode_radius * (1 - np.cos(phi)) + r * np.cos(theta) * np.cos(phi)], -1
    )


def test_voxels_and_probe_come_out_as_they_were_written(tmp_path):
    volume, probe = jv.load_ultrasound(str(write(tmp_path, kretz())))
    assert volume.data.dtype == jnp.uint8
    np.testing.assert_array_equal(volume.data, ECHO)
    np.testing.assert_allclose([probe.a, probe.b], [-20.2, 40.0], rtol=1e-6)
    np.testing.assert_allclose(probe.beta_range, (1.1, 2.0), rtol=1e-6)
    np.testing.assert_allclose(probe.sigma_range, (0.9, 2.2), rtol=1e-6)
    np.testing.assert_allclose(probe.gamma_range, (0, 2.0), rtol=1e-6)
    # the nodes lie where SlicerHeart puts them
    nodes = np.stack(np.meshgrid(BETA, SIGMA, np.arange(SHAPE[2]) * 0.4, indexing="ij"), -1)
    ours = jax.jit(lambda nodes: probe.to_world(nodes))(nodes)
    theirs = slicer_points(*np.moveaxis(nodes, -1, 0)) * (1, -1, 1) + (0, 0, APEX * RESOLUTION * 1000)
    np.testing.assert_allclose(ours, theirs, atol=1e-4)
    jv.load_ultrasound(write(tmp_path, changed(PLANES, uneven(BETA, 0.009))))  # angles so uneven are even
    # items may come in any order, with others between and padding behind
    shuffled = kretz(dict(reversed(GOOD.items())), [((0xC000, 0x201), b"\x09\x00")]) + bytes(5)
    np.testing.assert_array_equal(jv.load_ultrasound(write(tmp_path, shuffled))[0].data, ECHO)


def uneven(table, away):
    """The same table, with its second angle moved by this part of a step."""
    table = table.copy()
    table[1] += away * (table[1] - table[0])
    return table.tobytes()


BAD = {
    "foreign magic": (b"NOT A KRETZ FILE" + kretz()[16:], r"not a Kretz file.*KRETZFILE 1.0.*NOT A KRETZ"),
    "magic alone": (MAGIC, "has no item C000:1"),
    "cut in the voxels": (kretz()[:-60], r"cut short: item D000:1 \(the voxels\) is to end at byte \d+, and"),
    "cut in a header": (kretz()[:-7], r"cut short: item \w+:\w+ is to end at byte"),
    "no voxels": (without(VOXELS), r"no item D000:1 \(the voxels\)\. Compressed"),
    "several frames": (
        kretz({tag: GOOD[tag] for tag in GOOD if tag != VOXELS}, [((0xD600, 1), bytes(240))]),
        "no item D000:1 .*several frames.*uncompressed",
    ),
    "compressed": (changed(VOXELS, bytes(40)), "4 x 5 x 6 = 120 bytes.*holds 40.*compressed"),
    "too many voxels": (changed(VOXELS, bytes(121)), "= 120 bytes.*holds 121"),
    "Cartesian": (
        without(PLANES, BEAMS),
        r"no item C300:1 .*, no item C300:2 .*Cartesian",
    ),
    "an item twice": (kretz(more=[((0xC000, 1), b"\x06\x00")]), "holds item C000:1 .* twice"),
    "zero size": (changed((0xC000, 3), bytes(2)), "at least 2 planes, beams and samples.* says 0 x 5 x 6"),
    "huge sizes": (
        kretz(GOOD | {(0xC000, n): b"\xff\xff" for n in (1, 2, 3)}),
        r"fewer than 2\*\*31 voxels; its header says 65535 x 65535 x 65535",
    ),
    "a size of four bytes": (changed((0xC000, 1), bytes(4)), r"C000:1 .* must have 2 bytes \(H\); it has 4"),
    "too few angles": (changed(BEAMS, SIGMA[:4].tobytes()), r"C300:2 .* must have 40 bytes \(5d\)"),
    "uneven angles": (changed(PLANES, uneven(BETA, 0.1)), r"C300:1 .* evenly spaced.*up to 0\.1 steps"),
    "falling angles": (changed(PLANES, BETA[::-1].tobytes()), "increase; got 4 from 2.0 to 1.1"),
    "an angle of NaN": (changed(PLANES, uneven(BETA, np.nan)), "evenly spaced angles"),
    "angles in degrees": (changed(PLANES, np.rad2deg(BETA).tobytes()), "no probe: beta_range must lie"),
    "no resolution at all": (changed(STEP, f64(0)), "positive length in metres; got 0.0"),
    "offset of NaN": (changed(APEX_AT, f64(np.nan)), "no probe: a must be finite"),
    "beyond the apex": (changed(FIRST_AT, f64(-1)), "no probe: gamma_range must begin"),
    "behind the axis": (changed(APEX_AT, f64(-90)), "no probe: .* motor axis"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_is_refused_with_its_reason(tmp_path, case):
    content, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        jv.load_ultrasound(write(tmp_path, content))


def test_bad_paths_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"volume, probe = jv\.load_ultrasound\(path\)"):
        jv.load(write(tmp_path, kretz()))
    with pytest.raises(ValueError, match="path must be a str or a path; got 3"):
        jv.load_ultrasound(3)
    with pytest.raises(ValueError, match=r"there is no file .*none\.vol"):
        jv.load_ultrasound(tmp_path / "none.vol")
    with pytest.raises(ValueError, match="is a directory"):
        jv.load_ultrasound(tmp_path)


def test_neither_a_file_nor_a_header_takes_memory_or_time_that_the_other_does_not_back(tmp_path):
    size = {(0xC000, 1): b"\xff\x7f", (0xC000, 2): b"\xff\x7f", (0xC000, 3): b"\x02\x00"}
    promised = {tag: content for tag, content in (GOOD | size).items() if tag != VOXELS}
    voxels = kretz(promised) + struct.pack("<HHI", *VOXELS, 32767 * 32767 * 2)  # 2 GB, and none of them
    unwanted = kretz() + struct.pack("<HHI", 1, 1, 2**32 - 1)
    for content, length, message in (
        (voxels, len(voxels), "cut short"),
        (kretz(), 2**33, "twice|items or more"),  # empty items, which take no disk space
        (unwanted, len(unwanted) + 2**32 - 1, None),
    ):
        path = write(tmp_path, content)
        os.truncate(path, length)
        tracemalloc.start()
        begin = time.perf_counter()
        with contextlib.nullcontext() if message is None else pytest.raises(ValueError, match=message):
            np.testing.assert_array_equal(jv.load_ultrasound(path)[0].data, ECHO)
        assert time.perf_counter() - begin < 10
        assert tracemalloc.get_traced_memory()[1] < 4 * files.CHUNK
        tracemalloc.stop()
