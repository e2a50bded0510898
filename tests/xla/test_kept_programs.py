"""Are programs traced once, by the first process, and never taken from a file that is another one's?"""

import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol.compositing.blending import Over
from jaxvol.march.march import March
from jaxvol.xla import kept_programs
from jaxvol.xla.kept_programs import NotKept, kept, text_of


OVER = Over()
X = np.linspace(0, 1, 5).astype(np.float32)


class Own(eqx.Module):
    """A class outside of jaxvol."""

    power: int = eqx.field(static=True)


@pytest.fixture
def traces(tmp_path, monkeypatch):
    """A new process, at each call: a kept function, and the list of its traces."""
    monkeypatch.setattr(kept_programs, "kept_folder", lambda: tmp_path)
    traces = []

    def squares(x, power, more):
        traces.append(power)
        return {"sum": jnp.sum(x["x"] ** power), "all": (x["x"] ** power + 1, None)}

    def run(x=X, power=2, more=OVER, key=("squares",)):
        jax.clear_caches()
        return kept(squares, *key)({"x": jnp.asarray(x)}, power, more)

    return traces, run, lambda: sorted(tmp_path.glob("*.exported"))


def test_the_next_process_traces_nothing(traces, monkeypatch):
    traced, run, files = traces
    first = run()
    assert traced == [2]

    def refuse(*_):
        raise AssertionError("unpickled")

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    again = run()
    assert traced == [2]
    assert len(files()) == 1
    assert jax.tree.structure(first) == jax.tree.structure(again)
    assert all(map(np.array_equal, jax.tree.leaves(first), jax.tree.leaves(again)))
    np.testing.assert_allclose(again["all"][0], X**2 + 1, rtol=1e-6)


def test_another_type_number_or_version_is_another_program(traces, monkeypatch):
    traced, run, files = traces
    run()
    run(X[:3])
    run(power=3)
    run(key=("cubes",))
    run(X.astype(np.float16))
    assert len(files()) == 5
    monkeypatch.setattr(kept_programs, "_versions", lambda: ("jax 0.0.1",))
    run()
    assert len(files()) == len(traced) == 6


@pytest.mark.parametrize("change", [b"", b"jaxvol program 1\nshort", "bit", "magic"])
def test_a_damaged_file_is_replaced(traces, change):
    traced, run, files = traces
    run()
    (file,) = files()
    content = bytearray(file.read_bytes())
    content[0 if change == "magic" else 99] ^= 1
    file.write_bytes(content if isinstance(change, str) else change)
    np.testing.assert_allclose(run()["sum"], np.sum(X**2), rtol=1e-6)
    assert traced == [2, 2]
    run()
    assert traced == [2, 2]


def test_programs_of_other_code_are_not_kept(traces):
    traced, run, files = traces
    for more in (Own(2), lambda x: x):
        for _ in range(2):
            run(more=more)
    assert len(traced) == 4
    assert not files()


def test_keys_tell_what_differs_in_every_process():
    assert text_of((1, Over, jnp.cos.__name__, {"b": 2.0, "a": None})) == text_of(
        (1, Over, "cos", {"a": None, "b": 2.0})
    )
    texts = [text_of(each) for each in (1, 1.0, "1", True, (1,), [1], None, Over, Over(), np.dtype("f4"))]
    assert len(set(texts)) == len(texts)
    assert "0x" not in "".join(texts)
    for part in (object(), {1}, Own(1), Own, lambda: 0, March(0.1)):
        with pytest.raises(NotKept):
            text_of(part)


def test_rules_of_jax_go_around_a_program_from_a_file(traces):
    """A derivative and a batching rule of one's own, as the engine has."""
    traced, _, files = traces

    def square(x):
        traced.append(x)
        return x * x

    def program(x):
        jax.clear_caches()
        return kept(square, "square", has_rules=True)(x)

    @jax.custom_vjp
    def f(x):
        return program(x)

    f.defvjp(lambda x: (program(x), x), lambda x, bar: (2 * x * bar,))
    g = jax.custom_batching.custom_vmap(f)
    g.def_vmap(lambda size, in_batched, x: (jax.lax.map(f, x), True))
    x, both = jnp.asarray(X), jnp.asarray(np.stack([X, 2 * X]))
    np.testing.assert_allclose(program(x), X**2)
    np.testing.assert_allclose(jax.jit(jax.grad(lambda x: f(x).sum()))(x), 2 * X)
    np.testing.assert_allclose(jax.jit(jax.vmap(g))(both), both**2, rtol=1e-6)
    assert len(traced) == len(files()) == 1
