"""Lee, Kwon and Shin, Tables 1 to 3: the brightest photons of templates, brightest first, from the record of
`experiments/templates.py`, beside the intensities that the paper prints in the same rows. Lengths are in mean
free paths."""

from typing import Any

from .common import table_from_record


PAPER = {
    "Table 1": (0.72760, 0.10492, 0.04836, 0.02219, 0.01002, 0.00454, 0.00206, 0.00945),
    "Table 2": (0.18145, 0.12455, 0.12500, 0.12321, 0.05762, 0.05719, 0.05676, 0.02634),
    "Table 3, material A": (0.12291, 0.12241, 0.07501, 0.07500, 0.48284, 0.48282, 0.03076, 0.03060),
    "Table 3, material B": (0.22145, 0.17421, 0.17500, 0.17120, 0.04829, 0.04805, 0.04728, 0.01339),
}
"""Intensities as printed. 0.00945, 0.48284 and 0.48282 lack a zero: 0.000945, 0.048284, 0.048282."""


def table(result: dict[str, Any]) -> str:
    """All three tables as one Markdown table."""
    lines = ["| | x | y | z | intensity | *paper* |", "|---|---|---|---|---|---|"]
    for name, found in result["tables"].items():
        for row, paper in enumerate(PAPER[name.split(":")[0]]):
            cells = ["–"] * 4
            if row < len(found["photons"]):
                *offset, light = found["photons"][row]
                cells = [*(f"{c:.2f}" for c in offset), f"{light:.5f}"]
            lines.append(f"| {'' if row else name} | {' | '.join(cells)} | *{paper:.5f}* |")
        lines.append(f"| *{found['count']} photons* | | | | {found['energy']:.5f} | |")
    return "\n".join(lines) + "\n"


main = table_from_record(__doc__, "lee_tables.md", "templates", table)

if __name__ == "__main__":
    main()
