"""What does a step of fitting a radiance field cost, beside a plain JAX marcher, and how good do fits become?

A step is image and gradient of 4096 random rays, with 96 samples on the mean ray, through the unit cube of
`examples/radiance_field.py`. A grid of 64³ x 4 channels, activated or as it is stored, and a neural field
(features on two grids, and a network of 16) are marched by jaxvol and by a plain marcher: a `jax.lax.scan`
over as many samples for each ray, all rays side by side. Both sample in the middle of cells, which are a
little shorter or longer in one of them: so images differ by the error of their steps. Grids of 16 bits, and
the grid of which nine tenths are empty, with the blocks of emptiness made anew in each step and without, are
compared with jaxvol's own.

Then both examples are fitted for equal times, from 50 views of a CT of a head, and compared with 5 others.
Runs of one comparison are interleaved; a ratio is the median of those of pairs, with its 95 % interval.
"""

from argparse import Namespace
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxvol as jv
from examples.neural_field import RATES, neural
from examples.radiance_field import BOX, LOOK, grid, pictures, train
from jaxvol.metrics import rmse
from jaxvol.scene.occupancy import Blocks

from . import charts, timing
from .harness import experiment


FITS: dict[str, Any] = {"grid": (grid, optax.adam(0.2), "C0"), "neural field": (neural, RATES, "C1")}


def interpolated(data: Any, place: Any) -> Any:
    """Channels of a grid at places (rays, 3) between 0 and 1."""
    last = np.array(data.shape[:3]) - 1
    node = jnp.clip(jnp.floor(place * last), 0, last - 1)
    part, found = place * last - node, 0.0
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (node.astype(jnp.int32) + np.array(corner)).T
        found += jnp.prod(jnp.where(np.array(corner), part, 1 - part), axis=1)[:, None] * data[x, y, z]
    return found


def of_network(network: Any) -> Callable[[Any, Any], Any]:
    def value(parameters: Any, place: Any) -> Any:
        levels, arrays = parameters
        features = jnp.concatenate([interpolated(each, place) for each in levels], axis=1)
        return jax.vmap(eqx.combine(arrays, network))(features)

    return value


def plain(value: Any, look: jv.RadianceField, parameters: Any, rays: Any, samples: int) -> Any:
    """Image of the plain marcher: the same number of samples between each ray's entry and exit."""
    origins, directions = rays
    faces = jnp.stack([-origins / directions, (BOX - origins) / directions])
    near, far = faces.min(0).max(1, keepdims=True), faces.max(0).min(1, keepdims=True)
    width = jnp.maximum(far - near, 0) / samples

    def sample(state: Any, number: Any) -> Any:
        through, color = state
        channels = value(parameters, (origins + (near + (number + 0.5) * width) * directions) / BOX)
        opacity = 1 - jnp.exp(-look.scale * look.density(channels[:, 3:]) * width)
        color += through * opacity * look.color(channels[:, :3])
        return (through * (1 - opacity), color), None

    start = jnp.ones_like(near), jnp.zeros_like(origins)
    (through, color), _ = jax.lax.scan(sample, start, jnp.arange(samples, dtype=near.dtype))
    return jnp.concatenate([color, 1 - through], axis=1)


def random_rays(count: int, samples: int, seed: int) -> tuple[Any, float]:
    """From a sphere around the box to points in it; and the step that so many samples on the mean ray are."""
    random = np.random.default_rng(seed)
    away = random.normal(size=(count, 3))
    origins = BOX / 2 + 2 * away / np.linalg.norm(away, axis=1, keepdims=True)
    directions = random.uniform(0, BOX, (count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    faces = np.stack([-origins / directions, (BOX - origins) / directions])
    length = float(np.mean(faces.max(0).min(1) - faces.min(0).max(1)))
    return (jnp.asarray(origins, jnp.float32), jnp.asarray(directions, jnp.float32)), length / samples


def measured(images: dict[str, tuple[Any, Any]], repetitions: int, **others: Any) -> dict[str, Any]:
    """Times of image and of gradient, each an image's function and its parameters, as ratios to the first;
    and the difference of images to it."""
    programs: dict[Any, Any] = dict(others)
    for name, (image, parameters) in images.items():
        slopes = jax.jit(jax.grad(lambda p, image=image: jnp.mean(image(p) ** 2)))
        programs[name, "image"] = partial(jax.jit(image), parameters)
        programs[name, "step"] = partial(slopes, parameters)
    seconds, first = timing.interleaved(programs, repetitions), next(iter(images))
    truth, rows = programs[first, "image"](), {}
    for name in images:
        each = {what: seconds[name, what] for what in ("image", "step")}
        rows[name] = {f"{what} seconds": timing.median(run) for what, run in each.items()}
        rows[name] |= {w: timing.ratio(run, seconds[first, w]) for w, run in each.items()}
        rows[name]["rmse"] = rmse(programs[name, "image"]()[None], truth[None])
    for name in others:
        rows[name] = {"step seconds": timing.median(seconds[name])}
        rows[name]["step"] = timing.ratio(seconds[name], seconds[first, "step"])
    return rows


def costs(chosen: Namespace) -> dict[str, Any]:
    rays, step = random_rays(chosen.rays, chosen.samples, chosen.seed)

    def ours(volume_of: Any, look: jv.RadianceField, *transforms: jv.Transform) -> Any:
        march = jv.March(step, (jv.AlphaCorrection(), *transforms), "midpoint")
        origins, directions = rays
        return lambda p: jv.render_rays(volume_of(p), look, origins, directions, march, outputs="rgba").rgba

    def by_hand(value: Any, look: jv.RadianceField = LOOK) -> Any:
        return lambda p: plain(value, look, p, rays, chosen.samples)

    volume_of, fog = grid(chosen.resolution)
    random = np.random.default_rng(chosen.seed)
    data = fog + jnp.asarray(random.normal(size=fog.shape), fog.dtype)
    stored, as_stored = jnp.asarray(random.uniform(size=fog.shape), fog.dtype), jv.RadianceField(4.0)
    field_of, start = neural()
    field: Any = field_of(start).field
    network = eqx.filter(field.network, eqx.is_array, inverse=True)
    sides = np.linspace(-1, 1, chosen.resolution)
    ball = sum(np.meshgrid(sides**2, sides**2, sides**2, indexing="ij")) < 0.33
    thing, clipped = data.at[..., 3].set(jnp.where(ball, jnp.exp(data[..., 3]), -1)), jv.RadianceField(100)
    blocks = jax.jit(lambda data: Blocks.of(volume_of(data)))
    rows = {
        "grid": {
            "plain marcher": (by_hand(interpolated), data),
            "jaxvol": (ours(volume_of, LOOK), data),
        },
        "grid as stored": {
            "plain marcher": (by_hand(interpolated, as_stored), stored),
            "jaxvol": (ours(volume_of, as_stored), stored),
        },
        "neural field": {
            "plain marcher": (by_hand(of_network(network)), start),
            "jaxvol": (ours(field_of, LOOK), start),
        },
        "type of the grid": {
            name: (ours(volume_of, LOOK), data.astype(name)) for name in ("float32", "float16", "bfloat16")
        },
        "grid of a ball": {
            "all samples": (ours(volume_of, clipped), thing),
            "leaps": (ours(volume_of, clipped, jv.SpaceLeaping()), thing),
        },
    }
    others = {"grid of a ball": {"blocks of emptiness alone": lambda: blocks(thing)}}
    return {n: measured(each, chosen.repetitions, **others.get(n, {})) for n, each in rows.items()}


def fits(chosen: Namespace) -> dict[str, Any]:
    views, held_out = pictures(chosen.views, 0.5, chosen.size), pictures(5, 0.9, chosen.size)
    found: dict[str, Any] = {}
    for name, (model, optimizer, _) in FITS.items():
        volume_of, start = model()
        rows = [row[:3] for row in train(volume_of, start, optimizer, views, held_out, chosen.seconds)]
        spent, steps, psnr = zip(*rows, strict=True)
        found[name] = {"psnr at the end": psnr[-1], "steps": steps, "psnr": psnr, "seconds": spent}
    return found


def draw(result: dict[str, Any]) -> Any:
    figure, ((by_cost, by_time, by_steps),) = charts.panels(1, 3, 14, 4)
    rows = [(f"{kind}: {name}", row) for kind, each in result["steps"].items() for name, row in each.items()]
    for number, (_, row) in enumerate(rows):
        for what, color in (("image", "C0"), ("step", "C3")):
            if what in row:
                label = {"step": "image and gradient"}.get(what, what) if number == 0 else None
                charts.interval(by_cost, row[what], number, color, label)
    by_cost.set(xlabel="time / that of the first of its kind: median, 95 % interval", xscale="log")
    by_cost.set_yticks(range(len(rows)), [name for name, _ in rows])
    by_cost.invert_yaxis()
    by_cost.legend()
    charts.plain_numbers(by_cost)
    for name, row in result["fits"].items():
        by_time.plot(row["seconds"], row["psnr"], FITS[name][2], label=name)
        by_steps.plot(row["steps"], row["psnr"], FITS[name][2])
    by_time.set(xlabel="seconds, compilation left out", ylabel="PSNR of 5 held-out views, dB")
    by_steps.set(xlabel="steps")
    by_time.legend()
    return figure


@experiment(
    rays=4096,
    samples=96,
    resolution=64,
    repetitions=15,
    seconds=60,
    views=50,
    size=128,
    quick={
        "rays": 64,
        "samples": 8,
        "resolution": 16,
        "repetitions": 2,
        "seconds": 5,
        "views": 4,
        "size": 16,
    },
)
def main(chosen: Namespace) -> dict[str, Any]:
    return {"steps": costs(chosen), "fits": fits(chosen)}
