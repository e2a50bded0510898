"""One record of what a file, or an image of another library, says of its array, and the one function that
makes the arguments of `Volume` of it."""

import itertools
import math
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .affine import directions
from .checks import finite_array, integer, shortened
from .files import MOST_VOXELS
from .units import axis_letters, length_of
from .voxels import WHOLE, check_shape, within


ALONG_AXES = 1e-5
"""Greatest entry by which directions may differ from the world's axes to count as these: it misplaces no
voxel of 1000 by more than a hundredth. NIfTI's own rounding is smaller."""


INNER = "jaxvol.", "equinox.", "jaxtyping.", "beartype"
"""Modules between a caller and the reader of a file."""


@dataclass
class ImageRecord:
    """What is known of an array of voxels, as its writer meant it.

    Attributes:
        data: the array as it is stored, of NumPy or one that is read box by box.
        axes: the name of each of its axes, in order.
        steps: signed distances between voxels by x, y and z; those that are not known are missing.
        units: the unit of each of these, or one of all; None where there is none.
        origin: where the first voxel lies, along x, y and z, in the same units.
        direction: the directions of the axes x, y and z in the world, as columns.
        convention: where the world's axes point: "LPS" (left, back, head), "RAS" or such, or "" for nowhere.
        slope, intercept: a value is slope times the stored number plus intercept.
        missing: stored numbers that mean that there is no value.
        unsigned: whether stored integers have no sign, whatever their type (`_Unsigned` of NetCDF).
        labels: the name of each value of a segmentation, where the file has them.
        assumed: what the file does not say, and what was taken in its place.
        also: further arguments of `Volume`.
        what: how errors begin.
        format: the name of the format.
    """

    data: Any
    axes: Sequence[str]
    steps: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str | None] | str | None = None
    origin: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)
    direction: np.ndarray | None = None
    convention: str = ""
    slope: float = 1.0
    intercept: float = 0.0
    missing: tuple[float, ...] = ()
    unsigned: bool = False
    labels: Mapping[int, str] = field(default_factory=dict)
    assumed: list[str] = field(default_factory=list)
    also: dict[str, Any] = field(default_factory=dict)
    what: str = "data"
    format: str = ""

    @property
    def letters(self) -> str:
        """The letter of each axis. Raises `ValueError` for axes that are not known."""
        return axis_letters(self.what, self.axes, self.note)

    @property
    def is_scaled(self) -> bool:
        return (self.slope, self.intercept) != (1, 0)

    def note(self, text: str) -> None:
        """Append to `assumed`, once."""
        self.assumed += [] if text in self.assumed else [text]

    def unit(self, letter: str) -> str | None:
        """The unit of the step along an axis, as it is stored."""
        return self.units if isinstance(self.units, str | None) else self.units.get(letter)

    def millimetres(self) -> np.ndarray:
        """Lengths of the units along x, y, z in mm. An unknown one is taken as those of the others are, or as
        1, and `assumed` says so."""
        told = {letter: self.unit(letter) for letter in "xyz"}
        known = {letter: length_of(unit) for letter, unit in told.items()}
        usual = next((length for length in known.values() if length), None)
        for unit in dict.fromkeys(unit for letter, unit in told.items() if unit and not known[letter]):
            taken = "taken as 1" if usual is None else f"taken as {usual:g} mm, as along other axes"
            self.note(f"unit {shortened(unit)}: {taken}")
        return np.array([length or usual or 1.0 for length in known.values()])

    def decode(self, stored: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """The values of stored numbers, and where there are none, if anywhere. Whole numbers stay so under a
        scale of whole numbers; others are scaled in float64, and rounded once to float32."""
        mask = None
        for number in self.missing:
            if stored.dtype.kind == "f" or holds(stored.dtype, number):
                at = stored == stored.dtype.type(number)
                mask = (at if mask is None else mask | at) if at.any() else mask
        if self.unsigned and stored.dtype.kind == "i":
            stored = stored.view(stored.dtype.str.replace("i", "u"))
        slope, intercept = float(self.slope), float(self.intercept)
        if not self.is_scaled:
            return stored, mask
        if stored.dtype.kind in "iu" and slope.is_integer() and intercept.is_integer() and stored.size:
            most = max(abs(int(end) * int(slope) + int(intercept)) for end in (stored.min(), stored.max()))
            if most < 2**62:
                kind = (
                    np.int32 if most < 2**31 and abs(slope) < 2**31 and abs(intercept) < 2**31 else np.int64
                )
                return (stored.astype(np.int64) * int(slope) + int(intercept)).astype(kind), mask
        values = np.empty(stored.shape, np.float64 if stored.dtype == np.float64 else np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # what is infinite is refused, or replaced, later
            for plane, into in zip(stored, values, strict=True):  # which saves memory
                into[...] = plane * np.float64(slope) + intercept
        return values, mask

    def oriented(
        self, sizes: Sequence[int], *, turned: bool = True
    ) -> tuple[list[int], list[int], dict[str, Any]]:
        """How axes of so many voxels are brought along the world's: which of x, y, z becomes each, its sign,
        and spacing (mm), origin and direction of `Volume`, missing where the file says nothing. Not `turned`:
        axes stay in order, and only those along which steps are negative are reversed. No voxel is
        interpolated."""
        lengths, given = self.millimetres(), np.array([self.steps.get(a, 1.0) for a in "xyz"], float)
        if self.steps and (unknown := [letter for letter in "xyz" if letter not in self.steps]):
            self.note(f"the distance along {', '.join(unknown)}: taken as 1, in the unit of the others")
        world = np.array([1.0 if axis in "LPS" else -1.0 for axis in self.convention or "LPS"])
        turn = np.eye(3) if self.direction is None else np.asarray(self.direction, float)
        what, origin = f"{self.what}: its place", np.asarray(self.origin, float)
        if not (given.all() and np.isfinite([*given, *origin, *turn.flat]).all()):
            got = f"{given.tolist()} from {origin.tolist()}"
            raise ValueError(f"{what} must be finite, with steps longer than 0; got {got}.")
        turn = directions(what, turn) * world[:, None] * np.sign(given)
        order, signs = [0, 1, 2], np.sign(given).astype(int)
        if turned:  # the axis of the data that is nearest to each axis of the world, all three at once
            orders = map(list, itertools.permutations(range(3)))
            order = max(orders, key=lambda p: np.abs(turn[range(3), p]).sum())
            signs = np.where(np.diag(turn[:, order]) >= 0, 1, -1)
        turn, steps = turn[:, order], (np.abs(given) * lengths)[order]
        last = [sizes[axis] - 1 if sign < 0 else 0 for axis, sign in zip(order, signs, strict=True)]
        place = {"spacing": steps, "origin": world * origin * lengths + turn @ (steps * last)}
        if not np.allclose(turn * signs, np.eye(3), rtol=0, atol=ALONG_AXES):
            place["direction"] = turn * signs
        known = self.steps or self.convention or self.direction is not None or place["origin"].any()
        return order, signs.tolist(), place if known else {}

    def rows(self) -> dict[str, str]:
        """The record in words, by what they are about, for `jaxvol info`."""
        lengths = {a: f" of {step:.6g} {self.unit(a) or ''}".rstrip() for a, step in self.steps.items()}
        axes = zip(self.axes, self.data.shape, self.letters, strict=True)
        told = ", ".join(f"{name} {n}{lengths.get(letter, '')}" for name, n, letter in axes)
        stored = getattr(self.data.dtype, "numpy_dtype", self.data.dtype)  # of tensorstore
        rows = {"format": self.format, "stored": f"{stored}, {told}"}
        rows |= (
            {"scale": f"value = {self.slope:.9g} x stored + {self.intercept:.9g}"} if self.is_scaled else {}
        )
        rows |= {"missing": f"stored {', '.join(f'{n:g}' for n in self.missing)}"} if self.missing else {}
        rows |= {"world": f"{self.convention}, shown as LPS (left, back, head)"} if self.convention else {}
        named = ", ".join(f"{value} {name}" for value, name in self.labels.items())
        rows |= {"names": shortened(named)} if named else {}
        return rows | ({"assumed": "; ".join(self.assumed)} if self.assumed else {})


def holds(dtype: np.dtype, number: float) -> bool:
    """Whether a type of integers holds a number."""
    if dtype.kind not in "iu" or not float(number).is_integer():
        return False
    return bool(np.iinfo(dtype).min <= number <= np.iinfo(dtype).max)


def choose(record: ImageRecord, time: int | None, channel: int | None) -> tuple[tuple[Any, ...], str]:
    """An index of the array that chooses an image of several, and the letters of the axes that are left: x, y
    and z, and s of several values in a voxel. Raises `ValueError` where the choice is missing or wrong."""
    letters, shape, where = record.letters, record.data.shape, record.what.removeprefix("path: ")
    given = {"time": time, "channel": channel}
    own = {"time": "t", "channel": "c" if "c" in letters else "s"}
    axes = sorted(zip(letters, shape, strict=True), key=lambda axis: "xyztcs".index(axis[0]))
    sizes = ", ".join(f"{axis} {n}" for axis, n in axes)
    for name, letter in own.items():
        if given[name] is not None and letter not in letters:
            raise ValueError(f"{name}: {where} has no such axis; it holds {sizes}.")
    index: list[Any] = [slice(None)] * len(letters)
    for letter in sorted({*letters} - {*"xyz"}):
        name, at = "time" if letter == "t" else "channel", letters.index(letter)
        number = given[name] if own[name] == letter else None
        if number is None and shape[at] > 1:
            if letter == "s":
                continue  # the volume's channels
            raise ValueError(f"{name} must be given, from 0 to {shape[at] - 1}: {where} holds {sizes}.")
        index[at] = integer(name, number or 0, 0, shape[at] - 1)
    return tuple(index), "".join(a for a, i in zip(letters, index, strict=True) if isinstance(i, slice))


def volume_arguments(
    record: ImageRecord,
    *,
    time: int | None = None,
    channel: int | None = None,
    nan: float | None = None,
    turned: bool = True,
) -> dict[str, Any]:
    """Arguments of `Volume` for an image: axes along the world's (if `turned`), lengths in mm, values scaled,
    and those that are missing replaced by `nan`, by default by the least one that is there.

    Raises:
        ValueError: for axes that are not known, a choice of `time` or `channel` that is missing or wrong, a
            place that is none, and 2**31 voxels or more.

    Warns of what was taken in place of what the file does not say (`ImageRecord.assumed`).
    """
    index, letters = choose(record, time, channel)
    shape = [n for n, part in zip(record.data.shape, index, strict=True) if isinstance(part, slice)]
    if math.prod(shape) > MOST_VOXELS:
        raise ValueError(f"{record.what} must hold 1 to 2**31 - 1 voxels; got shape {tuple(shape)}.")
    if not {*"xyz"} <= {*letters}:
        check_shape(tuple(shape[:2]))
    order, signs, place = record.oriented([shape[letters.index(a)] for a in "xyz"], turned=turned)
    stored = np.asarray(record.data[index])
    data, mask = record.decode(
        stored if stored.dtype.isnative else stored.astype(stored.dtype.newbyteorder("="))
    )
    also = dict(record.also)
    if mask is not None:
        data = _filled(record, data, mask, nan)
    if nan is not None and data.dtype.kind == "f":
        data = np.where(np.isfinite(data), data, data.dtype.type(np.asarray(finite_array("nan", nan, ()))))
    if record.is_scaled and data.dtype.kind in "iu" and not within(data, WHOLE["float32"]):
        record.note("whole numbers beyond 2**24, which float32 would round: numbered, see label_ids")
        also |= numbered(data)
        data = also.pop("data")
    axes = [letters.index("xyz"[axis]) for axis in order] + [k for k, a in enumerate(letters) if a == "s"]
    data = np.transpose(data, axes)[tuple(slice(None, None, sign) for sign in signs)]
    for text in record.assumed:
        warn_caller(f"{record.what.removeprefix('path: ')}: {text}")
    return {"data": np.ascontiguousarray(data), **place, **also}


def warn_caller(text: str) -> None:
    """Warn of something at the line that called the library."""
    level, frame = 1, sys._getframe()
    while frame is not None and frame.f_globals.get("__name__", "").startswith(INNER):
        level, frame = level + 1, frame.f_back
    warnings.warn(text, stacklevel=level)


def _filled(record: ImageRecord, data: np.ndarray, mask: np.ndarray, nan: float | None) -> np.ndarray:
    """Values with those that are missing replaced."""
    if nan is None:
        if mask.all():
            raise ValueError(f"{record.what} must hold values; all {mask.size} are missing. Give nan=VALUE.")
        least = data[~mask].min().item()
        record.note(
            f"{np.count_nonzero(mask)} of {mask.size} values are missing: shown as {least:g}; see nan"
        )
        nan = float(least)
    data = np.array(data, data.dtype if data.dtype.kind == "f" or holds(data.dtype, nan) else np.float32)
    data[mask] = nan
    return data


def numbered(ids: np.ndarray) -> dict[str, Any]:
    """Arguments of `Volume`: numbers in the order of the ids, in place of these, and the ids."""
    kinds, numbers = np.unique(ids, return_inverse=True)
    return {"data": numbers.reshape(ids.shape), "label_ids": kinds.tolist()}


class DecodedArray:
    """The array of a record, of which boxes are read as values, with some of its axes reversed: for
    bricks."""

    def __init__(self, record: ImageRecord, reverse: Sequence[int], nan: float | None):
        self.record, self.reverse, self.nan, self.shape = record, reverse, nan, record.data.shape
        stored = np.dtype(getattr(record.data.dtype, "numpy_dtype", record.data.dtype))
        self.dtype = np.dtype(np.float32) if record.is_scaled or record.missing or record.unsigned else stored
        if (chunks := getattr(record.data, "chunks", None)) is not None:
            self.chunks = chunks

    def __getitem__(self, box: tuple[Any, ...]) -> np.ndarray:
        index = list(box)
        for axis in self.reverse:
            index[axis] = slice(self.shape[axis] - box[axis].stop, self.shape[axis] - box[axis].start)
        values, mask = self.record.decode(np.asarray(self.record.data[tuple(index)]))
        if mask is not None:
            if self.nan is None:
                raise ValueError("values are missing: give nan=VALUE")
            values = np.where(mask, self.nan, values)
        kept = [axis for axis, part in enumerate(box) if isinstance(part, slice)]
        return values[tuple(slice(None, None, -1 if axis in self.reverse else 1) for axis in kept)]
