"""Constraints of a fit: a bijection for each parameter, which says whether it is free, and its bounds."""

from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..lighting import Material
from ..march.march import March
from ..march.transforms.toroidal_map import ToroidalMap
from ..scene.camera import Camera
from ..scene.labels import LabelTransferFunction
from ..scene.transfer import TransferFunction
from ..scene.transfer2d import TransferFunction2D
from ..scene.volume import Volume
from ..xla.trees import PyTree
from .bijections import Bijection, Fixed, Pose, Positive, ProbeGeometry, Unconstrained, UnitInterval


TRANSFERS = TransferFunction, TransferFunction2D

KNOWN = *TRANSFERS, LabelTransferFunction, Camera, ToroidalMap, Volume, March, Material
"""Types that have default constraints."""

Where = Callable[[Any], Any]

FreeVariables: TypeAlias = tuple[PyTree, ...]
"""One entry per bijection, None where fixed."""


class Free(eqx.Module):
    """Parameters as the free variables that a solver moves."""

    bijections: list[Bijection]
    paths: list[str] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    @classmethod
    def of(cls, parameters: PyTree, constraints: PyTree, where: Where | None) -> tuple["Free", FreeVariables]:
        """The map from free variables to parameters, and the free variables of `parameters`."""
        parameters = jax.tree.map(lambda p: jnp.asarray(p) if isinstance(p, float) else p, parameters)
        tree = _select(_resolve(parameters, constraints), where)
        leaves, structure = jax.tree_util.tree_flatten_with_path(tree, is_leaf=_is_bijection)
        nodes = structure.flatten_up_to(parameters)
        pairs = zip(leaves, nodes, strict=True)
        bijections: list[Bijection] = [Fixed(node) if isinstance(b, Fixed) else b for (_, b), node in pairs]
        paths = ["parameters" + jax.tree_util.keystr(path) for path, _ in leaves]
        start = tuple(b.inverse(*at) for b, *at in zip(bijections, nodes, paths, strict=True))
        if not jax.tree.leaves(start):
            raise ValueError("parameters must hold a float array that is free; got only fixed ones.")
        return cls(bijections, paths, structure), start

    def forward(self, free: FreeVariables) -> PyTree:
        """Parameters at the free variables."""
        return jax.tree.unflatten(self.structure, self._nodes(free))

    def moved(self, free: FreeVariables) -> list[Any]:
        """Parts of the parameters that are fitted."""
        return [b.moved(node) for b, node in zip(self.bijections, self._nodes(free), strict=True)]

    def _nodes(self, free: FreeVariables) -> list[Any]:
        """Value of each bijection: by one program, but for fixed ones, which it would copy."""
        movable = [None if isinstance(b, Fixed) else b for b in self.bijections]
        pairs = zip(self.bijections, _values(movable, free), strict=True)
        return [b.start if isinstance(b, Fixed) else value for b, value in pairs]

    def reach(self, free: FreeVariables) -> FreeVariables:
        """Largest change of the free variables over which a function may be almost linear."""
        return tuple(b.reach(variables) for b, variables in zip(self.bijections, free, strict=True))

    def names(self, free: FreeVariables) -> list[str]:
        """Name of every number in `moved`, such as `.extinction[3]`."""
        names = []
        shapes = eqx.filter_eval_shape(self.moved, free)
        for (number, *inner), leaf in jax.tree_util.tree_flatten_with_path(shapes)[0]:
            name = self.paths[number.idx].removeprefix("parameters") + jax.tree_util.keystr(tuple(inner))
            names += [name + (str(list(at)) if at else "") for at in np.ndindex(leaf.shape)]
        return names


@eqx.filter_jit
def _values(bijections: list[Bijection | None], free: FreeVariables) -> list[Any]:
    pairs = zip(bijections, free, strict=True)
    return [None if b is None else b.forward(variables) for b, variables in pairs]


def unconstrain(
    parameters: PyTree, *, constraints: PyTree = None, where: Where | None = None
) -> tuple[FreeVariables, Callable[[FreeVariables], PyTree]]:
    """Convert parameters to free variables, any real numbers, as `fit` does, for a custom training loop.

        free, constrain = jv.unconstrain(transfer)
        optimizer = optax.adam(0.03)
        state = optimizer.init(free)
        for _ in range(100):
            gradient = jax.grad(lambda free: loss(constrain(free)))(free)
            updates, state = optimizer.update(gradient, state)
            free = optax.apply_updates(free, updates)

    Whatever the steps, `constrain(free)` is within its bounds: extinctions stay positive, colours in [0, 1].
    A parameter on a bound begins a thousandth of its scale away from it.

    Args:
        parameters: any tree, as for `fit`.
        constraints: as for `fit`: bijections, such as `Positive()`, or None for the defaults.
        where: the free parameters, as for `fit`.

    Returns:
        The free variables, a tree of arrays of order 1 (None where fixed), and the function from such a tree
        to the parameters, which `jax.jit`, `jax.grad` and `jax.vmap` accept, and which holds fixed values.

    Raises:
        ValueError: for parameters outside their bounds or not finite, and constraints or a `where` that do
            not match them.
    """
    free, start = Free.of(parameters, constraints, where)
    return start, jax.tree_util.Partial(Free.forward, free)


def size(tree: PyTree) -> int:
    """Number of numbers in a tree of arrays."""
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


def _is_bijection(node: Any) -> bool:
    return isinstance(node, Bijection)


def _resolve(parameters: PyTree, constraints: PyTree) -> PyTree:
    """Assign a bijection to every leaf, or to an object, such as a camera, that has a single one."""

    def expand(constraint: PyTree, node: PyTree) -> PyTree:
        if constraint is None:
            return jax.tree.map(_default, node, is_leaf=lambda n: isinstance(n, KNOWN))
        if not _is_bijection(constraint):
            raise ValueError(f"constraints must hold bijections, such as Positive(); got {constraint!r}.")
        if constraint.per_object:
            return constraint
        return jax.tree.map(lambda leaf: constraint if eqx.is_inexact_array(leaf) else Fixed(), node)

    try:
        return jax.tree.map(expand, constraints, parameters, is_leaf=lambda n: n is None or _is_bijection(n))
    except (ValueError, TypeError, KeyError) as fault:
        if "constraints" in str(fault):
            raise
        raise ValueError(
            "constraints must be a tree like the parameters, or a prefix of one, with a bijection, or None "
            f"for the default, at each leaf: {jax.tree.structure(parameters)}; got {constraints!r}."
        ) from fault


def _default(node: Any) -> PyTree:
    """Default constraints of an object, or of a leaf."""
    if isinstance(node, Camera):
        return Pose(node)
    if isinstance(node, ToroidalMap):
        return ProbeGeometry(node)
    fixed = jax.tree.map(lambda _: Fixed(), node)
    if isinstance(node, TRANSFERS):
        top = float(np.max(np.asarray(node.extinction)))
        bounds = UnitInterval(), Positive(top if top > 0 else 1.0)
        return eqx.tree_at(lambda t: (t.colors, t.extinction), fixed, bounds)
    if isinstance(node, LabelTransferFunction):  # factors of its extinctions are free in `stacked`
        return eqx.tree_at(lambda t: t.stacked, fixed, _default(node.stacked))
    if isinstance(node, Volume):
        field = jax.tree.map(_default, node.field, is_leaf=lambda n: isinstance(n, KNOWN))
        if any(not isinstance(b, Fixed) for b in jax.tree.leaves(field, is_leaf=_is_bijection)):
            return eqx.tree_at(lambda v: v.field, fixed, field)  # most fields read no voxels
        return eqx.tree_at(lambda v: v.data, fixed, _default(node.data))
    if isinstance(node, Material):
        return eqx.tree_at(lambda m: m.mean_free_path, fixed, Positive(node.mean_free_path))
    return Unconstrained() if eqx.is_inexact_array(node) else fixed


def _select(tree: PyTree, where: Where | None) -> PyTree:
    """Fix everything except what `where` selects."""
    if where is None:
        return tree
    chosen = jax.tree.map(lambda _: False, tree, is_leaf=_is_bijection)
    try:
        chosen = eqx.tree_at(where, chosen, replace_fn=lambda node: jax.tree.map(lambda _: True, node))
    except (AttributeError, KeyError, IndexError, TypeError, ValueError) as fault:
        raise ValueError(
            "where must return parts of the parameters, such as lambda p: p.extinction (a camera that is "
            f"fitted as a pose is a single part); it failed with {fault!r}."
        ) from fault
    return jax.tree.map(lambda free, bijection: bijection if free else Fixed(), chosen, tree)
