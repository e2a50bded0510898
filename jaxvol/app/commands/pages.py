"""`jaxvol demo`: a page of the toolkit's features, with the functions below that draw its pictures. `jaxvol
figures`: a page of the papers' figures, from scripts and records in a checkout of the repository."""

import argparse
import html
import importlib
import inspect
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from .options import SWITCH, Parser, add_output, add_quiet, add_size


def head(folder: Path, size: tuple[int, int], resolution: int) -> None:
    """A shaded volume: a phantom of a head, the skull under translucent skin and muscle, shaded by the
    gradient of the values."""
    import numpy as np
    from scipy.ndimage import gaussian_filter

    import jaxvol as jv

    phantom = jv.phantom("head", resolution)
    smooth = gaussian_filter(128 * np.asarray(phantom.data, np.float32), 1.5)
    volume = jv.Volume(np.round(smooth).astype(np.uint16), phantom.spacing, phantom.origin)
    fast = (jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination())
    rendering = jv.render(
        volume,
        jv.preset("head", (0, 128 * 255), unit_distance=0.01),
        jv.Camera.looking_at(volume, (0.65, -1, 0.15), size=size).zoom(1.65),
        jv.March(float(volume.spacing[0]) / 3, fast, "preintegrated"),
        lighting=jv.lighting.Phong(),
    )
    jv.save_png(folder / "head.png", rendering.image(background=(1, 1, 1)))


def grain(folder: Path, size: tuple[int, int], resolution: int) -> None:
    """Wood grain, before and after: a translucent cube at far too long a step. Each ray's last cell reaches
    past the cube by another fraction of a step, which shows as terraces. AlphaCorrection cuts that cell where
    the ray leaves the cube, and makes the same step exact there; nothing else is changed."""
    import numpy as np

    import jaxvol as jv

    ramp = jv.phantom("linear", 64)
    cube = jv.Volume((255 * np.asarray(ramp.data)).astype(np.uint8), ramp.spacing, ramp.origin)
    transfer = jv.TransferFunction.from_points([(0, (0.9, 0.35, 0.1), 0.45), (255, (0.15, 0.35, 0.9), 0.45)])
    camera = jv.Camera.looking_at(cube, (-0.6, 0.5, -1), (0, 1, 0), size=size).zoom(1.05)
    for name, transforms in (("before", ()), ("after", (jv.AlphaCorrection(),))):
        march = jv.March(0.25, (jv.SpaceLeaping(), *transforms))
        rendering = jv.render(cube, transfer, camera, march)
        jv.save_png(folder / f"{name}.png", rendering.image(background=(0, 0, 0)))


def fit(folder: Path, size: tuple[int, int], resolution: int) -> None:
    """A fit by gradients, in seconds: two images of an engine, of 48 x 48 pixels, determine their transfer
    function. The Levenberg-Marquardt method starts from flat grey and uses derivatives of the renderer. The
    view below is none of the two: at the start, fitted, and true."""
    import warnings

    import jaxvol as jv

    engine = jv.phantom("engine", 48)
    true = jv.preset("engine", unit_distance=0.04)
    fast = (jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination())
    march = jv.March(float(engine.spacing[0]) / 2, fast, "midpoint")
    sides = (0.5, -1, 0.4), (-1, -0.3, 0.5)
    cameras = [jv.Camera.looking_at(engine, side, size=(48, 48)).zoom(1.4) for side in sides]
    views = [(c, jv.render(engine, true, c, march).image(background=(1, 1, 1))) for c in cameras]
    residual = jv.ImageResidual(lambda transfer, camera: (engine, transfer, camera, march), views)
    grey = jv.flat_grey(engine, points=8)
    with warnings.catch_warnings(action="ignore"):  # of colours that are nowhere visible
        fitted = jv.fit(residual, grey, max_steps=12)
    new_view = jv.Camera.looking_at(engine, (0.8, 0.9, 0.7), size=size).zoom(1.4)
    for name, transfer in (("start", grey), ("found", fitted.parameters), ("true", true)):
        image = jv.render(engine, transfer, new_view, march).image(background=(1, 1, 1))
        jv.save_png(folder / f"fit_{name}.png", image)


PICTURES = {head: ("head",), grain: ("before", "after"), fit: ("fit_start", "fit_found", "fit_true")}


def run_demo(options: argparse.Namespace) -> None:
    from ..._util.checks import output_file
    from ..._util.progress import progress
    from ...xla.persistent_cache import keep_programs_by_default

    keep_programs_by_default()
    page = '<!doctype html><meta charset="utf-8"><title>jaxvol demo</title>'
    output_file("--output", options.output / "index.html")
    with TemporaryDirectory() as name:  # after an error nothing has changed
        folder = Path(name)
        for section, pictures in PICTURES.items():
            print(f"{options.output}: {', '.join(pictures)}", flush=True)
            with progress(f"drawing {', '.join(pictures)}", quiet=options.quiet):
                section(folder, tuple(options.size), options.resolution)
            images = "".join(f'<img src="{file}.png" alt="{file}" width="32%"> ' for file in pictures)
            page += f"{images}<pre>{html.escape(inspect.getsource(section))}</pre>\n"
        (folder / "index.html").write_text(page, encoding="utf-8")
        options.output.mkdir(parents=True, exist_ok=True)
        for file in folder.iterdir():
            shutil.copy(file, options.output)
    print(f"open {options.output / 'index.html'}")


def add_demo(parser: Parser) -> None:
    add_output(parser, "jaxvol-demo", "folder to write")
    add_quiet(parser)
    add_size(parser)
    parser.add_argument("--resolution", type=int, default=320, metavar="N", help="voxels along the head")


def run_figures(options: argparse.Namespace) -> None:
    from ..._util.checks import output_file

    folder = output_file("--output", options.output / "index.html").parent
    sys.path.insert(0, str(checkout()))
    index = importlib.import_module("paper_figs.index")
    print(f"open {index.make(folder, run=options.run, only=options.only)}")


def checkout() -> Path:
    """Folder of the repository: that of this package, else the working directory."""
    for folder in (Path(__file__).parents[3], Path.cwd()):
        if (folder / "paper_figs" / "index.py").is_file():
            return folder
    raise ValueError("the figures are drawn by scripts of the repository. Run this in a checkout of it.")


def add_figures(parser: Parser) -> None:
    add_output(parser, "jaxvol-figures", "folder to write")
    text = "some of them, such as fig09"
    parser.add_argument("--only", nargs="+", default=(), metavar="NAME", help=text)
    text = "measure and render everything again, with the volumes of JAXVOL_DATA: takes hours"
    parser.add_argument("--run", action=SWITCH, default=False, help=text)
