"""Reconstructs a CT from 50 pictures: a grid of colour and density, fitted to random rays by Adam. Prints the
PSNR of 5 pictures from other sides: JAXVOL_DATA=FOLDER python -m examples.radiance_field"""

import os
import time

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxvol as jv


WHITE, BOX = (1.0, 1.0, 1.0), np.array([1, 1, 0.88])
LOOK = jv.RadianceField(scale=100, density=jax.nn.softplus, color=jax.nn.sigmoid)
MARCH = jv.March(1 / 80, (jv.AlphaCorrection(), jv.EarlyTermination(1e-2)), "midpoint")


def pictures(count, first, size=128):
    """Rays of cameras all around a head, on a spiral, and their colours before a white background."""
    file = os.environ["JAXVOL_DATA"] + "/cthead_256x256x113_uint16le.raw.gz"
    ct = jv.load(file, spacing=np.array([1, 1, 2]) / 255)
    z, turn = 1 - 2 * (np.arange(count) + first) / count, np.pi * (1 + 5**0.5) * (np.arange(count) + first)
    sides = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=-1)
    cameras = [jv.Camera.looking_at(ct, side, size=(size, size)).zoom(1.6) for side in sides]
    march = jv.March(1 / 510, (jv.SpaceLeaping(), jv.AlphaCorrection()), "midpoint")
    transfer = jv.automatic_transfer(ct)
    return [(*c.rays(), jv.render(ct, transfer, c, march, antialias=2).image(WHITE)) for c in cameras]


def grid(n=64):
    """How parameters are a volume, and the first ones: thin grey fog."""
    return (lambda data: jv.Volume(data, BOX / (n - 1))), jnp.zeros((n, n, n, 4)).at[..., 3].set(-3)


def train(volume_of, parameters, optimizer, views, held_out, seconds):
    """Yields seconds (without compilation), steps, PSNR and parameters."""
    rays = [jnp.stack(part).reshape(-1, 3) for part in zip(*views, strict=True)]

    def loss(parameters, view):
        origins, directions, colors = view
        seen = jv.render_rays(volume_of(parameters), LOOK, origins, directions, MARCH, outputs="rgba")
        return jnp.mean((seen.image(WHITE) - colors) ** 2)

    @jax.jit
    def step(number, rate, parameters, state):
        chosen = jax.random.randint(jax.random.key(number), (4096,), 0, len(rays[0]))
        updates, state = optimizer.update(jax.grad(loss)(parameters, [part[chosen] for part in rays]), state)
        return optax.apply_updates(parameters, jax.tree.map(lambda u: rate * u, updates)), state

    errors = jax.jit(lambda p: jnp.stack([loss(p, view) for view in held_out]))
    spent, steps, state = 0.0, 0, optimizer.init(parameters)
    jax.block_until_ready(step(0, 1.0, parameters, state))  # compiles
    while spent < seconds:
        begin, rate = time.perf_counter(), 0.05 ** (spent / seconds)
        parameters, state = jax.block_until_ready(step(steps, rate, parameters, state))
        spent, steps = spent + time.perf_counter() - begin, steps + 1
        if steps % 50 == 0 or spent > seconds:
            yield spent, steps, float(jnp.mean(-10 * jnp.log10(errors(parameters)))), parameters


if __name__ == "__main__":
    for spent, steps, psnr, _ in train(*grid(), optax.adam(0.2), pictures(50, 0.5), pictures(5, 0.9), 60):
        print(f"{spent:.0f} s, {steps} steps: {psnr:.2f} dB", flush=True)
