"""The rig, its recordings and the experiment, from files or from Python; validated when they are built."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from itertools import count
from math import isclose
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args

import numpy as np
from annotated_types import Ge, Le, MinLen, Predicate
from numpy.typing import NDArray

from vjm.errors import (
    ExperimentError,
    RecordingError,
    ShapeError,
    printable,
    require,
    require_choice,
    require_kind,
    shown,
)
from vjm.experiment.arrays import as_array, check_rate, check_time, check_turns, column_numbers, number_array
from vjm.experiment.checks import MIN_FRAMES, cleaned, experiment_warnings
from vjm.experiment.conventions import Conventions, angle_of, check_columns
from vjm.experiment.payload import Payload
from vjm.text import counted

if TYPE_CHECKING:
    import pandas as pd

Kind = Literal["driven", "decay", "static", "quiet"]
Role = Literal["train", "holdout"]
Input = Literal["torque", "motion"]
Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
Complex = NDArray[np.complex128]

# Fields of the records and keys of the experiment file alike: type, constraints, and what errors say is expected.
# Bounds are those of anything that was ever called an arm, a thousand times wider for a number in the wrong unit, which
# is to be named as such: from the cantilever of an atomic force microscope (0.1 mm, 1 µm thick, 1e-11 kg, 1e-13 N m^2)
# to a tower crane (100 m, 1e5 kg, 1e11 N m^2), from gels (1 Pa) to diamond (1e12 Pa), and a centrifuge's 1e5 m/s^2.
_Acceleration = Annotated[float, Ge(-1e8), Le(1e8)]
_Gravity = Annotated[
    tuple[_Acceleration, _Acceleration],
    "two finite numbers, gravity along x and y of the base frame [m/s^2], at most 1e8",
]
_Payload = Annotated[float, Ge(0), Le(1e9), "a finite number, zero or positive [kg], at most 1e9"]
_Offset = Annotated[float, Ge(-1e6), Le(1e6), "a finite number [m], at most 1e6"]
_Inertia = Annotated[float, Ge(0), Le(1e15), "a finite number, zero or positive [kg m^2], at most 1e15"]
_Radius = Annotated[float, Ge(0), Le(1e6), "a finite number, zero or positive [m], at most 1e6"]
_Arc = Annotated[float, Ge(1e-9), Le(1e6)]
_Metres = Annotated[float, Ge(1e-9), Le(1e6), "a finite positive number [m], from 1e-9 to 1e6"]
_OptionalMetres = Annotated[float | None, Ge(1e-9), Le(1e6), "a finite positive number [m], from 1e-9 to 1e6"]
_OptionalPascals = Annotated[float | None, Ge(1e-6), Le(1e15), "a finite positive number [Pa], from 1e-6 to 1e15"]
_OptionalRadians = Annotated[float | None, Ge(1e-12), Le(1e6), "a finite positive number [rad], from 1e-12 to 1e6"]
_PRINTABLE = Predicate(lambda name: printable(name) == name)
_MIN_STIFFNESS, _MAX_STIFFNESS = 1e-18, 1e18  # N m^2

T = TypeVar("T")


class _RigsGravity(tuple[float, float]):
    """Gravity of a recording that is given none: zero, or that of the rig into whose experiment it was put last."""


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
        hub_radius: distance of the proximal end from the joint axis [m]; zero for a clamped link.
        payload: known mass at the distal end [kg].
        payload_offset: of its centre beyond the distal end, along the link there [m].
        payload_inertia: of it about its centre [kg m^2].
        markers_frame: frame of the marker coordinates: the base frame or the link frame Sigma_i.
        width: parallel to the joint axes [m]; None where only EI was given.
        thickness: in the bending plane [m]; None where only EI was given.
        youngs_modulus: nominal [Pa]; None where only EI was given.
        virtual_joints: number n of virtual joints asked for; None: chosen from the data.

    Raises:
        ExperimentError: a field has the wrong type or value, or contradicts another.
    """

    name: Annotated[str, Predicate(re.compile("[A-Za-z0-9_]+").fullmatch), "a name of letters, digits and underscores"]
    joint: Annotated[Literal["revolute", "clamped"], '"revolute" or "clamped"']
    length: _Metres
    mass: Annotated[float, Ge(1e-14), Le(1e9), "a finite positive number [kg], from 1e-14 to 1e9"]
    bending_stiffness: Annotated[
        float, Ge(_MIN_STIFFNESS), Le(_MAX_STIFFNESS), "a finite positive number [N m^2], from 1e-18 to 1e18"
    ] = None  # type: ignore[assignment]
    markers: Annotated[tuple[_Arc, ...], "a list of finite positive numbers, arc lengths [m]"] = ()
    hub_inertia: _Inertia = 0.0
    hub_radius: _Radius = 0.0
    payload: _Payload = 0.0
    payload_offset: _Offset = 0.0
    payload_inertia: _Inertia = 0.0
    markers_frame: Annotated[Literal["base", "link"], '"base" or "link"'] = "base"
    width: _OptionalMetres = None
    thickness: _OptionalMetres = None
    youngs_modulus: _OptionalPascals = None
    virtual_joints: Annotated[int | None, Ge(1), Le(60), "a whole number from 1 to 60"] = None

    def __post_init__(self) -> None:
        """Validate."""
        _check_fields(self, self.name)
        for key in ("hub_inertia", "hub_radius"):
            if self.joint == "clamped" and getattr(self, key):
                self._refuse(key, "the link is clamped and has no hub", 'this key only with joint = "revolute"')
        _check_payload(self, f"link {self.name}")
        previous = 0.0
        # On the tip in spite of rounding, as 3 * 0.1 is on one of 0.3 m, in single precision too.
        markers = tuple(
            self.length if isclose(marker, self.length, rel_tol=2e-7) else marker for marker in self.markers
        )
        object.__setattr__(self, "markers", markers)
        for number, marker in enumerate(self.markers, start=1):
            if marker > self.length:
                expected = f"arc lengths up to the link's length, {self.length:g} m"
                self._refuse("markers", f"item {number} is {marker:g}, beyond the link", expected)
            if marker <= previous:
                expected = "strictly increasing arc lengths, from the proximal end outwards"
                self._refuse("markers", f"item {number} is {marker:g} after {previous:g}", expected)
            previous = marker
        object.__setattr__(self, "bending_stiffness", self._section_stiffness())

    @property
    def payload_body(self) -> Payload:
        """The payload as a body."""
        return Payload(self.payload, self.payload_offset, self.payload_inertia)

    def _section_stiffness(self) -> float:
        section = {"youngs_modulus": self.youngs_modulus, "width": self.width, "thickness": self.thickness}
        absent = [key for key, value in section.items() if value is None]
        present = [key for key in section if key not in absent]
        alternatives = "either youngs_modulus, width and thickness, or bending_stiffness"
        E, w, h = (value or 0.0 for value in section.values())
        stiffness = E * w * h * h * h / 12.0
        if self.bending_stiffness is not None:
            # A link keeps both, and a copy of it is given both.
            if present and (absent or not np.isclose(stiffness, self.bending_stiffness, rtol=1e-6, atol=0.0)):
                advice = "a copy with another section has bending_stiffness = None"
                self._refuse(present[0], "given together with bending_stiffness", alternatives, advice)
            return self.bending_stiffness
        if absent:
            self._refuse(absent[0] if present else "bending_stiffness", "missing", alternatives)
        if not _MIN_STIFFNESS <= stiffness <= _MAX_STIFFNESS:
            problem = f"bending stiffness E w h^3 / 12 comes out as {stiffness:g}"
            expected = f"values that give {_MIN_STIFFNESS:g} to {_MAX_STIFFNESS:g} N m^2"
            self._refuse("youngs_modulus", problem, expected)
        return stiffness

    def _refuse(self, key: str, problem: str, expected: str, in_python: str = "") -> None:
        raise ExperimentError(None, f"link {self.name}", key, problem, expected, in_python)

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

    name: Annotated[
        str,
        MinLen(1),
        _PRINTABLE,  # XML, and so URDF, holds no other
        "the experiment's name, a string that is not empty and has no control characters",
    ]
    links: tuple[Link, ...]
    gravity: _Gravity = (0.0, 0.0)
    marker_noise: Annotated[float | None, Ge(1e-12), Le(1e6), "a finite positive number [m], from 1e-12 to 1e6"] = None
    encoder_noise: _OptionalRadians = None

    def __post_init__(self) -> None:
        """Validate."""
        _check_fields(self, self.name)
        links = _tuple_of(self.links, Link, f"rig {self.name}", "links")
        object.__setattr__(self, "links", links)
        names = [link.name for link in links]
        for index, name in enumerate(names):
            if name in names[:index]:
                problem = f"'{name}' is already the name of link[{names.index(name) + 1}]"
                raise ExperimentError(None, f"link[{index + 1}] {name}", "name", problem, "a name of its own")

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Names of all markers, link by link: those of their columns without `.x` and `.y`."""
        return tuple(column.removesuffix(".x") for link in self.links for column in link.marker_columns[::2])

    def require_markers(self) -> None:
        """Raise an `ExperimentError` if there is no marker on any link."""
        if not any(link.markers for link in self.links):
            table = f"link[1] {self.links[0].name}"
            raise ExperimentError(None, table, "markers", "no link has a marker", "at least one")

    def __repr__(self) -> str:
        links = [f"{link.name} ({link.joint}, {link.length:g} m, {len(link.markers)} markers)" for link in self.links]
        return f"Rig({self.name!r}, links: {', '.join(links)}; gravity {self.gravity} m/s^2)"

    @property
    def has_elbow(self) -> bool:
        """True if a joint beyond the first link is driven."""
        return any(link > 0 for link in self.active_links)

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
        payload_offset: of its centre beyond the tip, along the link there [m].
        payload_inertia: of it about its centre [kg m^2].
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
    payload_offset: _Offset = 0.0
    payload_inertia: _Inertia = 0.0
    repeat: Annotated[str | None, MinLen(1), "a label shared by recordings that repeat one experiment"] = None
    condition: Annotated[str | None, MinLen(1), 'a label, as "reference"'] = None
    input: Annotated[Input, '"torque" or "motion"'] = "torque"
    acceleration: Array | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Validate, and make arrays of what was measured."""
        gravity = _RIGS_GRAVITY if self.gravity is None else self.gravity
        object.__setattr__(self, "gravity", gravity)
        _check_fields(self, self.file)
        if isinstance(gravity, _RigsGravity):
            object.__setattr__(self, "gravity", gravity)
        name = self.file or "recording"
        _check_payload(self, name)
        time = as_array(name, "time", self.time, "(T,) instants [s]", (None,))
        check_time(name, "time", time)
        arrays = {
            key: as_array(name, key, values, f"(T, number of active joints) {unit}", (time.size, None))
            for key, values, unit in (("theta", self.theta, "angles [rad]"), ("tau", self.tau, "torques [N m]"))
            if values is not None
        }
        if len(arrays) == 2 and arrays["theta"].shape != arrays["tau"].shape:
            problem, expected = f"an array of shape {arrays['tau'].shape}", f"{arrays['theta'].shape}, as theta has"
            raise RecordingError(name, None, "tau", problem, expected)
        unknown = np.full(next(iter(arrays.values())).shape if arrays else (time.size, 0), np.nan)
        markers = as_array(name, "markers", self.markers, "(T, k, 2) positions [m]", (time.size, None, 2))
        if self.input == "motion":
            arrays["tau"] = np.full_like(arrays.get("theta", unknown), np.nan)
        if self.acceleration is not None:
            shape = arrays.get("theta", unknown).shape
            valid = number_array("acceleration", self.acceleration).shape == shape
            require("acceleration", self.acceleration, valid, f"an array {shape}, as theta has [rad/s^2]")
        for key, value in {"theta": unknown, "tau": unknown, **arrays, "time": time, "markers": markers}.items():
            object.__setattr__(self, key, value)

    @property
    def payload_body(self) -> Payload:
        """The payload as a body."""
        return Payload(self.payload, self.payload_offset, self.payload_inertia)

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
            ShapeError: no frame.
            RecordingError: a column is unknown or missing, a cell is no number, or too few frames are usable.
        """
        file, rig = fields.get("file"), as_rig(rig)
        name = file if isinstance(file, str) and file else "recording"
        if not hasattr(frame, "columns"):
            raise ShapeError("frame", shown(frame), "a pandas DataFrame")
        columns = tuple(str(column) for column in frame.columns)
        check_columns(name, columns, rig, kind, fields.get("input", "torque"))
        values = {column: column_numbers(name, column, frame[column]) for column in columns}
        check_time(name, "t", values["t"])
        if not values["t"].size:
            raise RecordingError(name, None, None, "the table is empty", "a row for each instant")
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
            **fields,
        )
        return for_rig(rig, recording, "")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Recording):
            return NotImplemented
        return all(
            np.array_equal(value, other_value, equal_nan=True)
            if isinstance(value, np.ndarray)
            else value == other_value
            for value, other_value in zip(vars(self).values(), vars(other).values(), strict=True)
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
        conventions: units, camera and column names of the recording files; the records themselves are SI.
        unused_columns: those of the recording files that nothing names.

    Raises:
        ExperimentError: no recording, or recordings of one `repeat` label that differ in kind, payload or gravity.
        RecordingError: a recording that does not fit the rig, or has fewer than 10 usable frames.
    """

    rig: Rig
    recordings: tuple[Recording, ...]
    file: Path | None = None
    conventions: Conventions = field(default_factory=Conventions)
    unused_columns: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Validate."""
        rig = as_rig(self.rig)
        rig.require_markers()
        require_kind("file", self.file, (Path, NoneType), "the path of the experiment file, or None")
        require_kind("conventions", self.conventions, Conventions, "the conventions of another experiment")
        valid = isinstance(self.unused_columns, tuple) and all(isinstance(name, str) for name in self.unused_columns)
        require("unused_columns", self.unused_columns, valid, "names of columns")
        recordings: list[Recording] = []
        given = _tuple_of(self.recordings, Recording, "experiment", "recordings")
        taken = {recording.file: recording for recording in reversed(given) if recording.file}
        for number, recording in enumerate(given, start=1):
            free = next(name for k in count(number) if (name := f"recording_{k}") not in taken)
            recording = for_rig(rig, recording, free)
            namesake = taken.setdefault(recording.file, recording)
            if not np.array_equal(recording.markers, namesake.markers, equal_nan=True):
                table = f"recording[{number}] {recording.file}"
                problem = "also the name of a recording of other markers"
                raise ExperimentError(self.file, table, "file", problem, "a name of its own")
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
            earlier = self.recordings[number]
            for key in ("kind", "payload", "payload_offset", "payload_inertia", "gravity"):
                value, earlier_value = getattr(recording, key), getattr(earlier, key)
                if value != earlier_value:
                    place = f"[recording[{number + 1}] {earlier.file}] with the same repeat label '{recording.repeat}'"
                    problem = f"{shown(value)}, but {place} has another"
                    table = f"recording[{index + 1}] {recording.file}"
                    expected = f"{shown(earlier_value)}, or another label"
                    raise ExperimentError(self.file, table, key, problem, expected)

    def __repr__(self) -> str:
        lines = [repr(self.rig), *map(repr, self.recordings[:8])]
        remaining = len(self.recordings) - 8
        lines += [f"and {remaining} more recordings"] if remaining > 0 else []
        return "Experiment(" + "\n  ".join(lines) + ")"

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Sentences that a user should read before trusting results."""
        unused = [f"columns that nothing names are not used: {', '.join(self.unused_columns)}"]
        warnings = experiment_warnings(self.rig, self.recordings, self.conventions)
        return (*unused[: len(self.unused_columns)], *warnings)

    @cached_property
    def cleaned_recordings(self) -> tuple[Recording, ...]:
        """The recordings without coordinates that cannot be right: what models are fitted to and compared with.

        Raises:
            RecordingError: nothing is left of a link's markers in a recording.
        """
        return tuple(cleaned(self.rig, recording, self.conventions.camera.origin) for recording in self.recordings)

    def with_role(self, role: Role) -> tuple[Recording, ...]:
        """Return the recordings of one role as they were read, in order.

        Raises:
            ChoiceError: an unknown role.
        """
        require_choice("role", role, get_args(Role))
        return tuple(recording for recording in self.recordings if recording.role == role)


def as_rig(rig: Rig | Link) -> Rig:
    """Return a rig, of a bare link one that has its name.

    Raises:
        ExperimentError: neither.
    """
    if isinstance(rig, Link):
        return Rig(rig.name, (rig,))
    if not isinstance(rig, Rig):
        raise ExperimentError(None, "experiment", "rig", f"got {shown(rig)}", "a vjm.Rig, or a single vjm.Link")
    return rig


def require_experiment(experiment: Experiment) -> None:
    """Raise an `ExperimentError` for what is no experiment, such as the name of its file."""
    if not isinstance(experiment, Experiment):
        expected = "a vjm.Experiment, as of `vjm.load_experiment(file)`"
        raise ExperimentError(None, "experiment", "experiment", f"got {shown(experiment)}", expected)


def require_recording(recording: Recording) -> None:
    """Raise a `ShapeError` for what is no recording, such as the name of its file."""
    require_kind("recording", recording, Recording, "a vjm.Recording, such as one of `experiment.recordings`")


def for_rig(rig: Rig, recording: Recording, name: str = "recording") -> Recording:
    """Return a recording as one of a rig: with the rig's gravity if it was given none, and a name if it has none.

    Raises:
        RecordingError: it does not fit the rig, or has fewer than 10 usable frames.
        ShapeError: no recording.
    """
    require_recording(recording)
    own = not isinstance(recording.gravity, _RigsGravity)
    gravity = recording.gravity if own else _RigsGravity(rig.gravity)
    if gravity != recording.gravity or not recording.file:
        recording = replace(recording, gravity=gravity, file=recording.file or name)
    _check_recording(rig, recording)
    return recording


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
        raise RecordingError(name, None, f"{active[0]}.theta", "the column is missing", angle_of(active[0]))
    if width != len(active):
        expected = f"{len(active)}, one for each active joint: {', '.join(active) or 'there is none'}"
        raise RecordingError(name, None, "theta", counted(width, "column"), expected)
    for column, joint in enumerate(active):
        if not np.isfinite(recording.theta[:, column]).any():
            raise RecordingError(name, None, f"{joint}.theta", "every cell is empty", "joint angles [rad]")
        torque = recording.kind == "driven" and recording.input == "torque"
        if torque and not np.isfinite(recording.tau[:, column]).any():
            expected = 'joint torques [N m], or input = "motion" where the joints turn as their encoders say'
            raise RecordingError(name, None, f"{joint}.tau", "every cell is empty", expected)
        known = int(np.isfinite(recording.theta[:, column]).sum())
        if recording.input == "motion" and known < MIN_FRAMES:
            expected = f"at least {MIN_FRAMES}, since the motion of the joint is given by them"
            raise RecordingError(name, None, f"{joint}.theta", f"{known} angles", expected)
        check_turns(name, f"{joint}.theta", recording.theta[:, column])
    if recording.input == "motion" and not active:
        expected = "a link with an active joint"
        raise RecordingError(name, None, "input", "the motion of no joint is given: every link is clamped", expected)
    measured = np.isfinite(recording.markers)
    signals = [measured.any(axis=(1, 2)), *np.isfinite(recording.theta).T, *np.isfinite(recording.tau).T]
    usable = measured[:, :, 1]
    for link, marker_slice in zip(rig.links, rig.marker_slices, strict=True):
        if link.markers_frame == "base":
            usable[:, marker_slice] &= measured[:, marker_slice, 0]
    count = int(usable.any(axis=1).sum())
    if count < MIN_FRAMES:
        expected = f"at least {MIN_FRAMES} rows with a measured marker"
        raise RecordingError(name, None, None, counted(count, "usable frame"), expected)
    check_rate(name, recording.time, (recording.time[rows] for rows in signals))


def _check_payload(record: Link | Recording, table: str) -> None:
    for key in ("payload_offset", "payload_inertia"):
        if getattr(record, key) and not record.payload:
            raise ExperimentError(None, table, key, "given without a payload", "this key only beside payload [kg]")


def _check_fields(record: object, name: object) -> None:
    from vjm.experiment.schema import check_fields  # pydantic is slow to import

    check_fields(record, name)


def _tuple_of(values: Any, kind: type[T], table: str, key: str) -> tuple[T, ...]:
    try:
        items = (values,) if isinstance(values, kind) else tuple(values)
    except TypeError:  # not iterable
        items = (values,)
    unsuitable = [item for item in items if not isinstance(item, kind)]
    if unsuitable or not items:
        problem = f"got {shown(unsuitable[0])}" if unsuitable else "there is none"
        raise ExperimentError(None, table, key, problem, f"at least one vjm.{kind.__name__}, and nothing else")
    return items
