"""Derivatives of predicted measurements by initial states and parameters, by variational equations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from vjm.chain.virtual_links import have_equal_links
from vjm.records import Array, Indices
from vjm.simulation.arm import Arm
from vjm.simulation.measurement import DIFFERENCE_STEP, Observations
from vjm.simulation.nonsmooth import Pieces
from vjm.simulation.system import Trajectory
from vjm.simulation.variational_equations import (
    Coefficients,
    ModalBasis,
    Motions,
    PerturbedArm,
    coefficients_along,
    propagators,
    with_added_joints,
)

_OF_CURVES = ("hub_radius", "lengths", "cells", "rest_curvature")  # fields of links on which markers' places depend
_MOST_COEFFICIENTS = 400_000  # held in memory at once: 3 MB of doubles


@dataclass(frozen=True)
class Linearization:
    """Linearization of a run by its variational equations.

    Attributes:
        observed: the measurements.
        arm: the arm that was simulated.
        basis: m modes.
        perturbed: p arms, each with one parameter changed.
        trajectory: the motion linearised about; its number of steps is a multiple of two strides.
        stride: integrator steps in half an interval.
        known: what was computed together with other runs' linearizations; None: nothing.
    """

    observed: Observations
    arm: Arm
    basis: ModalBasis
    perturbed: Sequence[PerturbedArm]
    trajectory: Trajectory
    stride: int
    known: _ComputedTogether | None = None

    @cached_property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """The motion for each of the perturbed arms, with joints that only it has."""
        return _trajectories_of([self])[0] if self.known is None else self.known.trajectories

    def jacobian(self) -> Iterator[tuple[Indices, Array]]:
        """Yield weighted derivatives of the measured values, one chunk of the recording after another.

        Yields:
            (r,) indices of `observed.values` in the chunk, and the derivatives (r, 2 slow + p) of their predictions,
            times their weights, by the slow modes' initial coordinates, initial rates, and by the parameters.
        """
        observed, time = self.observed, self.observed.recording.time
        # With a late or early camera a frame may show the arm in the chunk before or the next.
        exposures = observed.arcs.exposure_times(self.arm, self.trajectory, time[observed.frames])
        delays = time[observed.frames] - exposures
        largest_delay, largest_lead = float(np.max(delays, initial=0.0)), float(np.max(-delays, initial=0.0))
        first = 0
        part: Trajectory | None = None
        for chunk in self._chunks():
            part = chunk if part is None else _join_trajectories(part, chunk, largest_delay + largest_lead)
            at_end = part.time[-1] >= self.trajectory.time[-1]
            last = time.size if at_end else int(np.searchsorted(time, part.time[-1] - largest_lead, side="left"))
            if last <= first:
                continue
            camera, markers, angles = observed.rows_between(first, last)
            by_angles = self._encoder_jacobian(part, angles)
            by_markers = self._marker_jacobian(part, exposures[..., camera], time[observed.frames[camera]])
            flat = by_markers.reshape(-1, by_markers.shape[2])
            slopes = np.concatenate(
                [flat[observed.marker_indices[markers] - camera.start * by_markers.shape[1]], by_angles]
            )
            measured = np.r_[markers, angles]
            yield measured, observed.weights[measured, None] * slopes
            first = last

    def _chunks(self) -> Iterator[Trajectory]:
        """Yield derivatives of the motion: trajectories of m modal coordinates for each of 2 slow + p unknowns."""
        basis, trajectory = self.basis, self.trajectory
        size, slow_count, nz = basis.shapes.shape[1], basis.slow_count, trajectory.z.shape[1]
        count = 2 * slow_count + len(self.perturbed)
        state = np.zeros((2 * size + nz, count))
        state[:slow_count, :slow_count] = np.eye(slow_count)
        state[size : size + slow_count, slow_count : 2 * slow_count] = np.eye(slow_count)
        if nz:
            state[2 * size :] = self._initial_internal_states()
        rows, chunk_size = self.rows, self.max_chunk
        if self.known or any(sum(arm.state_counts) > nz for arm, _ in self.perturbed):
            chunk_size = rows.size  # internal states that only perturbed arms have are followed from the start
        for first in range(0, rows.size - 1, chunk_size):
            part = rows[first : first + chunk_size + 1]
            pieces = self.pieces(part)
            coefficients = self.known.coefficients if self.known else self._coefficients_along(part, pieces)
            edges = 2 * part[::2] if pieces is None else pieces.bounds
            flow, forced = propagators(coefficients, trajectory.step / 2 * np.diff(edges), pieces)
            jumps = {} if pieces is None else coefficients.jumps(pieces)
            starts, ends = np.empty((2, len(flow), *state.shape))
            for k in range(len(flow)):
                if k in jumps:
                    by_state, by_parameters = jumps[k]
                    state = by_state @ state
                    state[:, 2 * slow_count :] += by_parameters
                starts[k] = state
                state = flow[k] @ state
                state[:, 2 * slow_count :] += forced[k]
                ends[k] = state
            if pieces is None:
                time, states = trajectory.time[part[::2]], np.concatenate([starts, ends[-1:]])
                a = coefficients.accelerations(states, slice(None, None, 2), None)
            else:  # either side of each instant between pieces, at which derivatives may jump
                time = np.repeat(trajectory.time[0] + trajectory.step / 2 * pieces.bounds, 2)[1:-1]
                states = _alternating(starts, ends)
                a = _alternating(
                    coefficients.accelerations(starts, slice(0, -2, 2), pieces),
                    coefficients.accelerations(ends, slice(2, None, 2), pieces),
                )
            columns = (states[:, :size], states[:, size : 2 * size], a, states[:, 2 * size :])
            copies = (np.ascontiguousarray(np.swapaxes(column, 1, 2)) for column in columns)
            yield Trajectory(time, *copies, evenly=pieces is None)

    @cached_property
    def rows(self) -> Indices:
        """Indices of the trajectory's instants at which coefficients are evaluated."""
        return np.arange(0, len(self.trajectory.time), self.stride)

    @property
    def max_chunk(self) -> int:
        """Number of instants whose coefficients are held in memory at once."""
        size = int(2 * self.basis.shapes.shape[1] + self.trajectory.z.shape[1])
        return 2 * max(20, _MOST_COEFFICIENTS // size**2)

    def pieces(self, rows: Indices) -> Pieces | None:
        """Return the pieces of the intervals between rows; None where no joint sticks or touches."""
        friction = self.trajectory.friction if self.arm.has_dry_friction else None
        if friction is None and not self.arm.contacts:
            return None
        return Pieces.of(2 * rows[::2], friction, self.trajectory, self.arm.contacts)

    def _coefficients_along(self, rows: Indices, pieces: Pieces | None) -> Coefficients:
        return _coefficients_of([self], [rows], [pieces], [self.trajectories])[0]

    def _initial_internal_states(self) -> Array:
        """Return derivatives (nz, 2 slow + p) of the internal states at the start."""
        q, slow_count = self.trajectory.q[0], self.basis.slow_count
        observed = self.observed
        z = observed.internal_states(self.arm, q)
        shapes = self.basis.shapes[:, :slow_count].T
        steps = DIFFERENCE_STEP / np.abs(shapes).max(axis=1)  # small at every joint
        by_angles = [
            (observed.internal_states(self.arm, q + step * shape) - z) / step
            for step, shape in zip(steps, shapes, strict=True)
        ]
        by_rates = [np.zeros(z.size)] * slow_count
        by_parameters = [
            (observed.internal_states(other, path.q[0])[other.states_of(self.arm)] - z) / step
            for (other, step), path in zip(self.perturbed, self.trajectories, strict=True)
        ]
        return np.stack([*by_angles, *by_rates, *by_parameters], axis=1)

    def _marker_jacobian(self, part: Trajectory, exposures: Array, stamps: Array) -> Array:
        """Return derivatives (F, 2 k, 2 slow + p) of marker coordinates, seen at instants (F,) or (k, F)."""
        arcs, q, elapsed = self.observed.arcs, self.trajectory.angles(exposures), self.trajectory.elapsed(exposures)
        by_modes = arcs.jacobian(self.arm, q, elapsed, self.basis.shapes)
        modes = np.swapaxes(part.angles(exposures), -2, -1)
        if exposures.ndim == 1:
            slopes = by_modes @ modes
        else:
            by_marker = by_modes.reshape(len(by_modes), len(exposures), 2, by_modes.shape[2])
            slopes = (by_marker @ np.swapaxes(modes, 0, 1)).reshape(*by_modes.shape[:2], modes.shape[-1])
        chain, sensors, exposed = self.arm.chain, self.arm.sensors, self.arm.exposure_effects
        poses: tuple[Array, Array] | None = None
        first = slopes.shape[2] - len(self.perturbed)
        for k, (arm, step) in enumerate(self.perturbed, start=first):
            # Markers are measured at the same places unless sensors, joints or curves differ.
            placed = chain.size == arm.chain.size and have_equal_links(chain, arm.chain, _OF_CURVES)
            if placed and sensors == arm.sensors:
                continue
            if poses is None:
                poses = arcs.poses(chain, q)
                base = arcs.seen(self.arm, *poses, elapsed)
            if placed and exposed == arm.exposure_effects:
                changed = arcs.seen(arm, *poses, elapsed)
            else:
                changed = arcs.positions_in_frames(arm, self.trajectories[k - first], stamps)
            slopes[:, :, k] += ((changed - base) / step).reshape(len(base), 2 * base.shape[1])
        return slopes

    def _encoder_jacobian(self, part: Trajectory, angles: slice) -> Array:
        """Return derivatives (r, 2 slow + p) of the encoder values with indices `angles`."""
        observed, active = self.observed, self.arm.chain.active
        rows = slice(angles.start - observed.marker_indices.size, angles.stop - observed.marker_indices.size)
        instants, joints = np.divmod(observed.angle_indices[rows], max(active.size, 1))
        if not joints.size:
            return np.zeros((0, part.q.shape[1]))
        by_active = self.basis.shapes[active].T
        theta = replace(part, q=part.q @ by_active, v=part.v @ by_active, a=part.a @ by_active)
        all_slopes = theta.angles(observed.recording.time[instants])
        slopes: Array = np.take_along_axis(all_slopes, joints[:, None, None], axis=2)[:, :, 0]
        simulated = self.trajectory.angles(observed.recording.time)[:, active]
        first = slopes.shape[1] - len(self.perturbed)
        for k, (arm, step) in enumerate(self.perturbed, start=first):
            if arm.sensors != self.arm.sensors:
                change = arm.encoder_angles(simulated) - self.arm.encoder_angles(simulated)
                slopes[:, k] += change.ravel()[observed.angle_indices[rows]] / step
        return slopes


class _ComputedTogether(NamedTuple):
    """Parts of a linearization that were computed in one batch with those of others."""

    trajectories: tuple[Trajectory, ...]  # the motion for each of the perturbed arms
    coefficients: Coefficients  # along the whole trajectory


def computed_together(linearizations: Sequence[Linearization]) -> Iterator[Linearization]:
    """Yield linearizations with their coefficients; those of neighbouring short ones of the same arm in one batch."""
    group: list[Linearization] = []
    for linearization in linearizations:
        if group and not _is_compatible(group, linearization):
            yield from _as_group(group)
            group = []
        group.append(linearization)
    yield from _as_group(group)


def _is_compatible(group: Sequence[Linearization], added: Linearization) -> bool:
    """Return True if a linearization has the arms of a group and its number of modes, and fits into memory with it."""
    first, (reference, recording) = group[0], (group[0].observed.recording, added.observed.recording)
    arms = [(first.arm, added.arm), *((a.arm, b.arm) for a, b in zip(first.perturbed, added.perturbed, strict=True))]
    return (
        all(a is b for a, b in arms)
        and first.basis.shapes.shape == added.basis.shapes.shape
        and (reference.payload_body, reference.gravity) == (recording.payload_body, recording.gravity)
        and sum(member.rows.size for member in (*group, added)) <= first.max_chunk
    )


def _as_group(group: Sequence[Linearization]) -> Iterator[Linearization]:
    if len(group) < 2:
        yield from group
        return
    trajectories = _trajectories_of(group)
    rows, pieces = [member.rows for member in group], [member.pieces(member.rows) for member in group]
    coefficients = _coefficients_of(group, rows, pieces, trajectories)
    for member, paths, of_member in zip(group, trajectories, coefficients, strict=True):
        yield replace(member, known=_ComputedTogether(paths, of_member))


def _trajectories_of(group: Sequence[Linearization]) -> list[tuple[Trajectory, ...]]:
    """Return, for each linearization of the same arms, the motion for each of the perturbed ones."""
    arm, paths = group[0].arm, [member.trajectory for member in group]
    observed = [member.observed for member in group]
    by_arm = [with_added_joints(paths, arm, other, observed) for other, _ in group[0].perturbed]
    return list(zip(*by_arm, strict=True)) if by_arm else [()] * len(group)


def _coefficients_of(
    group: Sequence[Linearization],
    rows: Sequence[Indices],
    pieces: Sequence[Pieces | None],
    trajectories: Sequence[tuple[Trajectory, ...]],
) -> list[Coefficients]:
    """Return the coefficients of linearizations of the same arms, each at rows of its trajectories or in pieces."""
    observed = [member.observed for member in group]

    def motions(paths: Sequence[Trajectory]) -> Motions:
        parts = zip(paths, rows, pieces, strict=True)
        return Motions.of(
            [path.at(indices) if cut is None else path.between(cut.instants / 2) for path, indices, cut in parts],
            observed,
        )

    motion = motions([member.trajectory for member in group])
    changed = zip(*trajectories, strict=True)
    # Most perturbed arms have no joint of their own, and move as the arm does.
    perturbed = [motion if paths[0] is group[0].trajectory else motions(paths) for paths in changed]
    return coefficients_along(group[0].arm, [member.basis for member in group], group[0].perturbed, motion, perturbed)


def _join_trajectories(before: Trajectory, after: Trajectory, overlap: float) -> Trajectory:
    """Prepend the last `overlap` seconds of a chunk to the next one."""
    if overlap <= 0:
        return after
    overlapping = before.time >= after.time[0] - overlap - 2 * np.diff(after.time).max()
    if after.evenly:
        overlapping[-1] = False  # it is the first of the next one
    parts = zip((before.time, *before.motion), (after.time, *after.motion), strict=True)
    joined = (np.concatenate([earlier[overlapping], later]) for earlier, later in parts)
    return Trajectory(*joined, evenly=after.evenly)


def _alternating(first: Array, second: Array) -> Array:
    """Return the rows of two arrays (K, ...), each of the first followed by that of the second (2 K, ...)."""
    return np.stack([first, second], axis=1).reshape(-1, *first.shape[1:])
