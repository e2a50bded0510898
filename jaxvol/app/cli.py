"""The command `jaxvol`: puts its subcommands together, reports faults in one line, and ends at once when it
is interrupted."""

import argparse
import os
import re
import sys
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import jax

from .._util.checks import printable
from .._util.interruption import end_at_once, raise_again
from .._util.version import __version__
from .._util.whole_files import remove_unfinished
from ..xla.persistent_cache import SHORTEST, default_programs
from .commands.animate import add_animate
from .commands.fit import add_fit
from .commands.options import Parser, parsed
from .commands.pages import add_demo, add_figures
from .commands.render import add_plan, add_render
from .commands.volumes import add_datasets, add_info, add_view


COMMANDS = add_demo, add_render, add_animate, add_plan, add_fit, add_figures, add_info, add_datasets, add_view

EXAMPLES = """\
examples:
  jaxvol demo
  FILE=$(jaxvol datasets fetch engine)
  jaxvol info "$FILE"
  jaxvol render "$FILE"
  jaxvol render "$FILE" --preset engine --direction -0.7 -1 0.25 -o engine.png
  jaxvol render --like engine.png --size 1024 1024 -o large.png
  jaxvol animate "$FILE" --preset engine --frames 48 -o engine.gif
  jaxvol fit "$FILE" --images a.png b.png --cameras cameras.json -o transfer.json
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: the words after `jaxvol`; by default those of the process.

    Returns:
        The exit code: 0; 2 for bad input, reported in one line; 1, with nothing said, where what reads stdout
        has ended. Ctrl-C is reported in one line and ends the process at once with code 130, as in shells, by
        `os._exit`: XLA does not stop for a signal. Unfinished files are removed.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    program = " ".join(["jaxvol", *words[:1]])
    options = argparse.Namespace()
    try:
        raise_again()
        options = parsed(parser_of_all(), words or ["--help"])
        jax.config.update("jax_compilation_cache_dir", str(default_programs()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = lambda told, *_: print(f"{program}: {told}", file=sys.stderr)
            # the main thread gets the signals, and can handle them while it waits, also if XLA is busy
            ThreadPoolExecutor(1).submit(options.execute, options).result()
        sys.stdout.flush()
    except BrokenPipeError:
        # Python's documentation, "Note on SIGPIPE": else it complains when it flushes stdout at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError, ImportError, OverflowError) as fault:
        return _told(program, str(fault).removeprefix("path: "))  # the argument's name in Python
    except (MemoryError, jax.errors.JaxRuntimeError) as fault:
        if not isinstance(fault, MemoryError) and "RESOURCE_EXHAUSTED" not in str(fault):
            raise
        return _told(program, f"there is not enough memory ({fault})")
    except KeyboardInterrupt:
        remove_unfinished()
        checkpoint = getattr(options, "checkpoint", None)
        hint = f"; the same command resumes from {checkpoint}" if checkpoint and checkpoint.exists() else ""
        print(f"\n{program}: interrupted{hint}", file=sys.stderr, flush=True)
        sys.stdout.flush()
        os._exit(130)
    finally:
        end_at_once()
    return 0


ARGUMENT = re.compile(r'\b(shape|dtype|spacing|nan|time|channel)=(?:\(([\w, ]+)\)|"?(\w+)"?)')
"""Of `jv.load`, as messages quote it, such as `shape=(nx, ny, nz)`: an option of the command, too."""


def _told(program: str, fault: str) -> int:
    """Print a fault in one line, which may hold text of files. Returns the exit code."""
    fault = ARGUMENT.sub(lambda found: f"--{found[1]} {(found[2] or found[3]).replace(',', '')}", fault)
    print(f"{program}: error: {printable(' '.join(fault.split()))}", file=sys.stderr)
    return 2


def parser_of_all() -> Parser:
    """The parser of the command and its subcommands."""
    parser = Parser(
        prog="jaxvol",
        description="Direct volume rendering in JAX.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--version", action="version", version=f"%(prog)s {__version__} (jax {jax.__version__})"
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for add in COMMANDS:
        add(commands)
    return parser
