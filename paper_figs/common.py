"""Draws a scene under several marches, whole and zoomed, with measures of its error.

Images keep their pixels: one pixel of a picture is one ray, since resampling would smooth the artefacts.
"""

from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from PIL import Image

import jaxvol as jv
from experiments import record
from experiments.command import QUICK, Main, command
from experiments.common import plt
from experiments.marches import BOTH, EMPTY, JITTER, PLAIN, converged, transforms
from jaxvol._util.whole_files import whole_file
from jaxvol.metrics import boundary_noise, rmse, wood_grain_energy


OUTPUT = Path(__file__).parent / "output"
DATA = {"type": Path, "metavar": "FOLDER", "help": "real volumes, in place of phantoms"}
RECORDS = {"type": Path, "default": record.RESULTS, "metavar": "FOLDER", "help": "that of the records"}
"""The options `--data`, and `--results` of scripts that draw an experiment's record."""

METHODS = (PLAIN, JITTER, EMPTY, BOTH)
BLACK = (0.0, 0.0, 0.0)
DPI = 100
GAP, HEAD, TEXT = 4, 40, 54  # pixels: gap between images, height of the title and of the text under an image


Region: TypeAlias = Callable[["View", jv.Camera], np.ndarray]
Measures: TypeAlias = dict[str, float | None]


@dataclass(frozen=True)
class View:
    """A scene, and the part of its image that is zoomed."""

    volume: jv.Volume
    transfer: jv.TransferFunction
    camera: jv.Camera
    step: float
    factor: float
    """Magnification of the zoomed part."""
    middle: tuple[float, float]
    """Centre of the zoomed part, as fractions of the image's width and height from the top left."""

    @property
    def cameras(self) -> dict[str, jv.Camera]:
        return {"whole": self.camera, "zoomed": self.camera.zoom(self.factor, self.middle)}

    def render(self, camera: jv.Camera, march: jv.March) -> jv.Rendering:
        rendering = jv.render(self.volume, self.transfer, camera, march)
        assert not np.any(rendering.exhausted)
        return rendering

    def entered(self, camera: jv.Camera) -> np.ndarray:
        """Pixels whose rays enter the volume within visible material: cut faces, seen from the front."""
        first = jv.render(self.volume, self.transfer, camera, jv.March(self.step, max_samples=1))
        return np.asarray(first.rgba[..., 3] > 0)

    def left(self, camera: jv.Camera) -> np.ndarray:
        """Pixels that alignment changes: their rays leave the volume within visible material."""
        return np.asarray(self.render(camera, jv.March(self.step, transforms(BOTH))).aligned)


def cropped(volume: jv.Volume, low: tuple[float, ...], high: tuple[float, ...]) -> jv.Volume:
    """The part of a volume between two corners, given as fractions of its sides."""
    corners = zip(low, high, volume.shape, strict=True)
    first, last = zip(*((int(a * n), int(b * n)) for a, b, n in corners), strict=True)
    part = np.asarray(volume.data)[tuple(slice(a, b) for a, b in zip(first, last, strict=True))]
    origin = np.asarray(volume.origin) + np.array(first) * np.asarray(volume.spacing)
    return jv.Volume(part, volume.spacing, origin)


def figure(
    about: str | None, resolution: int = 160, size: int = 256
) -> Callable[[Callable[[Namespace], None]], Main]:
    """Decorator that makes the `main` of a script that draws scenes of a function of its options.

    - `about`: the module's docstring.
    - `resolution`: voxels along an axis of a phantom, by default. `size`: pixels along a side of an image.
    """

    def made(draw: Callable[[Namespace], None]) -> Main:
        @command(about, OUTPUT, data=DATA, size=size, resolution=resolution, quick=QUICK)
        def main(chosen: Namespace) -> None:
            if chosen.quick:
                chosen.size, chosen.resolution = 48, 40
            draw(chosen)

        return main

    return made


def write_table(table: str, path: Path) -> None:
    """Write a Markdown table to a file and to the terminal."""
    with whole_file(path) as part:
        part.write_text(table, encoding="utf-8")
    print(table)


def comparison(
    view: View,
    title: str,
    path: Path,
    methods: Sequence[str] = METHODS,
    region: Region = View.entered,
) -> dict[str, dict[str, Measures]]:
    """Draw the view under every method, whole above and zoomed below, and print its measures.

    `region`: the pixels whose boundary noise is measured. **Returns** the measures by look and method.
    """
    page = Page(len(methods), 2, view.camera.size[0], title)
    measures: dict[str, dict[str, Measures]] = {}
    for row, (look, camera) in enumerate(view.cameras.items()):
        truth = np.asarray(view.render(camera, converged(view.step)).image(BLACK))
        mask, measures[look] = region(view, camera), {}
        for column, method in enumerate(methods):
            image = np.asarray(view.render(camera, jv.March(view.step, transforms(method))).image(BLACK))
            measured = measures[look][method] = measure(image, truth, mask)
            page.draw(row, column, image, caption(measured), method if row == 0 else "")
    page.save(path)
    for look, of_method in measures.items():
        for method, measured in of_method.items():
            print(f"{path.stem} {look}, {method}: {', '.join(caption(measured).splitlines())}")
    return measures


def measure(image: np.ndarray, truth: np.ndarray, region: np.ndarray) -> Measures:
    error = image - truth
    try:
        noise = boundary_noise(error, region)
    except ValueError:  # no 3 x 3 pixels of such a face in this image
        noise = None
    return {"wood grain": wood_grain_energy(error), "boundary noise": noise, "RMSE": rmse(image, truth)}


def caption(measured: Measures) -> str:
    return "\n".join(f"{name} {'none' if v is None else f'{v:.2g}'}" for name, v in measured.items())


class Page:
    """A page of square images that keeps their pixels."""

    def __init__(self, columns: int, rows: int, side: int, title: str):
        self.side, self.width = side, columns * side + (columns + 1) * GAP
        self.height = HEAD + rows * (side + TEXT) + GAP
        self.figure = plt.figure(figsize=(self.width / DPI, self.height / DPI), dpi=DPI)
        self.figure.text(GAP / self.width, 1 - 5 / self.height, title, va="top", fontsize=8, weight="bold")

    def draw(self, row: int, column: int, linear: Any, below: str, above: str = "") -> Axes:
        left = GAP + column * (self.side + GAP)
        bottom = self.height - HEAD - row * (self.side + TEXT) - self.side
        box = left / self.width, bottom / self.height, self.side / self.width, self.side / self.height
        axes = self.figure.add_axes(box)
        axes.imshow(np.asarray(jv.to_srgb(linear)), interpolation="none")
        axes.axis("off")
        axes.text(0, -4 / self.side, below, va="top", fontsize=7.5, transform=axes.transAxes, linespacing=1.1)
        if above:
            axes.text(0, 1 + 3 / self.side, above, va="bottom", fontsize=8, transform=axes.transAxes)
        return axes

    def save(self, path: Path) -> None:
        """Write the page, down to the last line that is not white."""
        self.figure.canvas.draw()
        pixels = np.asarray(self.figure.canvas.buffer_rgba())[..., :3]  # pyright: ignore[reportAttributeAccessIssue]
        plt.close(self.figure)
        last = np.flatnonzero((pixels < 255).any(axis=(1, 2)))[-1]
        with whole_file(path) as part:
            Image.fromarray(pixels[: last + 1 + GAP]).save(part, "WEBP", quality=95, method=6)
        print(path)
