"""What cameras and encoders measured of a motion, and what a chain would have shown them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from vjm.chain.curve import marker_headings, marker_positions
from vjm.chain.virtual_links import Chain
from vjm.records import Array, Indices, Recording, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.encoder_feedback import EncoderFeedback
from vjm.simulation.integrators import Steps, sample
from vjm.simulation.least_squares import LINEAR, Loss

_PERTURBATION = 1e-6  # of a direction's length


@dataclass(frozen=True)
class Arcs:
    """Where the markers are.

    Attributes:
        lengths: for each link, (k_i,) arc lengths [m].
        in_link_frame: for each link, whether its markers are given in the link frame.
    """

    lengths: tuple[Array, ...]
    in_link_frame: tuple[bool, ...]

    @classmethod
    def of(cls, rig: Rig) -> Arcs:
        """Those of a rig."""
        return cls(
            tuple(np.array(link.markers) for link in rig.links),
            tuple(link.markers_frame == "link" for link in rig.links),
        )

    def markers(self, chain: Chain, q: Array) -> Array:
        """(..., k, 2) marker positions [m] at angles q (..., nv) [rad]."""
        return marker_positions(chain, q, self.lengths, self.in_link_frame)

    def shown(self, arm: Arm, q: Array) -> Array:
        """(F, k, 2) what the camera shows of the markers [m] at angles (F, nv), or (k, F, nv) of each marker's own."""
        if q.ndim == 3:
            return np.stack([self.shown(arm, own)[:, marker] for marker, own in enumerate(q)], axis=1)
        positions = self.markers(arm.chain, q)
        if arm.sensors:
            headings = marker_headings(arm.chain, q, self.lengths, self.in_link_frame)
            for effect in arm.sensors:
                positions = effect.marker_positions(positions, headings)
        return positions

    def slope(self, arm: Arm, q: Array, directions: Array) -> Array:
        """(F, 2 k, m) derivatives of `shown` along directions (nv, m) of the angles."""
        base = self.shown(arm, q)
        moved = np.stack([self.shown(arm, q + _PERTURBATION * each) for each in directions.T], axis=-1)
        slope: Array = (moved - base[..., None]) / _PERTURBATION
        return slope.reshape(len(base), 2 * base.shape[1], directions.shape[1])


def instants(arm: Arm, arcs: Arcs, steps: Steps, time: Array) -> Array:
    """When markers were where frames with time stamps (F,) show them, (F,) or, where markers differ, (k, F) [s]."""
    found, start = time, steps.time[0]
    if not arm.sensors:
        return time
    stamps, positions = time - start, arcs.markers(arm.chain, sampled(steps, time))
    for effect in arm.sensors:
        seen = effect.camera_instants(stamps, positions)
        late = seen.T - stamps  # (F,) or (k, F)
        found = found + late
    return found


def view(arm: Arm, arcs: Arcs, steps: Steps, time: Array) -> Array:
    """(F, k, 2) what frames with time stamps (F,) [s] show of a trajectory's markers [m]."""
    return arcs.shown(arm, sampled(steps, instants(arm, arcs, steps, time)))


def sampled(steps: Steps, time: Array) -> Array:
    """Angles (..., nv) [rad] of a trajectory of one copy at instants (...) [s]."""
    flat = sample(steps, time.ravel())[0][:, 0]
    return flat.reshape(*time.shape, flat.shape[-1])


@dataclass(frozen=True)
class Observed:
    """What was measured in one recording: marker coordinates first, then active joints' angles, each in order of time.

    Attributes:
        recording: its source.
        arcs: where the markers are.
        frames: (F,) rows of the recording at which the camera measured anything.
        markers: (N_m,) measured coordinates, as indices into (F, 2 k) flattened.
        angles: (N_t,) measured angles, as indices into (T, n_a) flattened.
        values: (N_m + N_t,) what was measured [m, rad].
        noise: 1-sigma of a marker coordinate [m] and of an angle [rad].
        loss: of the weighted residuals.
        whitening: (N_m + N_t, N_m + N_t) sparse, makes white noise of the weighted residuals' noise; None: it is white.
        discretization_offset: (N_m + N_t,) what is known to be shown beyond any simulation [m, rad]; None: nothing.
        feedback: that simulations are held on; None: they run open loop.
    """

    recording: Recording
    arcs: Arcs
    frames: Indices
    markers: Indices
    angles: Indices
    values: Array
    noise: tuple[float, float]
    loss: Loss = LINEAR
    whitening: sparse.csr_array | None = None
    discretization_offset: Array | None = None
    feedback: EncoderFeedback | None = None

    @classmethod
    def of(cls, rig: Rig, recording: Recording, noise: tuple[float, float], loss: Loss = LINEAR) -> Observed:
        """Everything measured in a recording, with the sensors' 1-sigma noise [m, rad]."""
        return cls._of(Arcs.of(rig), recording, noise, loss)

    @classmethod
    def _of(cls, arcs: Arcs, recording: Recording, noise: tuple[float, float], loss: Loss) -> Observed:
        frames = recording.frames
        seen, theta = recording.markers[frames].ravel(), recording.theta.ravel()
        markers, angles = np.flatnonzero(np.isfinite(seen)), np.flatnonzero(np.isfinite(theta))
        values = np.concatenate([seen[markers], theta[angles]])
        return cls(recording, arcs, frames, markers, angles, values, noise, loss)

    def again(self, recording: Recording, noise: tuple[float, float] | None = None) -> Observed:
        """The same arm in another recording, or in this one with other values left out; its noise is not whitened.

        Args:
            recording: of the same rig.
            noise: 1-sigma of a marker coordinate [m] and of an angle [rad]; as it is when None.
        """
        return self._of(self.arcs, recording, noise or self.noise, self.loss)

    @cached_property
    def weights(self) -> Array:
        """(N_m + N_t,) one over the noise of each value [1/m, 1/rad]."""
        return np.repeat(1 / np.array(self.noise), (self.markers.size, self.angles.size))

    @property
    def count(self) -> int:
        """Number of measured values."""
        return int(self.values.size)

    def predicted(self, arm: Arm, steps: Steps) -> Array:
        """(N_m + N_t,) what a trajectory of one copy would have shown [m, rad]."""
        markers = view(arm, self.arcs, steps, self.recording.time[self.frames])
        return np.concatenate([markers.ravel()[self.markers], self.encoders(arm, steps)])

    def encoders(self, arm: Arm, steps: Steps) -> Array:
        """(N_t,) what the encoders would have shown [rad]."""
        theta = sampled(steps, self.recording.time)[:, arm.chain.active]
        for effect in arm.sensors:
            theta = effect.encoder_angles(theta)
        return theta.ravel()[self.angles]

    def residual(self, arm: Arm, steps: Steps) -> Array:
        """(N_m + N_t,) measured less predicted, weighted and whitened."""
        left = self.values - self.predicted(arm, steps)
        return self.whitened(
            self.weights * (left if self.discretization_offset is None else left - self.discretization_offset)
        )

    def whitened(self, weighted: Array) -> Array:
        """Weighted values (N_m + N_t, ...), so that their noise is white."""
        return weighted if self.whitening is None else np.asarray(self.whitening @ weighted)

    @property
    def instants(self) -> Indices:
        """(N_m + N_t,) row of the recording at which each value was measured."""
        joints = max(self.recording.theta.shape[1], 1)
        return np.concatenate([self.frames[self.markers // self._width], self.angles // joints])

    def spread(self, values: Array) -> tuple[Array, Array]:
        """Values (N_m + N_t,) where they were measured, (F, 2 k) and (T, n_a); NaN where nothing was."""
        markers = np.full((self.frames.size, self._width), np.nan)
        angles = np.full(self.recording.theta.shape, np.nan)
        markers.ravel()[self.markers] = values[: self.markers.size]
        angles.ravel()[self.angles] = values[self.markers.size :]
        return markers, angles

    def until(self, end: float) -> Observed:
        """The beginning of the recording: all that was measured up to an instant [s]."""
        recording = self.recording
        rows = int(np.searchsorted(recording.time, end, side="right"))
        if rows >= recording.time.size:
            return self
        part = replace(
            recording,
            time=recording.time[:rows],
            theta=recording.theta[:rows],
            tau=recording.tau[:rows],
            markers=recording.markers[:rows],
        )
        frames = self.frames[self.frames < rows]
        kept_markers = self.markers < frames.size * self._width
        kept_angles = self.angles < rows * recording.theta.shape[1]
        kept = np.concatenate([kept_markers, kept_angles])
        markers, angles = self.markers[kept_markers], self.angles[kept_angles]
        whitening = None if self.whitening is None else self.whitening[kept][:, kept]
        return replace(
            self,
            recording=part,
            frames=frames,
            markers=markers,
            angles=angles,
            values=self.values[kept],
            whitening=whitening,
            discretization_offset=None if self.discretization_offset is None else self.discretization_offset[kept],
        )

    def held(self, feedback: EncoderFeedback | None) -> Observed:
        """The same on a guide, whose angles no longer count as measured: what draws a joint there is no evidence of it.

        Counted, the encoder's noise would be in what is simulated as in what is measured, and parameters off with it.
        """
        if feedback is None:
            return self
        kept = np.arange(self.markers.size)
        return replace(
            self,
            angles=self.angles[:0],
            values=self.values[kept],
            whitening=None if self.whitening is None else self.whitening[kept][:, kept],
            discretization_offset=None if self.discretization_offset is None else self.discretization_offset[kept],
            feedback=feedback,
        )

    def between(self, first: int, last: int) -> tuple[Indices, slice, slice]:
        """Of the rows from `first` up to `last`: their frames, their marker coordinates and their angles."""
        begin, end = np.searchsorted(self.frames, (first, last))
        markers = np.searchsorted(self.markers, (begin * self._width, end * self._width))
        joints = self.recording.theta.shape[1]
        angles = np.searchsorted(self.angles, (first * joints, last * joints))
        offset = self.markers.size
        return (
            self.frames[begin:end],
            slice(int(markers[0]), int(markers[1])),
            slice(offset + int(angles[0]), offset + int(angles[1])),
        )

    @property
    def _width(self) -> int:
        """Marker coordinates of a frame."""
        return 2 * int(self.recording.markers.shape[1])
