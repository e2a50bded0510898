"""The KISTI report's table (2005): what early ray termination (ERT) and empty-space skipping (ESS) save.
Writes the record of `experiments/kisti.py` in Markdown, beside the report's table, with the quotient of both
speed-ups.
"""

from argparse import Namespace
from typing import Any

from experiments import record
from experiments.command import command
from experiments.kisti import BOTH, ERT, ESS, NEITHER, REPORT

from .common import OUTPUT, RECORDS, write_table


def table(measured: dict[str, Any]) -> str:
    """The record of `experiments/kisti.py` and the report's table, as one Markdown table."""
    result = measured["result"]
    sizes, scenes = [str(size) for size in result["sizes"]], result["scenes"]
    lines = ["| | " + " | ".join(REPORT) + " |", "|---|" + "---|" * len(REPORT)]

    def line(name: str, cells: list[list[str]]) -> None:
        lines.append(f"| {name} | " + " | ".join(" / ".join(cell) for cell in cells) + " |")

    def of(method: str, form: str, *keys: str) -> list[list[str]]:
        rows = [[scenes[scene][size][method] for size in sizes] for scene in REPORT]
        for key in keys:
            rows = [[row[key] for row in pair] for pair in rows]
        return [[format(value, form) for value in pair] for pair in rows]

    for method in (ERT, ESS, BOTH):
        line(method, of(method, ".2f", "speed-up", "median"))
        line(f"*report: {method}*", [[f"{gain:.2f}" for gain in REPORT[scene][method]] for scene in REPORT])
        quotients = [
            [
                f"{scenes[scene][size][method]['speed-up']['median'] / gain:.2f}"
                for size, gain in zip(sizes, REPORT[scene][method], strict=True)
            ]
            for scene in REPORT
        ]
        line(f"{method}, ours / report's", quotients)
    line(f"seconds, {NEITHER}", of(NEITHER, ".3f", "seconds"))
    line(f"RMSE, {NEITHER}", of(NEITHER, ".4f", "rmse"))
    line(f"RMSE, {BOTH}", of(BOTH, ".4f", "rmse"))
    return "\n".join(lines) + "\n"


@command(__doc__, OUTPUT, results=RECORDS)
def main(chosen: Namespace) -> None:
    measured = record.read(chosen.results / "kisti.json")
    write_table(table(measured), chosen.output / "kisti_table.md")


if __name__ == "__main__":
    main()
