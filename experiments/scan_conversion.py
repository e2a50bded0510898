"""What error does scan conversion bring, by the spacing of its grid, and what does it cost?

Ultrasound as acquired is rendered under its `ToroidalMap`, without resampling, and after `scan_convert` onto
Cartesian grids of different spacing, in distances between the samples of a beam. Every image is compared with
the converged image of the volume as acquired. Beside the error of a frame at steps of one such distance is
that of converged frames, which resampling alone brings; and the time of a frame, the time of the conversion,
and the size of the grid.
"""

import time
from argparse import Namespace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxvol as jv
from jaxvol.metrics import rmse

from . import charts, harness, probe_geometry, timing
from .harness import chosen_scenes, experiment, some_of


SPACINGS = (8.0, 4.0, 2.0, 1.0)
"""In distances between the samples of a beam."""
DIRECT = "as acquired"
FINER = 4
"""How many times finer the step of the frames is that show what resampling alone brings."""
APLIO = "us_aplio_convex_239x128x91_uint8.raw.gz"
BODY = [(50, (0.1, 0.04, 0.03), 0.0), (90, (0.8, 0.5, 0.35), 0.1), (170, (1.0, 0.9, 0.8), 0.5)]


class Scene(NamedTuple):
    volume: jv.Volume
    probe: jv.ToroidalMap
    transfer: jv.TransferFunction
    camera: jv.Camera

    @property
    def sample(self) -> float:
        """Distance between the samples of a beam, mm."""
        first, last = self.probe.gamma_range
        return float(last - first) / (self.volume.shape[2] - 1)


def phantom(name: str, folder: Path | None, size: int, resolution: int) -> Scene:
    """Spheres and wires, or a fetus."""
    volume, probe = jv.toroidal_phantom(name, (resolution // 3, resolution // 2, resolution))
    camera = jv.Camera((60, -150, -110), (0, 0, 95), (1, 0, 0), 30.0, size=(size, size))
    points = BODY if name == "fetus" else probe_geometry.TISSUE
    return Scene(volume, probe, jv.TransferFunction.from_points(points), camera)


def scan(folder: Path, size: int, resolution: int) -> Scene:
    """A real convex scan of reverberation; its file has the beam's samples first. Half of its angles and its
    lengths, mm, are from its header; the angle of elevation is taken as the whole one."""
    data = np.asarray(jv.load(folder / APLIO).data)
    volume = jv.Volume(np.ascontiguousarray(data.transpose(2, 1, 0)))
    beta, sigma = (np.deg2rad((90 - half, 90 + half)) for half in (54.45 / 2, 38.55))
    probe = jv.ToroidalMap(22.70 - 52.70, 52.70, beta, sigma, (0, 69.58))
    camera = jv.Camera((100, -180, -60), probe.center, (0, 0, -1), 30.0, size=(size, size))
    return Scene(volume, probe, jv.colormap("gray", (60, 200), (0.0, 0.5), unit_distance=1.0), camera)


PHANTOM = "wires phantom"
SCENES = {
    PHANTOM: partial(phantom, "wires"),
    "fetus phantom": partial(phantom, "fetus"),
    "us_aplio_convex": scan,
}


def measure(scene: Scene, spacings: tuple[float, ...], repetitions: int) -> dict[str, dict[str, Any]]:
    """Errors, times and sizes: as acquired, and by the spacing of the grid."""
    grids, rows = {DIRECT: scene.volume}, {DIRECT: {"spacing": None, "convert seconds": 0.0}}
    for spacing in spacings:
        name, convert = (
            f"{spacing:g}",
            partial(jv.scan_convert, scene.volume, scene.probe, spacing * scene.sample),
        )
        jax.block_until_ready(convert().data)  # compiles it
        begin = time.perf_counter()
        grids[name] = jax.block_until_ready(convert())
        rows[name] = {"spacing": spacing, "convert seconds": round(time.perf_counter() - begin, 4)}

    def frame(name: str, finer: int = 1) -> jv.Rendering:
        located = (scene.probe,) if name == DIRECT else ()
        march = jv.March(scene.sample / finer, (*located, jv.AlphaCorrection()), "midpoint")
        return jv.render(grids[name], scene.transfer, scene.camera, march, outputs="rgba")

    truth = frame(DIRECT, harness.FINER).rgba
    seconds = timing.interleaved({name: partial(frame, name) for name in grids}, repetitions)
    for name, row in rows.items():
        row |= harness.row(seconds[name], seconds[DIRECT], rmse(frame(name).rgba, truth))
        row["rmse, converged"] = rmse(frame(name, FINER).rgba, truth)
        row["MiB"] = round(grids[name].data.nbytes / 2**20, 3)
    return rows


def draw(result: dict[str, Any]) -> Any:
    """Error and time of frames against the spacing; as acquired, which has none, as lines."""
    panels = {"rmse, converged": "RMSE by resampling alone", "rmse": "RMSE of a frame"}
    panels |= {"seconds": "seconds for a frame (dotted: and to convert)", "MiB": "size of the voxels, MiB"}
    figure, (axes,) = charts.panels(1, len(panels), 13, 3.4)
    for panel, (key, label) in zip(axes, panels.items(), strict=True):
        for number, (scene, rows) in enumerate(result["scenes"].items()):
            at = {row["spacing"]: row for name, row in rows.items() if row["spacing"] and "," not in name}
            panel.plot(list(at), [row[key] for row in at.values()], f"C{number}o-", label=scene)
            panel.axhline(rows[DIRECT][key], color=f"C{number}", linestyle="--", linewidth=1)
            if key == "seconds":
                both = [row[key] + row["convert seconds"] for row in at.values()]
                panel.plot(list(at), both, f"C{number}:")
        panel.set(yscale="log", title=label)
        panel.yaxis.set_major_formatter("{x:g}")
        charts.numbered(panel, SPACINGS, [f"{spacing:g}" for spacing in SPACINGS])
    figure.suptitle(
        "Solid: volumes converted to Cartesian grids. Dashed: rendered as acquired, which has no grid"
    )
    figure.supxlabel("spacing of the grid / distance between samples")
    axes[0].legend()
    return figure


@experiment(
    repetitions=7,
    size=128,
    resolution=160,
    only=some_of(SCENES, "SCENE"),
    spacings=SPACINGS,
    quick={"size": 24, "resolution": 24, "repetitions": 1, "spacings": (4.0, 2.0)},
)
def main(chosen: Namespace) -> dict[str, Any]:
    scenes = chosen_scenes(chosen, SCENES, PHANTOM, chosen.size)
    return {"scenes": {name: measure(scene, chosen.spacings, chosen.repetitions) for name, scene in scenes}}
