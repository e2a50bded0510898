"""Entry point of the command `jaxvol`: its subcommands, errors in one line, an immediate end on Ctrl-C."""

import argparse
import os
import re
import sys
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from typing import Any

from .._util.interruption import end_at_once, raise_again
from .._util.version import __version__, version_of
from .._util.whole_files import remove_unfinished
from .commands.options import Parser, parsed


COMMANDS = {
    "demo": ("pages", "make a page of a shaded head, wood grain before and after, and a fit by gradients"),
    "render": ("render", "render a volume file to an image"),
    "animate": ("animate", "render a volume file from a camera that turns about it"),
    "plan": ("render", "show the cheapest way to render a volume file within a tolerance, and why"),
    "fit": ("fit", "fit a transfer function to images of a volume"),
    "figures": ("pages", "make a page of the figures and tables of the source papers, from recorded results"),
    "warm": ("warm", "compile the programs of usual pictures, and keep them, so that these take less time"),
    "info": ("volumes", "print shape, type, place and values of a volume file, as jaxvol loads it"),
    "datasets": ("volumes", "list the Open SciVis volumes; or print the path of one, downloaded if need be"),
    "view": ("volumes", "look at a volume file in the browser of this machine; Ctrl-C ends it"),
}
"""Commands by name: the module in `commands/` with `add_NAME` (options) and `run_NAME`, and the help text."""

EXAMPLES = """\
examples:
  jaxvol demo
  FILE=$(jaxvol datasets fetch engine)
  jaxvol info "$FILE"
  jaxvol render "$FILE"
  jaxvol render "$FILE" --preset engine --direction -0.7 -1 0.25 -o engine.png
  jaxvol render "$FILE" --like engine.png --size 1024 1024 -o large.png
  jaxvol animate "$FILE" --preset engine --frames 48 -o engine.gif
  jaxvol fit "$FILE" --images a.png b.png --cameras cameras.json -o transfer.json
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, by default `sys.argv`, and return the exit code: 0; 2 for bad input, reported in
    one line; 1 if stdout was closed. Ctrl-C removes unfinished files and ends the process at once with code
    130, as in shells, since XLA does not stop for a signal."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    program = " ".join(["jaxvol", *words[:1]])
    options = argparse.Namespace()
    try:
        raise_again()
        options = parsed(parser_of_all(), words or ["--help"])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = lambda message, *_: print(f"{program}: {message}", file=sys.stderr)
            # the main thread gets the signals, and can handle them while it waits, also if XLA is busy
            ThreadPoolExecutor(1).submit(options.execute, options).result()
        sys.stdout.flush()
    except BrokenPipeError:
        # Python's documentation, "Note on SIGPIPE": else it complains when it flushes stdout at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError, ImportError, OverflowError) as fault:
        return _report(program, str(fault).removeprefix("path: "))  # the argument's name in Python
    except (MemoryError, RuntimeError) as fault:
        if not isinstance(fault, MemoryError) and "RESOURCE_EXHAUSTED" not in str(fault):
            raise
        return _report(program, f"there is not enough memory ({fault})")
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
"""Arguments of `jv.load` in messages, such as `shape=(nx, ny, nz)`, which are options of the command."""


def _report(program: str, fault: str) -> int:
    """Print an error, which may quote a file, in one line, and return the exit code."""
    from .._util.checks import printable  # here: takes long to import

    fault = ARGUMENT.sub(lambda match: f"--{match[1]} {(match[2] or match[3]).replace(',', '')}", fault)
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
    version = f"%(prog)s {__version__} (jax {version_of('jax')})"
    parser.add_argument("--version", action="version", version=version)
    commands: Any = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, (module, text) in COMMANDS.items():
        texts = {"help": text, "description": f"{text[0].upper()}{text[1:]}."}
        command = commands.add_parser(name, add_options=partial(_add_options, module, name), **texts)
        command.set_defaults(parser=command)
    return parser


def _add_options(module: str, name: str, parser: Parser) -> None:
    """Add the options of a command, and the function to execute."""
    commands = import_module(f"{__package__}.commands.{module}")
    getattr(commands, f"add_{name}")(parser)
    parser.set_defaults(execute=getattr(commands, f"run_{name}"))
