"""Validation of measured arrays and table columns: types, shapes, magnitudes and sampling."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from vjm.errors import RecordingError, ShapeError, shown

if TYPE_CHECKING:
    import pandas as pd

    from vjm.experiment.records import Array

_CELL = "a finite number, or NaN where nothing was measured"

# Magnitudes that no arm's recordings reach, not even in the wrong unit: a tower crane's 100 m in µm are 1e8, counts of
# an encoder 1e7, a wind turbine's torque of 1e7 N m in N mm is 1e10, the time of the epoch in µs is 2e15.
_LARGEST = {"time": (1e18, "s"), "theta": (1e9, "rad"), "tau": (1e15, "N m"), "markers": (1e9, "m")}
_MIN_INTERVAL, _MAX_DURATION = 1e-9, 1e10  # s; cameras take 1e7 frames/s at most, three hours in µs are 1e10
# Signals are filtered on even instants from a recording's begin to its end, pauses included: no more of these than ten
# for each row, or a hundred thousand.
_INSTANTS_PER_ROW, _MOST_INSTANTS = 10, 1e5


def as_array(name: str, key: str, value: ArrayLike, expected: str, shape: tuple[int | None, ...]) -> Array:
    """Return an array of finite numbers or NaN, of a shape in which None stands for any length; nothing can change it.

    What is masked is NaN.
    """
    _refuse_dates(name, key, value)
    try:
        if not np.iscomplexobj(value) and isinstance(value, np.ma.MaskedArray):
            value = np.ma.filled(value.astype(np.float64), np.nan)
        array = np.empty(()) if np.iscomplexobj(value) else np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(())
    if _may_change(array):
        array = array.copy()
        array.flags.writeable = False
    if not array.ndim:
        raise RecordingError(name, None, key, f"got {shown(value)}", f"an array {expected}")
    if key != "time" and array.ndim == 1 and len(shape) == 2:
        array = array[:, None]
    if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        length_note = "" if shape[0] is None else f" with T = {shape[0]}"
        raise RecordingError(name, None, key, f"an array of shape {array.shape}", f"an array {expected}{length_note}")
    _check_range(name, key, array, key)
    return array


def number_array(name: str, values: Any) -> Array:
    """Return an argument as an array of numbers.

    Raises:
        ShapeError: it holds something else.
    """
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ShapeError(name, shown(values), "an array of numbers") from None


def _may_change(array: Any) -> bool:
    """Return True if an array, or what it is a view of, can be written to; pandas hands out read-only views."""
    while isinstance(array, np.ndarray):
        if array.flags.writeable:
            return True
        array = array.base
    return array is not None  # the buffer of something that is no array


def _refuse_dates(name: str, key: str, value: Any) -> None:
    if getattr(getattr(value, "dtype", None), "kind", "") in ("m", "M"):
        expected = "numbers, as `(t - t[0]) / numpy.timedelta64(1, 's')` [s]"
        raise RecordingError(name, None, key, "dates or durations", expected)


def _check_range(name: str, column: str, values: Array, quantity: str) -> None:
    """Raise a `RecordingError` at the first number (T, ...) of a column that is infinite or beyond any arm's."""
    largest, unit = _LARGEST[quantity]
    positions = np.argwhere(np.abs(values) > largest)
    if positions.size:
        value, problem, expected = values[tuple(positions[0])], "an infinite value", _CELL
        if np.isfinite(value):
            problem, expected = f"{value:.6g} {unit} is beyond any arm", f"at most {largest:g} {unit}; check its unit"
        raise RecordingError(name, None, column, problem, expected, int(positions[0, 0]))


def check_rate(name: str, time: Array, sensors: Iterable[Array]) -> None:
    """Raise a `RecordingError` if the instants (T,) of a recording, or those of a sensor, are no sampling.

    Args:
        name: of the recording.
        time: all instants [s].
        sensors: of each sensor, the instants at which it measured anything [s].
    """
    duration = float(time[-1] - time[0])
    if duration > _MAX_DURATION:
        problem = f"{duration:.4g} s from the first row to the last"
        raise RecordingError(name, None, "t", problem, f"at most {_MAX_DURATION:g} s; check the unit of time")
    for instants in sensors:
        intervals = np.diff(instants)
        if not intervals.size:
            continue
        if intervals.min() < _MIN_INTERVAL:
            index = int(np.searchsorted(time, instants[intervals.argmin() + 1]))
            problem = f"{intervals.min():.4g} s after the sensor's measurement before"
            raise RecordingError(name, None, "t", problem, f"at least {_MIN_INTERVAL:g} s", index)
        usual = float(np.median(intervals))
        if duration > usual * max(_MOST_INSTANTS, _INSTANTS_PER_ROW * time.size):
            index = int(np.diff(time).argmax()) + 1
            problem = (
                f"{time[index] - time[index - 1]:.4g} s after the row before, where a sensor usually measures every "
                f"{usual:.4g} s"
            )
            expected = "shorter pauses; split the recording there"
            raise RecordingError(name, None, "t", problem, expected, index)


def column_numbers(name: str, column: str, values: pd.Series) -> Array:
    """Return a column of a table as numbers, NaN where it is empty."""
    _refuse_dates(name, column, values)
    with suppress(TypeError, ValueError, OverflowError):
        array = values.astype(object if np.iscomplexobj(values) else values.dtype).to_numpy(
            dtype=np.float64, na_value=np.nan, copy=True
        )
        quantity = {"t": "time"}.get(column, column.rpartition(".")[2])
        _check_range(name, column, array, quantity if quantity in _LARGEST else "markers")
        return array
    for index, cell in enumerate(values):
        try:
            float(cell)
        except (TypeError, ValueError, OverflowError) as error:
            raise RecordingError(name, None, column, f"{shown(cell)} is not a number", _CELL, index) from error
    raise RecordingError(name, None, column, "not a column of numbers", _CELL)


def check_time(name: str, column: str, time: Array) -> None:
    """Raise a `RecordingError` if a time (T,) is missing or time does not increase."""
    _check_range(name, column, time, "time")
    invalid = np.flatnonzero(np.isnan(time))
    if invalid.size:
        raise RecordingError(name, None, column, "the time is missing", "a time in every row [s]", int(invalid[0]))
    invalid = np.flatnonzero(np.diff(time) <= 0.0)
    if invalid.size:
        index = int(invalid[0]) + 1
        problem = f"time does not increase, {time[index]:.9g} after {time[index - 1]:.9g}"
        raise RecordingError(name, None, column, problem, "a time later than the row before", index)


def check_turns(name: str, column: str, angles: Array) -> None:
    """Raise a `RecordingError` where angles (T,) jump by a full turn, as those of an encoder do that starts over.

    A single angle that is off by that much is an outlier.
    """
    rows = np.flatnonzero(np.isfinite(angles))
    turns = np.diff(angles[rows]) / (2 * np.pi)
    jumps = np.abs(np.abs(turns) - 1) < 0.1  # by what an arm may turn beside that from one sample to the next
    ahead = np.cumsum(np.where(jumps, np.sign(turns), 0.0))
    found = np.flatnonzero((ahead[1:] != 0) & (ahead[:-1] != 0))  # for two samples and more
    # Angles in degrees step by six now and then, but by four and five as well.
    other = (np.abs(turns) > 0.25) & ~jumps
    if found.size and other.sum() < jumps.sum():
        row, before = rows[found[0] + 1], rows[found[0]]
        problem = f"{angles[row]:.6g} rad after {angles[before]:.6g} rad, a full turn at once"
        expected = "angles that go on beyond a turn, as of `numpy.unwrap`"
        raise RecordingError(name, None, column, problem, expected, int(row))
