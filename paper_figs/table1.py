"""Kye 2013, Table 1: the time of a whole frame. Writes the record of `experiments/overhead.py` in Markdown,
as ratios to ray casting, with those of the paper.
"""

from typing import Any

from experiments.marches import BOTH, EMPTY, JITTER, PLAIN

from .common import table_from_record


COLUMNS = (JITTER, EMPTY, BOTH)
PAPER = {  # seconds, 1024 x 1024 pixels, in the order of the table's columns
    "head": (0.767, 0.771, 0.775, 0.775),
    "heart": (3.728, 3.741, 3.739, 3.745),
    "kidney": (1.768, 1.765, 1.771, 1.772),
    "vessels": (1.192, 1.196, 1.199, 1.216),
}


def table(result: dict[str, Any]) -> str:
    """The record of `experiments/overhead.py` and the paper's table, as one Markdown table."""
    lines = [
        f"| volume | pixels | {PLAIN} | " + " | ".join(COLUMNS) + f" | RMSE, {PLAIN} | RMSE, {BOTH} |",
        "|---|" + "---|" * (len(COLUMNS) + 4),
    ]
    each = [
        (f"{name}, {said}", size, condition["volumes"][name][str(size)])
        for said, condition in result["conditions"].items()
        for size in result["sizes"]
        for name in condition["volumes"]
    ]
    for name, size, rows in each:
        cells = [f"{size}²", f"{rows[PLAIN]['seconds']:.3f} s"]
        for column in COLUMNS:
            ratio = rows[column]["ratio"]
            cells.append(f"{ratio['median']:.3f} [{ratio['low']:.3f}, {ratio['high']:.3f}]")
        cells += [f"{rows[march]['rmse']:.5f}" for march in (PLAIN, BOTH)]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    for name, (plain, *others) in PAPER.items():
        cells = ["1024²", f"{plain:.3f} s", *(f"{other / plain:.3f}" for other in others), "–", "–"]
        lines.append(f"| *paper: {name}* | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


main = table_from_record(__doc__, "table1.md", "overhead", table)

if __name__ == "__main__":
    main()
