"""Options of the subcommands, of the command line or of `--like`; slow imports are where they are used."""

import argparse
import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from os.path import realpath  # unlike `Path.resolve`, it raises nothing for links in a circle
from pathlib import Path
from typing import Any, NoReturn

from ..settings import DEFAULTS, ELSEWHERE, OVERRIDES, check_exclusive


SWITCH = argparse.BooleanOptionalAction


class Parser(argparse.ArgumentParser):
    """Raises `ValueError` for errors. `add_options` adds its options when they are first asked for."""

    def __init__(self, *args: Any, add_options: Callable[["Parser"], None] | None = None, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._add_options = add_options
        self._negative_number_matcher = re.compile(r"^-(\d|\.\d)")  # argparse's own takes -1e-5 for a flag

    def parse_known_args(self, *args: Any, **kwargs: Any) -> Any:
        add, self._add_options = self._add_options, None
        if add is not None:
            add(self)
        return super().parse_known_args(*args, **kwargs)

    def error(self, message: str) -> NoReturn:
        from ..._util.texts import near
        from ...compositing.modes import MODES_ELSEWHERE

        if wrong := re.search(r"invalid choice: '(.*)' \(choose from (.*)\)", message):
            message += "." + near(
                MODES_ELSEWHERE.get(wrong[1].lower(), wrong[1]), re.split("[', ]+", wrong[2])
            )
        if wrong := re.search("unrecognized arguments: --([a-z-]+)", message):
            meant = ELSEWHERE.get(wrong[1], wrong[1])
            message += "." + near(f"--{meant}", self._option_string_actions)
        raise ValueError(f"{message} ({self.prog} --help lists the options)")

    def defaults(self) -> dict[str, Any]:
        """All options, as they are where nothing is given."""
        return {action.dest: action.default for action in self._actions if action.dest != "help"}

    def given(self, words: Sequence[str]) -> dict[str, Any]:
        """The options that words give, without defaults."""
        names = self.defaults()
        found = vars(self.parse_args(in_full(words), argparse.Namespace(**dict.fromkeys(names))))
        return {name: found[name] for name in names if found[name] is not None}


def parsed(parser: Parser, words: Sequence[str]) -> argparse.Namespace:
    """The options of a command, their `defaults`, and the function that is to `execute` it."""
    words = in_full(words)
    found = parser.parse_known_args(words)[0]
    command: Parser = found.parser
    settings = command.given(words[1:])
    if "like" in settings:
        try:
            weaker = _of_picture(command, settings["like"])
        except ValueError as fault:
            raise ValueError(f"--like: {str(fault)[:400]}") from fault
        for option in weaker.pop("further", ()):
            if option not in settings:
                told = f"the picture shows {option} of files that it may not name"
                raise ValueError(f"--like: {told}: give --{option.replace('others', 'with')}, too.")
        settings = _over(settings, weaker)
    check_exclusive(settings)
    defaults = command.defaults()
    # that not every command has: as the viewer composites and fits begin, and what a picture may hold
    options = {"compositing": "over", "preset": None, "recorded_transfer": None} | defaults | settings
    return argparse.Namespace(execute=found.execute, defaults=defaults, **options)


def in_full(words: Sequence[str]) -> list[str]:
    """Words with both numbers of `--size 512` and `640x480`, and the linear RGB of `--background white`."""
    joined = "--size=", "--background="
    words = [part for word in words for part in (word.split("=", 1) if word.startswith(joined) else [word])]
    found = [*words]
    for number, (name, value) in reversed([*enumerate(pairwise(words))]):
        if name == "--size" and (both := re.fullmatch(r"(\d+)x(\d+)", value)):
            found[number + 1 : number + 2] = both.groups()
        elif name == "--size" and not "".join(words[number + 2 : number + 3]).isdecimal():
            found.insert(number + 1, value)
        elif name == "--background" and not re.match(r"[-+.\d]", value):
            from ..._util.srgb import linear_color

            found[number + 1 : number + 2] = map(str, linear_color(name, value).tolist())
    return found


def _over(settings: dict[str, Any], weaker: dict[str, Any]) -> dict[str, Any]:
    """The settings, above weaker ones, of which they override what they exclude."""
    overridden = set().union(*(OVERRIDES.get(n, ()) for n, value in settings.items() if value is not False))
    if settings.get("compositing", "isosurface") != "isosurface":
        overridden.add("isovalue")
    return {name: value for name, value in weaker.items() if name not in overridden} | settings


def _of_picture(command: Parser, path: Path) -> dict[str, Any]:
    """The options in a picture, which anyone may have written."""
    from ..._util.checks import shortened
    from ..recorded import recorded_in

    found = recorded_in(path)
    own = [action for action in command._actions if action.type is not Path]
    known = [action for action in own if action.dest not in ("help", "others")]
    flags = {flag for action in known for flag in action.option_strings}
    words = [word for word in found["options"] if word != "--transparent" or word in flags]
    for word in words:
        if re.match(r"-[^\d.]", word) and word.partition("=")[0] not in flags:
            raise ValueError(f"{path}: {command.prog} takes no {shortened(word)} from a picture.")
    settings = command.given(["FILE", *words])  # so that another one is an error
    del settings["file"]
    if "transfer" in found:
        settings["recorded_transfer"] = found["transfer"]
    return settings | ({"further": found["further"]} if "further" in found else {})


def refuse_to_replace(options: argparse.Namespace, *names: str) -> None:
    """Refuse to write a file that is read, such as a slice of the volume, or two options to one file."""
    from ...io.formats import files_of

    read = [getattr(options, name, None) for name in ("file", "labels", "transfer")]
    read += [Path(row[0]) for row in getattr(options, "others", [])]
    used = [path for each in read if each for path in (each, *(files_of(each) if each.is_dir() else []))]
    for name in names:
        path = getattr(options, name)
        if path is not None and realpath(path) in map(realpath, used):
            raise ValueError(f"--{name}: {path} is read, or written by another option; write another.")
        used += [] if path is None else [path]


def memory_size(text: str) -> int:
    """A number of bytes, such as 1000000, 256M or 2G (powers of 1024)."""
    found = re.fullmatch(r"(\d{1,15}(?:\.\d*)?|\.\d+)([KMG]?)", text.strip().upper())
    count = int(float(found[1]) * 1024 ** " KMG".index(found[2] or " ")) if found else 0
    if count < 1:
        raise argparse.ArgumentTypeError(f"must be a number of bytes, such as 256M or 2G; got {text!r}")
    return count


def add_output(parser: Parser, default: str, help: str) -> None:
    text = f"{help} (default: %(default)s)"
    parser.add_argument("-o", "--output", type=Path, default=Path(default), help=text)


def add_quiet(parser: Parser) -> None:
    text = "do not show what is being done, on stderr, as where that is no terminal"
    parser.add_argument("-q", "--quiet", action="store_true", default=False, help=text)


def add_vector(group: Any, flag: str, names: str, help: str, **more: Any) -> None:
    """Add an option of several numbers, as many as there are names."""
    metavar = tuple(names.split())
    more = {"type": float, "nargs": len(metavar), "metavar": metavar, "help": help} | more
    group.add_argument(flag, **more)


def add_size(parser: Parser) -> None:
    text = "pixels (default: 512 512); one number: a square"
    add_vector(parser, "--size", "W H", text, type=int, default=(512, 512))


def add_volume(parser: Parser) -> None:
    """Add the volume that a command reads."""
    text = "volume: NAME_XxYxZ_TYPE.raw[.gz], .npy, .npz, and more with jaxvol[io]"
    parser.add_argument("file", type=Path, metavar="FILE", help=text)
    text = "labels of the voxels (a segmentation), each shown in a colour, and around them what is shown else"
    parser.add_argument("--labels", type=Path, metavar="FILE", help=text)
    group = parser.add_argument_group("data: needed if the file and its name do not specify it")
    add_vector(group, "--shape", "X Y Z", "voxels, x fastest in the file", type=int)
    group.add_argument("--dtype", help="such as uint8 or uint16le")
    add_vector(group, "--spacing", "X Y Z", "world length between voxels")
    text = "of voxels that are NaN or infinite in the file, such as the value of what is transparent"
    group.add_argument("--nan", type=float, metavar="VALUE", help=text)
    group.add_argument("--offset", type=int, metavar="BYTES", help="before the voxels of a raw file")
    for name in ("time", "channel"):
        group.add_argument(f"--{name}", type=int, metavar="N", help="which one, from 0, of a file of several")


def add_sampling(parser: Parser) -> None:
    """Add the step and the background of images."""
    text = "distance between samples, world length (default: half a voxel for fit; as planned for render)"
    parser.add_argument("--step", type=float, help=text)
    text = "linear RGB, or a name (default: white; black behind projections)"
    add_vector(parser, "--background", "R G B", text)


def add_clim(group: Any, default: str = "all") -> None:
    text = f"range of values of the transfer function (default: {default})"
    add_vector(group, "--clim", "LOW HIGH", text)


def add_transfer(parser: Parser) -> None:
    from ...scene.presets import PRESETS, SLICER

    group = parser.add_argument_group("transfer function (default: what the histogram suggests)")
    own = {name: text for name, (text, _, _) in PRESETS.items() if not text.startswith(SLICER)}
    presets = "; ".join(f"{name}: {text}" for name, text in own.items())
    presets += f"; of {SLICER}: {', '.join(name for name in PRESETS if name not in own)}"
    group.add_argument("--preset", metavar="NAME", help=presets.replace("%", "%%"))
    text = "a matplotlib colormap, or a colour, over --clim (default with --clim: gray; isosurfaces: white)"
    group.add_argument("--cmap", metavar="NAME", help=text)
    text = "a transfer function written by jaxvol fit"
    group.add_argument("--transfer", type=Path, metavar="JSON", help=text)
    add_clim(group, "what stands out of the background; of projections, all")
    for name, text in (("window", "width of that range, with --level"), ("level", "middle of that range")):
        group.add_argument(f"--{name}", type=float, metavar="VALUE", help=text)
    text = "length to which opacities refer (default: a voxel's size; of presets, 1 if voxels are above 0.1)"
    group.add_argument("--unit-distance", type=float, metavar="LENGTH", help=text)


def add_others(parser: Parser) -> None:
    text = (
        "one more volume in the same image, such as PET in CT; by a colormap (default: hot) over LOW and "
        "HIGH (default: what stands out); may be given several times; without shading"
    )
    how: dict[str, Any] = {"nargs": "+", "action": "append", "metavar": ("FILE", "CMAP LOW HIGH")}
    parser.add_argument("--with", "--others", dest="others", help=text, **how)


def add_scene(parser: Parser) -> None:
    """Add a volume that is looked at through a camera."""
    from ...compositing.modes import MODES

    add_volume(parser)
    add_sampling(parser)
    add_size(parser)
    add_others(parser)
    text = "a picture that jaxvol wrote: take its options"
    parser.add_argument("--like", type=Path, metavar="PNG", help=text)
    text = "read the volume in bricks, with so much memory for them, such as 256M: .raw, .npy and Zarr"
    parser.add_argument("--memory", type=memory_size, metavar="BYTES", help=text)
    text = "RMSE of linear colours, by which step and transforms are chosen (default: 1/255; not with --step)"
    parser.add_argument("--tolerance", type=float, help=text)
    add_transfer(parser)

    group = parser.add_argument_group("appearance")
    text = (
        "how samples become a pixel: over (default), by emission and absorption; maximum, minimum, average: "
        "that value of the ray, as classified; integral: an X-ray image; isosurface: where --isovalue is "
        "first crossed"
    )
    group.add_argument("--compositing", choices=(*MODES, "isosurface"), help=text)
    text = "with --compositing isosurface: the value on it"
    group.add_argument("--isovalue", type=float, metavar="VALUE", help=text)
    text = (
        "shade by the gradient of the values, under a light at the camera; by default isosurfaces, the "
        "automatic transfer function, and presets of surfaces"
    )
    group.add_argument("--shade", action=SWITCH, help=text)

    group = parser.add_argument_group("camera")
    text = "position and focal point in the world; the camera may be inside the volume"
    add_vector(group, "--camera", "X Y Z FX FY FZ", text)
    text = "without --camera: the side from which to view the whole volume (default: 0.5 -1 0.4)"
    add_vector(group, "--direction", "X Y Z", text)
    text = "what is up (default: 0 0 1; of a raw file, away from the face that its content stands on)"
    add_vector(group, "--view-up", "X Y Z", text)
    text = "degrees from the lower to the upper edge of the image (default: 30)"
    group.add_argument("--view-angle", type=float, metavar="DEGREES", help=text)
    text = "orthographic camera; with --camera, as high as its view at the focal point"
    group.add_argument("--parallel", action=SWITCH, help=text)
    text = "magnification of the image (default: 1)"
    group.add_argument("--zoom", type=float, metavar="FACTOR", help=text)

    group = parser.add_argument_group("clip: show a part of the volume; box and planes in world coordinates")
    text = "show what is inside this box"
    add_vector(group, "--clip-box", "X_MIN X_MAX Y_MIN Y_MAX Z_MIN Z_MAX", text)
    text = (
        "show what lies on the side of the plane through (X, Y, Z) to which the normal (NX, NY, NZ) points; "
        "may be given several times"
    )
    add_vector(group, "--clip-plane", "X Y Z NX NY NZ", text, action="append")
    text = "cut away what is inside the box and on that side of all planes, and show the rest"
    group.add_argument("--clip-inside-out", action=SWITCH, help=text)
    add_quiet(parser)
    parser.set_defaults(**DEFAULTS)
