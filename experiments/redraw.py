"""Draws charts and pages from their records; nothing is measured.

`python -m experiments.redraw` draws all, `--only speed kisti` some. They are not kept beside the records, and
the documentation draws its own. `path_traced.webp`, `transport.webp`, `tomography.png` and `lit.png` are
drawn by their experiments alone. `pareto.html` holds images only if its experiment left some here.

To measure a result again, run the `command` of its record, on a machine that does nothing else.
"""

from argparse import Namespace
from pathlib import Path

from . import charts, record
from .harness import command, some_of


NAMES = sorted(file.stem for file in record.RESULTS.glob("*.json"))
IMAGES = {"path_traced", "tomography", "transport"}
"""Records whose charts show images that no record holds."""
OTHERS = {
    *(
        "adaptive_error",
        "bricks",
        "bricks_once",
        "compare",
        "compare_avx512",
        "compare_gpu",
        "compare_small",
        "compare_untuned",
    ),
    *("gradient_agreement", "gradient_agreement_gpu", "octree", "out_of_core", "probe_geometry", "shading"),
    *("viewer_latency", "visible_shading"),
}
"""Records without a chart."""
DRAWN = [name for name in NAMES if name not in IMAGES | OTHERS]


@command(
    __doc__,
    record.RESULTS,
    results={"type": Path, "default": record.RESULTS, "metavar": "FOLDER", "help": "that of the records"},
    only=some_of(DRAWN, "NAME"),
)
def main(chosen: Namespace) -> None:
    for name in chosen.only:
        file = chosen.results / f"{name}.json"
        if not file.is_file():
            raise ValueError(f"--results must hold the record {name}.json; {chosen.results} does not.")
        charts.draw_record(file, chosen.output / f"{name}.png")
        print(chosen.output / f"{name}.png")


if __name__ == "__main__":
    main()
