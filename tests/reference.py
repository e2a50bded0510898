"""The entries of the reference of the documentation: every public name, and the object that it stands for."""

import importlib
from pathlib import Path
from typing import Any

from docs.registry import with_entries


ROOT = Path(__file__).parent.parent


def entries() -> dict[str, Any]:
    """By path, such as `jaxvol.scene.camera.Camera`, the objects that the pages of docs/api show."""
    found: dict[str, Any] = {}
    for page in sorted((ROOT / "docs" / "api").glob("*.md")):
        for line in with_entries(page.read_text(encoding="utf-8")).splitlines():
            if line.startswith("::: "):
                module, _, name = line.removeprefix("::: ").rpartition(".")
                assert f"{module}.{name}" not in found, f"{line} stands twice in docs/api"
                found[f"{module}.{name}"] = getattr(importlib.import_module(module), name)
    return found
