"""Do imports go one way only, and is every class abstract or final?"""

import ast
import importlib
import inspect
import pkgutil
from pathlib import Path

import jaxvol as jv
from jaxvol.march.march import Transform
from jaxvol.scene.space import Path as RayPath


ROOT = Path(jv.__file__).parent

NAMES = """
    xla _util scene march lighting compositing ray reference engine io bricks planning render
    path_tracing metrics fitting app __main__ __init__
"""
ORDER = [str(name) for name in NAMES.split()]
"""Order of imports, from the volume to the command line: a file imports only entries before its own."""

DO_NOTHING = {Transform, RayPath}
"""Base classes without abstract methods: the default of each method changes nothing. None of them is
instantiated itself."""


def files():
    return sorted(ROOT.rglob("*.py"))


def place(file: Path) -> str:
    """The entry of `ORDER` that a file belongs to."""
    return file.relative_to(ROOT).parts[0].removesuffix(".py")


def imported(file: Path) -> set[Path]:
    """The library's files that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = file.parents[node.level - 1].joinpath(*(node.module or "").split("."))
            for name in [None] if node.module and not base.is_dir() else [each.name for each in node.names]:
                module = base if name is None else base / name
                for candidate in (module.with_suffix(".py"), module / "__init__.py", base / "__init__.py"):
                    if candidate.is_file():
                        found.add(candidate)
                        break
    return found - {file}


def test_every_file_has_a_place_and_imports_nothing_that_comes_later():
    assert {place(file) for file in files()} == set(ORDER)
    for file in files():
        here = ORDER.index(place(file))
        for other in imported(file):
            there = ORDER.index(place(other))
            assert there <= here, f"{file.relative_to(ROOT)} imports {other.relative_to(ROOT)}"
            assert there < here or place(other) not in ("__init__",), other


def test_there_are_no_circular_imports():
    remaining = {file: imported(file) for file in files()}
    while remaining:
        free = [file for file, others in remaining.items() if not others & remaining.keys()]
        assert free, sorted(str(file.relative_to(ROOT)) for file in remaining)
        remaining = {file: others for file, others in remaining.items() if file not in free}


def classes():
    for module in pkgutil.walk_packages([str(ROOT)], "jaxvol."):
        if module.name.endswith("__main__"):
            continue
        for _, kind in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            if kind.__module__ == module.name:
                yield kind


def test_a_class_is_abstract_or_final():
    for kind in classes():
        for base in kind.__bases__:
            if base.__module__.startswith("jaxvol") and base not in DO_NOTHING:
                abstract = inspect.isabstract(base) or bool(getattr(base, "__abstractvars__", ()))
                assert abstract, f"{kind.__name__} inherits from {base.__name__}, which is not abstract"
