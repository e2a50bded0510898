"""Which models are nested in one another? Candidates for `choose`, each of which contains the one before."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx

from .._util.checks import described, integer
from ..lighting import Material
from ..scene.transfer import TransferFunction
from ..xla.trees import PyTree
from .constraints import Where
from .starts import refined


def _unchanged(parameters: PyTree) -> PyTree:
    return parameters


class Candidate(NamedTuple):
    """A model that `choose` may choose.

    - `name`: in the table of results.
    - `start`: the parameters that its fit starts from, as for `fit`; or
    - `grow`: `grow(found)` makes them from the fitted parameters of the candidate before, so that the fit
      starts where that of the smaller model ended. Give one of the two.
    - `expand`: `expand(parameters)` is what the residual takes; by default the parameters themselves.
    - `constraints`, `where`: as for `fit`, of the model's own parameters.
    """

    name: str
    start: PyTree = None
    grow: Callable[[PyTree], PyTree] | None = None
    expand: Callable[[PyTree], PyTree] = _unchanged
    constraints: PyTree = None
    where: Where | None = None


def nested_points(
    start: TransferFunction | Any, points: Sequence[int] | Any = (2, 4, 8, 16), **of_each: Any
) -> list[Candidate]:
    """Candidates that are transfer functions of more and more control points.

    **Arguments:**

    - `start`: where the first fit starts, such as `flat_grey(volume, 2)`. It is `refined` to the first number
      of points.
    - `points`: increasing numbers of control points. Each candidate has those of the one before, and others
      between.
    - `of_each`: other fields of each `Candidate`, such as `constraints`.

    **Returns:** the candidates, for `choose`, from the fewest points to the most.

    **Raises:** `ValueError` for numbers that do not increase, or fewer than `start` has.
    """
    if not isinstance(start, TransferFunction):
        raise ValueError(f"start must be a TransferFunction; got {described(start)}.")
    numbers = [integer("points", number, 2) for number in points]
    if not numbers or any(b <= a for a, b in pairwise(numbers)):
        raise ValueError(f"points must be increasing numbers of control points; got {points!r}.")
    first = Candidate(f"{numbers[0]} points", refined(start, numbers[0]), **of_each)
    larger = (Candidate(f"{n} points", grow=partial(refined, points=n), **of_each) for n in numbers[1:])
    return [first, *larger]


def nested_materials(
    parts: Sequence[Any] | Any, partitions: Sequence[Sequence[int]] | Any
) -> list[Candidate]:
    """Candidates in which more and more materials have parameters of their own. The residual takes a tuple
    like `parts`, whichever of them are merged.

    **Arguments:**

    - `parts`: the starting point: materials, which share their mean free path and nothing else; or other
      trees of one kind, such as the transfer functions of labels, which are shared as a whole.
    - `partitions`: for each candidate the class of each part, numbered from 0 on: `[(0, 0, 0), (0, 1, 2)]`
      for one mean free path for all and then one for each; `[(0, 0, 1), (0, 1, 2)]` to ask whether the first
      two differ. Each divides classes of the one before.

    **Returns:** the candidates, for `choose`, in the order of `partitions`. The parameters of each are a
    tuple with the first part of each class; `candidate._replace(where=...)` fixes some of them.

    **Raises:** `ValueError` for no parts, and for partitions that do not match these or are not nested.
    """
    if not isinstance(parts, list | tuple) or not parts or len({type(part) for part in parts}) > 1:
        raise ValueError(f"parts must be a list of materials or parameters of one kind; got {parts!r}.")
    chain = _partitions(partitions, len(parts))
    candidates: list[Candidate] = []
    for classes in chain:
        count = max(classes) + 1
        members = [[str(i) for i, own in enumerate(classes) if own == number] for number in range(count)]
        name = f"{count} class{'es' if count > 1 else ''}: " + ", ".join(map("+".join, members))
        expand = partial(_expanded, parts, classes)
        if candidates:
            grow = partial(_split, candidates[-1].expand, classes)
            candidates.append(Candidate(name, grow=grow, expand=expand))
        else:
            candidates.append(Candidate(name, _first_of_each(parts, classes), expand=expand))
    return candidates


def _expanded(parts: Sequence[Any], classes: tuple[int, ...], found: Sequence[Any]) -> tuple[Any, ...]:
    """The parts, each with what it shares with its class as `found` for that."""
    of_class = tuple(found[number] for number in classes)
    if not isinstance(parts[0], Material):
        return of_class
    pairs = zip(parts, of_class, strict=True)
    return tuple(eqx.tree_at(lambda m: m.mean_free_path, part, own.mean_free_path) for part, own in pairs)


def _split(
    expand: Callable[[Sequence[Any]], tuple[Any, ...]], classes: tuple[int, ...], found: Sequence[Any]
) -> tuple[Any, ...]:
    """Parameters of each class, from those `found` for the classes that they divide."""
    return _first_of_each(expand(found), classes)


def _first_of_each(parts: Sequence[Any], classes: tuple[int, ...]) -> tuple[Any, ...]:
    return tuple(parts[classes.index(number)] for number in range(max(classes) + 1))


def _partitions(partitions: Any, parts: int) -> list[tuple[int, ...]]:
    chain = [tuple(integer("partitions", number, 0) for number in classes) for classes in partitions]
    for classes in chain:
        if len(classes) != parts or set(classes) != set(range(max(classes) + 1)):
            raise ValueError(
                f"partitions must hold a class for each of {parts} parts, numbered from 0 without gaps; "
                f"got {classes}."
            )
    for coarse, fine in pairwise(chain):
        pairs = set(zip(coarse, fine, strict=True))
        if len(pairs) != len(set(fine)) or len(set(fine)) <= len(set(coarse)):
            raise ValueError(f"partitions must each divide classes of the one before; got {coarse}, {fine}.")
    return chain
