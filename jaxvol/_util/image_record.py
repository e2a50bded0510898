"""Record of an array of voxels and its metadata, and its conversion to arguments of `Volume`."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .affine import directions
from .checks import finite_array, integer, shortened
from .files import MOST_VOXELS, ensure
from .texts import warn_caller
from .units import axis_letters, length_of
from .voxels import WHOLE, check_shape, is_flat, within


ALONG_AXES = 1e-5
"""Maximum deviation of directions from the world's axes that is ignored: 0.01 voxels in 1000."""


@dataclass
class ImageRecord:
    """Array of voxels and its metadata, as its writer meant them."""

    data: Any  # the stored array, of NumPy or one that is read box by box
    axes: Sequence[str]  # names of its axes, in order
    steps: Mapping[str, float] = field(default_factory=dict)  # signed distances along x, y, z, where known
    units: Mapping[str, str | None] | str | None = None  # units of the steps, or their common unit
    origin: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)  # position of the first voxel along x, y, z
    direction: np.ndarray | None = None  # directions of the axes x, y, z in the world, as columns
    convention: str = ""  # directions of the world's axes: "LPS" (left, back, head), "RAS" or such; "": none
    slope: float = 1.0  # value = slope * stored number + intercept
    intercept: float = 0.0
    missing: tuple[float, ...] = ()  # stored numbers that represent missing values
    unsigned: bool = False  # stored integers have no sign, whatever their type (`_Unsigned` of NetCDF)
    labels: Mapping[int, str] = field(default_factory=dict)  # names of the values of a segmentation
    assumed: list[str] = field(default_factory=list)  # assumptions in place of missing metadata
    also: dict[str, Any] = field(default_factory=dict)  # further arguments of `Volume`
    what: str = "data"  # beginning of error messages
    format: str = ""
    is_chosen: bool = False  # the reader has selected one of several times

    @property
    def letters(self) -> str:
        """Letters of the axes. Raises `ValueError` for unknown axes."""
        return axis_letters(self.what, self.axes, self.note)

    @property
    def is_scaled(self) -> bool:
        return (self.slope, self.intercept) != (1, 0)

    def note(self, text: str) -> None:
        """Append to `assumed`, once."""
        self.assumed += [] if text in self.assumed else [text]

    def unit(self, letter: str) -> str | None:
        """Unit of the step along an axis, as stored."""
        return self.units if isinstance(self.units, str | None) else self.units.get(letter)

    def millimetres(self) -> np.ndarray:
        """Lengths in mm of the units along x, y, z; for an unknown unit, as along another axis, or 1."""
        lengths = [length_of(self.unit(letter)) for letter in "xyz"]
        usual = next(filter(None, lengths), None)
        default = "taken as 1" if usual is None else f"taken as {usual:g} mm, as along other axes"
        for letter, length in zip("xyz", lengths, strict=True):
            if (unit := self.unit(letter)) and not length:
                self.note(f"unit {shortened(unit)}: {default}")
        return np.array([length or usual or 1.0 for length in lengths])

    def decode(self, stored: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Values of stored numbers, and a mask of missing ones, if any. An integer scale keeps integers."""
        kind = stored.dtype
        absent = [kind.type(number) for number in self.missing if holds(kind, number)]
        mask = np.isin(stored, absent) if absent else None
        mask = mask if mask is not None and mask.any() else None
        if self.unsigned and kind.kind == "i":
            stored = stored.view(kind.str.replace("i", "u"))
        slope, intercept = float(self.slope), float(self.intercept)
        if not self.is_scaled:
            return stored, mask
        if stored.dtype.kind in "iu" and slope.is_integer() and intercept.is_integer() and stored.size:
            limit = max(abs(int(end) * int(slope) + int(intercept)) for end in (stored.min(), stored.max()))
            if limit < 2**62 and max(abs(slope), abs(intercept)) < 2**63:
                values = stored.astype(np.int64) * int(slope) + int(intercept)
                return values.astype(np.int32 if limit < 2**31 else np.int64), mask
        values = np.empty(stored.shape, np.float64 if stored.dtype == np.float64 else np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # infinite values are refused, or replaced, later
            for source, target in zip(stored, values, strict=True):  # plane by plane, which saves memory
                target[...] = source * np.float64(slope) + intercept
        return values, mask

    def oriented(self, sizes: list[int], turned: bool = True) -> tuple[list[int], list[int], dict[str, Any]]:
        """Order and signs of the data's axes (of `sizes` voxels) along the world's, and the known of spacing
        (mm), origin and direction. If not `turned`, axes keep their order; negative steps reverse them."""
        lengths, steps = self.millimetres(), np.array([self.steps.get(a, 1.0) for a in "xyz"], float)
        if self.steps and (unknown := [letter for letter in "xyz" if letter not in self.steps]):
            self.note(f"the distance along {', '.join(unknown)}: taken as 1, in the unit of the others")
        world = np.array([1.0 if axis in "LPS" else -1.0 for axis in self.convention or "LPS"])
        turn = np.eye(3) if self.direction is None else np.asarray(self.direction, float)
        subject, origin = f"{self.what}: its place", np.asarray(self.origin, float)
        must, got = "must be finite, with steps longer than 0", f"{steps.tolist()} from {origin.tolist()}"
        is_place = steps.all() and np.isfinite([*steps, *origin, *turn.flat]).all()
        ensure(is_place, f"{subject} {must}; got {got}.")
        turn = directions(subject, turn) * world[:, None] * np.sign(steps)
        order, signs = [0, 1, 2], np.sign(steps).astype(int)
        if turned:  # the assignment of the data's axes to the world's with the largest sum of cosines
            orders = map(list, itertools.permutations(range(3)))
            order = max(orders, key=lambda p: np.abs(turn[range(3), p]).sum())
            signs = np.where(np.diag(turn[:, order]) >= 0, 1, -1)
        turn, spacing = turn[:, order], (np.abs(steps) * lengths)[order]
        last = [sizes[axis] - 1 if sign < 0 else 0 for axis, sign in zip(order, signs, strict=True)]
        place = {"spacing": spacing, "origin": world * origin * lengths + turn @ (spacing * last)}
        if not np.allclose(turn * signs, np.eye(3), rtol=0, atol=ALONG_AXES):
            place["direction"] = turn * signs
        known = self.steps or self.convention or self.direction is not None or place["origin"].any()
        return order, signs.tolist(), place if known else {}

    def rows(self) -> dict[str, str]:
        """Description of the record, by topic, for `jaxvol info`."""
        lengths = {a: f" of {step:.6g} {self.unit(a) or ''}".rstrip() for a, step in self.steps.items()}
        axes = zip(self.axes, self.data.shape, self.letters, strict=True)
        sizes = ", ".join(f"{name} {n}{lengths.get(letter, '')}" for name, n, letter in axes)
        stored = getattr(self.data.dtype, "numpy_dtype", self.data.dtype)  # of tensorstore
        scale = f"value = {self.slope:.9g} x stored + {self.intercept:.9g}"
        rows = {
            "format": self.format,
            "stored": f"{stored}, {sizes}",
            "scale": self.is_scaled and scale,
            "missing": self.missing and f"stored {', '.join(f'{n:g}' for n in self.missing)}",
            "world": self.convention and f"{self.convention}, shown as LPS (left, back, head)",
            "names": self.labels and shortened(", ".join(f"{k} {name}" for k, name in self.labels.items())),
            "assumed": "; ".join(self.assumed),
        }
        return {name: str(text) for name, text in rows.items() if text}


def holds(dtype: np.dtype, number: float) -> bool:
    """Test that a type of integers or floats can hold a number; floats may round it."""
    is_whole = dtype.kind in "iu" and float(number).is_integer()
    return dtype.kind == "f" or (is_whole and np.iinfo(dtype).min <= number <= np.iinfo(dtype).max)


def choose(record: ImageRecord, time: int | None, channel: int | None) -> tuple[tuple[Any, ...], str]:
    """Index that selects one image, and the remaining axes. Raises `ValueError` for a bad choice."""
    letters, shape, source = record.letters, record.data.shape, record.what.removeprefix("path: ")
    time = None if record.is_chosen else time
    axes = sorted(zip(letters, shape, strict=True), key=lambda axis: "xyztcs".index(axis[0]))
    sizes = ", ".join(f"{axis} {n}" for axis, n in axes)
    choices = {"t": ("time", time), "c" if "c" in letters else "s": ("channel", channel)}
    for letter, (name, number) in choices.items():
        ensure(number is None or letter in letters, f"{name}: {source} has no such axis; it holds {sizes}.")
    index: list[Any] = [slice(None)] * len(letters)
    for letter in sorted({*letters} - {*"xyz"}):
        axis = letters.index(letter)
        name, number = choices.get(letter, ("channel", None))
        if number is None and letter == "s" and shape[axis] > 1:
            continue  # the volume's channels
        missing = f"{name} must be given, from 0 to {shape[axis] - 1}: {source} holds {sizes}."
        ensure(number is not None or shape[axis] == 1, missing)
        index[axis] = integer(name, number or 0, 0, shape[axis] - 1)
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
    missing values replaced by `nan` or the minimum, and segment ids and scaled integers numbered if float32
    would round them. Raises `ValueError` for a bad record or choice; warns of assumptions."""
    index, letters = choose(record, time, channel)
    shape = [n for n, part in zip(record.data.shape, index, strict=True) if isinstance(part, slice)]
    fault = f"{record.what} must hold 1 to 2**31 - 1 voxels; got shape {tuple(shape)}."
    ensure(math.prod(shape) <= MOST_VOXELS, fault)
    if not {*"xyz"} <= {*letters}:
        check_shape(tuple(shape[:2]))
    order, signs, place = record.oriented([shape[letters.index(a)] for a in "xyz"], turned=turned)
    stored = np.asarray(record.data[index])
    data, mask = record.decode(stored.astype(stored.dtype.newbyteorder("="), copy=False))
    if mask is not None:
        data = _filled(record, data, mask, nan)
    if nan is not None and data.dtype.kind == "f":
        data = np.where(np.isfinite(data), data, data.dtype.type(np.asarray(finite_array("nan", nan, ()))))
    axes = [letters.index("xyz"[axis]) for axis in order] + [k for k, a in enumerate(letters) if a == "s"]
    data = np.transpose(data, axes)[tuple(slice(None, None, sign) for sign in signs)]
    arguments = {"data": np.ascontiguousarray(data), **place, **record.also}
    is_wide = data.dtype.kind in "iu" and data.itemsize > 2 and data.size > 0
    is_wide = is_wide and not within(data, WHOLE["float32"])
    if is_wide and record.is_scaled:
        record.note("whole numbers beyond 2**24, which float32 would round: numbered, see label_ids")
    if is_wide and (record.is_scaled or any(is_flat(np.moveaxis(data, axis, 0)) for axis in range(3))):
        arguments |= numbered(arguments["data"])
    for text in record.assumed:
        warn_caller(f"{record.what.removeprefix('path: ')}: {text}")
    return arguments


def _filled(record: ImageRecord, data: np.ndarray, mask: np.ndarray, nan: float | None) -> np.ndarray:
    """Replace missing values."""
    if nan is None:
        count, n = np.count_nonzero(mask), mask.size
        ensure(count < n, f"{record.what} must hold values; all {n} are missing. Give nan=VALUE.")
        nan = float(data[~mask].min().item())
        record.note(f"{count} of {n} values are missing: shown as {nan:g}; see nan")
    data = np.array(data, data.dtype if holds(data.dtype, nan) else np.float32)
    data[mask] = nan
    return data


def numbered(ids: np.ndarray) -> dict[str, Any]:
    """Arguments of `Volume` for integer ids: their ranks as data, and the sorted ids as `label_ids`."""
    kinds, numbers = np.unique(ids, return_inverse=True)
    return {"data": numbers.reshape(ids.shape), "label_ids": kinds.tolist()}


class DecodedArray:
    """Array of a record for bricks: boxes are read as decoded values, with some axes reversed."""

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
