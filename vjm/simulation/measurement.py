"""Measurements of a motion by cameras and encoders, and their prediction from a simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from vjm.chain.curve import marker_pose_slopes, marker_poses, transfer_state
from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect
from vjm.records import Array, Indices, Recording, Rig, Simulation
from vjm.simulation.arm import Arm
from vjm.simulation.given_motion import given_acceleration
from vjm.simulation.least_squares import LINEAR, Loss
from vjm.simulation.system import Trajectory, torque_at

# Forward difference, largest at a joint [rad, rad/s or units of internal states]: its relative error is of the order of
# the step, and rounding adds 1e-16 / 1e-6.
DIFFERENCE_STEP = 1e-6
# How often instants and positions of markers that are seen one after another are made to agree: what they differ by
# falls each time to what a marker moves within the readout of as much, a few per cent.
_EXPOSURE_PASSES = 3
# Variance that errors of a given motion add to the noise, below which they do not matter: a percent of it.
_LEAST_VARIANCE = 0.01


@dataclass(frozen=True)
class MarkerArcs:
    """Positions of the markers along the links.

    Attributes:
        lengths: for each link, (k_i,) arc lengths [m].
        in_link_frame: for each link, whether its markers are given in the link frame.
    """

    lengths: tuple[Array, ...]
    in_link_frame: tuple[bool, ...]

    @classmethod
    def of(cls, rig: Rig) -> MarkerArcs:
        """Return the markers of a rig."""
        return cls(
            tuple(np.array(link.markers) for link in rig.links),
            tuple(link.markers_frame == "link" for link in rig.links),
        )

    def positions(self, chain: Chain, q: Array) -> Array:
        """Return (..., k, 2) marker positions [m] at angles q (..., nv) [rad]."""
        return self.poses(chain, q)[0]

    def poses(self, chain: Chain, q: Array) -> tuple[Array, Array]:
        """Return the markers' positions (..., k, 2) [m], and headings (..., k) [rad] of the links there."""
        return marker_poses(chain, q, self.lengths, self.in_link_frame)

    def seen(self, arm: Arm, positions: Array, headings: Array, time: Array) -> Array:
        """Return (F, k, 2) positions [m] as the camera gives them, from the markers' poses when they are seen.

        Poses are at each of the instants (F,), or at (k, F), those at which each marker is seen.
        """
        if time.ndim == 1:
            return arm.marker_positions(positions, headings, time)
        instants = enumerate(zip(positions, headings, time, strict=True))
        return np.stack([arm.marker_positions(*seen)[:, k] for k, seen in instants], axis=1)

    def measured_positions(self, arm: Arm, q: Array, time: Array) -> Array:
        """Return (F, k, 2) positions [m] as the camera gives them.

        Args:
            arm: with its sensors.
            q: (F, nv), or (k, F, nv) for each marker, angles [rad].
            time: (F,) or (k, F) when the arm is seen at these, since the recording's start [s].
        """
        return self.seen(arm, *self.poses(arm.chain, q), time)

    def jacobian(self, arm: Arm, q: Array, time: Array, directions: Array) -> Array:
        """Return (F, 2 k, m) derivatives of `measured_positions` along directions (nv, m) of the angles."""
        if q.ndim == 3:
            by_marker = [
                self.jacobian(arm, *exposure, directions)[:, 2 * k : 2 * k + 2]
                for k, exposure in enumerate(zip(q, time, strict=True))
            ]
            return np.concatenate(by_marker, axis=1)
        slopes, turning = marker_pose_slopes(arm.chain, q, directions, self.lengths, self.in_link_frame)
        if arm.sensors:  # what they make of the markers is known in values only
            positions, headings = self.poses(arm.chain, q)
            seen = arm.marker_positions(positions, headings, time)
            # Small at every joint: shapes of a mode with unit modal mass are large on a light arm.
            steps = DIFFERENCE_STEP / np.maximum(np.abs(directions).max(axis=0, initial=0.0), 1e-300)
            for k, step in enumerate(steps.tolist()):
                moved = positions + step * slopes[..., k], headings + step * turning[:, k]
                slopes[..., k] = (arm.marker_positions(*moved, time) - seen) / step
        return slopes.reshape(len(q), 2 * turning.shape[0], turning.shape[1])

    def exposure_times(self, arm: Arm, trajectory: Trajectory, time: Array) -> Array:
        """Return when the camera saw frames stamped (F,) [s]: (F,) or, where markers differ, (k, F) [s]."""
        exposures = time
        if arm.exposure_effects:
            stamps = trajectory.elapsed(time)
            for _ in range(_EXPOSURE_PASSES):
                positions = self.positions(arm.chain, trajectory.angles(exposures))
                if exposures.ndim == 2:  # of each marker when it is seen itself
                    positions = np.diagonal(positions, axis1=0, axis2=2).transpose(0, 2, 1)
                delays = [effect.camera_instants(stamps, positions).T - stamps for effect in arm.exposure_effects]
                exposures = time + sum(delays[1:], start=delays[0])
                if exposures.ndim == 1:  # whatever the positions are
                    break
        return exposures

    def positions_in_frames(self, arm: Arm, trajectory: Trajectory, time: Array) -> Array:
        """Return the (F, k, 2) marker positions [m] in frames stamped (F,) [s] of a trajectory."""
        exposures = self.exposure_times(arm, trajectory, time)
        return self.measured_positions(arm, trajectory.angles(exposures), trajectory.elapsed(exposures))

    def velocities(self, arm: Arm, trajectory: Trajectory, time: Array) -> Array:
        """Return the (F, k, 2) velocities [m/s] of what frames stamped (F,) [s] of a trajectory show."""
        exposures, step = self.exposure_times(arm, trajectory, time), 0.1 * trajectory.step
        later, earlier = (
            self.measured_positions(arm, trajectory.angles(instants), trajectory.elapsed(instants))
            for instants in (exposures + step, exposures - step)
        )
        result: Array = (later - earlier) / (2 * step)
        return result


def sensor_readings(arm: Arm, arcs: MarkerArcs, recording: Recording, trajectory: Trajectory) -> Simulation:
    """Return a trajectory at a recording's instants, with the readings of its sensors."""
    angles, rates = trajectory.sample(recording.time)
    markers = arcs.positions_in_frames(arm, trajectory, recording.time)
    return Simulation(recording.time, angles, rates, arm.encoder_angles(angles[:, arm.chain.active]), markers)


@dataclass(frozen=True, eq=False)
class PrecedingMotions:
    """Estimated motions before segments of recordings, from which effects with memory get their initial states.

    Attributes:
        chain: that moved.
        files: R recordings.
        time: (I, R) since each recording's start [s]; shorter motions end with repetitions of their last instant.
        q, v: (I, R, nv) angles [rad] and rates [rad/s].
    """

    chain: Chain
    files: tuple[str, ...]
    time: Array
    q: Array
    v: Array
    _known: dict[tuple[int, tuple[Effect, ...]], Array] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, chain: Chain, motions: Mapping[str, tuple[Array, Array, Array]]) -> Self:
        """Collect times (I,), angles and rates (I, nv), by recording's file."""
        longest = max(time.size for time, *_ in motions.values())
        time, q, v = (
            np.stack([values[np.minimum(np.arange(longest), len(values) - 1)] for values in each], axis=1)
            for each in zip(*motions.values(), strict=True)
        )
        return cls(chain, tuple(motions), time, q, v)

    def internal_states(self, arm: Arm, file: str, time: float) -> Array:
        """Return the internal states (nz,) of an arm's effects at a time since a recording's start [s]."""
        states, of_recording = self._along(arm), self.files.index(file)
        times = self.time[:, of_recording]
        later = max(int(np.searchsorted(times, time)), 1)
        if later >= times.size:
            return np.asarray(states[-1, of_recording])
        share = np.clip((time - times[later - 1]) / (times[later] - times[later - 1]), 0.0, 1.0)
        before, after = states[later - 1 : later + 1, of_recording]
        return np.asarray(before + share * (after - before))

    def _along(self, arm: Arm) -> Array:
        """Return internal states (I, R, nz) of an arm's effects, which depend on no stiffness."""
        counts = zip(arm.effects, arm.state_counts, strict=True)
        key = arm.chain.size, tuple(effect for effect, count in counts if count)
        if key not in self._known:
            q, v = self.q, self.v
            if arm.chain.size != self.chain.size:
                states = np.concatenate([q, v], axis=2)
                moved = transfer_state(self.chain, arm.chain, states.reshape(-1, states.shape[2]).T).T
                q, v = np.split(moved.reshape(*states.shape[:2], -1), 2, axis=2)
            self._known[key] = Arm(arm.chain, key[1]).follow(self.time, q, v)
        return self._known[key]


def principal_errors(errors: Array) -> Array:
    """Return the principal components (N, r) of independent errors (N, k) of weighted values, as far as they matter.

    They are orthogonal, and independent as well.
    """
    variances, combinations = np.linalg.eigh(errors.T @ errors)
    return np.asarray(errors @ combinations[:, variances > _LEAST_VARIANCE])


@dataclass(frozen=True)
class Observations:
    """Values measured in one recording: marker coordinates first, then active joints' angles, each in order of time.

    Attributes:
        recording: its source.
        arcs: positions of the markers along the links.
        frames: (F,) rows of the recording at which the camera measured anything.
        marker_indices: (N_m,) measured coordinates, as indices into (F, 2 k) flattened.
        angle_indices: (N_t,) measured angles, as indices into (T, n_a) flattened.
        values: (N_m + N_t,) measured values [m, rad].
        noise: 1-sigma of a marker coordinate [m] and of an angle [rad].
        loss: of the weighted residuals.
        whitening: (N_m + N_t, N_m + N_t) sparse, makes white noise of the sensors' weighted noise; None: it is white.
        motion_errors: (N_m + N_t, k) changes of the weighted values by k independent errors, each of one standard
            deviation, of the given motion of joints; None: there are none.
        discretization_offset: (N_m + N_t,) added to predictions [m, rad]; None: nothing.
        start: instant at which the recording began, where this is part of a longer one [s]; None: its first.
        preceding: motions of whole recordings; None: not known, effects remember nothing.
    """

    recording: Recording
    arcs: MarkerArcs
    frames: Indices
    marker_indices: Indices
    angle_indices: Indices
    values: Array
    noise: tuple[float, float]
    loss: Loss = LINEAR
    whitening: sparse.csr_array | None = None
    motion_errors: Array | None = None
    discretization_offset: Array | None = None
    start: float | None = None
    preceding: PrecedingMotions | None = None

    @classmethod
    def of(cls, rig: Rig | MarkerArcs, recording: Recording, noise: tuple[float, float], loss: Loss = LINEAR) -> Self:
        """Return everything measured in a recording of a rig, with the sensors' 1-sigma noise [m, rad]."""
        if recording.input == "motion" and recording.acceleration is None:
            recording = replace(recording, acceleration=given_acceleration(recording, noise[1]))
        frames = recording.frames
        coordinates, theta = recording.markers[frames].ravel(), recording.theta.ravel()
        markers, angles = np.flatnonzero(np.isfinite(coordinates)), np.flatnonzero(np.isfinite(theta))
        values = np.concatenate([coordinates[markers], theta[angles]])
        arcs = rig if isinstance(rig, MarkerArcs) else MarkerArcs.of(rig)
        return cls(recording, arcs, frames, markers, angles, values, noise, loss)

    def of_recording(self, recording: Recording, noise: tuple[float, float] | None = None) -> Self:
        """Return the values of another recording of the rig, or of this one with some removed, not whitened.

        Their 1-sigma noise [m, rad] is as it is when None.
        """
        return self.of(self.arcs, recording, noise or self.noise, self.loss)

    @cached_property
    def weights(self) -> Array:
        """(N_m + N_t,) one over the noise of each value [1/m, 1/rad]."""
        return np.repeat(1 / np.array(self.noise), (self.marker_indices.size, self.angle_indices.size))

    @property
    def count(self) -> int:
        """Number of measured values."""
        return int(self.values.size)

    @cached_property
    def signal_power(self) -> float:
        """Sum of the squared weighted values about each sensor's mean."""
        grids = [grid[:, np.isfinite(grid).any(axis=0)] for grid in self.on_grid(self.weights * self.values)]
        return float(sum(np.nansum((grid - np.nanmean(grid, axis=0)) ** 2) for grid in grids))

    def predicted(self, arm: Arm, trajectory: Trajectory) -> Array:
        """Return the (N_m + N_t,) values predicted by a trajectory of one copy [m, rad]."""
        markers = self.arcs.positions_in_frames(arm, trajectory, self.recording.time[self.frames])
        return np.concatenate([markers.ravel()[self.marker_indices], self.predicted_angles(arm, trajectory)])

    def predicted_angles(self, arm: Arm, trajectory: Trajectory) -> Array:
        """Return the (N_t,) encoder angles predicted by a trajectory of one copy [rad]."""
        theta = trajectory.angles(self.recording.time)[:, arm.chain.active]
        return arm.encoder_angles(theta).ravel()[self.angle_indices]

    def residual(self, arm: Arm, trajectory: Trajectory) -> Array:
        """Return (N_m + N_t,) measured less predicted values, weighted and whitened."""
        offset = 0.0 if self.discretization_offset is None else self.discretization_offset
        return self.whitened(self.weights * (self.values - self.predicted(arm, trajectory) - offset))

    def whitened(self, weighted: Array) -> Array:
        """Return weighted values (N_m + N_t, ...) transformed so that their noise is white."""
        white = weighted if self.whitening is None else np.asarray(self.whitening @ weighted)
        if self.motion_errors is None:
            return white
        directions, gains = self._error_directions
        return np.asarray(white - (directions * (1 - gains)) @ (directions.T @ white))

    @property
    def encoders_are_input(self) -> bool:
        """True if joints turn as their encoders say, whose residuals are what smoothing has taken off."""
        return self.recording.input == "motion"

    @property
    def is_white(self) -> bool:
        """True if `whitened` changes nothing."""
        return self.whitening is None and self.motion_errors is None

    @cached_property
    def _error_directions(self) -> tuple[Array, Array]:
        """Orthonormal directions (N_m + N_t, r) of the motion's errors, and factors (r,) that whiten noise there."""
        errors = np.zeros((self.count, 0)) if self.motion_errors is None else self.motion_errors
        errors = principal_errors(errors if self.whitening is None else np.asarray(self.whitening @ errors))
        sizes = np.linalg.norm(errors, axis=0)
        return errors / sizes, 1 / np.sqrt(1 + sizes**2)

    @cached_property
    def instants(self) -> Indices:
        """(N_m + N_t,) row of the recording at which each value was measured."""
        joints = max(self.recording.theta.shape[1], 1)
        return np.concatenate([self.frames[self.marker_indices // self._width], self.angle_indices // joints])

    @property
    def channel_count(self) -> int:
        """Number of sensor channels: marker coordinates and encoders."""
        return self._width + int(self.recording.theta.shape[1])

    @cached_property
    def channels(self) -> Indices:
        """(N_m + N_t,) channel of each value, marker coordinates first."""
        joints = max(self.recording.theta.shape[1], 1)
        return np.concatenate([self.marker_indices % self._width, self._width + self.angle_indices % joints])

    def on_grid(self, values: Array) -> tuple[Array, Array]:
        """Return values (N_m + N_t,) as (F, 2 k) and (T, n_a); NaN where nothing was measured."""
        markers = np.full((self.frames.size, self._width), np.nan)
        angles = np.full(self.recording.theta.shape, np.nan)
        markers.ravel()[self.marker_indices] = values[: self.marker_indices.size]
        angles.ravel()[self.angle_indices] = values[self.marker_indices.size :]
        return markers, angles

    @property
    def began(self) -> float:
        """Instant at which the recording began [s]."""
        return float(self.recording.time[0]) if self.start is None else self.start

    def internal_states(self, arm: Arm, q: Array) -> Array:
        """Return the internal states (nz,) of an arm's effects at the first instant, at angles q (nv,) [rad]."""
        if self.preceding is None or not sum(arm.state_counts):
            return arm.initial_states(q)
        return self.preceding.internal_states(arm, self.recording.file, float(self.recording.time[0]) - self.began)

    def truncated(self, end: float) -> Observations:
        """Return the values measured up to an instant [s]."""
        return self.between(0, int(np.searchsorted(self.recording.time, end, side="right")), 0.0)

    def segments(self, duration: float, margin: float) -> tuple[Observations, ...]:
        """Cut the recording into parts of equal length, each with its own initial state (multiple shooting).

        Args:
            duration: of a part, about [s].
            margin: by which a simulation begins before its first value and ends after its last [s], for effects that
                take what was measured to be earlier or later than its time stamp.
        """
        time = self.recording.time
        count = max(1, round(float(time[-1] - time[0]) / duration))
        edges = np.searchsorted(time, np.linspace(time[0], time[-1], count + 1))
        edges[-1] = time.size
        parts = [self.between(first, last, margin) for first, last in pairwise(edges.tolist())]
        return tuple(part for part in parts if part.count)

    def between(self, first: int, last: int, margin: float) -> Observations:
        """Return the values measured in rows from `first` up to `last`, simulated a margin [s] beyond them."""
        time, joints = self.recording.time, self.recording.theta.shape[1]
        if first <= 0 and last >= time.size:
            return self
        begin = int(np.searchsorted(time, time[first] - margin))
        end = int(np.searchsorted(time, time[last - 1] + margin, side="right"))
        rows = slice(begin, end)
        names = ("time", "theta", "tau", "markers", "acceleration")
        known = {name: getattr(self.recording, name) for name in names}
        columns = {name: values[rows] for name, values in known.items() if values is not None}
        if joints and np.isfinite(self.recording.tau).any():
            # A torque that is sampled slowly is the same line within the part as across its ends.
            columns["tau"] = columns["tau"].copy()
            columns["tau"][[0, -1]] = torque_at(self.recording, columns["time"][[0, -1]])
        frames = np.searchsorted(self.frames, (begin, end))
        part = self._only((self.instants >= first) & (self.instants < last))
        return replace(
            part,
            recording=replace(self.recording, **columns),
            frames=self.frames[frames[0] : frames[1]] - begin,
            marker_indices=part.marker_indices - frames[0] * self._width,
            angle_indices=part.angle_indices - begin * joints,
            start=self.began,
        )

    def _only(self, mask: NDArray[np.bool_]) -> Self:
        """Return part of the values, by a mask (N_m + N_t,)."""
        offset, (markers, angles) = self.discretization_offset, np.split(mask, [self.marker_indices.size])
        return replace(
            self,
            marker_indices=self.marker_indices[markers],
            angle_indices=self.angle_indices[angles],
            values=self.values[mask],
            whitening=None if self.whitening is None else self.whitening[mask][:, mask],
            motion_errors=None if self.motion_errors is None else self.motion_errors[mask],
            discretization_offset=None if offset is None else offset[mask],
        )

    def rows_between(self, first: int, last: int) -> tuple[slice, slice, slice]:
        """Return the slices of frames, and of values by markers and by encoders, of rows from `first` up to `last`."""
        camera = slice(*np.searchsorted(self.frames, (first, last)).tolist())
        markers, angles = np.split(self.instants, [self.marker_indices.size])
        begin, end = np.searchsorted(angles, (first, last)).tolist()
        offset = self.marker_indices.size
        return camera, slice(*np.searchsorted(markers, (first, last)).tolist()), slice(offset + begin, offset + end)

    @property
    def _width(self) -> int:
        """Marker coordinates of a frame."""
        return 2 * int(self.recording.markers.shape[1])
