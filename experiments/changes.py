"""Was code changed on which a result depends since it was recorded? Comments and docstrings do not count."""

import ast
import subprocess
from pathlib import Path


ROOT = Path(__file__).parent.parent

OF_NONE = (
    "_util/whole_files.py",
    "cli.py",
    "commands",
    "datasets",
    "figures.py",
    "fitting/files.py",
    "formats",
    "programs.py",
)
"""Parts of the package on which no result depends."""

OF_SOME = {
    "bricks": ("bricks", "out_of_core", "pareto", "stability"),
    "fitting": ("fit_pose", "fit_transfer", "mean_free_path", "model_choice", "probe_geometry", "tomography"),
    "viewer": ("viewer_latency",),
}
"""Parts on which only these results depend. All else in the package is the engine's, on which all do."""


def changed_since(commit: str | None, name: str, root: Path = ROOT) -> bool:
    """Whether the code on which this result depends is another one than at a commit of the repository at
    `root`; also if that is not known here."""
    others = [*OF_NONE, *(part for part, names in OF_SOME.items() if name not in names)]
    left_out = [f":(exclude)jaxvol/{part}" for part in others]
    commit = (commit or "none").rstrip("+")
    differing = _git(root, "diff", "--name-only", "--no-renames", commit, "--", "jaxvol", *left_out)
    if differing is None:
        return True
    return any(
        _code(_git(root, "show", f"{commit}:{file}")) != _here(root / file) for file in differing.split()
    )


def _git(root: Path, *words: str) -> str | None:
    """What Git prints; None if it fails."""
    ran = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True)
    return ran.stdout if ran.returncode == 0 else None


def _here(file: Path) -> str | None:
    return _code(file.read_text(encoding="utf-8")) if file.is_file() else None


def _code(text: str | None) -> str | None:
    """The code of a module, without its comments and docstrings; None of no module."""
    if text is None:
        return None
    tree = ast.parse(text)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [each for each in body if not _is_docstring(each)]  # pyright: ignore[reportAttributeAccessIssue]
    return ast.dump(tree)


def _is_docstring(statement: ast.stmt) -> bool:
    value = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)
