"""The KISTI report's table (2005): what early ray termination (ERT) and empty-space skipping (ESS) save.
`experiments/kisti.py` measures it; here it is told in Markdown, beside the report's.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments import record
from experiments.kisti import BOTH, ERT, ESS, NEITHER, REPORT

from .common import OUTPUT


def table(measured: dict[str, Any]) -> str:
    """The record of `experiments/kisti.py`, and the report's table, as one in Markdown."""
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
        line(f"*report: {method}*", [[f"{told:.2f}" for told in REPORT[scene][method]] for scene in REPORT])
    line(f"seconds, {NEITHER}", of(NEITHER, ".3f", "seconds"))
    line(f"RMSE, {NEITHER}", of(NEITHER, ".4f", "rmse"))
    line(f"RMSE, {BOTH}", of(BOTH, ".4f", "rmse"))
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--results", type=Path, default=record.RESULTS, metavar="FOLDER")
    parser.add_argument("--output", type=Path, default=OUTPUT, metavar="FOLDER")
    chosen = parser.parse_args(argv)
    told = table(record.read(chosen.results / "kisti.json"))
    chosen.output.mkdir(parents=True, exist_ok=True)
    (chosen.output / "kisti_table.md").write_text(told, encoding="utf-8")
    print(told)


if __name__ == "__main__":
    main()
