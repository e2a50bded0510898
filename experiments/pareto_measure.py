"""Time, error and picture of every setting in one scene, kept on disk as they are measured.

Each scene has a folder: `scene.json` with what is finished, `reference.npy`, and a picture for each point.
What is there is not measured again if commit, sources, sizes, seed and peers are the same.
"""

import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from PIL import Image as Pillow

import jaxvol as jv
from jaxvol.metrics import psnr, rmse, ssim, wood_grain_energy

from . import common, pareto_gradients, pareto_points, pareto_reference, record, timing
from .pareto_points import Setting
from .pareto_programs import Program
from .pareto_scenes import ROWS, Case, Row


AMPLIFIED = 10
"""How many times as bright as it is an error is shown."""
SIDE = 112
"""Pixels along a side of the small pictures."""


class Sizes(NamedTuple):
    """How much is measured. `templates`: of a lit scene's reference."""

    pixels: int
    resolution: int
    repetitions: int
    templates: int
    seed: int = 0


class Store:
    """What is finished of a scene. Nothing is written, or removed, before `save`."""

    def __init__(self, folder: Path, key: dict[str, Any]):
        self.folder, self.path = folder, folder / "scene.json"
        kept = json.loads(self.path.read_text(encoding="utf-8")) if self.path.is_file() else {}
        fresh: dict[str, Any] = {"key": key, "points": {}, "base": {}}
        self.kept = kept if kept.get("key") == key else fresh

    def save(self) -> None:
        """Write all, or, if interrupted, leave what was there."""
        self.folder.mkdir(parents=True, exist_ok=True)
        new = self.path.with_suffix(".new")
        new.write_text(json.dumps(self.kept, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        new.replace(self.path)


def state() -> str:
    """Identifies the code: a digest of its sources. (Whether the checkout is clean does not: results lie in
    it.)"""
    found, root = hashlib.sha256(), Path(__file__).parent.parent
    for file in sorted([*(root / "jaxvol").rglob("*.py"), *(root / "experiments").glob("*.py")]):
        found.update(file.read_bytes())
    return found.hexdigest()[:16]


def key_of(name: str, sizes: Sizes, there: dict[str, str]) -> dict[str, Any]:
    """What a scene's results depend on."""
    commit = (record.commit() or "").rstrip("+")
    return {"scene": name, "commit": commit, "sources": state(), **sizes._asdict(), "peers": there}


def slug(name: str) -> str:
    """A setting's name as that of a file."""
    return re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-")


def case_of(row: Row, sizes: Sizes) -> Case:
    return row.make(common.data(), max(32, int(sizes.pixels * row.part)), sizes.resolution)


def scene(
    name: str,
    folder: Path,
    sizes: Sizes,
    there: dict[str, str],
    chosen: Callable[[dict[str, Setting]], dict[str, Setting]] = lambda settings: settings,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """All results of a scene; measured are those that its folder lacks. `chosen`: of its settings."""
    row, store = ROWS[name], Store(folder, key_of(name, sizes, there))
    settings, base = chosen(pareto_points.of(row, there)), pareto_points.base_of(row)
    kept, missing = store.kept, {n: s for n, s in settings.items() if n not in store.kept["points"]}
    wanted = row.gradients and "gradients" not in kept
    if not missing and not wanted and "reference" in kept:
        say(f"{name}: kept, {len(kept['points'])} points")
        return kept
    case = case_of(row, sizes)
    truth = reference(case, row, sizes, store)
    kept["pixels"] = case.scene.camera.size[0]
    say(f"{name}: reference errs by {kept['reference']['rmse']:.1e}")
    against = settings[base].make(case)
    for family in dict.fromkeys(setting.family for setting in missing.values()):
        programs = {n: s.make(case) for n, s in missing.items() if s.family == family}
        rows, base_seconds = timed(programs, base, against, truth, sizes.repetitions)
        for point, found in rows.items():
            kept["points"][point] = {"family": family, **found}
            picture(programs[point], truth).save(folder / f"{slug(point)}.webp", quality=72, method=6)
        kept["base"].setdefault(family, []).extend(base_seconds)
        store.save()
        say(f"{name}: {family}, {len(rows)} points, {len(kept['points'])} of {len(settings)}")
    if wanted:
        kept["gradients"] = pareto_gradients.measure(case, settings, sizes.repetitions)
        store.save()
        say(f"{name}: gradients at {len(kept['gradients']['points'])} points")
    jax.clear_caches()  # a process cannot hold the programs of all scenes
    return kept


def truth_of(case: Case, row: Row, sizes: Sizes, store: Store) -> np.ndarray:
    """The converged image, from the store if it is there."""
    if "reference" in store.kept:
        return np.load(store.folder / "reference.npy")
    return pareto_reference.converged(case, row, sizes.templates)


def reference(case: Case, row: Row, sizes: Sizes, store: Store) -> np.ndarray:
    """The converged image, kept with its own error."""
    truth = truth_of(case, row, sizes, store)
    if "reference" in store.kept:
        return truth
    own = pareto_reference.own_error(case, row, truth, sizes.templates)
    store.save()  # makes the folder, and marks what it holds as stale
    np.save(store.folder / "reference.npy", truth)
    small(truth).save(store.folder / "reference.webp", quality=80, method=6)
    store.kept["reference"] = own
    store.save()
    return truth


def timed(
    programs: dict[str, Program], base: str, against: Program, truth: np.ndarray, repetitions: int
) -> tuple[dict[str, dict[str, Any]], list[float]]:
    """Time and error of each program, timed in turn with the base; and the base's times."""
    seconds = timing.interleaved(
        {base: against.draw, **{n: p.draw for n, p in programs.items() if n != base}}, repetitions
    )
    rows = {}
    for name, each in programs.items():
        image, seen = each.image(), each.seen(truth)
        row = common.row(seconds[name], seconds[base], rmse(image, seen))
        rows[name] = {**row, **quality(image, seen)}
    return rows, [round(s, 5) for s in seconds[base]]


def quality(image: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """What `common.row` does not have of an image's error."""
    return {
        "psnr": round(psnr(image, truth), 3),
        "ssim": round(ssim(image, truth), 6),
        "wood grain": wood_grain_energy(image - truth),
    }


def beside(each: Program, truth: np.ndarray) -> Float[np.ndarray, "height width 3"]:
    """The image, and beside it its error, amplified."""
    image = each.image()
    error = np.abs(image - each.seen(truth)) * AMPLIFIED
    return np.concatenate([image, np.clip(error, 0, 1)], axis=1)


def picture(each: Program, truth: np.ndarray) -> Pillow.Image:
    return small(beside(each, truth))


def small(linear: np.ndarray) -> Pillow.Image:
    """Linear RGB as a small picture."""
    shown = Pillow.fromarray(np.rint(np.asarray(jv.to_srgb(linear)) * 255).astype(np.uint8))
    height, width = linear.shape[:2]
    return shown.resize((round(SIDE * width / height), SIDE), Pillow.Resampling.LANCZOS)
