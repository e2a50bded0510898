"""Are Kretz ultrasound files read as the voxels and the probe that they hold, and bad ones refused with the
reason?"""

import struct
import time
import tracemalloc

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
PATIENT = (0x0110, 2)
VOXELS = (0xD000, 1)

GOOD = {
    PATIENT: b"Nobody",
    (0xC000, 1): struct.pack("<H", SHAPE[2]),
    (0xC000, 2): struct.pack("<H", SHAPE[1]),
    (0xC000, 3): struct.pack("<H", SHAPE[0]),
    (0xC100, 1): struct.pack("<d", RESOLUTION),
    (0xC200, 1): struct.pack("<d", FIRST),
    (0xC200, 2): struct.pack("<d", APEX),
    (0xC300, 1): BETA.tobytes(),
    (0xC300, 2): SIGMA.tobytes(),
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


def test_nodes_lie_where_slicerheart_puts_them(tmp_path):
    _, probe = jv.load_ultrasound(write(tmp_path, kretz()))
    nodes = np.stack(np.meshgrid(BETA, SIGMA, np.arange(SHAPE[2]) * 0.4, indexing="ij"), -1)
    ours = np.asarray(probe.to_world(nodes))
    theirs = slicer_points(*np.moveaxis(nodes, -1, 0)) * (1, -1, 1) + (0, 0, APEX * RESOLUTION * 1000)
    np.testing.assert_allclose(ours, theirs, atol=1e-4)


def test_items_may_come_in_any_order_with_others_between_and_padding_behind(tmp_path):
    shuffled = dict(reversed(GOOD.items()))
    volume, _ = jv.load_ultrasound(
        write(tmp_path, kretz(shuffled, [((0xC000, 0x201), b"\x09\x00")]) + bytes(5))
    )
    np.testing.assert_array_equal(volume.data, ECHO)


def test_a_file_as_read_renders(tmp_path):
    volume, probe = jv.load_ultrasound(write(tmp_path, kretz()))
    camera = jv.Camera((100, -180, -60), probe.center, (0, 0, -1), 10.0, size=(20, 16))
    rendering = jv.render(volume, jv.colormap("gray", (0, 255), (0.0, 0.5)), camera, jv.March(0.4, (probe,)))
    assert rendering.rgba[..., 3].max() > 0.5


def uneven(table, away):
    """The same table, with its second angle moved by this part of a step."""
    table = table.copy()
    table[1] += away * (table[1] - table[0])
    return table.tobytes()


F64 = "<d"
BAD = {
    "foreign magic": (b"NOT A KRETZ FILE" + kretz()[16:], r"not a Kretz file.*KRETZFILE 1.0.*NOT A KRETZ"),
    "magic alone": (MAGIC, "has no item C000:1"),
    "half a magic": (MAGIC[:7], r"must begin with.*got b'KRETZFI'"),
    "empty": (b"", r"empty \(0 bytes\)"),
    "cut in the voxels": (kretz()[:-60], r"cut short: item D000:1 \(the voxels\) is to end at byte \d+, and"),
    "cut in a header": (kretz()[:-7], "cut short: it ends after 3 of the 8 bytes"),
    "no voxels": (without(VOXELS), r"no item D000:1.*compressed.*D400:1 \(2 bytes\)"),
    "several frames": (
        kretz({tag: GOOD[tag] for tag in GOOD if tag != VOXELS}, [((0xD600, 1), bytes(240))]),
        r"one of several frames.*D600:1 \(240 bytes\).*uncompressed",
    ),
    "compressed": (
        changed(VOXELS, bytes(40)),
        "4 x 5 x 6 = 120 bytes.*holds 40, which is less, as in",
    ),
    "too many voxels": (changed(VOXELS, bytes(121)), "= 120 bytes.*holds 121, which is more"),
    "Cartesian": (without((0xC300, 1), (0xC300, 2)), "no angles .*Cartesian"),
    "no planes": (without((0xC300, 1)), r"has no item C300:1 \(the angles of the planes\)\."),
    "no size": (without((0xC000, 2)), r"has no item C000:2 \(the number of beams\)\."),
    "no offsets": (without((0xC200, 1), (0xC200, 2)), "no item C200:1 .*, no item C200:2"),
    "no resolution": (without((0xC100, 1)), "no item C100:1"),
    "an item twice": (kretz(more=[((0xC000, 1), b"\x06\x00")]), "holds item C000:1 .* twice"),
    "zero size": (
        changed((0xC000, 3), bytes(2)),
        r"C000:3 \(the number of planes\) must be at least 2",
    ),
    "a size of one": (changed((0xC000, 1), b"\x01\x00"), "C000:1 .* must be at least 2; got 1"),
    "huge sizes": (
        kretz(GOOD | {(0xC000, n): b"\xff\xff" for n in (1, 2, 3)}),
        r"fewer than 2\*\*31 voxels; its header says 65535 x 65535 x 65535",
    ),
    "a size of four bytes": (changed((0xC000, 1), bytes(4)), r"C000:1 .* must have 2 bytes \(H\); it has 4"),
    "a number of four bytes": (
        changed((0xC100, 1), bytes(4)),
        r"C100:1 .* must have 8 bytes \(d\)",
    ),
    "too few angles": (changed((0xC300, 2), SIGMA[:4].tobytes()), r"C300:2 .* must have 40 bytes \(5d\)"),
    "uneven angles": (changed((0xC300, 1), uneven(BETA, 0.1)), r"C300:1 .* evenly spaced.*up to 0\.1 steps"),
    "falling angles": (
        changed((0xC300, 1), BETA[::-1].tobytes()),
        "increase; got 4 from 2.0 to 1.1",
    ),
    "equal angles": (changed((0xC300, 1), np.full(4, 1.5).tobytes()), "angles that increase"),
    "angles of NaN": (changed((0xC300, 2), np.full(5, np.nan).tobytes()), "evenly spaced angles.*from nan"),
    "angles in degrees": (
        changed((0xC300, 1), np.rad2deg(BETA).tobytes()),
        r"no probe: beta_range must lie",
    ),
    "fans over more than π": (
        changed((0xC300, 2), np.linspace(0.5, 3.5, SHAPE[1]).tobytes()),
        r"no probe: sigma_range must lie in \[0, π\]",
    ),
    "angles from the middle": (
        changed((0xC300, 1), (BETA - np.pi / 2).tobytes()),
        r"no probe: beta_range must lie in \[0, π\]",
    ),
    "an angle of NaN in the middle": (
        changed((0xC300, 1), np.where(np.arange(SHAPE[0]) == 1, np.nan, BETA).tobytes()),
        "evenly spaced angles",
    ),
    "no resolution at all": (changed((0xC100, 1), struct.pack(F64, 0)), "positive length in metres; got 0.0"),
    "negative resolution": (changed((0xC100, 1), struct.pack(F64, -4e-4)), "in metres; got -0.0004"),
    "infinite resolution": (changed((0xC100, 1), struct.pack(F64, np.inf)), "in metres; got inf"),
    "offset of NaN": (changed((0xC200, 2), struct.pack(F64, np.nan)), "no probe: a must be finite"),
    "beyond the apex": (
        changed((0xC200, 1), struct.pack(F64, -1)),
        "no probe: gamma_range must begin",
    ),
    "behind the axis": (changed((0xC200, 2), struct.pack(F64, -90)), "no probe: .* motor axis"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_is_refused_with_its_reason(tmp_path, case):
    content, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        jv.load_ultrasound(write(tmp_path, content))


def test_angles_may_be_uneven_up_to_what_the_docstring_says(tmp_path):
    jv.load_ultrasound(write(tmp_path, changed((0xC300, 1), uneven(BETA, 0.009))))
    with pytest.raises(ValueError, match="evenly spaced"):
        jv.load_ultrasound(write(tmp_path, changed((0xC300, 1), uneven(BETA, 0.011))))


def test_load_points_to_the_reader_that_returns_the_probe_too(tmp_path):
    with pytest.raises(ValueError, match=r"volume, probe = jv\.load_ultrasound\(path\)"):
        jv.load(write(tmp_path, kretz()))


def test_a_path_of_another_type_is_refused():
    with pytest.raises(ValueError, match="path must be a str or a path; got 3"):
        jv.load_ultrasound(3)


def test_a_missing_file_and_a_directory_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"there is no file .*scan\.vol"):
        jv.load_ultrasound(tmp_path / "scan.vol")
    with pytest.raises(ValueError, match="is a directory"):
        jv.load_ultrasound(tmp_path)


def promises(path):
    """A header that promises 2 GB of voxels, and none of them."""
    items = {tag: content for tag, content in GOOD.items() if tag != VOXELS}
    items |= {(0xC000, 1): b"\xff\x7f", (0xC000, 2): b"\xff\x7f", (0xC000, 3): b"\x02\x00"}
    path.write_bytes(kretz(items) + struct.pack("<HHI", *VOXELS, 32767 * 32767 * 2))


def zeros(path):
    """8 GiB of empty items, which take no disk space."""
    path.write_bytes(kretz())
    with path.open("r+b") as stream:
        stream.truncate(2**33)


def long_item(path):
    """4 GiB in an item that nobody wants."""
    path.write_bytes(kretz() + struct.pack("<HHI", 1, 1, 2**32 - 1))
    with path.open("r+b") as stream:
        stream.truncate(len(kretz()) + 8 + 2**32 - 1)


@pytest.mark.parametrize(
    ("make", "message"), [(promises, "cut short"), (zeros, "twice|items or more"), (long_item, None)]
)
def test_neither_a_file_nor_a_header_takes_memory_or_time_that_the_other_does_not_back(
    tmp_path, make, message
):
    path = tmp_path / "scan.vol"
    make(path)
    tracemalloc.start()
    begin = time.perf_counter()
    if message is None:
        np.testing.assert_array_equal(jv.load_ultrasound(path)[0].data, ECHO)
    else:
        with pytest.raises(ValueError, match=message):
            jv.load_ultrasound(path)
    assert time.perf_counter() - begin < 10
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * files.CHUNK


def mutated(content, rng):
    """The content with a few bytes changed, a part cut out, repeated or put in, its end cut off, or a number
    of the header replaced by an extreme one."""
    content, (at, to) = bytearray(content), np.sort(rng.integers(0, len(content), 2))
    match rng.integers(6):
        case 0:
            for place in rng.integers(0, len(content), rng.integers(1, 5)):
                content[place] ^= 1 << rng.integers(8)
        case 1:
            del content[at:to]
        case 2:
            content[at:at] = content[at:to]
        case 3:
            content[at:at] = rng.bytes(rng.integers(1, 20))
        case 4:
            del content[to:]
        case 5:
            extreme = [0, 2**16 - 1, 2**31, 2**32 - 1, 1, 0x7FF00000]
            place = rng.integers(0, len(content) - 4)
            content[place : place + 4] = struct.pack("<I", extreme[rng.integers(len(extreme))])
    return bytes(content)


def test_mutated_files_are_read_or_refused_with_a_value_error(tmp_path):
    rng = np.random.default_rng(0)
    refused = 0
    for number in range(400):
        path = write(tmp_path, mutated(kretz(), rng))
        begin = time.perf_counter()
        try:
            volume, probe = jv.load_ultrasound(path)
        except (ValueError, OSError):
            refused += 1
        else:
            assert volume.shape == SHAPE, number
            assert np.isfinite(probe.bounds).all(), number
        assert time.perf_counter() - begin < 5, number
    assert 200 < refused < 400
