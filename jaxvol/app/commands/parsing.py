"""Where do options come from? From the picture that `--like` names, a TOML file, and the command line: what
stands later in this order overrides what stands before."""

import argparse
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NoReturn

from ..._util.checks import shortened
from .options import ARGUMENT, Command, Option, defaults_of, memory_size
from .recorded import in_pictures, recorded_in, volume_of_picture
from .render import RENDER


OF_COLORS = {"opacity", "clim", "unit_distance"}

OVERRIDES = {
    "preset": {"cmap", "transfer", "recorded_transfer", "opacity"},
    "cmap": {"preset", "transfer", "recorded_transfer"},
    "transfer": {"preset", "cmap", "recorded_transfer", *OF_COLORS},
    "recorded_transfer": {"preset", "cmap", "transfer", *OF_COLORS},
    "camera": {"direction", "parallel"},
    "direction": {"camera"},
    "parallel": {"camera"},
    "step": {"tolerance"},
    "tolerance": {"step"},
}
"""Options that exclude this one: in one source both are an error, and a later source overrides an earlier."""

FIXED = {"compositing": "over", "recorded_transfer": None}
"""Where no option says so. `recorded_transfer`: the transfer function that a picture holds."""

KINDS: Mapping[Any, tuple[str, Any]] = {
    bool: ("true or false", bool),
    int: ("a whole number", int),
    float: ("a number", (int, float)),
    memory_size: ("a number of bytes, such as 256M", (int, str)),
}
"""What a value in a file must be: in words, and its Python types. Others are texts."""


class Parser(argparse.ArgumentParser):
    """Reports errors in one line: the usage of a command with many options would fill the screen."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"^-(\d|\.\d)")  # argparse's own takes -1e-5 for a flag

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message} ({self.prog} --help lists the options)\n")


def add_commands(parser: argparse.ArgumentParser, commands: Iterable[Command]) -> None:
    """Add subcommands to a parser."""
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in commands:
        about = f"{command.help[0].upper()}{command.help[1:]}."
        child = subparsers.add_parser(
            command.name, help=command.help, description=about, argument_default=argparse.SUPPRESS
        )
        child.set_defaults(command=command, parser=child)
        sections: dict[str, Any] = {"": child, ARGUMENT: child}
        for option in command.options:
            if option.group not in sections:
                sections[option.group] = child.add_argument_group(option.group)
            _add(sections[option.group], option)


def _add(section: Any, option: Option) -> None:
    text = option.help.replace("%", "%%")
    if option.default not in (None, False, ()):
        default = option.default if isinstance(option.default, tuple) else (option.default,)
        text += f" (default: {' '.join('yes' if each is True else str(each) for each in default)})"
    if option.type is bool:
        section.add_argument(f"--{option.name}", action=argparse.BooleanOptionalAction, help=text)
        return
    words = tuple(option.values.removesuffix("...").split())
    how: dict[str, Any] = {
        "type": option.type,
        "nargs": option.nargs,
        "metavar": words if len(words) > 1 else words[0] if words else None,
        "choices": option.choices or None,
        "help": text,
    }
    if option.group == ARGUMENT:
        # a file may give it; None, because argparse would convert its own SUPPRESS
        section.add_argument(option.key, **how | {"nargs": "?", "default": None})
    else:
        flags = ["-o"] if option.name == "output" else []
        action = "append" if option.repeated else "store"
        section.add_argument(*flags, f"--{option.name}", action=action, **how)


def parsed(parser: argparse.ArgumentParser, words: Sequence[str]) -> tuple[Command, argparse.Namespace]:
    """The command and its options, from all sources. `words`: of the command line.

    **Raises:** `ValueError` for a file that cannot be read, and, naming file and option, for an option that
    the command does not have, or whose value is of another kind. `SystemExit` for faults in the words.
    """
    found, unknown = parser.parse_known_args(words)
    given = {name: value for name, value in vars(found).items() if value is not None}
    command, child = given.pop("command"), given.pop("parser")
    if unknown:
        flags = [f"--{option.name}" for option in command.options]
        near = [flag for word in unknown for flag in get_close_matches(word.partition("=")[0], flags, 1)]
        hint = f". Did you mean {near[0]}?" if near else ""
        child.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
    sources = []
    if "like" in given:
        try:
            sources.append(_of_picture(command, given["like"], named="file" in given))
        except ValueError as fault:
            raise ValueError(f"--like: {fault}") from fault
    if "config" in given:
        sources.append(_of_toml(command, given["config"]))
    settings: dict[str, Any] = {}
    for source in (*sources, given):
        settings = _without_overridden(settings, source) | source
    _refuse_conflicts(settings)
    if missing := [o for o in command.options if o.required and o.key not in settings]:
        names = (option.name if option.group == ARGUMENT else f"--{option.name}" for option in missing)
        child.error(f"the following arguments are required: {', '.join(names)}")
    return command, argparse.Namespace(**FIXED | defaults_of(command.options) | settings)


def _without_overridden(settings: Mapping[str, Any], later: Mapping[str, Any]) -> dict[str, Any]:
    on = [name for name, value in later.items() if value is not False]
    overridden = set().union(*(OVERRIDES.get(name, ()) for name in on))
    if later.get("compositing", "isosurface") != "isosurface":
        overridden.add("isovalue")
    return {name: value for name, value in settings.items() if name not in overridden}


def _of_toml(command: Command, path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            content = tomllib.load(file)
    except OSError as fault:
        raise ValueError(f"--config: {path} cannot be read ({fault.strerror}).") from fault
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as fault:
        raise ValueError(f"--config: {path} is not TOML: {fault}.") from fault
    options = [option for option in command.options if option.key not in ("config", "programs")]
    return _checked(command.name, options, content, str(path))


def _of_picture(command: Command, path: Path, *, named: bool) -> dict[str, Any]:
    """The settings in a picture that this command has. `named`: whether the command line names the volume."""
    found = recorded_in(path)
    where = f"{path}: the settings in it"
    settings = _checked(RENDER.name, in_pictures(RENDER.options), found.settings, where)
    settings = {name: value for name, value in settings.items() if name in defaults_of(command.options)}
    if found.transfer is not None:
        settings["recorded_transfer"] = found.transfer
    if not named:
        settings["file"] = volume_of_picture(path, found)
    return settings


def _checked(
    program: str, options: Iterable[Option], content: Mapping[str, Any], where: str
) -> dict[str, Any]:
    """Values by their names in Python. What is read is data that anyone may have written."""
    by_name = {option.name: option for option in options}
    found = {}
    for name, value in content.items():
        if name not in by_name:
            near = get_close_matches(name, by_name, 1)
            hint = f"Did you mean {near[0]}?" if near else f"There are {', '.join(sorted(by_name))}."
            raise ValueError(f"{where}: jaxvol {program} has no option {shortened(name)}. {hint}")
        option = by_name[name]
        if option.repeated and not isinstance(value, list):
            raise ValueError(f"{where}: {name} must be a list of lists; got {shortened(value)}.")
        rows = value if option.repeated else [value]
        converted = [_converted(option, row, f"{where}: {name}") for row in rows]
        found[option.key] = converted if option.repeated else converted[0]
    _refuse_conflicts(found, f"{where}: ")
    return found


def _refuse_conflicts(settings: Mapping[str, Any], where: str = "") -> None:
    on = {name for name, value in settings.items() if value is not None and value is not False}
    for name in sorted(on):
        for other in sorted(on & OVERRIDES.get(name, set())):
            both = " and ".join(f"--{each.replace('_', '-')}" for each in (name, other))
            both = both.replace("--recorded-transfer", "the transfer function in the picture")
            raise ValueError(f"{where}{both} exclude each other; leave one out.")


def _converted(option: Option, value: Any, where: str) -> Any:
    """A value, or a list of them, as the command line makes it of words."""
    if option.nargs is None:
        return _one(option, value, where)
    any_number = option.nargs == "+"
    if not isinstance(value, list) or (not value if any_number else len(value) != option.nargs):
        many = "numbers" if option.type in (int, float) else "texts"
        count = "one or several" if any_number else option.nargs
        raise ValueError(f"{where} must be a list of {count} {many}; got {shortened(value)}.")
    return [_one(option, each, where) for each in value]


def _one(option: Option, value: Any, where: str) -> Any:
    wanted, kinds = KINDS.get(option.type, ("a text", str))
    fits = isinstance(value, kinds) and isinstance(value, bool) == (option.type is bool)
    try:
        found = option.type(value) if fits else None
    except (ValueError, OverflowError, argparse.ArgumentTypeError):
        found = None
    if found is None:
        raise ValueError(f"{where} must be {wanted}; got {shortened(value)}.")
    if option.choices and found not in option.choices:
        raise ValueError(f"{where} must be one of {', '.join(option.choices)}; got {shortened(value)}.")
    return found
