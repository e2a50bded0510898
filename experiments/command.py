"""The one `main` of scripts, of experiments and of figures."""

import argparse
import sys
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias


Main: TypeAlias = Callable[..., None]
"""`main(argv)`; without `argv`, it takes the arguments of the command line."""

QUICK = {"action": "store_true", "help": "tiny sizes, to check that the script runs"}

HELP = {
    "output": "default: %(default)s",
    "size": "pixels along a side",
    "sizes": "pixels along a side",
    "resolution": "voxels along an axis",
    "paths": "paths through each pixel",
}
"""Of options that several scripts have."""

POSITIONAL = ("commits",)


def command(about: str | None, output: Path, **options: Any) -> Callable[[Callable[[Namespace], None]], Main]:
    """Decorator that makes a script's `main` of a function of its options.

    - `about`: what the script does, its docstring.
    - `output`: default of `--output`, the folder to write into, which is made.
    - `options`: the other options, by name: the default of an integer, or what `add_argument` takes; those
      of `POSITIONAL` are given without their names.

    The arguments as they were given, but for the output, are `argv` among the options: what was asked for,
    wherever it is written.
    """
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    options["output"] = {"type": Path, "default": output, "metavar": "FOLDER"}
    for name, option in options.items():
        how = option if isinstance(option, dict) else {"type": int, "default": option}
        flag = name if name in POSITIONAL else "--" + name.replace("_", "-")
        parser.add_argument(flag, **{"help": HELP.get(name), **how})

    def made(run: Callable[[Namespace], None]) -> Main:
        def main(argv: Sequence[str] | None = None) -> None:
            given = sys.argv[1:] if argv is None else list(argv)
            chosen = parser.parse_args(given, Namespace(argv=_without_output(given)))
            chosen.output.mkdir(parents=True, exist_ok=True)
            run(chosen)

        return main

    return made


def _without_output(given: Sequence[str]) -> list[str]:
    """Arguments without `--output FOLDER` or `--output=FOLDER`."""
    pairs = zip(["", *given], given, strict=False)
    return [word for last, word in pairs if "--output" not in (last, word.partition("=")[0])]
