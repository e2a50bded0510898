"""Keeps traced programs in files, so that the next process need not trace and lower them again.

JAX's persistent cache keeps what XLA compiles, under a hash of the lowered program: to find it, a process
traces and lowers first, which takes four times as long as to read it. `kept` also stores the lowered program
(`jax.export`), under a key of its own. Files are flatbuffers behind a checksum; nothing is unpickled. As
JAX's cache, the folder is trusted: who may write to it may run code.
"""

import hashlib
import os
import re
import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax import export
from jax.core import ShapedArray

from .compiling import OPTIONS
from .persistent_cache import kept_folder
from .platform import is_traced


MAGIC = b"jaxvol program 1\n"
MOST_BYTES = 2**28
"""Of a file that is read."""

CONFIG = "jax_enable_x64", "jax_default_matmul_precision", "jax_threefry_partitionable"
"""Settings of JAX that change what is traced."""

PACKAGE = Path(__file__).parents[1]


class NotKept(Exception):
    """Raised for a part of a key that means something else in another process."""


def kept(function: Callable[..., Any], *key_parts: Any, has_rules: bool = False) -> Callable[..., Any]:
    """`jax.jit(function)`, whose lowered programs are kept, where JAX keeps compiled ones.

    Args:
        function: of trees that may hold static leaves. It returns arrays in tuples, lists and dicts, and
            depends on nothing but its arguments, `key_parts`, and the code of jaxvol.
        key_parts: what `function` depends on besides: numbers, texts, classes and static modules of jaxvol.
            With others, such as a user's class, whose code may change, programs are not kept.
        has_rules: whether all calls are made by a `jax.custom_vjp` within a `jax.custom_batching.custom_vmap`
            (or derivatives and batches never asked for). Programs from files have no rules. With it, larger
            programs contain them, too; otherwise, `function` itself is traced there.

    Returns:
        The compiled function.
    """
    programs: dict[Any, Program] = {}
    traced = eqx.filter_jit(function)

    def run(*args: Any) -> Any:
        in_program = is_traced(*args)
        if in_program and not has_rules:
            return traced(*args)
        arrays, static = eqx.partition(args, lambda leaf: isinstance(leaf, jax.Array | np.ndarray))
        leaves, structure = jax.tree.flatten(arrays)
        types = tuple(jax.typeof(leaf) for leaf in leaves)
        rest, other = jax.tree.flatten(static)
        config = tuple(getattr(jax.config, name) for name in CONFIG)
        key = structure, tuple(rest), other, types, config
        if key not in programs:

            def flat(*leaves: Any) -> Any:
                return function(*eqx.combine(jax.tree.unflatten(structure, leaves), static))

            marked = eqx.combine(jax.tree.map(lambda leaf: "array", arrays), static)
            programs[key] = Program.of(flat, types, (key_parts, marked, types, config))
        single = in_program or all(len(each.devices()) == 1 for each in leaves if isinstance(each, jax.Array))
        if not single:
            return traced(*args)
        return (programs[key].nested if in_program else programs[key].outermost)(*leaves)

    return run


class Program(NamedTuple):
    """A function of arrays, to be called from Python, and within a larger program."""

    outermost: Callable[..., Any]
    nested: Callable[..., Any]

    @classmethod
    def of(cls, flat: Callable[..., Any], types: Any, parts: Any) -> "Program":
        """A function of arrays of these types: from its file, if that is there, else into it."""
        called = _exported(flat, types, parts) or flat
        options: Any = {"compiler_options": OPTIONS}
        return cls(jax.jit(called, **options), jax.jit(called))


def _exported(flat: Callable[..., Any], types: Any, parts: Any) -> Callable[..., Any] | None:
    folder = kept_folder()
    if folder is None:
        return None
    try:
        file = folder / f"{_name(parts)}.exported"
        if (found := _read(file)) is None:
            found = export.export(jax.jit(flat))(*types)
            _write(file, bytes(found.serialize()))
    # a full disk; a callback of the host
    except (NotKept, OSError, ValueError, NotImplementedError):
        return None
    return found.call


def _read(file: Path) -> export.Exported | None:
    """The program in a file; None where there is none, or the file is damaged."""
    try:
        if file.stat().st_size > MOST_BYTES:
            return None
        content = file.read_bytes()
    except OSError:
        return None
    checksum, program = content[len(MAGIC) : len(MAGIC) + 32], content[len(MAGIC) + 32 :]
    if not content.startswith(MAGIC) or hashlib.sha256(program).digest() != checksum:
        return None
    return export.deserialize(bytearray(program))


def _write(file: Path, program: bytes) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".part", delete=False) as part:
        part.write(MAGIC + hashlib.sha256(program).digest() + program)
    os.replace(part.name, file)  # appears whole, also for processes that write it at the same time


def _name(parts: Any) -> str:
    device = jax.devices()[0]
    where = device.platform, device.device_kind, sorted(OPTIONS.items())
    text = "\n".join([*_versions(), repr(where), text_of(parts)])
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def _versions() -> tuple[str, ...]:
    """Versions of what traces, and a hash of jaxvol's code."""
    code = hashlib.sha256()
    for file in sorted(PACKAGE.rglob("*.py")):
        code.update(str(file.relative_to(PACKAGE)).encode() + b"\0" + file.read_bytes() + b"\0")
    return *(f"{name} {version(name)}" for name in ("jax", "jaxlib", "equinox")), code.hexdigest()


def text_of(part: Any) -> str:
    """A text that is the same in every process for the same part of a key, and differs for another one.

    Raises:
        NotKept: where there is none.
    """
    if part is None or isinstance(part, bool | int | float | complex | str | bytes | np.generic):
        return f"{type(part).__name__} {part!r}"
    if isinstance(part, type | FunctionType):
        if re.match(r"(jaxvol|jax|numpy|builtins)\b", part.__module__) and "<" not in part.__qualname__:
            return f"{part.__module__}.{part.__qualname__}"
    elif isinstance(part, np.dtype | ShapedArray):
        return f"{part!r} {getattr(part, 'weak_type', False)}"
    elif isinstance(part, tuple | list):
        return f"{text_of(type(part))}({', '.join(map(text_of, part))})"
    elif isinstance(part, Mapping):
        return f"{{{', '.join(sorted(f'{text_of(k)}: {text_of(v)}' for k, v in part.items()))}}}"
    elif isinstance(part, eqx.Module):
        fields = {name: getattr(part, name, None) for name in part.__dataclass_fields__}
        return f"{text_of(type(part))}{text_of(fields)}"
    raise NotKept(type(part).__name__)
