"""What does the command `jaxvol` do? It puts its subcommands together, reports faults in one line, and ends
at once when it is interrupted."""

import argparse
import os
import sys
import threading
from collections.abc import Sequence
from typing import NoReturn

import jax

from .._util.whole_files import remove_unfinished
from ..xla.persistent_cache import SHORTEST
from .commands.animate import add_animate
from .commands.datasets import add_datasets
from .commands.demo import add_demo
from .commands.fit import add_fit
from .commands.info import add_info
from .commands.options import shared_options
from .commands.plan import add_plan
from .commands.recorded import own_version
from .commands.render import add_render
from .commands.settings import parsed
from .commands.view import add_view
from .figures import add_figures


EXAMPLES = """\
examples:
  jaxvol demo
  jaxvol datasets list
  FILE=$(jaxvol datasets fetch engine)
  jaxvol info "$FILE"
  jaxvol render "$FILE"
  jaxvol render "$FILE" --preset engine -o engine.png
  jaxvol render --like engine.png --size 1024 1024 -o large.png
  jaxvol animate "$FILE" --preset engine --frames 48 -o engine.gif
  jaxvol render head_256x256x113_uint16le.raw.gz --spacing 1 1 2 --preset ct_skin_bone --clim 0 4000 \\
      --direction -0.7 -1 0.25 --view-up 0 0 -1 -o head.png
  jaxvol render "$FILE" --preset engine --clip-plane 128 128 64 1 -1 0 -o half.png
  jaxvol render "$FILE" --cmap gray --compositing maximum -o mip.png
  jaxvol render "$FILE" --preset engine --compositing isosurface --isovalue 170
  jaxvol render large.npy --memory 512M --config settings.toml
  jaxvol plan "$FILE" --preset engine --tolerance 0.001
  jaxvol render chest.npy --preset ct_airway --camera 99 64 165 96 78 140 --view-angle 90 -o inside.png
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
    command = next((word for word in (sys.argv[1:] if arguments is None else arguments)), "")
    options = argparse.Namespace()
    try:
        options = parsed(_parser, arguments)
        jax.config.update("jax_compilation_cache_dir", str(options.programs))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST)
        _run_in_thread(options)
        sys.stdout.flush()
    except BrokenPipeError:
        # Python's documentation, "Note on SIGPIPE": else it complains when it flushes stdout at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError, ImportError) as fault:
        text = " ".join(str(fault).split()).removeprefix("path: ")  # the argument's name in Python
        print(f"jaxvol {command}: error: {text}", file=sys.stderr)
        return 2
    except (MemoryError, jax.errors.JaxRuntimeError) as fault:
        if not isinstance(fault, MemoryError) and "RESOURCE_EXHAUSTED" not in str(fault):
            raise
        print(f"jaxvol {command}: error: there is not enough memory ({fault})", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        remove_unfinished()
        checkpoint = getattr(options, "checkpoint", None)
        hint = f"; the same command resumes from {checkpoint}" if checkpoint and checkpoint.exists() else ""
        print(f"\njaxvol {command}: interrupted{hint}", file=sys.stderr, flush=True)
        sys.stdout.flush()
        os._exit(INTERRUPTED)
    return 0


def _run_in_thread(options: argparse.Namespace) -> None:
    """Run a command in a thread of its own. Python delivers signals to the main thread, which only waits and
    so can handle them while XLA is busy."""
    faults: list[BaseException] = []

    def run() -> None:
        try:
            options.run(options)
        except BaseException as fault:
            faults.append(fault)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join()
    if faults:
        raise faults[0]


class _Parser(argparse.ArgumentParser):
    """Of the command and of its subcommands. A fault in the arguments is told in one line, as others are: the
    usage of commands with many options would push it off the screen."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message} ({self.prog} --help lists the options)\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="jaxvol",
        description="Direct volume rendering in JAX.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    version = f"%(prog)s {own_version()} (jax {jax.__version__})"
    parser.add_argument("--version", action="version", version=version)
    shared = shared_options()
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    add_demo(commands, shared)
    add_render(commands, shared, EXAMPLES)
    add_animate(commands, shared)
    add_plan(commands, shared)
    add_fit(commands, shared)
    add_figures(commands, shared)
    add_info(commands, shared)
    add_datasets(commands, shared)
    add_view(commands, shared)
    return parser
