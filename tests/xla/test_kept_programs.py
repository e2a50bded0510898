"""Are programs traced once, by the first process, and never taken from a file that is another one's?"""

import json
import pickle
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.compositing.blending import Over
from jaxvol.engine.tiling import Tiling
from jaxvol.scene.rendering import Rendering
from jaxvol.xla import compiling, kept_programs
from jaxvol.xla.kept_programs import ARRAY, NotKept, described, kept, rebuilt
from jaxvol.xla.trees import unchecked


OVER = Over()
X = np.linspace(0, 1, 5).astype(np.float32)
TRACES = []


def squares(x, power, more):
    """A function with what stages take and return: arrays, numbers, modules, and None."""
    TRACES.append(power)
    return {"sum": jnp.sum(x["x"] ** power), "all": (x["x"] ** power + 1, None, Tiling(), more, 0.1)}


squares.__module__ = "jaxvol.squares"


class Own(eqx.Module):
    """A class outside of jaxvol."""

    power: int = eqx.field(static=True)


class Pair(NamedTuple):
    """Another."""

    x: int


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Calls a kept function, in a new process each time, as far as it knows."""
    monkeypatch.setattr(kept_programs, "kept_folder", lambda: tmp_path)
    TRACES.clear()

    def run(x=X, power=2, more=OVER, **options):
        jax.clear_caches()
        return kept(squares, **options)({"x": jnp.asarray(x)}, power, more)

    return run


@pytest.fixture
def files(tmp_path):
    return lambda: sorted(tmp_path.glob("*.exported"))


def test_the_next_process_traces_nothing(run, files, monkeypatch):
    first = run()
    assert TRACES == [2]

    def refuse(*_):
        raise AssertionError("unpickled")

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    again = run()
    assert TRACES == [2]
    assert len(files()) == 1
    assert jax.tree.structure(first) == jax.tree.structure(again)
    assert again["all"][1:] == (None, Tiling(), OVER, 0.1)
    assert all(map(np.array_equal, jax.tree.leaves(first), jax.tree.leaves(again)))
    np.testing.assert_allclose(again["all"][0], X**2 + 1, rtol=1e-6)
    assert not again["sum"].committed  # so that it goes with arrays of any device


def test_another_type_number_option_or_version_is_another_program(run, files, monkeypatch):
    run()
    run(X[:3])
    run(power=3)
    run(X.astype(np.float16))
    run(compiler_options=compiling.OPTIONS)
    assert len(files()) == 5
    monkeypatch.setattr(kept_programs, "_versions", lambda: ("jax 0.0.1",))
    run()
    with jax.numpy_dtype_promotion("standard"):
        run()
    assert len(files()) == len(TRACES) == 7


@pytest.mark.parametrize("change", [b"", b"jaxvol program 2\nshort", "bit", "magic"])
def test_a_damaged_file_is_replaced(run, files, change):
    run()
    (file,) = files()
    content = bytearray(file.read_bytes())
    content[0 if change == "magic" else 99] ^= 1
    file.write_bytes(content if isinstance(change, str) else change)
    np.testing.assert_allclose(run()["sum"], np.sum(X**2), rtol=1e-6)
    assert TRACES == [2, 2]
    run()
    assert TRACES == [2, 2]


def test_programs_of_other_code_are_not_kept(run, files):
    for more in (Own(2), Pair(2), lambda x: x, partial(Own, 2)):
        for _ in range(2):
            run(more=more)
    assert len(TRACES) == 8
    assert not files()


def test_a_folder_that_cannot_be_written_loses_nothing(run, monkeypatch, tmp_path):
    monkeypatch.setattr(kept_programs, "kept_folder", lambda: tmp_path / "none")
    np.testing.assert_allclose(run()["sum"], np.sum(X**2), rtol=1e-6)


def test_arrays_on_a_device_of_ones_choice_stay_there(run, files):
    (x,) = jax.device_put((X,), jax.devices()[0])
    assert run(x)["sum"].committed
    assert not files()


def test_descriptions_tell_what_differs_and_are_the_same_in_every_process():
    structure = jax.tree.structure({"a": 1, "b": (2, None)})
    parts = [1, 1.0, "1", True, (1,), [1], None, Over, Over(), np.dtype("f4"), {"1": 1}]
    parts += [partial(jv.March, 0.1), Tiling(), structure, jnp.bfloat16.dtype, float("inf"), X]
    texts = [json.dumps(described(each)) for each in parts]
    assert len(set(texts)) == len(texts)
    assert "0x7" not in "".join(texts)
    for part, text in zip(parts, texts, strict=True):
        if not isinstance(part, partial):
            again = rebuilt(json.loads(text))
            assert again is ARRAY if part is X else (again == part and type(again) is type(part))
    image = unchecked(Rendering, rgba=X, exhausted=X, details=None, background=(1.0, 0.5))
    told = {"rgba": ARRAY, "exhausted": ARRAY, "details": None, "background": (1.0, 0.5)}
    assert vars(rebuilt(described(image))) == told
    for part in (object(), {1}, Own(1), Own, lambda: 0, np.linalg.norm, partial(lambda: 0)):
        with pytest.raises(NotKept):
            described(part)


def test_images_and_gradients_are_those_that_are_traced(tmp_path, monkeypatch):
    """Of a shape of its own, so that no other test has compiled their programs."""
    volume = jv.phantom("head", 21)
    transfer = jv.colormap("gray", (0, 255), unit_distance=0.2)
    camera = jv.Camera.looking_at(volume, (0.6, -0.8, 0.3), size=(9, 7))
    march = jv.March(0.1, (jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination(1e-4)), "midpoint")

    def found():
        loss = lambda transfer: jv.render(volume, transfer, camera, march).rgba.sum()  # noqa: E731
        image = jv.render(volume, transfer, camera, march)
        return jax.tree.leaves((image, *jax.value_and_grad(loss)(transfer)))

    usual = found()
    monkeypatch.setattr(kept_programs, "kept_folder", lambda: tmp_path)
    written = found()
    count = len(list(tmp_path.glob("*.exported")))
    jax.clear_caches()
    read = found()
    assert len(list(tmp_path.glob("*.exported"))) == count > 4
    for each in (written, read):
        for a, b in zip(usual, each, strict=True):
            np.testing.assert_array_equal(a, b)
