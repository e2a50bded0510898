"""A user's script, in a folder of its own: does an installed jaxvol run, and are its types seen?"""

from pathlib import Path
from typing import assert_type

import jax

import jaxvol as jv


volume = jv.phantom("sphere", 16)
transfer = jv.colormap("gray", (0.0, 1.0))
camera = jv.Camera.looking_at(volume, size=(8, 8))
march = jv.March(0.2, (jv.Jitter(seed=1), jv.AlphaCorrection()))
assert_type(volume, jv.Volume)
assert_type(camera, jv.Camera)
assert_type(jv.render(volume, transfer, camera, march), jv.Rendering)


def brightness(transfer: jv.TransferFunction) -> jax.Array:
    return jv.render(volume, transfer, camera, march).image().mean()


gradient = jax.grad(brightness)(transfer)
assert abs(gradient.extinction).max() > 0
assert (Path(jv.__file__).parent / "py.typed").is_file()
print(f"jaxvol from {Path(jv.__file__).parent}")
