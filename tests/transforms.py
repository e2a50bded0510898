"""Examples of all public transforms, and what they mean to the independent marcher.

They are `EXAMPLES` and `MEANINGS` of the test files of their modules, so that a transform is compared in
random sets with all others once its own test file has both."""

from collections.abc import Callable
from importlib import import_module
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from hypothesis import strategies as st

import jaxvol as jv
from docs.registry import subclasses

from . import oracle
from .scenes import BOX, PLANE
from .switch import switch


class Values(NamedTuple):
    """Numbers of which examples are made; `left`: the transmittance at which rays end early."""

    seed: int = 3
    left: float = 0.05
    box: tuple[float, ...] = BOX
    planes: tuple[Any, ...] = (PLANE,)


KINDS = [kind for kind in subclasses(jv.Transform) if kind.locate is jv.Transform.locate]
"""The public transforms, but for those with a space of their own, which is static."""
EXAMPLES: dict[str, Callable[[Values], jv.Transform]] = {}
MEANINGS: dict[type, Callable[[Any, jv.Camera], oracle.Meaning]] = {}
for name in dict.fromkeys(kind.__module__.rpartition(".")[2] for kind in KINDS):
    module = import_module(f"tests.march.transforms.test_{name}")
    EXAMPLES |= module.EXAMPLES
    MEANINGS |= module.MEANINGS

NAMES = tuple(EXAMPLES)
CLASSES = {name: type(make(Values())) for name, make in EXAMPLES.items()}
assert set(CLASSES.values()) == set(KINDS) == set(MEANINGS), "each transform has an example and a meaning"
ALONE = [pair for pair in combinations(NAMES, 2) if CLASSES[pair[0]] is CLASSES[pair[1]]]
"""A march takes a class of transforms once."""

SUBSETS = st.frozensets(st.sampled_from(NAMES)).filter(
    lambda on: all(not on.issuperset(pair) for pair in ALONE)
)
"""Names of transforms that are on, drawn by hypothesis."""

MOST = frozenset({kind: name for name, kind in reversed(CLASSES.items())}.values())
OTHERS = frozenset({kind: name for name, kind in CLASSES.items()}.values()) - {"termination"}
"""The first example of each class, and the last one of each, whose rays go on to their exits."""


def transforms(**values) -> dict[str, jv.Transform]:
    """Every example, of these `Values`."""
    return {name: make(Values(**values)) for name, make in EXAMPLES.items()}


def switched(on, without=(), **values) -> tuple[jv.Transform, ...]:
    """All of `transforms(**values)`, of which those named in `on` are on; some may be left out."""
    every = transforms(**values).items()
    return tuple(switch(each, name in on, name.title()) for name, each in every if name not in without)


def plain(on, **values) -> tuple[jv.Transform, ...]:
    """The same as users give them: those that are on."""
    return tuple(each for name, each in transforms(**values).items() if name in on)


def oracle_image(volume, transfer, camera, march):
    """Image and numbers of samples by the independent marcher, for the camera's rays."""
    origins, directions = camera.rays()
    rgba, samples = oracle.march(
        *(volume.data, volume.spacing, volume.origin),
        (transfer.values, transfer.colors, transfer.extinction),
        *(origins, directions, float(march.step)),
        quadrature=march.quadrature,
        meanings=[MEANINGS[type(each)](each, camera) for each in march.transforms],
    )
    shape = origins.shape[:-1]
    return np.reshape(rgba, (*shape, 4)), np.reshape(samples, shape)
