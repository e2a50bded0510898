"""Kim, Kwon and Shin, Fig. 9: rate against the size of bricks. Draws the record of `experiments/bricks.py`,
with the rates that the paper prints in its Table 1."""

from pathlib import Path
from statistics import median
from typing import Any

from experiments import charts

from .common import from_record


BEST = "2,4,2"


def draw(result: dict[str, Any], path: Path) -> None:
    """Above the paper's rates, below ours, from the largest bricks to the smallest."""
    rows = result["splits"]
    names = sorted(rows, key=lambda name: (rows[name]["bricks"], name))
    at = range(len(names))
    figure, ((theirs,), (ours,)) = charts.panels(2, 1, 9, 5.6, sharex=True)
    theirs.plot(at, [rows[n]["paper"]["proposed"] for n in names], "C0o-", label="proposed (overlap)")
    theirs.plot(at, [rows[n]["paper"]["reload"] for n in names], "C1s-", label="reload")
    for method, style in (("overlap", "C0o-"), ("reload", "C1s-"), ("naive", "C3x:")):
        label = "naive, wrong" if method == "naive" else method
        ours.plot(at, [1 / rows[n][method]["seconds"] for n in names], style, label=label)
    whole = median(1 / rows[n]["whole"]["seconds"] for n in names)
    ours.axhline(whole, color="0.5", linestyle="--", label="the whole volume at once")
    for panel, title in ((theirs, "the paper: 1280 x 490 x 325 voxels, 375 x 375 pixels"), (ours, None)):
        voxels, image = result["voxels"], result["image"]
        mine = f"measured: {' x '.join(map(str, voxels[::-1]))} voxels, {image[0]} x {image[1]} pixels"
        panel.set_title(title or mine, fontsize=9)
        panel.set_yscale("log")
        panel.set_ylabel("frames per second", fontsize=8)
        panel.legend(fontsize=7)
        panel.tick_params(labelsize=7)
        if BEST in names:
            panel.axvline(names.index(BEST), color="0.8", linewidth=6, zorder=0)
    labels = [f"{n}\n{rows[n]['bricks']}" for n in names]
    ours.set_xticks(at, labels, fontsize=7)
    ours.set_xlabel("split β,σ,γ and number of bricks; grey: the paper's best", fontsize=8)
    charts.save(figure, path)


main = from_record(__doc__, "kim_fig9.webp", "bricks", draw)

if __name__ == "__main__":
    main()
