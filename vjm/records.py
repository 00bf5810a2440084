"""What passes between the stages: the rig, its recordings, and a parameter's estimate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Joint = Literal["revolute", "clamped"]
Kind = Literal["driven", "decay", "static", "quiet"]
Role = Literal["train", "holdout"]
MarkersFrame = Literal["base", "link"]
Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
Complex = NDArray[np.complex128]

Progress = Callable[[str, int, int], None]  # told (text, done, total) now and then

REFERENCE = "reference"  # the condition in which the effect being sought is known to be absent


@dataclass(frozen=True)
class Link:
    """One flexible link of the rig.

    Attributes:
        name: unique; letters, digits and underscores.
        joint: `revolute`, an active joint at the proximal end, or `clamped`.
        length: undeformed [m].
        mass: spread uniformly along the link [kg].
        bending_stiffness: nominal EI [N m^2].
        markers: arc length of each marker from the proximal end [m].
        hub_inertia: about the joint axis, motor included [kg m^2]; zero for a clamped link.
        payload: known point mass at the distal end [kg].
        markers_frame: frame of the marker coordinates: the base frame or the link frame Sigma_i.
        width: parallel to the joint axes [m]; None where only EI was given.
        thickness: in the bending plane [m]; None where only EI was given.
        youngs_modulus: nominal [Pa]; None where only EI was given.
        virtual_joints: number n of virtual joints asked for; None: chosen from the data.
    """

    name: str
    joint: Joint
    length: float
    mass: float
    bending_stiffness: float
    markers: tuple[float, ...]
    hub_inertia: float = 0.0
    payload: float = 0.0
    markers_frame: MarkersFrame = "base"
    width: float | None = None
    thickness: float | None = None
    youngs_modulus: float | None = None
    virtual_joints: int | None = None


@dataclass(frozen=True)
class Rig:
    """The arm: its links from the base outwards, gravity and the sensors' noise.

    Attributes:
        name: the experiment's name.
        links: from the base outwards.
        gravity: in the plane, (x, y) of the base frame [m/s^2].
        marker_noise: 1-sigma noise of a marker coordinate [m]; None: estimated from the data.
        encoder_noise: 1-sigma noise of an encoder [rad]; None: estimated from the data.
    """

    name: str
    links: tuple[Link, ...]
    gravity: tuple[float, float] = (0.0, 0.0)
    marker_noise: float | None = None
    encoder_noise: float | None = None

    @property
    def active_links(self) -> tuple[int, ...]:
        """Indices of the links with an active joint, in order; columns of `theta` and `tau` follow them."""
        return tuple(i for i, link in enumerate(self.links) if link.joint == "revolute")

    @property
    def marker_slices(self) -> tuple[slice, ...]:
        """For each link, the markers that are its own in a recording's marker array."""
        stops = np.cumsum([len(link.markers) for link in self.links]).tolist()
        return tuple(slice(stop - len(link.markers), stop) for stop, link in zip(stops, self.links, strict=True))


@dataclass(frozen=True)
class Recording:
    """One recording, time first; what was not measured at an instant is NaN.

    Attributes:
        file: its name as the experiment file gives it.
        kind: `driven`, `decay`, `static` or `quiet`.
        role: `train`, or `holdout` (never used for fitting).
        time: (T,) [s], increasing.
        theta: (T, number of active joints) joint angles [rad].
        tau: (T, number of active joints) joint torques [N m].
        markers: (T, k, 2) marker positions (x, y) [m], all links' markers one after another, each in its link's
            `markers_frame`; a coordinate the file has no column for is NaN throughout.
        gravity: in the plane, (x, y) of the base frame [m/s^2].
        payload: known extra mass on the last link's tip [kg].
        repeat: label shared by recordings that repeat one experiment.
        condition: `reference` where the effect being sought is known to be absent.
    """

    file: str
    kind: Kind
    role: Role
    time: Array
    theta: Array
    tau: Array
    markers: Array
    gravity: tuple[float, float] = (0.0, 0.0)
    payload: float = 0.0
    repeat: str | None = None
    condition: str | None = None

    @property
    def frames(self) -> NDArray[np.intp]:
        """Rows at which the camera measured anything at all."""
        return np.flatnonzero(np.isfinite(self.markers).any(axis=(1, 2)))


@dataclass(frozen=True)
class Experiment:
    """A rig and what was recorded on it.

    Attributes:
        rig: the arm.
        recordings: in the file's order.
        file: the experiment file, None for an experiment built in Python.
        warnings: what a user should know before trusting results.
    """

    rig: Rig
    recordings: tuple[Recording, ...]
    file: Path | None = None
    warnings: tuple[str, ...] = ()

    def with_role(self, role: Role) -> tuple[Recording, ...]:
        """The recordings of one role, in order."""
        return tuple(recording for recording in self.recordings if recording.role == role)


@dataclass(frozen=True)
class Estimate:
    """One identified (or fixed) parameter.

    Attributes:
        name: `LINK.quantity` or `LINK.quantity_J`, as `beam.bending_stiffness` or `beam.stiffness_2`.
        value: in `unit`.
        std: standard error in `unit`; None for a parameter that was not estimated.
        unit: SI.
        identifiable: whether the data determine it.
        reason: in words, why not; empty where they do.
        remedy: in words, which recording would; empty where they do.
    """

    name: str
    value: float
    std: float | None
    unit: str
    identifiable: bool = True
    reason: str = ""
    remedy: str = ""


@dataclass(frozen=True)
class Simulation:
    """An open-loop trajectory at a recording's instants.

    Attributes:
        time: (T,) [s].
        q, v: (T, nv) joint angles [rad] and rates [rad/s].
        theta: (T, number of active joints) active joint angles [rad].
        markers: (T, k, 2) marker positions, each in its link's `markers_frame` [m].
    """

    time: Array
    q: Array
    v: Array
    theta: Array
    markers: Array


@dataclass(frozen=True)
class SimulatedRecording:
    """A recording beside its open-loop simulation from the most likely initial state.

    Attributes:
        recording: without coordinates that cannot be right.
        simulation: at the recording's instants, as its sensors would show it.
        noise: 1-sigma of a marker coordinate [m] and of an encoder [rad].
        chi2: weighted sum of squared residuals.
        count: number of measured values behind it.
        status: `converged`, or `not converged` (the remedy is a better model: the state alone cannot follow the data).
    """

    recording: Recording
    simulation: Simulation
    noise: tuple[float, float]
    chi2: float
    count: int
    status: Literal["converged", "not converged"]

    @cached_property
    def marker_residual(self) -> Array:
        """(T, k, 2) measured minus simulated marker coordinates [m]; NaN where none was measured."""
        return self.recording.markers - self.simulation.markers

    @cached_property
    def theta_residual(self) -> Array:
        """(T, n_a) measured minus simulated active joint angles [rad]; NaN where none was measured."""
        return self.recording.theta - self.simulation.theta

    @cached_property
    def marker_rms(self) -> float:
        """RMS of the residuals of all measured marker coordinates [m]; NaN without any."""
        return _rms(self.marker_residual)

    @cached_property
    def theta_rms(self) -> float | None:
        """RMS of the active joints' residuals [rad]; None where no angle was measured."""
        return _rms(self.theta_residual) if np.isfinite(self.theta_residual).any() else None


@dataclass(frozen=True)
class RecordingComparison:
    """One recording beside simulations of it by up to three models.

    Attributes:
        recording: without coordinates that cannot be right, and without outliers.
        noise: 1-sigma of a marker coordinate [m] and of an encoder [rad].
        simulated: by the model that is judged: the identified one, or the one extended by the causes found; None where
            it cannot be simulated.
        reference: by the model it is compared with: of nominal values, or without causes; None as above.
        alternative: by a third model: what the torque method found, or the next best explanation; None where there is
            none.
        left_out: number of marker coordinates, impossible or outlying, that are not in `recording` any more.
        problem: why the recording cannot be simulated; empty otherwise.
    """

    recording: Recording
    noise: tuple[float, float]
    simulated: SimulatedRecording | None
    reference: SimulatedRecording | None = None
    alternative: SimulatedRecording | None = None
    left_out: int = 0
    problem: str = ""


def _rms(residual: Array) -> float:
    known = residual[np.isfinite(residual)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
