"""Keeps lowered programs in files, so that the next process neither traces nor lowers them again.

JAX's persistent cache keeps what XLA compiles, under a hash of the lowered program: to find it, a process
traces and lowers first, which takes four times as long as to read it. `kept` also stores the lowered program
(`jax.export`), under a key of its own. Files are JSON and flatbuffers behind a checksum, never unpickled. As
JAX's cache, the folder is trusted: who may write to it may run code.
"""

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Sequence
from functools import cache, partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import FunctionType
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax import export
from jax.extend.core import Primitive
from jax.interpreters import mlir

from .persistent_cache import kept_folder
from .platform import platform


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
    programs: dict[Any, Callable[..., Any] | None] = {}
    traced: Any = eqx.filter_jit(function, **options)

    def run(*args: Any) -> Any:
        if kept_folder() is None or jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
            return traced(*args)
        arrays, static = eqx.partition(args, _is_array)
        leaves, structure = jax.tree.flatten(arrays)
        # those on devices of a user's choice may be spread over several
        if any(isinstance(leaf, jax.Array) and leaf.committed for leaf in leaves):
            return traced(*args)
        rest, other = jax.tree.flatten(static)
        types, settings = tuple(map(jax.typeof, leaves)), (platform(), *_config())
        key = structure, tuple(rest), other, types, settings
        if key not in programs:
            try:
                programs[key] = _program(function, args, types, settings, options)
            # what cannot be exported: a callback of the host
            except (NotKept, OSError, ValueError, NotImplementedError):
                programs[key] = None
        program = programs[key]
        return traced(*args) if program is None else program(leaves)

    return run


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray)


def _config() -> tuple[Any, ...]:
    return tuple(getattr(jax.config, name) for name in CONFIG)


def _program(
    function: Callable[..., Any], args: Any, types: Any, settings: Any, options: Any
) -> Callable[[Sequence[Any]], Any]:
    """The program of arguments like these: from its file, if that is there, else into it."""
    called = described(function), described(args), list(map(repr, types)), list(map(repr, settings))
    text = json.dumps([*_versions(), jax.devices()[0].device_kind, repr(options), *called])
    folder = kept_folder()
    assert folder is not None
    file = folder / f"{hashlib.sha256(text.encode()).hexdigest()}.exported"
    if (found := _read(file)) is None:
        results = []

        def flat(*leaves: Any) -> Any:
            arrays, static = eqx.partition(args, _is_array)
            _, structure = jax.tree.flatten(arrays)
            result = function(*eqx.combine(jax.tree.unflatten(structure, leaves), static))
            results.append(described(result))
            return jax.tree.leaves(eqx.filter(result, _is_array))

        flat.__name__ = getattr(function, "__name__", "program")
        exported = export.export(jax.jit(flat))(*types)
        found = json.dumps(results[0]).encode(), exported
        _write(file, found[0], bytes(exported.serialize()))
    result, exported = found
    arrays, static = eqx.partition(rebuilt(json.loads(result)), lambda leaf: leaf is ARRAY)
    structure: Any = jax.tree.structure(arrays)

    def call(*leaves: Any) -> Any:
        return _CALL.bind(*leaves, exported=exported)

    call.__name__ = exported.fun_name
    program: Any = jax.jit(call, **options)
    return lambda leaves: eqx.combine(jax.tree.unflatten(structure, program(*leaves)), static)


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
        part.write(MAGIC + hashlib.sha256(rest).digest() + rest)
    os.replace(part.name, file)  # appears whole, also for processes that write it at the same time


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
    if _is_array(part) or part is ARRAY:
        return {"array": None}
    if isinstance(part, np.generic):
        return {"number": [part.dtype.name, part.item()]}
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
        case "number":
            return np.dtype(content[0]).type(content[1])
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
