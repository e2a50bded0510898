"""Which models are nested in one another? Candidates for `choose`, each of which contains the one before."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from .._util.checks import described, integer
from ..lighting import Material
from ..scene.transfer import TransferFunction
from ..xla.trees import PyTree
from .constraints import Where


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


def refined(transfer: TransferFunction, points: int | Any) -> TransferFunction:
    """The same transfer function with more control points.

    All points are kept. Each new one goes where the gap is widest, and those of one gap divide it evenly:
    even points become even ones again from n to 2n - 1, as 2, 3, 5, 9, and nearly even ones otherwise.

    **Arguments:**

    - `transfer`: the transfer function.
    - `points`: their number, at least that of `transfer`.

    **Returns:** a `TransferFunction` that shows the same.

    **Raises:** `ValueError` for fewer points, and where the float type has no values left between two.
    """
    values = np.asarray(transfer.values)
    points = integer("points", points, len(values))
    gaps = np.diff(values.astype(float))
    pieces = np.ones(len(gaps), int)
    for _ in range(points - len(values)):
        pieces[np.argmax(gaps / pieces)] += 1
    gap = np.repeat(np.arange(len(gaps)), pieces)
    part = np.concatenate([np.arange(n) / n for n in pieces])

    def between(rows: Any) -> np.ndarray:
        rows = np.asarray(rows)
        share = part.astype(rows.dtype).reshape(-1, *(1,) * (rows.ndim - 1))
        return np.concatenate([rows[gap] * (1 - share) + rows[gap + 1] * share, rows[-1:]])

    at = between(values)
    if np.any((np.diff(at) <= 0) & (pieces[gap] > 1)):
        raise ValueError(
            f"points must be few enough for {values.dtype} to hold values between those of transfer; "
            f"got {points} from {values[0]} to {values[-1]}."
        )
    return TransferFunction(at, between(transfer.colors), between(transfer.extinction))


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
    parts: Sequence[Any] | Any,
    partitions: Sequence[Sequence[int]] | Any,
    *,
    shared: Where | None = None,
    constraints: PyTree = None,
    where: Where | None = None,
) -> list[Candidate]:
    """Candidates in which more and more materials have parameters of their own. The residual takes a tuple
    like `parts`, whichever of them are merged.

    **Arguments:**

    - `parts`: the starting point: materials, or the transfer functions of labels, or other trees, all of one
      kind.
    - `partitions`: for each candidate the class of each part, numbered from 0 on: `[(0, 0, 0), (0, 1, 2)]`
      for one mean free path for all and then one for each; `[(0, 0, 1), (0, 1, 2)]` to ask whether the first
      two differ. Each divides classes of the one before.
    - `shared`: what the parts of a class have in common, `shared(part)` as for `equinox.tree_at`: by default
      the mean free path of a `Material`, and all of anything else. What is not shared stays as in `parts`.
    - `constraints`, `where`: as for `fit`, of one part. The default fits what the default of `fit` does: the
      mean free path, or colours and extinction.

    **Returns:** the candidates, for `choose`, in the order of `partitions`.

    **Raises:** `ValueError` for no parts, and for partitions that do not match these or are not nested.
    """
    if not isinstance(parts, list | tuple) or not parts or len({type(part) for part in parts}) > 1:
        raise ValueError(f"parts must be a list of materials or parameters of one kind; got {parts!r}.")
    if shared is None:
        shared = _mean_free_path if isinstance(parts[0], Material) else _whole
    chain = _partitions(partitions, len(parts))
    expand = [partial(_expanded, parts, classes, shared) for classes in chain]
    candidates: list[Candidate] = []
    for number, classes in enumerate(chain):
        count = max(classes) + 1
        candidates.append(
            Candidate(
                _name(classes),
                start=None if number else _first_of_each(parts, classes),
                grow=partial(_split, expand[number - 1], classes) if number else None,
                expand=expand[number],
                constraints=None if constraints is None else (constraints,) * count,
                where=None if where is None else lambda parts: [where(part) for part in parts],
            )
        )
    return candidates


def _whole(part: Any) -> Any:
    return part


def _mean_free_path(material: Material) -> Any:
    return material.mean_free_path


def _expanded(
    parts: Sequence[Any], classes: tuple[int, ...], shared: Where, found: Sequence[Any]
) -> tuple[Any, ...]:
    """The parts, each with what it shares with its class as `found` for that."""
    of_class = [found[number] for number in classes]
    if shared is _whole:
        return tuple(of_class)
    pairs = zip(parts, of_class, strict=True)
    return tuple(eqx.tree_at(shared, part, shared(own)) for part, own in pairs)


def _split(
    expand: Callable[[Sequence[Any]], tuple[Any, ...]], classes: tuple[int, ...], found: Sequence[Any]
) -> tuple[Any, ...]:
    """Parameters of each class, from those `found` for the classes that they divide, which `expand` makes
    parts of."""
    return _first_of_each(expand(found), classes)


def _first_of_each(parts: Sequence[Any], classes: tuple[int, ...]) -> tuple[Any, ...]:
    """The first part of each class."""
    return tuple(parts[classes.index(number)] for number in range(max(classes) + 1))


def _name(classes: tuple[int, ...]) -> str:
    """Such as `2 classes: 0+1, 2`."""
    count = max(classes) + 1
    members = [[str(i) for i, own in enumerate(classes) if own == number] for number in range(count)]
    return f"{count} class{'es' if count > 1 else ''}: " + ", ".join(map("+".join, members))


def _partitions(partitions: Any, parts: int) -> list[tuple[int, ...]]:
    chain = [tuple(integer("partitions", number, 0) for number in classes) for classes in partitions]
    if not chain:
        raise ValueError(
            "partitions must hold the classes of the parts for at least one candidate; got none."
        )
    for classes in chain:
        if len(classes) != parts or set(classes) != set(range(max(classes) + 1)):
            raise ValueError(
                f"partitions must hold a class for each of {parts} parts, numbered from 0 without gaps; "
                f"got {classes}."
            )
    for coarse, fine in pairwise(chain):
        pairs = set(zip(coarse, fine, strict=True))
        if len(pairs) != len(set(fine)) or len(set(fine)) <= len(set(coarse)):
            raise ValueError(
                "partitions must each divide classes of the one before, and keep no parts together that were "
                f"apart; got {coarse} and then {fine}."
            )
    return chain
