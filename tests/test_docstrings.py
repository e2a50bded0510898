"""Do the docstrings of public names say what goes in, what comes out, and which errors are raised?"""

import ast
import inspect
import re
import textwrap
from pathlib import Path
from typing import Any

import pytest

import jaxvol as jv
from jaxvol import ray
from jaxvol._util import checks

from .reference import entries


ENTRIES = {
    path: thing for path, thing in entries().items() if inspect.isclass(thing) or inspect.isfunction(thing)
}
CHECKS = {
    name
    for module in (checks, ray)
    for name, value in vars(module).items()
    if inspect.isfunction(value) and re.search(r"\braise\b", inspect.getsource(value))
}
"""Functions that raise for bad input."""
SECTIONS = "Args", "Returns", "Raises"


def has(section, doc):
    """Whether a docstring has this section of Google's form."""
    return re.search(rf"^{section}:\n    \S", doc, re.MULTILINE) is not None


def says(name, doc):
    """Whether an argument has a line of its own, or is spoken of."""
    return (
        f"`{name}`" in doc
        or re.search(rf"^    \*{{0,2}}{re.escape(name)}: \S", doc, re.MULTILINE) is not None
    )


def tree(thing) -> Any:
    return ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]


def raises(function):
    """Whether a function's own code raises, or calls a check of arguments that does."""
    nodes = list(ast.walk(function))
    called = {
        node.func.id for node in nodes if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    return any(isinstance(node, ast.Raise) for node in nodes) or bool(called & CHECKS)


def parameters(function):
    given = function.args
    every = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    every += [each for each in (given.vararg, given.kwarg) if each is not None]
    return [each.arg for each in every if each.arg not in ("self", "cls")]


def text(thing):
    """A docstring, and those of public names that it refers to: "as for `render`", "as `rmse`"."""
    own = inspect.getdoc(thing) or ""
    names = re.findall(r"\b[Aa]s (?:for|in) `(?:jv\.)?(\w+)`", own)
    return own + "".join(
        inspect.getdoc(other) or "" for path, other in ENTRIES.items() if path.rpartition(".")[2] in names
    )


def lacks(thing):
    """What the docstring of a public name lacks."""
    doc, node = inspect.getdoc(thing) or "", tree(thing)
    found = [] if len(doc) > 20 else ["a docstring"]
    made = node
    if inspect.isclass(thing):
        own = {each.name: each for each in node.body if isinstance(each, ast.FunctionDef)}
        made = own.get("__init__")
        for name, method in own.items():
            shown = ast.get_docstring(method)
            if shown and not name.startswith("_") and any(isinstance(n, ast.Raise) for n in ast.walk(method)):
                found += (
                    []
                    if has("Raises", inspect.cleandoc(shown)) or has("Raises", doc)
                    else [f"Raises of {name}"]
                )
    elif not (
        node.returns is None or (isinstance(node.returns, ast.Constant) and node.returns.value is None)
    ):
        found += [] if has("Returns", doc) else ["Returns"]
    if made is not None:
        found += [] if has("Raises", doc) or not raises(made) else ["Raises"]
        if names := parameters(made):
            found += [] if has("Args", doc) else ["Args"]
            found += [name for name in names if not says(name, text(thing))]
    return found


@pytest.mark.parametrize("path", ENTRIES)
def test_a_public_docstring_says_what_goes_in_what_comes_out_and_what_is_raised(path):
    assert lacks(ENTRIES[path]) == []
    # sections in Google's form and in this order, which IDEs and the reference read
    doc = inspect.getdoc(ENTRIES[path]) or ""
    at = [doc.find(f"\n{name}:\n") for name in SECTIONS if has(name, doc)]
    assert at == sorted(at)
    assert not re.search(r"\*\*(Arguments|Returns|Raises|Attributes):?\*\*|^Arguments:", doc, re.MULTILINE)


def test_a_gap_is_found():
    def function(step: float, size: int) -> float:
        """Something that is said about `step`, and nothing else."""
        if step < 0:
            raise ValueError
        return step * size

    assert lacks(function) == ["Returns", "Raises", "Args", "size"]


def public(module):
    """What users may name of a module: its own objects, neither submodules nor what it imports."""

    def belongs(place):
        return place.startswith("jaxvol") if hasattr(module, "__path__") else place == module.__name__

    return {
        name: value
        for name, value in vars(module).items()
        if name == "PRESETS" or (not name.startswith("_") and belongs(getattr(value, "__module__", "")))
    }


def test_the_reference_holds_every_public_name_once():
    shown = list(entries().values())
    for module in (jv, jv.lighting, jv.bricks, jv.metrics):
        for name, value in public(module).items():
            count = sum(value is each for each in shown)
            assert count == 1, f"{module.__name__}.{name} is {count} times in docs/api"


# ---- plain names and sentences ----

VAGUE = re.findall(
    r"\w+",
    "each every own given told here there how what which whose whole other others same both alike apart "
    "together beside behind along away so few many some most least seen left rest found made taken",
)
"""Pronouns, prepositions and adverbs, which name nothing."""
OPENERS = re.findall(
    r"\w+",
    "of in at by with without from for as if where who why when whether how what which whose to its their "
    "these those this that it they some so only both each every none nothing no",
)
KEPT = 21, 23
"""At most so many definitions of vague names, of public keywords and of what many files share, and public
parameters that are `Any`, where no type says what they may be."""


def definitions(path):
    """Names that a file defines, first words of its docstrings, and its public parameters that are `Any`."""
    names, words, loose = [], [], []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (doc := ast.get_docstring(node)):
            words.append(re.split(r"[\s,.;:]", doc)[0].strip("`\"'").lower())
        if isinstance(node, ast.arg):
            names.append(node.arg)
        elif isinstance(node, ast.FunctionDef) or (
            isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
        ):
            names.append(node.name if isinstance(node, ast.FunctionDef) else node.id)
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            annotated = (each.annotation for each in (*node.args.args, *node.args.kwonlyargs))
            types = (ast.unparse(each) for each in annotated if each is not None)
            loose += [kind for kind in types if re.search(r"\| Any\b|^Any$", kind)]
    return names, words, loose


def test_names_are_nouns_docstrings_open_with_verbs_or_nouns_and_parameters_have_types():
    files = [definitions(path) for path in Path(jv.__file__).parent.rglob("*.py")]
    assert not [word for _, words, _ in files for word in words if word in OPENERS]
    vague = [name for names, _, _ in files for name in names if name.strip("_").lower() in VAGUE]
    assert len(vague) <= KEPT[0], sorted(vague)
    assert sum(len(loose) for _, _, loose in files) <= KEPT[1]
