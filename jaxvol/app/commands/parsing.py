"""Where do options come from? From the picture that `--like` names, a TOML file, and the command line: what
stands later in this order overrides what stands before."""

import argparse
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from ..._util.checks import shortened
from .recorded import recorded_in, volume_of_picture


OVERRIDES = {
    "preset": {"cmap", "transfer", "recorded_transfer"},
    "cmap": {"preset", "transfer", "recorded_transfer"},
    "transfer": {"preset", "cmap", "recorded_transfer", "clim", "unit_distance"},
    "recorded_transfer": {"preset", "cmap", "transfer", "clim", "unit_distance"},
    "camera": {"direction", "parallel"},
    "direction": {"camera"},
    "parallel": {"camera"},
    "step": {"tolerance"},
    "tolerance": {"step"},
}
"""Options that exclude this one: in one source both are an error, and a later source overrides an earlier."""

FIXED = {"compositing": "over", "recorded_transfer": None}
"""Where no option says so. `recorded_transfer`: the transfer function that a picture holds."""


class Parser(argparse.ArgumentParser):
    """Raises `ValueError` for errors."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"^-(\d|\.\d)")  # argparse's own takes -1e-5 for a flag

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message} ({self.prog} --help lists the options)")

    def defaults(self) -> dict[str, Any]:
        """All options, as they are where nothing is given."""
        return {action.dest: action.default for action in self._actions if action.dest != "help"}

    def given(self, words: Sequence[str]) -> dict[str, Any]:
        """The options that words give, without defaults."""
        names = self.defaults()
        found = vars(self.parse_args(words, argparse.Namespace(**dict.fromkeys(names))))
        return {name: found[name] for name in names if found[name] is not None}


def parsed(parser: Parser, words: Sequence[str]) -> argparse.Namespace:
    """The options of a command, from all sources, their `defaults`, and the function that is to `execute` it.

    **Raises:** `ValueError` for a file that cannot be read, and for an option that the command does not have,
    or whose value is of another kind, naming the file if it is from one."""
    found = parser.parse_known_args(words)[0]
    command: Parser = found.parser
    given = command.given(words[1:])
    sources = [given]
    if "config" in given:
        sources.insert(0, _of_toml(command, given["config"]))
    if "like" in given:
        try:
            sources.insert(0, _of_picture(command, given["like"], named="file" in given))
        except ValueError as fault:
            raise ValueError(f"--like: {fault}") from fault
    settings: dict[str, Any] = {}
    for source in sources:
        settings = _without_overridden(settings, source) | source
    _refuse_conflicts(settings)
    defaults = command.defaults()
    options = FIXED | defaults | settings
    needed = ("file", "images", "cameras")
    if missing := [name for name in needed if options.get(name, "") is None]:
        command.error(f"the following arguments are required: {', '.join(missing)}")
    return argparse.Namespace(execute=found.execute, defaults=defaults, **options)


def _of_toml(command: Parser, path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            content = tomllib.load(file)
    except OSError as fault:
        raise ValueError(f"--config: {path} cannot be read ({fault.strerror}).") from fault
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as fault:
        raise ValueError(f"--config: {path} is not TOML: {fault}.") from fault
    file = content.pop("file", None)
    if not isinstance(file, str | None):
        raise ValueError(f"{path}: file must be a text; got {shortened(file)}.")
    return _checked(command, content, path) | ({"file": Path(file)} if file else {})


def _of_picture(command: Parser, path: Path, *, named: bool) -> dict[str, Any]:
    """The settings in a picture. `named`: whether the command line names the volume."""
    found = recorded_in(path)
    settings = found["settings"]
    if "transparent" not in command.defaults():
        settings.pop("transparent", None)
    files = {action.dest.replace("_", "-") for action in command._actions if action.type is Path}
    if files & settings.keys():
        raise ValueError(f"{path}: a picture names no file but its volume; got {shortened(settings)}.")
    settings = _checked(command, settings, path)
    if "transfer" in found:
        settings["recorded_transfer"] = found["transfer"]
    if not named:
        settings["file"] = volume_of_picture(path, found["file"]["name"], found["file"]["sha256"])
    return settings


def _checked(command: Parser, settings: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Settings that a file holds, as the command line makes them of words. Anyone may have written them."""
    names = {name.replace("_", "-") for name in command.defaults()} - {"file", "config", "like"}
    words: list[str] = []
    for name, value in settings.items():
        if name not in names:
            raise ValueError(f"{path}: {command.prog} has no option {shortened(name)}.")
        if isinstance(value, bool):
            words.append(f"--{name}" if value else f"--no-{name}")
        elif isinstance(value, list):
            nested = bool(value) and all(isinstance(row, list) for row in value)
            for row in value if nested else [value]:
                texts = [str(each) for each in row]
                if any(re.match(r"-[^\d.]", text) for text in texts):  # would be a flag
                    raise ValueError(f"{path}: {name} must not hold {shortened(row)}.")
                words += [f"--{name}", *texts]
        else:
            words.append(f"--{name}={value}")
    try:
        found = command.given(words)
        if "file" in found:
            command.error(f"too many values: {found['file']}")
        _refuse_conflicts(found)
    except ValueError as fault:
        raise ValueError(f"{path}: {str(fault)[:300]}") from fault
    return found


def _without_overridden(settings: Mapping[str, Any], later: Mapping[str, Any]) -> dict[str, Any]:
    on = [name for name, value in later.items() if value is not False]
    overridden = set().union(*(OVERRIDES.get(name, ()) for name in on))
    if later.get("compositing", "isosurface") != "isosurface":
        overridden.add("isovalue")
    return {name: value for name, value in settings.items() if name not in overridden}


def _refuse_conflicts(settings: Mapping[str, Any]) -> None:
    on = {name for name, value in settings.items() if value is not False}
    for name in sorted(on):
        for other in sorted(on & OVERRIDES.get(name, set())):
            both = " and ".join(f"--{each.replace('_', '-')}" for each in (name, other))
            both = both.replace("--recorded-transfer", "the transfer function in the picture")
            raise ValueError(f"{both} exclude each other; leave one out.")
