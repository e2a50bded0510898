"""By which rule does JAX differentiate an image, for each `adjoint=`? `gradients` has the VJP of `"replay"`.

An image is one compiled program, and its gradient another.
"""

from abc import abstractmethod
from functools import partial
from typing import Any, Literal, TypeAlias

import equinox as eqx
import jax
from jaxtyping import Array

from ..march.march import March
from ..reference import steps_across
from ..scene.rendering import Rendering
from ..scene.volume import Volume
from ..xla.compiling import compiled, recomputed
from ..xla.differentiation import forward_mode, forward_only, transformations
from ..xla.platform import is_traced
from .acceleration import VolumeAcceleration
from .gradients import render_vjp
from .image import RenderOptions, march_image, scan_image
from .resolve import Found, resolve_image
from .scene import Scene


Adjoint: TypeAlias = Literal["replay", "forward", "direct"]

WRONG_MODE = {
    "replay": 'adjoint="replay" is for reverse mode (jax.grad, jax.vjp). For forward mode (jax.jvp, '
    'jax.jacfwd) pass adjoint="forward"; for both, and for higher derivatives, adjoint="direct".',
    "forward": 'adjoint="forward" is for forward mode (jax.jvp, jax.jacfwd). For reverse mode (jax.grad, '
    'jax.vjp) pass adjoint="replay", the default; for both, adjoint="direct".',
}


class AbstractAdjoint(eqx.Module):
    """How an image is made so that it can be differentiated."""

    @abstractmethod
    def render(self, scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
        """The image."""

    def resolve(
        self, scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, found: Found
    ) -> Array:
        """Pixels as `resolve_image` returns them, where they are computed after the march."""
        return _resolve(scene, options, acceleration, found)


class ReplayAdjoint(AbstractAdjoint):
    """Reverse mode, by a second march."""

    def render(self, scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
        if not is_traced(scene):  # going through a custom rule takes milliseconds
            return _march_in_turn(scene, options, acceleration)
        kinds = _checked_for_forward_mode(scene)
        # inside `jax.shard_map`, JAX has custom rules only under `jax.jit`
        sharded = any("ShardMapTracer" in kind for kind in kinds)
        image = _replayed_in_shard if sharded else _replayed
        return image(scene, options, jax.lax.stop_gradient(acceleration))

    def resolve(
        self, scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, found: Found
    ) -> Array:
        _checked_for_forward_mode(scene)
        return _resolve_again(scene, options, acceleration, found)


class ForwardAdjoint(AbstractAdjoint):
    """Forward mode, by JAX, through the fast engine."""

    def render(self, scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
        return forward_only(_march(scene, options, acceleration), WRONG_MODE["forward"])

    def resolve(
        self, scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, found: Found
    ) -> Array:
        return forward_only(super().resolve(scene, options, acceleration, found), WRONG_MODE["forward"])


class DirectAdjoint(AbstractAdjoint):
    """Any mode and order, by JAX, through this many steps of the reference engine."""

    length: int = eqx.field(static=True)

    def render(self, scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
        return _scan(scene, options, acceleration, self.length)


def _checked_for_forward_mode(scene: Scene) -> list[list[str]]:
    """The transformations of JAX that each leaf of the scene undergoes. Raises where one is forward mode."""
    kinds = [transformations(leaf) for leaf in jax.tree.leaves(scene)]
    if forward_mode(kinds):
        raise ValueError(WRONG_MODE["replay"])
    return kinds


def adjoint_of(name: Adjoint, volume: Volume, march: March) -> AbstractAdjoint:
    """The adjoint of this name.

    **Raises:** `ValueError` for `"direct"` where the march or the spacing is traced and `march.max_samples`
    is not given."""
    if name == "replay":
        return ReplayAdjoint()
    if name == "forward":
        return ForwardAdjoint()
    assert name == "direct"
    # rounded up to one of few lengths, so that a change of step rarely compiles the program again
    return DirectAdjoint(min(-(-steps_across(volume, march) // 64) * 64, march.most_samples))


def _image(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
    return march_image(scene, options, acceleration)[0]


_march = compiled(_image, has_jvp=True)
_march_in_turn = compiled(_image)
_march_recorded = compiled(partial(march_image, record=True))
_render_vjp = compiled(render_vjp)
_scan = compiled(scan_image, has_jvp=True)
_resolve = compiled(resolve_image, has_jvp=True)
_resolve_again = recomputed(resolve_image)


@eqx.filter_custom_vjp
def _replayed(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
    return _march_in_turn(scene, options, acceleration)


@_replayed.def_fwd
def _(
    perturbed: Any, scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration
) -> tuple[Rendering, Any]:
    rendering, ranges = _march_recorded(scene, options, acceleration)
    return rendering, (rendering, ranges)


@_replayed.def_bwd
def _(
    residuals: Any,
    cotangent: Rendering,
    perturbed: Any,
    scene: Scene,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
) -> Any:
    return _render_vjp(scene, perturbed, options, acceleration, residuals, cotangent)


_replayed_in_shard = eqx.filter_jit(_replayed)
