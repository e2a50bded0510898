"""Kim, Kwon and Shin, Table 1: overlap and rates by how a scan is split into bricks. Writes the record of
`experiments/bricks.py` in Markdown, beside the numbers that the paper prints."""

from typing import Any

from .common import table_from_record


METHODS = ("overlap", "reload", "naive", "whole")


def table(result: dict[str, Any]) -> str:
    """A row for each split: overlap as printed, by the formula, and for the voxels that are measured; what
    was read, loads, and rates, of the paper and ours."""
    head = [
        "β, σ, γ",
        "*paper: overlap %*",
        "formula, paper's unit %",
        "formula, these voxels %",
        "read: overlap / reload, times the volume",
        "loads: overlap / reload",
        "*paper: fps, proposed / reload*",
        "fps: overlap / reload / naive / whole",
        "time of reload / overlap",
    ]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for name, row in result["splits"].items():
        paper, overlap, reload = row["paper"], row["overlap"], row["reload"]
        read = (method["read, times the volume"] for method in (overlap, reload))
        rates = (1 / row[method]["seconds"] for method in METHODS)
        ratio = reload["ratio to overlap"]
        cells = [
            name.replace(",", " × "),
            f"*{paper['overlap']:.2f}*",
            f"{row['formula']:.2f}",
            f"{row['formula, of these voxels']:.2f}",
            " / ".join(f"{times:.2f}" for times in read),
            f"{overlap['loads']} / {reload['loads']}",
            f"*{paper['proposed']:.2f} / {paper['reload']:.2f}*",
            " / ".join(f"{rate:.2f}" for rate in rates),
            f"{ratio['median']:.2f} [{ratio['low']:.2f}, {ratio['high']:.2f}]"
            if row["repetitions"] > 1
            else f"{ratio['median']:.2f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


main = table_from_record(__doc__, "kim_table1.md", "bricks", table)

if __name__ == "__main__":
    main()
