"""Draws charts and pages from their records; nothing is measured.

`python -m experiments.redraw` draws all, `--only speed kisti` some. They are not kept beside the records, and
the documentation draws its own. `elevation_angle.png`, `path_traced.webp`, `tomography.png` and `lit.png`
show images that no record holds: their experiments alone draw them. `pareto.html` holds images only if its
experiment left some here.
"""

from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

from . import (
    accuracy,
    adaptive_error,
    bricks,
    common,
    compare,
    fit_pose,
    fit_transfer,
    gradient_agreement,
    gradient_errors,
    growth,
    jitter_accuracy,
    kisti,
    lighting,
    mean_free_path,
    minimum_distance,
    model_choice,
    out_of_core,
    overhead,
    pareto_chart,
    pareto_page,
    planning,
    probe_geometry,
    record,
    scaling,
    scan_conversion,
    shading,
    speed,
    stability,
    viewer_latency,
)
from .command import command


def draw_pareto(result: Any, path: Path) -> None:
    pareto_chart.draw(result, path)
    pareto_page.write(record.RESULTS / "pareto.json", record.RESULTS / "pareto", path.with_suffix(".html"))


DRAWN: dict[str, Callable[[Any, Path], None]] = {
    "accuracy": accuracy.draw,
    "adaptive_error": adaptive_error.draw,
    "bricks": bricks.draw,
    "compare": lambda result, path: compare.draw(result["programs"], path),
    "fit_pose": lambda result, path: fit_pose.draw(result["starts"], path),
    "fit_transfer": lambda result, path: fit_transfer.draw(result["scenes"], path),
    "gradient_agreement": lambda result, path: gradient_agreement.draw(result["scenes"], path),
    "gradient_agreement_gpu": lambda result, path: gradient_agreement.draw(result["scenes"], path),
    "gradient_errors": lambda result, path: gradient_errors.draw(
        result["relative errors"], result["widths"], path
    ),
    "growth": lambda result, path: growth.draw(result["sweeps"], path),
    "jitter_accuracy": lambda result, path: jitter_accuracy.draw(
        {scene: rows for scene, rows in result.items() if scene != "note"}, path
    ),
    "kisti": kisti.draw,
    "lighting": lighting.draw,
    "mean_free_path": mean_free_path.draw,
    "minimum_distance": minimum_distance.draw,
    "model_choice": model_choice.draw,
    "out_of_core": out_of_core.draw,
    "overhead": lambda result, path: overhead.draw(result["conditions"], result["sizes"], path),
    "pareto": draw_pareto,
    "planning": planning.draw,
    "planning_seed_1": planning.draw,
    "probe_geometry": probe_geometry.draw,
    "scaling": scaling.draw,
    "scan_conversion": scan_conversion.draw,
    "shading": lambda result, path: shading.draw(result["scenes"], path),
    "speed": speed.draw,
    "speed_gpu": speed.draw,
    "stability": lambda result, path: stability.draw(result, record.RESULTS / "stability", path),
    "viewer_latency": viewer_latency.draw,
}
"""By the name of a record, what draws its result."""


@command(
    __doc__,
    record.RESULTS,
    results={"type": Path, "default": record.RESULTS, "metavar": "FOLDER", "help": "that of the records"},
    only=common.some_of(DRAWN, "NAME"),
)
def main(chosen: Namespace) -> None:
    for name in chosen.only:
        file = chosen.results / f"{name}.json"
        if not file.is_file():
            raise ValueError(f"--results must hold the record {name}.json; {chosen.results} does not.")
        DRAWN[name](record.read(file)["result"], chosen.output / f"{name}.png")
        print(chosen.output / f"{name}.png")


if __name__ == "__main__":
    main()
