"""Where do options come from? From the command line, a TOML file, and the picture that `--like` names, in
this order: what is given earlier counts."""

import argparse
import sys
import tomllib
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from ..._util.checks import shortened
from .checksum import checksum
from .recorded import Recorded, recorded_in


OF_COLORS = {"opacity", "clim", "unit_distance"}

REPLACED = {
    "preset": {"cmap", "transfer", "kept_transfer", "opacity"},
    "cmap": {"preset", "transfer", "kept_transfer"},
    "transfer": {"preset", "cmap", "kept_transfer", *OF_COLORS},
    "kept_transfer": {"preset", "cmap", "transfer", *OF_COLORS},
    "camera": {"direction", "parallel"},
    "direction": {"camera"},
    "parallel": {"camera"},
    "step": {"tolerance"},
    "tolerance": {"step"},
}
"""Options of weaker places that do not count where this one is given."""

OF_RENDER = frozenset({"turn", "orbit", "transparent"})
"""Options that, of the commands that look at a volume, only render has."""

NOT_IN_FILES = frozenset({"help", "config", "programs", "version"})


def parsed(
    make: Callable[[], argparse.ArgumentParser], arguments: Sequence[str] | None
) -> argparse.Namespace:
    """The options of a command, from all places. `make`: makes the parser.

    **Raises:** `ValueError` for a file that cannot be read, and, naming file and option, for an option that
    the command has not, or whose value is of another kind.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    if {"-h", "--help"} & set(words):  # of the parser as it is
        return make().parse_args(words)
    loose = make()
    for command in _commands(loose):
        for action in command._actions:
            _relax(action)
            # argparse would convert what says SUPPRESS for a positional argument
            action.default = argparse.SUPPRESS if action.option_strings else None
    found, unknown = loose.parse_known_args(words)
    given = {name: value for name, value in vars(found).items() if value is not None}
    if unknown:
        command = _chosen(loose, given)
        command.error(_told_unknown(command, unknown))
    settings: dict[str, Any] = {}
    parser = make()
    command = _chosen(parser, given)
    sources = []
    if given.get("like"):
        try:
            sources = [_of_picture(command, given, given["like"])]
        except ValueError as fault:
            raise ValueError(f"--like: {fault}") from fault
    sources += [_of_toml(command, given["config"])] if given.get("config") else []
    for source in sources:
        settings = _without_rivals(settings, source) | source
    settings = {name: v for name, v in _without_rivals(settings, given).items() if name not in given}
    for action in command._actions:
        if action.dest in settings:
            _relax(action)
    command.set_defaults(**settings)
    return parser.parse_args(words)


def _told_unknown(command: argparse.ArgumentParser, unknown: Sequence[str]) -> str:
    flags = [flag for action in command._actions for flag in action.option_strings]
    near = [flag for word in unknown for flag in get_close_matches(word.partition("=")[0], flags, 1)]
    hint = f". Did you mean {near[0]}?" if near else ""
    return f"unrecognized arguments: {' '.join(unknown)}{hint}"


def _without_rivals(settings: dict[str, Any], stronger: dict[str, Any]) -> dict[str, Any]:
    on = [name for name, value in stronger.items() if value is not False]
    replaced = set().union(*(REPLACED.get(name, ()) for name in on))
    if stronger.get("compositing", "isosurface") != "isosurface":
        replaced.add("isovalue")
    return {name: value for name, value in settings.items() if name not in replaced - stronger.keys()}


def _commands(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """The parsers of all commands below this one."""
    found = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                found += [command, *_commands(command)]
    return found


def _chosen(parser: argparse.ArgumentParser, given: dict[str, Any]) -> argparse.ArgumentParser:
    """The parser of the command that is given."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction) and action.dest in given:
            return _chosen(action.choices[given[action.dest]], given)
    return parser


def _relax(action: argparse.Action) -> None:
    """Let an option be left out."""
    action.required = False
    if not action.option_strings and action.nargs is None:
        action.nargs = "?"


def _of_toml(command: argparse.ArgumentParser, path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            content = tomllib.load(file)
    except OSError as fault:
        raise ValueError(f"--config: {path} cannot be read ({fault.strerror}).") from fault
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as fault:
        raise ValueError(f"--config: {path} is not TOML: {fault}.") from fault
    return _checked(command, content, str(path), NOT_IN_FILES)


def _of_picture(command: argparse.ArgumentParser, given: dict[str, Any], path: Path) -> dict[str, Any]:
    found = recorded_in(path)
    if found.command != "render":
        said = " ".join(f"--{name} {_written(value)}" for name, value in found.settings.items())
        raise ValueError(
            f"{path} was not made by jaxvol render, but, as it says, by jaxvol "
            f"{shortened(f'{found.command} {said}')}."
        )
    # a picture names no file but its volume's, whose checksum it holds
    refused = NOT_IN_FILES | {action.dest for action in command._actions if action.type is Path}
    known = {action.dest for action in command._actions}
    # what only the command render has, another leaves out
    settings = {n: v for n, v in found.settings.items() if n not in OF_RENDER or n in known}
    settings = _checked(command, settings, f"{path}: the settings in it", refused)
    if found.transfer is not None:
        settings["kept_transfer"] = found.transfer
    if "file" not in given:
        settings["file"] = _volume_of(path, found)
    return settings


def _volume_of(path: Path, found: Recorded) -> Path:
    """The volume that a picture shows, unchanged."""
    if found.file is None:
        raise ValueError(f"{path} does not say which volume it shows: name one.")
    for candidate in (Path(found.file), path.parent / Path(found.file).name):
        if candidate.exists():
            if checksum(candidate) == found.sha256:
                return candidate
            raise ValueError(
                f"{candidate} is not the volume that {path} shows: its SHA-256 differs. To render it all the "
                f"same, name it: jaxvol render {candidate} --like {path}"
            )
    raise ValueError(
        f"{path} shows the volume {shortened(found.file)}, which is not there. Name it, or another: "
        f"jaxvol render FILE --like {path}"
    )


def _written(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _checked(
    command: argparse.ArgumentParser, content: dict[str, Any], where: str, refused: frozenset[str]
) -> dict[str, Any]:
    """Values by the attribute that the parser stores them in."""
    actions = {}
    for action in command._actions:
        if action.dest not in refused and not isinstance(action, argparse._SubParsersAction):
            names = [n.removeprefix("--") for n in action.option_strings if n.startswith("--")]
            actions[names[0] if names else action.dest] = action
    found = {}
    for name, value in content.items():
        if name not in actions:
            near = get_close_matches(name, actions, 1)
            hint = f" Did you mean {near[0]}?" if near else f" There are {', '.join(sorted(actions))}."
            program = command.prog
            raise ValueError(f"{where}: {program} has no option {shortened(name)}.{hint}")
        action = actions[name]
        found[action.dest] = _converted(action, value, f"{where}: {name}")
    for group in command._mutually_exclusive_groups:
        both = [action.dest for action in group._group_actions if action.dest in found]
        if len(both) > 1:
            raise ValueError(f"{where}: one of {' and '.join(both)} excludes the other; leave one out.")
    return found


def _converted(action: argparse.Action, value: Any, where: str) -> Any:
    """The value as the parser would make it."""
    if action.nargs == 0 or isinstance(action, argparse.BooleanOptionalAction):
        return _one(bool, value, where)
    if isinstance(action, argparse._AppendAction):  # may be given several times
        if not isinstance(value, list | tuple):
            raise ValueError(f"{where} must be a list of lists; got {shortened(value)}.")
        return [_several(action, each, where) for each in value]
    return _several(action, value, where)


def _several(action: argparse.Action, value: Any, where: str) -> Any:
    kind = action.type or str
    if action.nargs in (None, "?"):
        return _allowed(action, _one(kind, value, where), where)
    many = "numbers" if kind in (int, float) else "texts"
    length = action.nargs if isinstance(action.nargs, int) else None
    if not isinstance(value, list | tuple) or (len(value) == 0 if length is None else len(value) != length):
        wanted = f"{length} {many}" if length else f"one or several {many}"
        raise ValueError(f"{where} must be a list of {wanted}; got {shortened(value)}.")
    return [_allowed(action, _one(kind, each, where), where) for each in value]


def _allowed(action: argparse.Action, one: Any, where: str) -> Any:
    """A value that is one of the option's choices, if it has such."""
    if action.choices is not None and one not in action.choices:
        raise ValueError(
            f"{where} must be one of {', '.join(map(str, action.choices))}; got {shortened(one)}."
        )
    return one


def _one(kind: Any, value: Any, where: str) -> Any:
    names = {bool: "true or false", int: "a whole number", float: "a number"}
    kinds = {bool: bool, int: int, float: (int, float)}.get(kind, str)
    numeric = kind not in (int, float, bool, str, Path)  # such as a size in bytes, a number or a text
    fits = isinstance(value, (str, int) if numeric else kinds) and (
        kind is bool or not isinstance(value, bool)
    )
    try:
        if not fits:
            raise ValueError
        return kind(str(value) if numeric else value)
    except (ValueError, OverflowError, argparse.ArgumentTypeError) as fault:
        wanted = names.get(kind, "a number of bytes, such as 256M" if numeric else "a text")
        raise ValueError(f"{where} must be {wanted}; got {shortened(value)}.") from fault
