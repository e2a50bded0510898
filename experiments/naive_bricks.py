"""What does a scan look like whose bricks are shown one after the other, each whole, as without overlap?

The order that Kim, Kwon and Shin (2008) set their overlap against: a ray that comes back to a brick is given
all that it meets in it at once, so that what lies in between is blended in the wrong order.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from jaxvol.bricks.traversal import Load, Traversal


def each_at_once(traversal: Traversal) -> Iterator[Load]:
    """Each brick with all its cells of each ray, whatever other bricks the ray meets between them:
    `render_bricks(..., method=each_at_once)`."""
    for brick in traversal.order:
        if not traversal.visible[brick]:
            continue
        outside = np.ones(traversal.grid.number + 1, bool)
        outside[brick] = False
        own = ~outside
        own[-1] = True  # a ray goes on through a gap, in which there is no brick
        reached, load = jnp.zeros(traversal.rays.length.shape, jnp.int32), None
        while True:
            found = traversal.cells_of(brick, own, outside, reached)
            if found is None:
                break
            load = traversal.load(brick, found.cells) if load is None else load._replace(cells=found.cells)
            reached = found.reached
            yield load
