"""Keeps lowered programs in files, so that the next process neither traces nor lowers them again.

JAX's persistent cache keeps what XLA compiles, under a hash of the lowered program: to find it, a process
traces and lowers first, which takes four times as long as to read it. `kept` also stores the lowered program
(`jax.export`), under a key of its own. Files are JSON and flatbuffers behind a checksum, never unpickled. As
JAX's cache, the folder is trusted: who may write to it may run code.
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


MAGIC = b"jaxvol program 2\n"

MOST_BYTES = 2**28
"""Of a file that is read."""

CONFIG = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_threefry_partitionable",
    "jax_numpy_dtype_promotion",
)
"""Settings of JAX that change what is traced."""

ARRAYS = jax.Array, np.ndarray, np.generic

PACKAGE = Path(__file__).parents[1]


class NotKept(Exception):
    """Raised for what means something else in another process."""


def kept(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`equinox.filter_jit(function, **options)`, whose lowered programs are kept where `keep_programs` keeps
    compiled ones.

    Args:
        function: of concrete arguments. It depends on nothing but these and the code of jaxvol. Where they
            hold anything else, such as a user's class, whose code may change, its programs are not kept.
    """
    programs: dict[Any, Callable[..., Any]] = {}

    def run(*args: Any) -> Any:
        arrays, rest = _apart(args)
        key = *rest, None
        # arrays on devices of a user's choice may be spread over several
        keeps = kept_folder() is not None and not any(getattr(leaf, "committed", False) for leaf in arrays)
        if keeps:
            types = tuple(getattr(leaf, "aval", None) or jax.typeof(leaf) for leaf in arrays)
            key = (
                *rest,
                (types, platform(), gathers_are_fast(), *(getattr(jax.config, name) for name in CONFIG)),
            )
        if key not in programs:
            flat = _flat(function, rest)
            found = _exported(function, args, flat, key[-1], options) if keeps else None
            programs[key] = jax.jit(flat, **options) if found is None else found
        return _together(*programs[key](*arrays))

    return run


class Rest(NamedTuple):
    """A tree without its arrays."""

    structure: Any
    leaves: tuple[Any, ...]


# a node without children: `jax.jit` returns it as it is for arguments of these types
jax.tree_util.register_pytree_node(Rest, lambda rest: ((), tuple(rest)), lambda rest, _: Rest(*rest))


def _apart(tree: Any) -> tuple[list[Any], Rest]:
    leaves, structure = jax.tree.flatten(tree)
    dynamic = [isinstance(leaf, ARRAYS) for leaf in leaves]
    rest = (None if is_array else leaf for leaf, is_array in zip(leaves, dynamic, strict=True))
    return list(itertools.compress(leaves, dynamic)), Rest(structure, tuple(rest))


def _together(arrays: Sequence[Any], rest: Rest) -> Any:
    if len(arrays) < len(rest.leaves):
        remaining = iter(arrays)
        arrays = [next(remaining) if leaf is None else leaf for leaf in rest.leaves]
    return jax.tree.unflatten(rest.structure, arrays)


def _flat(function: Callable[..., Any], rest: Rest) -> Callable[..., Any]:
    """The function of arrays, which returns arrays, and a `Rest`."""

    def flat(*arrays: Any) -> tuple[list[Any], Rest]:
        return _apart(function(*_together(arrays, rest)))

    flat.__name__ = getattr(function, "__name__", "program")
    return flat


def _exported(
    function: Callable[..., Any], args: Any, flat: Callable[..., Any], how: Any, options: Any
) -> Callable[..., Any] | None:
    """The program of arguments like these: from its file, if that is there, else into it; None where it
    cannot be kept."""
    types, *settings = how
    try:
        called = described(function), described(args), list(map(repr, types)), list(map(repr, settings))
        text = json.dumps([*_versions(), jax.devices()[0].device_kind, repr(options), *called])
        file = Path(kept_folder() or "") / f"{hashlib.sha256(text.encode()).hexdigest()}.exported"
        if (found := _read(file)) is None:
            rest = []

            def arrays(*leaves: Any) -> list[Any]:
                results, other = flat(*leaves)
                rest.append(other)
                return results

            arrays.__name__ = flat.__name__
            exported = export.export(jax.jit(arrays))(*types)
            found = json.dumps(described(rest[0])).encode(), exported
            _write(file, found[0], bytes(exported.serialize()))
    # what cannot be exported: a callback of the host
    except (NotKept, OSError, ValueError, NotImplementedError):
        return None
    rest, exported = rebuilt(json.loads(found[0])), found[1]

    def call(*leaves: Any) -> Any:
        return _CALL.bind(*leaves, exported=exported), rest

    call.__name__ = flat.__name__
    return jax.jit(call, **options)


def _read(file: Path) -> tuple[bytes, export.Exported] | None:
    """What `described` tells of a program's result, and the program; None if the file is damaged."""
    try:
        if file.stat().st_size > MOST_BYTES:
            return None
        content = file.read_bytes()
    except OSError:
        return None
    checksum, rest = content[len(MAGIC) : len(MAGIC) + 32], content[len(MAGIC) + 32 :]
    if not content.startswith(MAGIC) or hashlib.sha256(rest).digest() != checksum:
        return None
    result, _, program = rest.partition(b"\n")
    return result, export.deserialize(bytearray(program))


def _write(file: Path, result: bytes, program: bytes) -> None:
    rest = result + b"\n" + program
    with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".part", delete=False) as part:
        try:
            part.write(MAGIC + hashlib.sha256(rest).digest() + rest)
            part.close()
            os.replace(part.name, file)  # appears whole, also for processes that write it at the same time
        finally:
            Path(part.name).unlink(missing_ok=True)


@cache
def _versions() -> tuple[str, ...]:
    """Versions of what traces, and a hash of jaxvol's code."""
    code = hashlib.sha256()
    for file in sorted(PACKAGE.rglob("*.py")):
        code.update(str(file.relative_to(PACKAGE)).encode() + b"\0" + file.read_bytes() + b"\0")
    return *(f"{name} {version(name)}" for name in ("jax", "jaxlib", "equinox")), code.hexdigest()


# by `Exported.call` itself, results would be committed to a device
_CALL = Primitive("kept_program")
_CALL.multiple_results = True
_CALL.def_impl(lambda *args, exported: exported.call(*args))  # under `jax.disable_jit`
_CALL.def_abstract_eval(lambda *_, exported: exported.out_avals)
mlir.register_lowering(
    _CALL,
    lambda context, *args, exported: mlir.lower_fun(exported.call, multiple_results=True)(context, *args),
)


ARRAY: Any = object()
"""Stands for an array in a tree of which only the rest is known."""


def described(part: Any) -> Any:
    """A tree in terms of JSON: the same for the same tree in every process, and another for another. Arrays
    are all alike.

    Raises:
        NotKept: for what cannot be told by names and numbers.
    """
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
        return {"partial": [described(each) for each in (part.func, part.args, part.keywords)]}
    if isinstance(part, jax.tree_util.PyTreeDef):
        return {"structure": described(jax.tree.unflatten(part, [ARRAY] * part.num_leaves))}
    if isinstance(part, dict):
        return {"dict": [[described(key), described(each)] for key, each in part.items()]}
    if type(part) in (tuple, list):
        return {type(part).__name__: list(map(described, part))}
    if isinstance(part, tuple):
        return {"fields": [_name(type(part)), list(map(described, part))]}
    if isinstance(part, eqx.Module):
        fields = [[name, described(each)] for name, each in vars(part).items()]
        return {"module": [_name(type(part)), fields]}
    raise NotKept(type(part).__name__)


def _name(part: Any) -> str:
    module = part.__module__
    if module.split(".")[0] not in ("jaxvol", "numpy", "builtins") or "<" in part.__qualname__:
        raise NotKept(part.__qualname__)
    return f"{module}:{part.__qualname__}"


def rebuilt(told: Any) -> Any:
    """The tree that `described` tells, with `ARRAY` for each array."""
    if not isinstance(told, dict):
        return told
    ((kind, content),) = told.items()
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
            return {rebuilt(key): rebuilt(each) for key, each in content}
        case "tuple" | "list":
            found = map(rebuilt, content)
            return tuple(found) if kind == "tuple" else list(found)
        case "fields":
            return _named(content[0])(*map(rebuilt, content[1]))
        case "module":
            module = object.__new__(_named(content[0]))
            for name, each in content[1]:
                object.__setattr__(module, name, rebuilt(each))
            return module
    raise ValueError(f"results of a kept program hold no {kind!r}.")


def _named(name: str) -> Any:
    module, _, path = name.partition(":")
    found: Any = import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    return found
