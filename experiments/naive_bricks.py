"""What does a scan look like whose bricks are shown one after the other, each whole, as without overlap?

The order that Kim, Kwon and Shin (2008) set their overlap against: a ray that comes back to a brick is given
all that it meets in it at once, so that what lies in between is blended in the wrong order.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from jaxvol.bricks.cells import Turn
from jaxvol.bricks.stream import Load, Stream
from jaxvol.ray import Progress
from jaxvol.scene.space import Ray


def each_at_once(stream: Stream, rays: Ray, living: list[Progress]) -> Iterator[Load]:
    """Each brick with all its cells of each ray, whatever other bricks the ray meets between them:
    `render_bricks(..., method=each_at_once)`."""
    for brick in stream.order:
        if not stream.visible[brick]:
            continue
        outside = np.ones(stream.grid.number + 1, bool)
        outside[brick] = False
        own = ~outside
        own[-1] = True  # a ray goes on through a gap, in which there is no brick
        others = jnp.asarray(outside)
        turn = Turn(jnp.asarray(brick, jnp.int32), others, jnp.asarray(own), others)
        reached, load = jnp.zeros(rays.length.shape, jnp.int32), None
        while True:
            found = stream.cells_in(turn, rays, living[0], reached)
            if found is None:
                break
            if load is None:
                load = stream.load(brick, found.cells, *stream.around(brick))
            else:
                load = load._replace(cells=found.cells)
            reached = found.reached
            yield load
