"""A user's mistakes, each of which a type checker must see where jaxvol is installed."""

import jaxvol as jv


volume = jv.phantom("sphere", 16)
camera = jv.Camera.looking_at(volume, sizes=(8, 8))  # no such argument
rendering = jv.render(volume, jv.colormap("gray", (0.0, 1.0)), jv.Camera.looking_at(volume), jv.March(0.1))
print(rendering.rgb)  # no such attribute
