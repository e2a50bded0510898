"""Parser of the subcommands, and their shared options. Slow imports are inside functions."""

import argparse
import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from os.path import realpath  # unlike `Path.resolve`, it raises nothing for links in a circle
from pathlib import Path
from typing import Any, NoReturn

from ..settings import ALIASES, DEFAULTS, OVERRIDES, check_exclusive


SWITCH = argparse.BooleanOptionalAction


class Parser(argparse.ArgumentParser):
    """A parser that raises `ValueError`. `add_options(parser)` is called before the first use."""

    def __init__(self, *args: Any, add_options: Callable[["Parser"], None] | None = None, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._add_options = add_options
        self._negative_number_matcher = re.compile(r"^-(\d|\.\d)")  # argparse takes -1e-5 for a flag

    def parse_known_args(self, *args: Any, **kwargs: Any) -> Any:
        add, self._add_options = self._add_options, None
        if add is not None:
            add(self)
        return super().parse_known_args(*args, **kwargs)

    def error(self, message: str) -> NoReturn:
        from ..._util.texts import near
        from ...compositing.modes import MODES_ELSEWHERE

        if wrong := re.search(r"invalid choice: '(.*)' \(choose from (.*)\)", message):
            choices = re.split("[', ]+", wrong[2])
            message += "." + near(MODES_ELSEWHERE.get(wrong[1].lower(), wrong[1]), choices)
        if wrong := re.search("unrecognized arguments: --([a-z-]+)", message):
            option = ALIASES.get(wrong[1], wrong[1])
            message += "." + near(f"--{option}", self._option_string_actions)
        raise ValueError(f"{message} ({self.prog} --help lists the options)")

    def defaults(self) -> dict[str, Any]:
        """Default values of all options."""
        return {action.dest: action.default for action in self._actions if action.dest != "help"}

    def options_in(self, words: Sequence[str]) -> dict[str, Any]:
        """The options set by command-line words, without defaults."""
        names = self.defaults()
        values = vars(self.parse_args(in_full(words), argparse.Namespace(**dict.fromkeys(names))))
        return {name: values[name] for name in names if values[name] is not None}


def parsed(parser: Parser, words: Sequence[str]) -> argparse.Namespace:
    """The options of a command, their `defaults`, and the function to `execute`."""
    words = in_full(words)
    namespace = parser.parse_known_args(words)[0]
    command: Parser = namespace.parser
    settings = command.options_in(words[1:])
    if "like" in settings:
        try:
            weaker = _of_picture(command, settings["like"])
        except ValueError as fault:
            raise ValueError(f"--like: {str(fault)[:400]}") from fault
        for option in weaker.pop("further", ()):
            if option not in settings:
                flag = option.replace("others", "with")
                raise ValueError(
                    f"--like: the picture shows {option}, but names no files: give --{flag}, too."
                )
        settings = _over(settings, weaker)
    check_exclusive(settings)
    defaults = command.defaults()
    # defaults of commands without these options
    options = {"compositing": "over", "preset": None, "recorded_transfer": None} | defaults | settings
    return argparse.Namespace(execute=namespace.execute, defaults=defaults, **options)


def in_full(words: Sequence[str]) -> list[str]:
    """Command-line words with `--size 512` and `640x480` as two numbers, and colour names as linear RGB."""
    joined = "--size=", "--background="
    words = [part for word in words for part in (word.split("=", 1) if word.startswith(joined) else [word])]
    expanded = [*words]
    for number, (name, value) in reversed([*enumerate(pairwise(words))]):
        if name == "--size" and (match := re.fullmatch(r"(\d+)x(\d+)", value)):
            expanded[number + 1 : number + 2] = match.groups()
        elif name == "--size" and not "".join(words[number + 2 : number + 3]).isdecimal():
            expanded.insert(number + 1, value)
        elif name == "--background" and not re.match(r"[-+.\d]", value):
            from ..._util.srgb import linear_color

            expanded[number + 1 : number + 2] = map(str, linear_color(name, value).tolist())
    return expanded


def _over(settings: dict[str, Any], weaker: dict[str, Any]) -> dict[str, Any]:
    """The settings, and the weaker ones that they do not exclude."""
    overridden = set().union(*(OVERRIDES.get(n, ()) for n, value in settings.items() if value is not False))
    if settings.get("compositing", "isosurface") != "isosurface":
        overridden.add("isovalue")
    return {name: value for name, value in weaker.items() if name not in overridden} | settings


def _of_picture(command: Parser, path: Path) -> dict[str, Any]:
    """The options in a picture, which are untrusted."""
    from ..._util.checks import shortened
    from ..recorded import recorded_in

    record = recorded_in(path)
    actions = [action for action in command._actions if action.type is not Path]
    actions = [action for action in actions if action.dest not in ("help", "others")]
    flags = {flag for action in actions for flag in action.option_strings}
    words = [word for word in record["options"] if word != "--transparent" or word in flags]
    for word in words:
        if re.match(r"-[^\d.]", word) and word.partition("=")[0] not in flags:
            raise ValueError(f"{path}: {command.prog} takes no {shortened(word)} from a picture.")
    settings = command.options_in(["FILE", *words])  # a second file in the picture is an error
    del settings["file"]
    if "transfer" in record:
        settings["recorded_transfer"] = record["transfer"]
    return settings | ({"further": record["further"]} if "further" in record else {})


def refuse_to_replace(options: argparse.Namespace, *names: str) -> None:
    """Refuse to write a file that is read, such as a slice of the volume, or the file of another option."""
    from ...io.formats.dicom import dicom_files
    from ...io.formats.tiff import slice_files

    read = [getattr(options, name, None) for name in ("file", "labels", "transfer")]
    read += [Path(row[0]) for row in getattr(options, "others", [])]
    used = [path for path in read if path]
    for folder in filter(Path.is_dir, used[:]):
        used += dicom_files(folder) or slice_files(folder)
    for name in names:
        path = getattr(options, name)
        if path is not None and realpath(path) in map(realpath, used):
            raise ValueError(f"--{name}: {path} is read, or written by another option; write another.")
        used += [] if path is None else [path]


def add_option(group: argparse._ActionsContainer, flag: str, names: str, help: str, **kwargs: Any) -> None:
    """Add an option with a value for each of the names, by default numbers."""
    metavar = tuple(names.split())
    form: dict[str, Any] = {"nargs": len(metavar), "metavar": metavar} if metavar[1:] else {"metavar": names}
    group.add_argument(flag, **{"type": float, "help": help} | form | kwargs)


def add_output(parser: Parser, default: str, help: str) -> None:
    text = f"{help} (default: %(default)s)"
    parser.add_argument("-o", "--output", type=Path, default=Path(default), help=text)


def add_quiet(parser: Parser) -> None:
    text = "show no progress on stderr, as where that is no terminal"
    parser.add_argument("-q", "--quiet", action="store_true", default=False, help=text)


def add_size(parser: Parser) -> None:
    text = "pixels (default: 512 512); one number: a square"
    add_option(parser, "--size", "W H", text, type=int, default=(512, 512))


def add_volume(parser: Parser) -> None:
    """Add the volume that a command reads."""
    text = "volume: NAME_XxYxZ_TYPE.raw[.gz], .npy, .npz, and more with jaxvol[io]"
    parser.add_argument("file", type=Path, metavar="FILE", help=text)
    text = "labels of the voxels (a segmentation), each shown in a colour; elsewhere the volume is shown"
    add_option(parser, "--labels", "FILE", text, type=Path)
    group = parser.add_argument_group("data: needed if the file and its name do not specify it")
    add_option(group, "--shape", "X Y Z", "voxels, x fastest in the file", type=int)
    group.add_argument("--dtype", help="such as uint8 or uint16le")
    add_option(group, "--spacing", "X Y Z", "world length between voxels")
    add_option(group, "--nan", "VALUE", "value of NaN and infinite voxels, such as a transparent one")
    add_option(group, "--offset", "BYTES", "before the voxels of a raw file", type=int)
    for name in ("time", "channel"):
        add_option(group, f"--{name}", "N", "number, from 0, in a file of several", type=int)


def add_sampling(parser: Parser) -> None:
    """Add the step and the background of images."""
    text = "distance between samples, world length (default: half a voxel for fit; as planned for render)"
    add_option(parser, "--step", "STEP", text)
    text = "linear RGB, or a name (default: white; black behind projections)"
    add_option(parser, "--background", "R G B", text)


def add_clim(group: argparse._ActionsContainer, default: str = "all") -> None:
    text = f"range of values of the transfer function (default: {default})"
    add_option(group, "--clim", "LOW HIGH", text)


def add_transfer(parser: Parser) -> None:
    from ...scene.presets import PRESETS, SLICER

    group = parser.add_argument_group("transfer function (default: from the histogram)")
    texts = {name: text for name, (text, _, _) in PRESETS.items() if not text.startswith(SLICER)}
    presets = "; ".join(f"{name}: {text}" for name, text in texts.items())
    presets += f"; of {SLICER}: {', '.join(name for name in PRESETS if name not in texts)}"
    group.add_argument("--preset", metavar="NAME", help=presets.replace("%", "%%"))
    text = "a matplotlib colormap, or a colour, over --clim (default with --clim: gray; isosurfaces: white)"
    group.add_argument("--cmap", metavar="NAME", help=text)
    add_option(group, "--transfer", "JSON", "a transfer function written by jaxvol fit", type=Path)
    add_clim(group, "what stands out of the background; of projections, all")
    add_option(group, "--window", "VALUE", "width of that range, with --level")
    add_option(group, "--level", "VALUE", "middle of that range")
    text = "length to which opacities refer (default: a voxel's size; of presets, 1 if voxels are above 0.1)"
    add_option(group, "--unit-distance", "LENGTH", text)


def add_others(parser: Parser) -> None:
    text = "add a volume, such as PET in CT, unshaded; by default hot, over what stands out; may be repeated"
    kwargs: dict[str, Any] = {"nargs": "+", "action": "append", "metavar": ("FILE", "CMAP LOW HIGH")}
    parser.add_argument("--with", "--others", dest="others", help=text, **kwargs)


def add_scene(parser: Parser) -> None:
    """Add a volume, a camera, and the look of an image."""
    from ...compositing.modes import MODES

    add_volume(parser)
    add_sampling(parser)
    add_size(parser)
    add_others(parser)
    add_option(parser, "--like", "PNG", "a picture that jaxvol wrote: take its options", type=Path)
    text = "RMSE of linear colours, for the choice of step and transforms (default: 1/255; not with --step)"
    add_option(parser, "--tolerance", "TOLERANCE", text)
    add_transfer(parser)

    group = parser.add_argument_group("appearance")
    text = "over (default); maximum, minimum, average of the ray; integral (X-rays); isosurface (--isovalue)"
    group.add_argument("--compositing", choices=(*MODES, "isosurface"), help=text)
    add_option(group, "--isovalue", "VALUE", "with --compositing isosurface: the value on it")
    text = "shade by gradients, lit from the camera (default: isosurfaces, surface presets, automatic look)"
    group.add_argument("--shade", action=SWITCH, help=text)

    group = parser.add_argument_group("camera")
    text = "position and focal point in the world; the camera may be inside the volume"
    add_option(group, "--camera", "X Y Z FX FY FZ", text)
    text = "without --camera: the side from which to view the whole volume (default: 0.5 -1 0.4)"
    add_option(group, "--direction", "X Y Z", text)
    text = "what is up (default: 0 0 1; of a raw file, away from the face that its content stands on)"
    add_option(group, "--view-up", "X Y Z", text)
    text = "degrees from the lower to the upper edge of the image (default: 30)"
    add_option(group, "--view-angle", "DEGREES", text)
    text = "orthographic camera; with --camera, as high as its view at the focal point"
    group.add_argument("--parallel", action=SWITCH, help=text)
    add_option(group, "--zoom", "FACTOR", "magnification of the image (default: 1)")

    group = parser.add_argument_group("clip: show a part of the volume; box and planes in world coordinates")
    add_option(group, "--clip-box", "X_MIN X_MAX Y_MIN Y_MAX Z_MIN Z_MAX", "show what is inside this box")
    text = "show the side of the plane through (X, Y, Z) to which (NX, NY, NZ) points; may be repeated"
    add_option(group, "--clip-plane", "X Y Z NX NY NZ", text, action="append")
    text = "cut away what is inside the box and on that side of all planes, and show the rest"
    group.add_argument("--clip-inside-out", action=SWITCH, help=text)
    add_quiet(parser)
    parser.set_defaults(**DEFAULTS)
