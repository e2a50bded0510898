"""Do the examples in documents and docstrings run, and does the reference hold every public name?"""

import ast
import inspect
import re
import textwrap

import jax
import numpy as np
import pytest

import jaxvol as jv

from .reference import ROOT, entries


BLOCK = re.compile(r"^( *)```python\n(.*?)^\1```", re.DOTALL | re.MULTILINE)


def examples(text):
    """Python code in a text: its ```python blocks, and its lines at a >>> prompt."""
    blocks = [textwrap.dedent(block) for _, block in BLOCK.findall(text)]
    prompts = re.findall(r"^ *(?:>>>|\.\.\.) ?(.*)$", text, re.MULTILINE)
    return [*blocks, *(["\n".join(prompts)] if prompts else [])]


def docstrings(module):
    """Docstrings of a module, its classes and its functions."""
    kinds = ast.Module, ast.ClassDef, ast.FunctionDef
    nodes = ast.walk(ast.parse(module.read_text(encoding="utf-8")))
    return [ast.get_docstring(node) or "" for node in nodes if isinstance(node, kinds)]


PAGES = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md"))


def documents():
    """Name and examples of every document that has some. A document's examples share one namespace."""
    for name in ("README.md", "CONTRIBUTING.md", *PAGES):
        if found := examples((ROOT / name).read_text(encoding="utf-8")):
            yield name, found
    for module in sorted((ROOT / "jaxvol").rglob("*.py")):
        for text in docstrings(module):
            if found := examples(text):
                yield f"{module.relative_to(ROOT)}: {text.splitlines()[0]}", found


DOCUMENTS = dict(documents())
FITS = "jv.fit("

# A fit takes minutes. The fast tests run the examples before it.
CASES = [
    *(pytest.param(name, False, id=name) for name in DOCUMENTS),
    *(
        pytest.param(name, True, id=f"{name}, fits", marks=pytest.mark.slow)
        for name, found in DOCUMENTS.items()
        if any(FITS in block for block in found)
    ),
]


def assert_tells_something(value, what):
    """Every float is finite, and some are not 0."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(value) if hasattr(leaf, "dtype")]
    floats = [leaf for leaf in leaves if np.issubdtype(leaf.dtype, np.inexact)]
    assert floats, what
    assert all(np.isfinite(leaf).all() for leaf in floats), what
    assert any(leaf.any() for leaf in floats), what


@pytest.mark.parametrize(("document", "fits"), CASES)
def test_python_in_the_documents_runs(document, fits, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = [block for block in DOCUMENTS[document] if fits or FITS not in block]
    assert blocks
    names: dict = {}
    for block in blocks:
        exec(block, names)
    assert float(names["rendering"].rgba.max()) > 0.1
    assert_tells_something(names["rendering"].rgba, "rendering")
    if "jax.grad" in "".join(blocks):
        gradient = names["gradient"]
        assert_tells_something(gradient.colors, "gradient.colors")
        assert_tells_something(gradient.extinction, "gradient.extinction")
    if fits:
        assert names["found"].losses[-1] < 0.1 * names["found"].losses[0]
        assert_tells_something(names["found"].parameters, "found.parameters")


def test_examples_are_found_wherever_they_stand():
    text = inspect.cleandoc(
        """
        - a list, with

          ```python
          one = 1
          ```

        >>> two = 2
        >>> for three in range(3):
        ...     pass
        """
    )
    assert examples(text) == ["one = 1\n", "two = 2\nfor three in range(3):\n    pass"]
    assert sum(FITS in block for block in DOCUMENTS["README.md"]) == 1
    assert len(DOCUMENTS["README.md"]) == 3


def test_every_link_to_a_file_leads_somewhere():
    for document in [*ROOT.glob("*.md"), *(ROOT / name for name in PAGES)]:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", document.read_text(encoding="utf-8")):
            assert (document.parent / target).exists(), f"{document.name} -> {target}"


def public(module):
    """What users may name of a module: its own objects, neither submodules nor what it imports."""
    return {
        name: value
        for name, value in vars(module).items()
        if name == "PRESETS"
        or (getattr(value, "__module__", "").startswith("jaxvol") and not name.startswith("_"))
    }


def test_the_reference_holds_every_public_name_once():
    shown = list(entries().values())
    for module in (jv, jv.lighting, jv.bricks, jv.metrics):
        for name, value in public(module).items():
            count = sum(value is each for each in shown)
            assert count == 1, f"{module.__name__}.{name} is {count} times in docs/api"


def test_every_page_is_in_the_contents_of_the_documentation():
    contents = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in PAGES:
        assert f": {page.removeprefix('docs/')}\n" in contents, page


def test_sections_that_the_documentation_takes_from_other_documents_exist():
    for page in PAGES:
        for file, heading in re.findall(r"<!-- section (\S+): (.+?) -->", (ROOT / page).read_text("utf-8")):
            text = (ROOT / file).read_text(encoding="utf-8")
            assert re.search(rf"^#+ {re.escape(heading)}$", text, re.MULTILINE), (page, file, heading)
