"""The command `jaxvol`: puts its subcommands together, reports faults in one line, and ends at once when it
is interrupted."""

import argparse
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata

import jax

from .._util.whole_files import remove_unfinished
from ..xla.persistent_cache import SHORTEST, default_programs
from .commands.animate import add_animate
from .commands.datasets import add_datasets
from .commands.demo import add_demo
from .commands.figures import add_figures
from .commands.fit import add_fit
from .commands.info import add_info
from .commands.parsing import Parser, parsed
from .commands.plan import add_plan
from .commands.render import add_render
from .commands.view import add_view


COMMANDS = add_demo, add_render, add_animate, add_plan, add_fit, add_figures, add_info, add_datasets, add_view

EXAMPLES = """\
examples:
  jaxvol demo
  FILE=$(jaxvol datasets fetch engine)
  jaxvol info "$FILE"
  jaxvol render "$FILE"
  jaxvol render "$FILE" --preset engine --direction -0.7 -1 0.25 -o engine.png
  jaxvol render --like engine.png --size 1024 1024 -o large.png
  jaxvol render "$FILE" --cmap gray --compositing maximum -o maximum.png
  jaxvol render large.npy --memory 512M --config settings.toml
  jaxvol animate "$FILE" --preset engine --frames 48 -o engine.gif
  jaxvol plan "$FILE" --preset engine --tolerance 0.001
  jaxvol fit "$FILE" --images a.png b.png --cameras cameras.json -o transfer.json
  jaxvol render "$FILE" --transfer transfer.json --transparent --depth depth.npy
"""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    **Returns:** the exit code: 0, or 2 for bad input, reported in one line; 1, with nothing said, where what
    reads stdout has ended. Ctrl-C is reported in one line, too, and ends the process at once with code 130,
    by `os._exit`: XLA does not stop compiling or computing for a signal. Files that are not whole are
    removed."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    program = " ".join(["jaxvol", *words[:1]])
    options = argparse.Namespace()
    try:
        options = parsed(parser_of_all(), words)
        jax.config.update("jax_compilation_cache_dir", str(default_programs()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
        # the main thread gets the signals, and can handle them while it waits, also if XLA is busy
        ThreadPoolExecutor(1).submit(options.execute, options).result()
        sys.stdout.flush()
    except BrokenPipeError:
        # Python's documentation, "Note on SIGPIPE": else it complains when it flushes stdout at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError, ImportError) as fault:
        text = " ".join(str(fault).split()).removeprefix("path: ")  # the argument's name in Python
        print(f"{program}: error: {text}", file=sys.stderr)
        return 2
    except (MemoryError, jax.errors.JaxRuntimeError) as fault:
        if not isinstance(fault, MemoryError) and "RESOURCE_EXHAUSTED" not in str(fault):
            raise
        print(f"{program}: error: there is not enough memory ({fault})", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        remove_unfinished()
        checkpoint = getattr(options, "checkpoint", None)
        hint = f"; the same command resumes from {checkpoint}" if checkpoint and checkpoint.exists() else ""
        print(f"\n{program}: interrupted{hint}", file=sys.stderr, flush=True)
        sys.stdout.flush()
        os._exit(INTERRUPTED)
    return 0


def parser_of_all() -> Parser:
    """The parser of the command and its subcommands."""
    parser = Parser(
        prog="jaxvol",
        description="Direct volume rendering in JAX.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    try:
        version = metadata.version("jaxvol")
    except metadata.PackageNotFoundError:  # run from a checkout
        version = "(not installed)"
    parser.add_argument("--version", action="version", version=f"%(prog)s {version} (jax {jax.__version__})")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for add in COMMANDS:
        add(commands)
    return parser
