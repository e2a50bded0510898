"""The KISTI report's table (2005): what early ray termination (ERT) and empty-space skipping (ESS) save.
Writes the record of `experiments/kisti.py` in Markdown, with shading on as in the report and without, beside
the report's table, with the quotient of both speed-ups.
"""

from typing import Any

from experiments.kisti import BOTH, BOTH_SKIPPED, ERT, ESS, NEITHER, REPORT, SKIPPED

from .common import table_from_record


def table(result: dict[str, Any], shading: str) -> str:
    """One half of the record of `experiments/kisti.py`, "scenes" (unshaded) or "shaded", and the report's
    table, as one Markdown table."""
    sizes, scenes = [str(size) for size in result["sizes"]], result[shading]
    lines = ["| | " + " | ".join(REPORT) + " |", "|---|" + "---|" * len(REPORT)]

    def line(name: str, cells: list[list[str]]) -> None:
        lines.append(f"| {name} | " + " | ".join(" / ".join(cell) for cell in cells) + " |")

    def of(method: str, form: str, *keys: str) -> list[list[str]]:
        rows = [[scenes[scene][size][method] for size in sizes] for scene in REPORT]
        for key in keys:
            rows = [[row[key] for row in pair] for pair in rows]
        return [[format(value, form) for value in pair] for pair in rows]

    ours = {ERT: [ERT], ESS: [SKIPPED, ESS], BOTH: [BOTH_SKIPPED, BOTH]}
    for method, forms in ours.items():
        line(f"*report: {method}*", [[f"{gain:.2f}" for gain in REPORT[scene][method]] for scene in REPORT])
        for form in forms:
            if form not in scenes[next(iter(REPORT))][sizes[0]]:
                continue
            line(form, of(form, ".2f", "speed-up", "median"))
            quotients = [
                [
                    f"{scenes[scene][size][form]['speed-up']['median'] / gain:.2f}"
                    for size, gain in zip(sizes, REPORT[scene][method], strict=True)
                ]
                for scene in REPORT
            ]
            line(f"{form}, ours / report's", quotients)
    line(f"seconds, {NEITHER}", of(NEITHER, ".3f", "seconds"))
    line(f"RMSE, {NEITHER}", of(NEITHER, ".4f", "rmse"))
    line(f"RMSE, {BOTH}", of(BOTH, ".4f", "rmse"))
    return "\n".join(lines) + "\n"


def tested_every(result: dict[str, Any]) -> str:
    """What early termination gains where ended rays are looked for every so many samples."""
    rows = result["ended rays are looked for every so many samples"]
    counts = list(rows[next(iter(REPORT))])
    lines = ["| samples | " + " | ".join(REPORT) + " |", "|---|" + "---|" * len(REPORT)]
    for count in counts:
        cells = [
            f"{rows[scene][count]['speed-up']['median']:.2f} ({rows[scene][count]['seconds'][ERT]:.3f} s)"
            for scene in REPORT
        ]
        lines.append(f"| {count} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def tables(result: dict[str, Any]) -> str:
    """All three."""
    return "\n".join((table(result, "shaded"), table(result, "scenes"), tested_every(result)))


main = table_from_record(__doc__, "kisti_table.md", "kisti", tables)

if __name__ == "__main__":
    main()
