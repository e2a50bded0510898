"""Records results again, one after the other, each in full and in a process of its own.

`python -m experiments.again` records all, which takes some four hours on two cores; `--only speed shading`
some; `--list` prints how long each took when it was recorded, and of which commit it is. Run it on a machine
that does nothing else: most results are times. A result replaces the old one when it is there as a whole, so
that Ctrl-C loses one of them. All records are of one engine if its code is not changed meanwhile: `--list`
names those for which it was (`changes.py`). What was recorded on a GPU is left alone where there is none.
"""

import os
import shlex
import subprocess
import sys
from argparse import Namespace
from pathlib import Path
from tempfile import TemporaryDirectory

import jax

from . import common, record
from .changes import changed_since
from .command import command


ARGUMENTS = {
    "accuracy": "accuracy --repetitions 3",
    "bricks": "bricks --size 40 --repetitions 3",
    "compare": "compare 77f9c25 HEAD --kinds image gradient",
    "fit_transfer": "fit_transfer --size 64 --resolution 64",
    "gradient_agreement": "gradient_agreement --only 'head phantom' tooth engine lidc0314_airway aneurism"
    " --methods none hierarchy min_distance",
    "gradient_agreement_gpu": "gradient_agreement --only 'head phantom' tooth engine --methods none hierarchy"
    " distance",
    "jitter_accuracy": "jitter_accuracy --repetitions 7",
    "overhead": "overhead --sizes 512",
    "planning": "planning --scenes 100",
    "planning_seed_1": "planning --scenes 40 --every 4 --seed 1",
    "scan_conversion": "scan_conversion --size 256 --repetitions 3",
    "shading": "shading --repetitions 25",
    "speed": "speed --gradients --sizes 512 --repetitions 7",
    "speed_gpu": "speed --gradients --sizes 1024 --resolution 512 --steps 2 --processes 2 --only"
    " 'head phantom' engine bonsai aneurism",
}
"""What records are made by, where it is not the experiment of their name without options."""

ON_GPU = ("gradient_agreement_gpu", "speed_gpu")
"""Those that are of a GPU."""

NAMES = sorted(file.stem for file in record.RESULTS.glob("*.json"))


def recorded(name: str, folder: Path) -> None:
    """Measures a result and puts its files into the folder: the record, charts and pages of its name, and
    the pictures that pages show.

    **Raises** `subprocess.CalledProcessError` if the experiment fails; the folder is then as it was."""
    experiment, *options = shlex.split(ARGUMENTS.get(name, name))
    with TemporaryDirectory(dir=folder) as new:  # so that files are moved at once
        module = f"experiments.{experiment}"
        subprocess.run([sys.executable, "-m", module, *options, "--output", new], check=True)
        pictures = Path(new).glob("*/**/*.webp")  # what else is in folders serves to go on after Ctrl-C
        for file in sorted({*pictures, *(each for each in Path(new).iterdir() if each.is_file())}):
            place = folder / file.relative_to(new).parent
            place.mkdir(parents=True, exist_ok=True)
            os.replace(file, place / file.name.replace(experiment, name, 1))


def told(name: str, folder: Path) -> str:
    """What a record says of how it was made."""
    found = record.read(folder / f"{name}.json")
    seconds = found.get("seconds")
    took = "" if seconds is None else f"{seconds / 60:.1f} min"
    changed = "  (code was changed since)" if changed_since(found["commit"], name) else ""
    return f"{name:20} {took:>10}  {found['commit'] or ''}{changed}"


@command(
    __doc__,
    record.RESULTS,
    only=common.some_of(NAMES, "NAME"),
    list={"action": "store_true", "help": "print how long each took, and measure nothing"},
)
def main(chosen: Namespace) -> None:
    if chosen.list:
        print("\n".join(told(name, chosen.output) for name in chosen.only))
        return
    # this process must leave the memory of a GPU to those that it starts
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    platform = jax.default_backend()
    for name in chosen.only:
        if (platform == "gpu") == (name in ON_GPU):
            recorded(name, chosen.output)
            print(told(name, chosen.output), flush=True)
        else:
            print(f"{name:20} left alone: it is not recorded on a {platform}", flush=True)


if __name__ == "__main__":
    main()
