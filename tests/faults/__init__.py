"""Do the fast tests see faults? Each is injected where a function, a method or a constant is looked up.

`python -m tests.faults` runs the tests that each fault names, with the fault in place: at least one must
fail; and all of them once without any, which must pass. `--only TEXT` takes the faults whose names contain
it, `-j N` runs N at a time (2), `--list` lists them. Faults are in the files of this folder, by part of the
library: those that happened, and those that are easy to make. Whoever mends a fault, or adds a seam, adds
one.

`pytest --fault NAME tests/...` runs any tests with a fault.
"""

import importlib
import sys
from collections.abc import Callable
from typing import Any, NamedTuple


class Fault(NamedTuple):
    """A fault.

    - `name`: what goes wrong.
    - `where`: what is replaced, "module:name" or "module:Class.method", below `jaxvol`.
    - `make`: from what stands there to the faulty one.
    - `tests`: fast tests, below `tests/`, at least one of which must fail.
    """

    name: str
    where: str
    make: Callable[[Any], Any]
    tests: tuple[str, ...]

    def inject(self) -> None:
        """Replaces it in this process: in its module or class, and in all modules that imported it."""
        holder, name, original = self.found()
        faulty = self.make(original)
        if isinstance(holder, type):
            setattr(holder, name, faulty)
            return
        for module in [each for key, each in sys.modules.items() if key.partition(".")[0] == "jaxvol"]:
            for key, value in list(vars(module).items()):
                if value is original and (key == name or callable(original)):
                    setattr(module, key, faulty)

    def found(self) -> tuple[Any, str, Any]:
        """The module or class, the name in it, and what stands there; as written, not as looked up."""
        module, _, path = self.where.partition(":")
        holder: Any = importlib.import_module(f"jaxvol.{module}")
        *classes, name = path.split(".")
        for each in classes:
            holder = getattr(holder, each)
        return holder, name, vars(holder)[name]


def all_faults() -> dict[str, Fault]:
    """All faults by name."""
    from . import applications, bricks, engine, fitting, lighting, scene

    lists = (scene, engine, lighting, bricks, fitting, applications)
    faults = [fault for each in lists for fault in each.FAULTS]
    named = {fault.name: fault for fault in faults}
    assert len(named) == len(faults), "two faults have the same name"
    return named
