"""Lee, Kwon and Shin, Tables 1 to 3: the brightest photons of templates, brightest first. Generated here in
the conserving form, which the paper's own tables have (README.md), with lengths in mean free paths, beside
the intensities that the paper prints in the same rows."""

from argparse import Namespace

import numpy as np

import jaxvol as jv
from experiments.command import command

from .common import OUTPUT, write_table


ROWS = 8
INDEX = 1.4
ONE, FOUR, THIN, DENSE = (
    "Table 1: opacity 50 %, one packet",
    "Table 2: opacity 50 %, four packets",
    "Table 3, material A: opacity 30 %",
    "Table 3, material B: opacity 70 %",
)
TEMPLATES = {ONE: (0.5, 1), FOUR: (0.5, 4), THIN: (0.3, 4), DENSE: (0.7, 4)}
"""Opacity, and number of packets."""
PAPER = {
    ONE: (0.72760, 0.10492, 0.04836, 0.02219, 0.01002, 0.00454, 0.00206, 0.00945),
    FOUR: (0.18145, 0.12455, 0.12500, 0.12321, 0.05762, 0.05719, 0.05676, 0.02634),
    THIN: (0.12291, 0.12241, 0.07501, 0.07500, 0.48284, 0.48282, 0.03076, 0.03060),
    DENSE: (0.22145, 0.17421, 0.17500, 0.17120, 0.04829, 0.04805, 0.04728, 0.01339),
}
"""Intensities as printed. 0.00945, 0.48284 and 0.48282 lack a zero: 0.000945, 0.048284, 0.048282."""


def table() -> str:
    """All three tables as one Markdown table."""
    lines = ["| | x | y | z | intensity | *paper* |", "|---|---|---|---|---|---|"]
    for name, (opacity, packets) in TEMPLATES.items():
        template = jv.scatterer_template(jv.Material(opacity, 1.0, INDEX), 0, packets=packets)
        intensity = np.asarray(template.intensity)
        photons = zip(np.asarray(template.offset), intensity, PAPER[name], strict=False)
        for row, (offset, light, paper) in enumerate(photons):
            cells = [*(f"{c:.2f}" for c in offset), f"{light:.5f}"] if light > 0 else ["–"] * 4
            lines.append(f"| {'' if row else name} | {' | '.join(cells)} | *{paper:.5f}* |")
        lines.append(f"| *{np.sum(intensity > 0)} photons* | | | | {intensity.sum():.5f} | |")
    return "\n".join(lines) + "\n"


@command(__doc__, OUTPUT)
def main(chosen: Namespace) -> None:
    write_table(table(), chosen.output / "lee_tables.md")


if __name__ == "__main__":
    main()
