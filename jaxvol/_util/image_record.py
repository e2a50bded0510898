"""One record of what a file, or an image of another library, says of its array, and the one function that
makes the arguments of `Volume` of it."""

import itertools
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .affine import directions
from .checks import finite_array, integer, shortened
from .files import MOST_VOXELS
from .units import axis_letters, length_of
from .voxels import WHOLE, within


ALONG_AXES = 1e-5
"""Greatest entry by which directions may differ from the world's axes to count as these: it misplaces no
voxel of 1000 by more than a hundredth. NIfTI's own rounding is smaller."""


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
    labels: Mapping[int, str] = field(default_factory=dict)
    assumed: list[str] = field(default_factory=list)
    also: dict[str, Any] = field(default_factory=dict)
    what: str = "data"
    format: str = ""

    def letters(self) -> str:
        """The letter of each axis. Raises `ValueError` for axes that are not known."""
        return axis_letters(self.what, self.axes)

    def unit(self, letter: str) -> str | None:
        """The unit of the step along an axis, as it is stored."""
        return self.units if isinstance(self.units, str | None) else self.units.get(letter)

    def millimetres(self) -> np.ndarray:
        """Lengths of the units along x, y, z in mm. An unknown one is taken as those of the others are, or as
        1, and `assumed` says so."""
        told = {letter: self.unit(letter) for letter in "xyz"}
        known = {letter: length_of(unit) for letter, unit in told.items()}
        usual = next((length for length in known.values() if length), 1.0)
        for unit in dict.fromkeys(unit for letter, unit in told.items() if unit and not known[letter]):
            taken = "1" if not any(known.values()) else f"{usual:g} mm, as of the other axes"
            self.note(f"unit {shortened(unit)}: taken as {taken}")
        return np.array([length or usual for length in known.values()])

    def note(self, text: str) -> None:
        """Append to `assumed`, once."""
        self.assumed += [] if text in self.assumed else [text]

    def decode(self, stored: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """The values of stored numbers, and where there are none, if anywhere. Whole numbers stay so under a
        scale of whole numbers; others are scaled in float64, and rounded once to float32."""
        mask = None
        for number in self.missing:
            with np.errstate(over="ignore", invalid="ignore"):
                at = stored == np.array(number).astype(stored.dtype, copy=False)
            exact = stored.dtype.kind == "f" or (math.isfinite(number) and number == int(number))
            if exact and (stored.dtype.kind == "f" or within_type(number, stored.dtype)) and at.any():
                mask = at if mask is None else mask | at
        slope, intercept = float(self.slope), float(self.intercept)
        if (slope, intercept) == (1.0, 0.0):
            return stored, mask
        if stored.dtype.kind in "iu" and slope.is_integer() and intercept.is_integer():
            ends = [int(end) * int(slope) + int(intercept) for end in (stored.min(), stored.max())]
            kind = np.int32 if max(map(abs, ends)) < 2**31 else np.int64
            if max(map(abs, ends)) < 2**62:
                return stored.astype(kind) * kind(slope) + kind(intercept), mask
        values = np.empty(stored.shape, np.float64 if stored.dtype == np.float64 else np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # what is infinite is refused, or replaced, later
            for plane, into in zip(np.atleast_1d(stored), np.atleast_1d(values), strict=True):  # saves memory
                into[...] = plane * np.float64(slope) + intercept
        return values, mask

    def place(self) -> tuple[list[int], list[int], dict[str, np.ndarray]]:
        """How axes are brought along the world's (left, back and head, where a convention is known): which of
        x, y, z becomes each, the sign of its direction, and spacing (mm), origin of the turned array for a
        first voxel at its `origin`, and the direction that is left, if any. No voxel is interpolated."""
        lengths, given = (
            self.millimetres(),
            np.array([self.steps.get(letter, 1.0) for letter in "xyz"], float),
        )
        if self.steps and (unknown := [letter for letter in "xyz" if letter not in self.steps]):
            self.note(f"the distance along {', '.join(unknown)}: taken as 1, in the unit of the others")
        world = np.array([1.0 if axis in "LPS" else -1.0 for axis in self.convention or "LPS"])
        turn = np.eye(3) if self.direction is None else np.asarray(self.direction, float)
        if not (
            np.all(given != 0) and np.all(np.isfinite([*given, *self.origin])) and np.isfinite(turn).all()
        ):
            got = f"{np.asarray(given).tolist()} from {np.asarray(self.origin).tolist()}"
            raise ValueError(f"{self.what} must be finite, with steps longer than 0; got {got}.")
        turn = directions(self.what, turn) * np.sign(given) * world[:, None]
        # the axis of the data that is nearest to each axis of the world, all three at once
        orders = map(list, itertools.permutations(range(3)))
        order = max(orders, key=lambda p: np.abs(turn[range(3), p]).sum())
        turn, steps = turn[:, order], (np.abs(given) * lengths)[order]
        signs = np.where(np.diag(turn) >= 0, 1, -1)
        place = {"spacing": steps, "origin": world * self.origin * lengths, "turn": turn}
        if not np.allclose(turn * signs, np.eye(3), rtol=0, atol=ALONG_AXES):
            place["direction"] = turn * signs
        return order, signs.tolist(), place

    def oriented(self, sizes: Sequence[int]) -> tuple[list[int], list[int], dict[str, Any]]:
        """As `place`, for an array of so many voxels along its x, y, z: order, signs, and spacing, origin and
        direction of `Volume`, which are missing where the file says nothing."""
        order, signs, place = self.place()
        last = np.array([sizes[axis] - 1 if sign < 0 else 0 for axis, sign in zip(order, signs, strict=True)])
        place["origin"] = place["origin"] + place.pop("turn") @ (place["spacing"] * last)
        known = (
            bool(self.steps) or self.direction is not None or np.any(place["origin"]) or bool(self.convention)
        )
        return order, signs, place if known else {}

    def rows(self) -> dict[str, str]:
        """The record in words, by what they are about, for `jaxvol info`."""
        lengths = {a: f" of {step:.6g} {self.unit(a) or ''}".rstrip() for a, step in self.steps.items()}
        axes = zip(self.axes, self.data.shape, self.letters(), strict=True)
        told = [f"{name} {n}{lengths.get(letter, '')}" for name, n, letter in axes]
        rows = {"format": self.format, "stored": f"{self.data.dtype}, {', '.join(told)}"}
        if (self.slope, self.intercept) != (1, 0):
            rows["scale"] = f"value = {self.slope:.9g} x stored + {self.intercept:.9g}"
        if self.missing:
            rows["missing"] = f"stored {', '.join(f'{number:g}' for number in self.missing)}"
        if self.convention:
            rows["world"] = f"{self.convention}, read as LPS (left, back, head)"
        if self.labels:
            rows["names"] = ", ".join(f"{value} {name}" for value, name in list(self.labels.items())[:8])
        return rows | ({"assumed": "; ".join(self.assumed)} if self.assumed else {})


def within_type(number: float, dtype: np.dtype) -> bool:
    """Whether a type of integers holds a number."""
    limits = np.iinfo(dtype)
    return bool(limits.min <= number <= limits.max)


def choose(record: ImageRecord, time: int | None, channel: int | None) -> tuple[Any, str]:
    """An index of the array that chooses an image of several, and the letters of the axes that are left: x, y
    and z, and s of several values in a voxel. Raises `ValueError` where the choice is missing or wrong."""
    letters, shape, where = record.letters(), record.data.shape, record.what.removeprefix("path: ")
    given = {"time": time, "channel": channel}
    own = {"time": "t", "channel": "c" if "c" in letters else "s"}
    sizes = ", ".join(f"{axis} {n}" for axis, n in sorted(zip(letters, shape, strict=True), key=_rank))
    for name, letter in own.items():
        if given[name] is not None and letter not in letters:
            raise ValueError(f"{name}: {where} has no such axis; it holds {sizes}.")
    if not {*"xyz"} <= {*letters}:
        raise ValueError(f"{record.what} must be a 3-D image; got one of {sizes}.")
    index: list[Any] = [slice(None)] * len(letters)
    for letter in sorted({*letters} - {*"xyz"}):
        name, at = ("time" if letter == "t" else "channel"), letters.index(letter)
        number = given[name] if own[name] == letter else None
        if number is None and shape[at] > 1:
            if letter == "s":
                continue  # the volume's channels
            raise ValueError(f"{name} must be given, from 0 to {shape[at] - 1}: {where} holds {sizes}.")
        index[at] = integer(name, number or 0, 0, shape[at] - 1)
    return tuple(index), "".join(a for a, i in zip(letters, index, strict=True) if isinstance(i, slice))


def _rank(axis: tuple[str, int]) -> int:
    return "xyztcs".index(axis[0])


def volume_arguments(
    record: ImageRecord, *, time: int | None = None, channel: int | None = None, nan: float | None = None
) -> dict[str, Any]:
    """Arguments of `Volume` for an image: axes in order along the world's, lengths in mm, values scaled, and
    those that are missing replaced by `nan`, by default by the least one that is there.

    Raises:
        ValueError: for axes that are not known, a choice of `time` or `channel` that is missing or wrong, a
            place that is none, and 2**31 voxels or more.

    Warns of what was taken in place of what the file does not say (`ImageRecord.assumed`).
    """
    record.assumed += [] if record.assumed else _of_axes(record)
    index, letters = choose(record, time, channel)
    shape = [n for n, i in zip(record.data.shape, index, strict=True) if isinstance(i, slice)]
    if math.prod(shape) > MOST_VOXELS:
        raise ValueError(f"{record.what} must hold 1 to 2**31 - 1 voxels; got shape {tuple(shape)}.")
    order, signs, place = record.oriented([shape[letters.index(letter)] for letter in "xyz"])
    stored = np.asarray(record.data[index])
    stored = stored if stored.dtype.isnative else stored.astype(stored.dtype.newbyteorder("="))
    data, mask = record.decode(stored)
    if mask is not None:
        data = _filled(record, data, mask, nan)
    if nan is not None and data.dtype.kind == "f":
        nan = np.asarray(finite_array("nan", nan, ())).item()
        data = np.where(np.isfinite(data), data, data.dtype.type(nan))
    if (record.slope, record.intercept) != (1, 0) and data.dtype.kind in "iu" and data.dtype.itemsize > 2:
        if not within(data, WHOLE["float32"]) and len(np.unique(data)) <= 2**16:
            record.note("whole numbers beyond 2**24, which float32 rounds: numbered, see label_ids")
            record.also = record.also | numbered(data)
            data = record.also.pop("data")
    axes = [letters.index("xyz"[axis]) for axis in order] + [k for k, a in enumerate(letters) if a == "s"]
    turned = np.transpose(data, axes)[tuple(slice(None, None, sign) for sign in signs)]
    for text in record.assumed:
        warnings.warn(f"{record.what.removeprefix('path: ')}: {text}", stacklevel=4)
    return {"data": np.ascontiguousarray(turned), **place, **record.also}


def _of_axes(record: ImageRecord) -> list[str]:
    assumed: list[str] = []
    axis_letters(record.what, record.axes, assumed)
    return assumed


def _filled(record: ImageRecord, data: np.ndarray, mask: np.ndarray, nan: float | None) -> np.ndarray:
    """Values with those that are missing replaced."""
    if nan is None:
        if mask.all():
            raise ValueError(f"{record.what} must hold values; all {mask.size} are missing. Give nan=VALUE.")
        nan = data[~mask].min().item()
        count = np.count_nonzero(mask)
        record.note(
            f"{count} of {mask.size} values are missing: shown as the least, {nan:g}; nan= is another"
        )
    whole = data.dtype.kind in "iu" and float(nan).is_integer() and within_type(nan, data.dtype)
    data = np.array(data, data.dtype if whole or data.dtype.kind == "f" else np.float32)
    data[mask] = nan
    return data


def numbered(ids: np.ndarray) -> dict[str, Any]:
    """Arguments of `Volume`: numbers in the order of the ids, in place of these, and the ids."""
    kinds, numbers = np.unique(ids, return_inverse=True)
    return {"data": numbers.reshape(ids.shape), "label_ids": kinds.tolist()}


class DecodedArray:
    """The array of a record, of which boxes are read as values, with some axes reversed: for bricks.

    Args:
        record: its array has `shape`, `dtype` and `array[box]`.
        reverse: axes of the array that are reversed.
    """

    def __init__(self, record: ImageRecord, reverse: Sequence[int], nan: float | None):
        self.record, self.reverse, self.nan, self.shape = record, reverse, nan, record.data.shape
        stored = np.dtype(getattr(record.data.dtype, "numpy_dtype", record.data.dtype))
        scaled = (record.slope, record.intercept) != (1, 0) or record.missing
        self.dtype = np.dtype(np.float32) if scaled else stored

    def __getattr__(self, name: str) -> Any:  # chunks, chunk_layout
        if name in ("chunks", "chunk_layout"):
            return getattr(self.record.data, name)
        raise AttributeError(name)

    def __getitem__(self, box: tuple[Any, ...]) -> np.ndarray:
        index = list(box)
        for axis in self.reverse:
            index[axis] = slice(self.shape[axis] - box[axis].stop, self.shape[axis] - box[axis].start)
        values, mask = self.record.decode(np.asarray(self.record.data[tuple(index)]))
        if mask is not None:
            if self.nan is None:
                raise ValueError("values are missing: give nan=VALUE, --nan")
            values = np.where(mask, self.nan, values)
        kept = [axis for axis, part in enumerate(box) if isinstance(part, slice)]
        return values[tuple(slice(None, None, -1 if axis in self.reverse else 1) for axis in kept)]
