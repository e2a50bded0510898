"""Keeps lowered programs in files, so that later processes neither trace nor lower them.

JAX's persistent cache keeps compiled programs under a hash of the lowered program: a look-up requires tracing
and lowering, which take four times as long as reading the file. `kept` also stores the lowered program
(`jax.export`) under a separate key. Files are JSON and flatbuffers behind a checksum, never unpickled. As for
JAX's cache, the folder is trusted: whoever may write to it may run code.
"""

import hashlib
import itertools
import json
import os
import tempfile
from collections.abc import Callable, Sequence
from functools import cache, partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax import export
from jax.extend.core import Primitive
from jax.interpreters import mlir

from .persistent_cache import kept_folder
from .platform import gathers_are_fast, platform
from .trees import PyTree


MAGIC = b"jaxvol program 2\n"
MAX_BYTES = 2**28  # of a file

CONFIG = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_threefry_partitionable",
    "jax_numpy_dtype_promotion",
)
"""Settings of JAX that change the traced program."""

ARRAYS = jax.Array, np.ndarray, np.generic

PACKAGE = Path(__file__).parents[1]


class NotKept(Exception):
    """Raised for an object that may differ in another process."""


def kept(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`equinox.filter_jit(function, **options)`, whose lowered programs are kept in the folder of
    `keep_programs`. The function must depend only on its arguments, which are concrete, and on the code of
    jaxvol. Programs of arguments with other code, such as a user's class, are not kept."""
    programs: dict[Any, Callable[..., Any]] = {}

    def run(*args: Any) -> Any:
        arrays, static = _split(args)
        key = *static, None
        # committed arrays may be sharded over several devices
        keeps = kept_folder() is not None and not any(getattr(leaf, "committed", False) for leaf in arrays)
        if keeps:
            types = tuple(getattr(leaf, "aval", None) or jax.typeof(leaf) for leaf in arrays)
            settings = platform(), gathers_are_fast(), *(getattr(jax.config, name) for name in CONFIG)
            key = *static, (types, *settings)
        if key not in programs:
            flat = _flat(function, static)
            program = _exported(function, args, flat, key[-1], options) if keeps else None
            programs[key] = jax.jit(flat, **options) if program is None else program
        return _merge(*programs[key](*arrays))

    return run


class Static(NamedTuple):
    """A tree without its arrays."""

    structure: Any
    leaves: tuple[Any, ...]  # None in place of arrays


# a node without children: `jax.jit` returns it unchanged for arguments of these types
jax.tree_util.register_pytree_node(Static, lambda tree: ((), tuple(tree)), lambda data, _: Static(*data))


def _split(tree: Any) -> tuple[list[Any], Static]:
    leaves, structure = jax.tree.flatten(tree)
    dynamic = [isinstance(leaf, ARRAYS) for leaf in leaves]
    static = (None if is_array else leaf for leaf, is_array in zip(leaves, dynamic, strict=True))
    return list(itertools.compress(leaves, dynamic)), Static(structure, tuple(static))


def _merge(arrays: Sequence[Any], static: Static) -> Any:
    if len(arrays) < len(static.leaves):
        array = iter(arrays)
        arrays = [next(array) if leaf is None else leaf for leaf in static.leaves]
    return jax.tree.unflatten(static.structure, arrays)


def _flat(function: Callable[..., Any], static: Static) -> Callable[..., Any]:
    """The function of arrays, which returns arrays and a `Static`."""

    def flat(*arrays: Any) -> tuple[list[Any], Static]:
        return _split(function(*_merge(arrays, static)))

    flat.__name__ = getattr(function, "__name__", "program")
    return flat


def _exported(
    function: Callable[..., Any], args: Any, flat: Callable[..., Any], key: Any, options: Any
) -> Callable[..., Any] | None:
    """The program of a key, read from its file, or exported to it; None if it cannot be kept."""
    types, *settings = key
    try:
        called = described(function), described(args), list(map(repr, types)), list(map(repr, settings))
        text = json.dumps([*_versions(), jax.devices()[0].device_kind, repr(options), *called])
        file = Path(kept_folder() or "") / f"{hashlib.sha256(text.encode()).hexdigest()}.exported"
        if (content := _read(file)) is None:
            statics = []

            def arrays(*leaves: Any) -> list[Any]:
                results, static = flat(*leaves)
                statics.append(static)
                return results

            arrays.__name__ = flat.__name__
            exported = export.export(jax.jit(arrays))(*types)
            content = json.dumps(described(statics[0])).encode(), exported
            _write(file, content[0], bytes(exported.serialize()))
    # callbacks of the host cannot be exported
    except (NotKept, OSError, ValueError, NotImplementedError):
        return None
    static, exported = rebuilt(json.loads(content[0])), content[1]

    def call(*leaves: Any) -> Any:
        return _CALL.bind(*leaves, exported=exported), static

    call.__name__ = flat.__name__
    return jax.jit(call, **options)


def _read(file: Path) -> tuple[bytes, export.Exported] | None:
    """Description of a program's result, and the program; None if the file is missing or damaged."""
    try:
        if file.stat().st_size > MAX_BYTES:
            return None
        content = file.read_bytes()
    except OSError:
        return None
    checksum, body = content[len(MAGIC) : len(MAGIC) + 32], content[len(MAGIC) + 32 :]
    if not content.startswith(MAGIC) or hashlib.sha256(body).digest() != checksum:
        return None
    result, _, program = body.partition(b"\n")
    return result, export.deserialize(bytearray(program))


def _write(file: Path, result: bytes, program: bytes) -> None:
    body = result + b"\n" + program
    with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".part", delete=False) as part:
        try:
            part.write(MAGIC + hashlib.sha256(body).digest() + body)
            part.close()
            os.replace(part.name, file)  # atomic, also if several processes write the file
        finally:
            Path(part.name).unlink(missing_ok=True)


@cache
def _versions() -> tuple[str, ...]:
    """Versions of JAX and equinox, and a hash of jaxvol's code."""
    code = hashlib.sha256()
    for file in sorted(PACKAGE.rglob("*.py")):
        code.update(str(file.relative_to(PACKAGE)).encode() + b"\0" + file.read_bytes() + b"\0")
    return *(f"{name} {version(name)}" for name in ("jax", "jaxlib", "equinox")), code.hexdigest()


# a primitive, since `Exported.call` alone would commit its results to a device
_CALL = Primitive("kept_program")
_CALL.multiple_results = True
_CALL.def_impl(lambda *args, exported: exported.call(*args))  # under `jax.disable_jit`
_CALL.def_abstract_eval(lambda *_, exported: exported.out_avals)
mlir.register_lowering(
    _CALL,
    lambda context, *args, exported: mlir.lower_fun(exported.call, multiple_results=True)(context, *args),
)


ARRAY: Any = object()  # placeholder of an array in a tree


def described(part: PyTree) -> Any:
    """Description of a tree in terms of JSON, equal in all processes, and different for different trees.
    Arrays are not distinguished. Raises `NotKept` for an object that names and numbers do not describe."""
    if part is None or isinstance(part, bool | int | str):
        return part
    if isinstance(part, float):
        return {"float": part.hex()}
    if isinstance(part, ARRAYS) or part is ARRAY:
        return {"array": None}
    if isinstance(part, np.dtype):
        return {"dtype": part.name}
    if isinstance(part, type | FunctionType):
        return {"name": _name(part)}
    if isinstance(part, partial):
        return {"partial": list(map(described, (part.func, part.args, part.keywords)))}
    if isinstance(part, jax.tree_util.PyTreeDef):
        return {"structure": described(jax.tree.unflatten(part, [ARRAY] * part.num_leaves))}
    if isinstance(part, dict):
        return {"dict": [[described(key), described(value)] for key, value in part.items()]}
    if type(part) is tuple or type(part) is list:
        return {type(part).__name__: list(map(described, part))}
    if isinstance(part, tuple):
        return {"fields": [_name(type(part)), list(map(described, part))]}
    if isinstance(part, eqx.Module):
        fields = [[name, described(value)] for name, value in vars(part).items()]
        return {"module": [_name(type(part)), fields]}
    raise NotKept(type(part).__name__)


def _name(part: Any) -> str:
    module = part.__module__
    if module.split(".")[0] not in ("jaxvol", "numpy", "builtins") or "<" in part.__qualname__:
        raise NotKept(part.__qualname__)
    return f"{module}:{part.__qualname__}"


def rebuilt(description: PyTree) -> Any:
    """The tree of a `described` result, with `ARRAY` in place of arrays."""
    if not isinstance(description, dict):
        return description
    ((kind, content),) = description.items()
    match kind:
        case "float":
            return float.fromhex(content)
        case "array":
            return ARRAY
        case "dtype":
            return np.dtype(content)
        case "name":
            return _named(content)
        case "structure":
            return jax.tree.structure(rebuilt(content))
        case "dict":
            return {rebuilt(key): rebuilt(value) for key, value in content}
        case "tuple" | "list":
            return (tuple if kind == "tuple" else list)(map(rebuilt, content))
        case "fields":
            return _named(content[0])(*map(rebuilt, content[1]))
        case "module":
            module = object.__new__(_named(content[0]))
            for name, value in content[1]:
                object.__setattr__(module, name, rebuilt(value))
            return module
    raise ValueError(f"a description of a kept program must not have a {kind!r}.")


def _named(name: str) -> Any:
    module, _, path = name.partition(":")
    value: Any = import_module(module)
    for part in path.split("."):
        value = getattr(value, part)
    return value
