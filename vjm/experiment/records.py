"""The rig, its recordings and the experiment, from files or from Python; validated when they are built."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
from annotated_types import Ge, Gt, Le, MinLen, Predicate
from numpy.typing import ArrayLike, NDArray

from vjm.errors import ExperimentError, RecordingError, shown, suggestion
from vjm.experiment.checks import cleaned, experiment_warnings

if TYPE_CHECKING:
    import pandas as pd

Joint = Literal["revolute", "clamped"]
Kind = Literal["driven", "decay", "static", "quiet"]
Role = Literal["train", "holdout"]
Input = Literal["torque", "motion"]
MarkersFrame = Literal["base", "link"]
Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
Complex = NDArray[np.complex128]

# Fields of the records and keys of the experiment file alike: type, constraints, and what errors say is expected.
_Gravity = Annotated[tuple[float, float], "two finite numbers, gravity along x and y of the base frame [m/s^2]"]
_Payload = Annotated[float, Ge(0), "a finite number, zero or positive [kg]"]
_Metres = Annotated[float, Gt(0), "a finite positive number [m]"]
_OptionalMetres = Annotated[float | None, Gt(0), "a finite positive number [m]"]

T = TypeVar("T")
_CELL = "a finite number, or NaN where nothing was measured"

_MIN_FRAMES = 10  # usable ones, for a recording to be worth anything


class _RigsGravity(tuple[float, float]):
    """Gravity of a recording that is given none: zero until an experiment puts its rig's there."""


_RIGS_GRAVITY = _RigsGravity((0.0, 0.0))


@dataclass(frozen=True)
class Link:
    """One flexible link of the rig.

    Numbers are SI. Lists and NumPy arrays both do for `markers`. Bending stiffness comes either as such or from
    `youngs_modulus`, `width` and `thickness`.

    Attributes:
        name: unique; letters, digits and underscores.
        joint: `revolute`, an active joint at the proximal end, or `clamped`.
        length: undeformed [m].
        mass: spread uniformly along the link [kg].
        bending_stiffness: nominal EI [N m^2]; None: E w h^3 / 12.
        markers: arc length of each marker from the proximal end [m], increasing.
        hub_inertia: about the joint axis, motor included [kg m^2]; zero for a clamped link.
        payload: known point mass at the distal end [kg].
        markers_frame: frame of the marker coordinates: the base frame or the link frame Sigma_i.
        width: parallel to the joint axes [m]; None where only EI was given.
        thickness: in the bending plane [m]; None where only EI was given.
        youngs_modulus: nominal [Pa]; None where only EI was given.
        virtual_joints: number n of virtual joints asked for; None: chosen from the data.

    Raises:
        ExperimentError: a field has the wrong type or value, or contradicts another.
    """

    name: Annotated[str, Predicate(re.compile("[A-Za-z0-9_]+").fullmatch), "a name of letters, digits and underscores"]
    joint: Annotated[Joint, '"revolute" or "clamped"']
    length: _Metres
    mass: Annotated[float, Gt(0), "a finite positive number [kg]"]
    bending_stiffness: Annotated[float, Gt(0), "a finite positive number [N m^2]"] = None  # type: ignore[assignment]
    markers: Annotated[tuple[Annotated[float, Gt(0)], ...], "a list of finite positive numbers, arc lengths [m]"] = ()
    hub_inertia: Annotated[float, Ge(0), "a finite number, zero or positive [kg m^2]"] = 0.0
    payload: _Payload = 0.0
    markers_frame: Annotated[MarkersFrame, '"base" or "link"'] = "base"
    width: _OptionalMetres = None
    thickness: _OptionalMetres = None
    youngs_modulus: Annotated[float | None, Gt(0), "a finite positive number [Pa]"] = None
    virtual_joints: Annotated[int | None, Ge(1), Le(60), "a whole number from 1 to 60"] = None

    def __post_init__(self) -> None:
        """Validate."""
        _check_fields(self, self.name)
        if self.joint == "clamped" and self.hub_inertia:
            self._refuse("hub_inertia", "the link is clamped and has no hub", 'this key only with joint = "revolute"')
        previous = 0.0
        for number, marker in enumerate(self.markers, start=1):
            if marker > self.length:
                expected = f"arc lengths up to the link's length, {self.length:g} m"
                self._refuse("markers", f"item {number} is {marker:g}, beyond the link", expected)
            if marker <= previous:
                expected = "strictly increasing arc lengths, from the proximal end outwards"
                self._refuse("markers", f"item {number} is {marker:g} after {previous:g}", expected)
            previous = marker
        object.__setattr__(self, "bending_stiffness", self._section_stiffness())

    def _section_stiffness(self) -> float:
        section = {"youngs_modulus": self.youngs_modulus, "width": self.width, "thickness": self.thickness}
        absent = [key for key, value in section.items() if value is None]
        given = [key for key in section if key not in absent]
        either = "either youngs_modulus, width and thickness, or bending_stiffness"
        E, w, h = (value or 0.0 for value in section.values())
        stiffness = E * w * h * h * h / 12.0
        if self.bending_stiffness is not None:
            # A link keeps both, and a copy of it is given both.
            if given and (absent or not np.isclose(stiffness, self.bending_stiffness, rtol=1e-6, atol=0.0)):
                self._refuse(given[0], "given together with bending_stiffness", either)
            return self.bending_stiffness
        if absent:
            self._refuse(absent[0] if given else "bending_stiffness", "missing", either)
        if not (np.isfinite(stiffness) and stiffness > 0.0):
            problem = f"bending stiffness E w h^3 / 12 comes out as {stiffness:g}"
            self._refuse("youngs_modulus", problem, "values that give a finite positive one")
        return stiffness

    def _refuse(self, key: str, problem: str, expected: str) -> None:
        raise ExperimentError(None, f"link {self.name}", key, problem, expected)

    @property
    def marker_columns(self) -> tuple[str, ...]:
        """Names of the columns of its markers' coordinates, x and y of each in turn."""
        return tuple(f"{self.name}.m{number}.{axis}" for number in range(1, len(self.markers) + 1) for axis in "xy")


@dataclass(frozen=True)
class Rig:
    """The arm: its links from the base outwards, gravity and the sensors' noise.

    Attributes:
        name: the experiment's name.
        links: from the base outwards; a bare link is fine too.
        gravity: in the plane, (x, y) of the base frame [m/s^2].
        marker_noise: 1-sigma noise of a marker coordinate [m]; None: estimated from the data.
        encoder_noise: 1-sigma noise of an encoder [rad]; None: estimated from the data.

    Raises:
        ExperimentError: a field has the wrong type or value, or two links have one name.
    """

    name: Annotated[str, MinLen(1), "the experiment's name, a string that is not empty"]
    links: tuple[Link, ...]
    gravity: _Gravity = (0.0, 0.0)
    marker_noise: _OptionalMetres = None
    encoder_noise: Annotated[float | None, Gt(0), "a finite positive number [rad]"] = None

    def __post_init__(self) -> None:
        """Validate."""
        _check_fields(self, self.name)
        links = _several(self.links, Link, f"rig {self.name}", "links")
        object.__setattr__(self, "links", links)
        names = [link.name for link in links]
        for index, name in enumerate(names):
            if name in names[:index]:
                problem = f"'{name}' is already the name of link[{names.index(name) + 1}]"
                raise ExperimentError(None, f"link[{index + 1}] {name}", "name", problem, "a name of its own")

    def require_markers(self) -> None:
        """Raise an `ExperimentError` if there is no marker on any link."""
        if not any(link.markers for link in self.links):
            table = f"link[1] {self.links[0].name}"
            raise ExperimentError(None, table, "markers", "no link has a marker", "at least one")

    def __repr__(self) -> str:
        links = [f"{link.name} ({link.joint}, {link.length:g} m, {len(link.markers)} markers)" for link in self.links]
        return f"Rig({self.name!r}, links: {', '.join(links)}; gravity {self.gravity} m/s^2)"

    @property
    def active_links(self) -> tuple[int, ...]:
        """Indices of the links with an active joint, in order; columns of `theta` and `tau` follow them."""
        return tuple(i for i, link in enumerate(self.links) if link.joint == "revolute")

    @property
    def marker_slices(self) -> tuple[slice, ...]:
        """For each link, the markers that are its own in a recording's marker array."""
        stops = np.cumsum([len(link.markers) for link in self.links]).tolist()
        return tuple(slice(stop - len(link.markers), stop) for stop, link in zip(stops, self.links, strict=True))


@dataclass(frozen=True, repr=False)
class Recording:
    """One recording, time first; what was not measured at an instant is NaN.

    Attributes:
        time: (T,) [s], increasing.
        markers: (T, k, 2) marker positions (x, y) [m], all links' markers one after another, each in its link's
            `markers_frame`; a coordinate that was never measured is NaN throughout.
        theta: (T, number of active joints) joint angles [rad]; (T,) will do for a single joint.
        tau: (T, number of active joints) joint torques [N m]; None: not measured.
        kind: `driven`, `decay`, `static` or `quiet`.
        role: `train`, or `holdout` (never used for fitting).
        file: its name, as the experiment file gives it; an experiment names those without one `recording_1` and so on.
        gravity: in the plane, (x, y) of the base frame [m/s^2]; None: the rig's, once it is part of an experiment.
        payload: known extra mass on the last link's tip [kg].
        repeat: label shared by recordings that repeat one experiment.
        condition: `reference` where the effect being sought is known to be absent.
        input: what drives the active joints: `torque`, as measured, or `motion`: they turn as their encoders say,
            whatever torque that takes; one that was recorded is not used.
        acceleration: (T, number of active joints) of joints that turn as given [rad/s^2], worked out from theta where
            the recording is simulated; None: not yet, or the input is the torque.

    Raises:
        ExperimentError: a field has the wrong type or value.
        RecordingError: an array has the wrong shape, a value is infinite, or time does not increase.
    """

    time: Array
    markers: Array
    theta: Array = None  # type: ignore[assignment]
    tau: Array = None  # type: ignore[assignment]
    _: KW_ONLY
    kind: Annotated[Kind, '"driven", "decay", "static" or "quiet"']
    role: Annotated[Role, '"train" or "holdout"'] = "train"
    file: Annotated[str, "the name of a CSV file, relative to the experiment file"] = ""
    gravity: _Gravity = _RIGS_GRAVITY
    payload: _Payload = 0.0
    repeat: Annotated[str | None, MinLen(1), "a label shared by recordings that repeat one experiment"] = None
    condition: Annotated[str | None, MinLen(1), 'a label, as "reference"'] = None
    input: Annotated[Input, '"torque" or "motion"'] = "torque"
    acceleration: Array | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Validate, and make arrays of what was measured."""
        if self.gravity is None or isinstance(self.gravity, _RigsGravity):
            object.__setattr__(self, "gravity", _RIGS_GRAVITY)
        _check_fields(self, self.file)
        name = self.file or "recording"
        time = _array(name, "time", self.time, "(T,) instants [s]", (None,))
        _check_time(name, "time", time)
        arrays = {
            key: _array(name, key, values, f"(T, number of active joints) {unit}", (time.size, None))
            for key, values, unit in (("theta", self.theta, "angles [rad]"), ("tau", self.tau, "torques [N m]"))
            if values is not None
        }
        if len(arrays) == 2 and arrays["theta"].shape != arrays["tau"].shape:
            problem, expected = f"an array of shape {arrays['tau'].shape}", f"{arrays['theta'].shape}, as theta has"
            raise RecordingError(name, None, "tau", problem, expected)
        unknown = np.full(next(iter(arrays.values())).shape if arrays else (time.size, 0), np.nan)
        markers = _array(name, "markers", self.markers, "(T, k, 2) positions [m]", (time.size, None, 2))
        if self.input == "motion":
            arrays["tau"] = np.full_like(arrays.get("theta", unknown), np.nan)
        for key, value in {"theta": unknown, "tau": unknown, **arrays, "time": time, "markers": markers}.items():
            object.__setattr__(self, key, value)

    @classmethod
    def from_dataframe(cls, frame: pd.DataFrame, rig: Rig | Link, *, kind: Kind, **fields: Any) -> Recording:
        """Return a recording from a table with the columns of a recording's CSV file.

        Args:
            frame: columns `t`, `LINK.theta`, `LINK.tau`, `LINK.mK.x` and `LINK.mK.y`; NaN where not measured.
            rig: the arm, which says what columns there can be; a bare link is fine too.
            kind: `driven`, `decay`, `static` or `quiet`.
            fields: further fields of the recording: role, file, gravity, payload, repeat, condition.

        Raises:
            ExperimentError: a field has the wrong type or value.
            RecordingError: a column is unknown or missing, a cell is no number, or too few frames are usable.
        """
        file, rig = fields.get("file"), _as_rig(rig)
        name = file if isinstance(file, str) and file else "recording"
        if not hasattr(frame, "columns"):
            raise RecordingError(name, None, None, f"got {shown(frame)}", "a pandas DataFrame")
        columns = tuple(str(column) for column in frame.columns)
        check_columns(name, columns, rig, kind, fields.get("input", "torque"))
        values = {column: _numbers(name, column, frame[column]) for column in columns}
        _check_time(name, "t", values["t"])
        unknown = np.full(values["t"].size, np.nan)

        def gathered(names: Iterable[str]) -> Array:
            return np.array([values.get(column, unknown) for column in names]).reshape(-1, unknown.size).T.copy()

        active = [rig.links[i].name for i in rig.active_links]
        recording = cls(
            values["t"],
            gathered(column for link in rig.links for column in link.marker_columns).reshape(unknown.size, -1, 2),
            gathered(f"{link}.theta" for link in active),
            gathered(f"{link}.tau" for link in active),
            kind=kind,
            **{"gravity": rig.gravity, **fields},
        )
        _check_recording(rig, recording)
        return recording

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Recording):
            return NotImplemented
        return all(
            np.array_equal(mine, its, equal_nan=True) if isinstance(mine, np.ndarray) else mine == its
            for mine, its in zip(vars(self).values(), vars(other).values(), strict=True)
        )

    def __repr__(self) -> str:
        span = f" from {self.time[0]:g} to {self.time[-1]:g} s" if self.time.size else ""
        arrays = ", ".join(f"{key} {getattr(self, key).shape}" for key in ("markers", "theta", "tau"))
        return f"Recording({self.file!r}, {self.kind}, {self.role}: {self.time.size} samples{span}, {arrays})"

    @property
    def initial_theta(self) -> Array:
        """(n_a,) active joints' angles first measured; zero where none was [rad]."""
        first = [column[np.isfinite(column)][:1] for column in self.theta.T]
        return np.array([value[0] if value.size else 0.0 for value in first])

    @property
    def frames(self) -> NDArray[np.intp]:
        """Rows at which the camera measured anything at all."""
        return np.flatnonzero(np.isfinite(self.markers).any(axis=(1, 2)))


@dataclass(frozen=True)
class Experiment:
    """A rig and what was recorded on it.

    Attributes:
        rig: the arm; a bare link is fine too.
        recordings: in the file's order; a bare one is fine too.
        file: the experiment file, None for an experiment built in Python.

    Raises:
        ExperimentError: no recording, or recordings of one `repeat` label that differ in kind, payload or gravity.
        RecordingError: a recording that does not fit the rig, or has fewer than 10 usable frames.
    """

    rig: Rig
    recordings: tuple[Recording, ...]
    file: Path | None = None

    def __post_init__(self) -> None:
        """Validate."""
        rig = _as_rig(self.rig)
        rig.require_markers()
        recordings = []
        for number, recording in enumerate(_several(self.recordings, Recording, "experiment", "recordings"), start=1):
            gravity = rig.gravity if isinstance(recording.gravity, _RigsGravity) else recording.gravity
            if gravity is not recording.gravity or not recording.file:
                recording = replace(recording, gravity=gravity, file=recording.file or f"recording_{number}")
            _check_recording(rig, recording)
            recordings.append(recording)
        object.__setattr__(self, "rig", rig)
        object.__setattr__(self, "recordings", tuple(recordings))
        self._check_repeats()

    def _check_repeats(self) -> None:
        first: dict[str, int] = {}
        for index, recording in enumerate(self.recordings):
            if recording.repeat is None:
                continue
            number = first.setdefault(recording.repeat, index)
            other = self.recordings[number]
            for key in ("kind", "payload", "gravity"):
                here, there = getattr(recording, key), getattr(other, key)
                if here != there:
                    place = f"[recording[{number + 1}] {other.file}] with the same repeat label '{recording.repeat}'"
                    problem = f"{shown(here)}, but {place} has another"
                    table, expected = f"recording[{index + 1}] {recording.file}", f"{shown(there)}, or another label"
                    raise ExperimentError(self.file, table, key, problem, expected)

    def __repr__(self) -> str:
        lines = [repr(self.rig), *map(repr, self.recordings[:8])]
        more = len(self.recordings) - 8
        lines += [f"and {more} more recordings"] if more > 0 else []
        return "Experiment(" + "\n  ".join(lines) + ")"

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Sentences that a user should read before trusting results."""
        return tuple(experiment_warnings(self.rig, self.recordings))

    @cached_property
    def cleaned_recordings(self) -> tuple[Recording, ...]:
        """The recordings without coordinates that cannot be right: what models are fitted to and compared with.

        Raises:
            RecordingError: nothing is left of a link's markers in a recording.
        """
        return tuple(cleaned(self.rig, recording) for recording in self.recordings)

    def with_role(self, role: Role) -> tuple[Recording, ...]:
        """Return the recordings of one role as they were read, in order."""
        return tuple(recording for recording in self.recordings if recording.role == role)


def _as_rig(rig: Rig | Link) -> Rig:
    if isinstance(rig, Link):
        return Rig(rig.name, (rig,))
    if not isinstance(rig, Rig):
        raise ExperimentError(None, "experiment", "rig", f"got {shown(rig)}", "a vjm.Rig, or a single vjm.Link")
    return rig


def check_columns(
    name: Path | str,
    columns: Sequence[str],
    rig: Rig,
    kind: Kind,
    given: Input = "torque",
    row: int | None = None,
) -> None:
    """Check that each column occurs once, that the rig knows it, and that none is missing.

    Raises:
        RecordingError: naming the column, the file or recording, and of a file the header's line `row`.
    """
    active = [rig.links[i].name for i in rig.active_links]
    known = {"t", *(f"{link}.{quantity}" for link in active for quantity in ("theta", "tau"))}
    known |= {column for link in rig.links for column in link.marker_columns}
    for position, column in enumerate(columns):
        if column in columns[:position]:
            raise RecordingError(name, row, column, "the column occurs twice", "each column once")
        if column not in known:
            problem = _unknown_reason(column, rig, known) if column else "a column without a name"
            raise RecordingError(name, row, column, problem, f"only the columns {_known_columns(rig)}")
    for column, expected in _needed_columns(columns, rig, kind == "driven" and given == "torque"):
        if column not in columns:
            raise RecordingError(name, row, column, "the column is missing", expected)


def _check_recording(rig: Rig, recording: Recording) -> None:
    name = recording.file or "recording"
    counts = ", ".join(f"{link.name} {len(link.markers)}" for link in rig.links)
    total = sum(len(link.markers) for link in rig.links)
    active = [rig.links[i].name for i in rig.active_links]
    if recording.markers.shape[1] != total:
        problem = f"{recording.markers.shape[1]} markers"
        raise RecordingError(name, None, "markers", problem, f"{total}, as the links have: {counts}")
    width = recording.theta.shape[1]
    if active and not width:
        raise RecordingError(name, None, f"{active[0]}.theta", "the column is missing", _angle_of(active[0]))
    if width != len(active):
        expected = f"{len(active)}, one for each active joint: {', '.join(active) or 'there is none'}"
        raise RecordingError(name, None, "theta", f"{width} column{'s' if width > 1 else ''}", expected)
    for column, joint in enumerate(active):
        if not np.isfinite(recording.theta[:, column]).any():
            raise RecordingError(name, None, f"{joint}.theta", "every cell is empty", "joint angles [rad]")
        torque = recording.kind == "driven" and recording.input == "torque"
        if torque and not np.isfinite(recording.tau[:, column]).any():
            expected = 'joint torques [N m], or input = "motion" where the joints turn as their encoders say'
            raise RecordingError(name, None, f"{joint}.tau", "every cell is empty", expected)
        known = int(np.isfinite(recording.theta[:, column]).sum())
        if recording.input == "motion" and known < _MIN_FRAMES:
            expected = f"at least {_MIN_FRAMES}, since the motion of the joint is given by them"
            raise RecordingError(name, None, f"{joint}.theta", f"{known} angles", expected)
    if recording.input == "motion" and not active:
        expected = "a link with an active joint"
        raise RecordingError(name, None, "input", "the motion of no joint is given: every link is clamped", expected)
    measured = np.isfinite(recording.markers)
    usable = measured[:, :, 1]
    for link, own in zip(rig.links, rig.marker_slices, strict=True):
        if link.markers_frame == "base":
            usable[:, own] &= measured[:, own, 0]
    count = int(usable.any(axis=1).sum())
    if count < _MIN_FRAMES:
        problem = f"{count} usable frame{'' if count == 1 else 's'}"
        raise RecordingError(name, None, None, problem, f"at least {_MIN_FRAMES} rows with a measured marker")


def _check_fields(record: object, name: object) -> None:
    from vjm.experiment.schema import check_fields  # pydantic is slow to import

    check_fields(record, name)


def _several(values: Any, kind: type[T], table: str, key: str) -> tuple[T, ...]:
    try:
        items = (values,) if isinstance(values, kind) else tuple(values)
    except TypeError:  # not iterable
        items = (values,)
    strangers = [item for item in items if not isinstance(item, kind)]
    if strangers or not items:
        problem = f"got {shown(strangers[0])}" if strangers else "there is none"
        raise ExperimentError(None, table, key, problem, f"at least one vjm.{kind.__name__}, and nothing else")
    return items


def _array(name: str, key: str, value: ArrayLike, expected: str, shape: tuple[int | None, ...]) -> Array:
    """Return an array of finite numbers or NaN, of a shape in which None stands for any length."""
    try:
        array = np.empty(()) if np.iscomplexobj(value) else np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(())
    if not array.ndim:
        raise RecordingError(name, None, key, f"got {shown(value)}", f"an array {expected}")
    if key != "time" and array.ndim == 1 and len(shape) == 2:
        array = array[:, None]
    if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        there = "" if shape[0] is None else f" with T = {shape[0]}"
        raise RecordingError(name, None, key, f"an array of shape {array.shape}", f"an array {expected}{there}")
    _check_finite(name, key, array)
    return array


def _check_finite(name: str, column: str, values: Array) -> None:
    infinite = np.isinf(values)
    if infinite.any():
        raise RecordingError(name, None, column, "an infinite value", _CELL, int(np.argwhere(infinite)[0, 0]))


def _numbers(name: str, column: str, values: pd.Series) -> Array:
    """Return a column of a table as numbers, NaN where it is empty."""
    with suppress(TypeError, ValueError, OverflowError):
        array = values.astype(object if np.iscomplexobj(values) else values.dtype).to_numpy(
            dtype=np.float64, na_value=np.nan, copy=True
        )
        _check_finite(name, column, array)
        return array
    for index, cell in enumerate(values):
        try:
            float(cell)
        except (TypeError, ValueError, OverflowError) as error:
            raise RecordingError(name, None, column, f"{shown(cell)} is not a number", _CELL, index) from error
    raise RecordingError(name, None, column, "not a column of numbers", _CELL)


def _check_time(name: str, column: str, time: Array) -> None:
    bad = np.flatnonzero(np.isnan(time))
    if bad.size:
        raise RecordingError(name, None, column, "the time is missing", "a time in every row [s]", int(bad[0]))
    bad = np.flatnonzero(np.diff(time) <= 0.0)
    if bad.size:
        index = int(bad[0]) + 1
        problem = f"time does not increase, {time[index]:.9g} after {time[index - 1]:.9g}"
        raise RecordingError(name, None, column, problem, "a time later than the row before", index)


def _known_columns(rig: Rig) -> str:
    parts = ["t"]
    for link in rig.links:
        parts += [f"{link.name}.theta", f"{link.name}.tau"] if link.joint == "revolute" else []
        count = len(link.markers)
        numbers = "K = 1" if count == 1 else f"K = 1..{count}"
        parts += [f"{link.name}.mK.x and {link.name}.mK.y ({numbers})"] if count else []
    return ", ".join(parts)


def _unknown_reason(column: str, rig: Rig, known: set[str]) -> str:
    owner, _, quantity = column.partition(".")
    link = {link.name: link for link in rig.links}.get(owner)
    if link is not None and quantity in ("theta", "tau"):
        return f"unknown column: link '{owner}' is clamped and has no active joint"
    if link is not None and re.fullmatch(r"m[1-9][0-9]*\.[xy]", quantity):
        return f"unknown column: link '{owner}' has {len(link.markers)} markers"
    if link is None and quantity:
        return f"unknown column: there is no link {shown(owner)}{suggestion(column, sorted(known))}"
    return f"unknown column{suggestion(column, sorted(known))}"


def _needed_columns(columns: Sequence[str], rig: Rig, torque: bool) -> Iterator[tuple[str, str]]:
    yield "t", "the time of each row [s]"
    for link in rig.links:
        if link.joint == "revolute":
            yield f"{link.name}.theta", _angle_of(link.name)
        if link.joint == "revolute" and torque:
            yield f"{link.name}.tau", f"the torque that drives link '{link.name}' [N m]"
        pairs = list(zip(link.marker_columns[::2], link.marker_columns[1::2], strict=True))
        given = [pair for pair in pairs if pair[0] in columns or pair[1] in columns]
        if pairs and not given:
            yield pairs[0][1], f"columns of at least one marker of link '{link.name}'"
        for x, y in given:
            yield y, "x and y of a marker, both [m]"
            if link.markers_frame == "base":
                yield x, "both x and y of a marker measured in the base frame [m]"


def _angle_of(link: str) -> str:
    return f"the angle of the active joint of link '{link}' [rad]"
