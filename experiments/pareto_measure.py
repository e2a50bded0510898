"""Time, error and picture of every setting in one scene, against its converged image.

The converged image, the reference, is ours at a fraction of the step, by the midpoint rule (under a thin
peak pre-integrated), cells cut at the exit, rays not ended early; of a lit scene every sample is lit, by
many templates. Its own error is estimated by the difference to the image of twice the step, which is several
times as large; in lit scenes also by the difference to half as many templates from another seed.
"""

import re
from argparse import Namespace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image as Pillow

import jaxvol as jv
from jaxvol.metrics import psnr, rmse, ssim, wood_grain_energy

from . import harness, pareto_points, programs
from .pareto_points import Setting
from .pareto_scenes import ROWS, Row
from .programs import Case, Image, Program, Quadrature, lighting_of, program


AMPLIFIED = 10
"""How many times as bright as it is an error is shown."""
SIDE = 112
"""Pixels along a side of the small pictures."""
TEMPLATES = 256
"""Two images of 32 templates each differ by 0.07 on the lit head, as much as they differ from those of some
settings."""
SEEDS = 1001, 2002
"""Of the reference's templates: not those of the settings."""


def slug(name: str) -> str:
    """A setting's name as that of a file."""
    return re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-")


def case_of(row: Row, chosen: Namespace) -> Case:
    return row.make(harness.data(), max(32, int(chosen.size * row.part)), chosen.resolution)


def scene(name: str, folder: Path, chosen: Namespace, settings: dict[str, Setting]) -> dict[str, Any]:
    """All results of a scene; its pictures are written into the folder."""
    row = ROWS[name]
    case, base = case_of(row, chosen), pareto_points.base_of(row)
    truth = converged(case, row, chosen.templates)
    found: dict[str, Any] = {
        "pixels": case.scene.camera.size[0],
        "reference": own_error(case, row, truth, chosen.templates),
        "points": {},
        "base seconds": [],
    }
    folder.mkdir(parents=True, exist_ok=True)
    small(truth).save(folder / "reference.webp", quality=80, method=6)
    against = settings[base].make(case)
    for family in dict.fromkeys(setting.family for setting in settings.values()):
        made = {n: against if n == base else s.make(case) for n, s in settings.items() if s.family == family}
        rows = programs.measured({base: against, **made}, truth, chosen.repetitions)
        found["base seconds"] += rows[base]["all seconds"]
        for point, each in made.items():
            image, seen = each.image(), each.seen(truth)
            found["points"][point] = {
                "family": family,
                **{key: value for key, value in rows[point].items() if key != "all seconds"},
                "psnr": round(psnr(image, seen), 3),
                "ssim": round(ssim(image, seen), 6),
                "wood grain": wood_grain_energy(image - seen),
            }
            small(beside(each, truth)).save(folder / f"{slug(point)}.webp", quality=72, method=6)
    jax.clear_caches()  # a process cannot hold the programs of all scenes
    return found


def beside(each: Program, truth: Image) -> Image:
    """The image, and beside it its error, amplified."""
    image = each.image()
    error = np.abs(image - each.seen(truth)) * AMPLIFIED
    return np.concatenate([image, np.clip(error, 0, 1)], axis=1)


def small(linear: Image) -> Pillow.Image:
    """Linear RGB as a small picture."""
    shown = Pillow.fromarray(np.rint(np.asarray(jv.to_srgb(linear)) * 255).astype(np.uint8))
    height, width = linear.shape[:2]
    return shown.resize((round(SIDE * width / height), SIDE), Pillow.Resampling.LANCZOS)


def fine(case: Case, finer: float, quadrature: Quadrature) -> jv.March:
    transforms = *case.placed, jv.AlphaCorrection(), jv.SpaceLeaping()
    return jv.March(case.scene.step / finer, transforms, quadrature)


def converged(case: Case, row: Row, count: int = TEMPLATES, seed: int = SEEDS[0]) -> Image:
    """The reference, over white, of so many templates."""
    how = {"templates": count, "blend": True, "seed": seed} if row.kind == "lit" else {}
    lighting = None if case.lighting is None else lighting_of(case, **how)
    return program(case, fine(case, row.finer, row.quadrature), lighting).image()


def own_error(case: Case, row: Row, truth: Image, count: int = TEMPLATES) -> dict[str, Any]:
    """What is estimated of the reference's own error: `rmse` in total, and its parts."""
    coarse = converged(case, row._replace(finer=row.finer / 2), count)
    found = {"steps in a voxel": row.finer, "difference to twice the step": rmse(truth, coarse)}
    if row.kind == "lit":
        counts = zip((count, count // 2), SEEDS, strict=True)
        one, other = (converged(case, row._replace(finer=1), n, seed) for n, seed in counts)
        # of images with the variances v and 2 v
        found["error by the number of templates"] = rmse(one, other) / np.sqrt(3)
    errors = found["difference to twice the step"], found.get("error by the number of templates", 0)
    return {"rmse": float(np.hypot(*errors)), **found}
