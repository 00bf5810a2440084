"""Derivatives of predicted measurements by initial states and parameters: the variational equations of a run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from scipy import linalg, signal
from scipy.interpolate import CubicSpline

from vjm.chain.virtual_links import Chain
from vjm.model.dynamics import mechanism_of
from vjm.model.modes import linearise
from vjm.records import Array, Indices, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import locked_joint_frequencies, phi_functions
from vjm.simulation.measurement import Observations
from vjm.simulation.system import Trajectory, torque_at

# Modes whose phase changes by less in an interval are slow [rad]; derivatives, which are interpolated inside it, are
# right to 3 % up to there.
_SLOW_PHASE = 3.2
_MAX_MODES = 16  # bounds the cost, which grows with the cube of the number of modes
_OMITTED_COMPLIANCE = 1e-3  # share of a static deflection that omitted modes may have: far below those 3 %
# Forward difference, largest at a joint [rad, rad/s or units of internal states]: its relative error is of the order of
# the step, and rounding adds 1e-16 / 1e-6.
_STEP = 1e-6
# Fields of links on which rigid-body dynamics depends, and those on which the link's curve does.
_OF_BODIES = (
    "lengths",
    "masses",
    "mass_centers",
    "inertias",
    "hub_inertia",
    "root_inertia",
    "payload",
    "rest_curvature",
)
_OF_CURVES = ("lengths", "cells", "rest_curvature")
_MOST_COEFFICIENTS = 400_000  # held in memory at once: 3 MB of doubles


@dataclass(frozen=True)
class ModalBasis:
    """Natural modes of the arm at rest, in which derivatives are expressed.

    Initial states are expressed in the slow ones only: measurements do not show the initial state of faster modes.

    Attributes:
        shapes: (nv, m) joint angles of each mode, normalised to modal mass one; slowest first.
        slow_count: number of slow modes.
    """

    shapes: Array
    slow_count: int

    @classmethod
    def of(cls, chain: Chain, recording: Recording, interval: float) -> ModalBasis:
        """Return the modes of an arm with free active joints; slow ones turn by less than 3.2 rad in an interval [s].

        Fast modes respond quasi-statically, and are omitted where they add nothing to a static deflection.
        """
        M, _, K, _ = linearise(chain, recording.payload, recording.gravity, recording.initial_theta)
        squares, shapes = linalg.eigh(K, M)
        slow_count = int(np.count_nonzero(np.sqrt(np.maximum(squares, 0.0)) * interval < _SLOW_PHASE))
        # Compliances of the modes that bend the arm; limited, as that of an arm about to buckle would be infinite.
        slowest, _ = locked_joint_frequencies(chain, recording.payload)
        compliance = 1 / np.maximum(squares[chain.active.size :], (2 * np.pi * slowest) ** 2)
        needed = np.count_nonzero(np.cumsum(compliance[::-1]) > _OMITTED_COMPLIANCE * np.sum(compliance))
        slow_count = min(max(slow_count, chain.active.size + 1), chain.size, _MAX_MODES)
        return cls(shapes[:, : min(max(slow_count, chain.active.size + int(needed)), _MAX_MODES)], slow_count)

    @property
    def states(self) -> Array:
        """(2 nv, 2 slow) initial angles and rates by each slow mode's coordinate and rate."""
        shapes = self.shapes[:, : self.slow_count]
        return np.asarray(linalg.block_diag(shapes, shapes))


class PerturbedArm(NamedTuple):
    """The arm with one parameter changed by a small step, in the parameter's unit."""

    arm: Arm
    step: float


class _Motions(NamedTuple):
    """Motions of one arm in several recordings or segments, concatenated: I instants in all.

    Coefficients of the variational equations depend on the instant alone: those of all motions are one batch.
    """

    elapsed: Array  # (I,) since each recording began [s]
    q: Array
    v: Array
    a: Array
    z: Array
    paths: tuple[Trajectory, ...]
    observed: tuple[Observations, ...]

    @classmethod
    def of(cls, paths: Sequence[Trajectory], observed: Sequence[Observations]) -> Self:
        """Concatenate motions."""
        elapsed = np.concatenate([path.elapsed(path.time) for path in paths])
        q, v, a, z = (np.concatenate(parts) for parts in zip(*(path.motion for path in paths), strict=True))
        return cls(elapsed, q, v, a, z, tuple(paths), tuple(observed))

    @property
    def parts(self) -> list[slice]:
        """Instants of each motion."""
        stops = np.cumsum([len(path.time) for path in self.paths]).tolist()
        return [slice(stop - len(path.time), stop) for stop, path in zip(stops, self.paths, strict=True)]

    def followed(self, arm: Arm) -> Self:
        """Return the motions with the internal states that another arm's effects would have along them."""
        longest = max(len(path.time) for path in self.paths)
        # Shorter motions are padded with their last instant.
        shown = np.stack(
            [np.minimum(np.arange(longest), part.stop - part.start - 1) + part.start for part in self.parts]
        )
        time, q, v = (values[shown.T] for values in (self.elapsed, self.q, self.v))
        start = [each.internal_states(arm, path.q[0]) for each, path in zip(self.observed, self.paths, strict=True)]
        z = arm.follow(time, q, v, np.stack(start))
        own = [z[: len(path.time), k] for k, path in enumerate(self.paths)]
        return self._replace(z=np.concatenate(own))


class _EquationsOfMotion:
    """An arm's equations of motion along given motions of I instants."""

    def __init__(self, arm: Arm, motions: _Motions) -> None:
        self.arm = arm
        self.driven = [arm.inputs(each.recording) for each in motions.observed]
        self.gravity, payload = self.driven[0].gravity, self.driven[0].payload
        self.mechanism = mechanism_of(arm.chain, payload, self.gravity)
        self.force = arm.forces(payload)

    def inertial_torque(self, motion: _Motions) -> Array:
        """Return M a + h (I, nv)."""
        return self.mechanism.inverse_dynamics(motion.q, motion.v, motion.a)

    def inertia_of(self, joint: int, motion: _Motions) -> Array:
        """Return the torques (I, nv) on all joints by a unit of acceleration of one."""
        unit = motion.a + (np.arange(motion.a.shape[1]) == joint)
        return self.inertial_torque(motion._replace(a=unit)) - self.inertial_torque(motion)

    def further_torque(self, motion: _Motions) -> Array:
        """Return the effects' forces, with reversed sign (I, nv)."""
        if self.force is None:
            return np.zeros(motion.q.shape)
        return -self.force(motion.elapsed, motion.q, motion.v, motion.z)

    def state_rates(self, motion: _Motions) -> Array:
        """Return rates of change of the internal states (I, nz)."""
        return self.arm.state_rates(motion.elapsed, motion.q, motion.v, motion.z)


class _AddedJoint(NamedTuple):
    """Motion of a joint that a perturbed arm has in addition, per unit of its parameter."""

    column: int  # the parameter's
    inertia: Array  # (I, m) modal accelerations by its acceleration, with reversed sign
    q: Array  # (I,)
    v: Array
    a: Array

    def during(self, part: slice) -> Self:
        """Return the motion at some of its instants."""
        return self._replace(inertia=self.inertia[part], q=self.q[part], v=self.v[part], a=self.a[part])

    def carried(self, part: slice, by: Array) -> Array:
        """Return modal coordinates and rates (K, 2 m) by which the joint carries the arm, at an inertia (K, m)."""
        return np.concatenate([self.q[part, None] * by, self.v[part, None] * by], axis=1)


class _Coefficients(NamedTuple):
    """Coefficients of the variational equations along a motion of I instants.

    They are derivatives of m modal accelerations and nz internal states' rates. Those by the parameters do not include
    what the accelerations of added joints do.
    """

    by_state: Array  # (I, m + nz, 2 m + nz), by modal coordinates, rates and internal states
    by_parameters: Array  # (I, m + nz, p)
    joints: tuple[_AddedJoint, ...]

    @property
    def accelerations(self) -> Array:
        """(I, m, p) accelerations by the parameters, those of added joints included."""
        m = self.by_state.shape[2] - self.by_state.shape[1]
        total = self.by_parameters[:, :m].copy()
        for joint in self.joints:
            total[:, :, joint.column] -= joint.a[:, None] * joint.inertia
        return total


# Unbounded growth is noticed by `Run.linearized`, which refuses derivatives that are not finite.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _coefficients(
    arm: Arm,
    bases: Sequence[ModalBasis],
    perturbed: Sequence[PerturbedArm],
    motion: _Motions,
    others: Sequence[_Motions],
) -> list[_Coefficients]:
    """Return the coefficients of the variational equations along several motions, of I instants each.

    Args:
        arm: the arm.
        bases: modes for each motion.
        perturbed: p arms, each with one parameter changed.
        motion: the motions.
        others: the same motions as each of the perturbed arms makes them, with joints that only it has.

    Those by parameters, and those of effects' forces, are forward differences.
    """
    equations, chain = _EquationsOfMotion(arm, motion), arm.chain
    inertial, further = equations.inertial_torque(motion), equations.further_torque(motion)
    state_rates = equations.state_rates(motion)
    lengths = [len(path.time) for path in motion.paths]
    shapes = np.repeat(np.stack([basis.shapes for basis in bases]), lengths, axis=0)  # (I, nv, m)
    # Steps small at every joint: those of fast modes, whose shapes are large, must not take a force across its kink.
    steps = _STEP / np.abs(shapes).max(axis=1)
    m, nz = shapes.shape[2], motion.z.shape[1]
    forces = np.zeros((len(motion.q), chain.size, 2 * m + nz + len(perturbed)))
    rates = np.zeros((len(motion.q), nz, 2 * m + nz + len(perturbed)))
    by_angle, by_rate, inertia = equations.mechanism.derivatives(motion.q, motion.v, motion.a)
    forces[:, :, :m] = by_angle @ shapes + chain.stiffness[:, None] * shapes
    forces[:, :, m : 2 * m] = by_rate @ shapes + chain.damping[:, None] * shapes
    for j in range(m) if nz or equations.force is not None else ():
        shape, step = shapes[:, :, j], steps[:, j, None]
        turned, sped = motion._replace(q=motion.q + step * shape), motion._replace(v=motion.v + step * shape)
        for column, other in ((j, turned), (m + j, sped)):
            if equations.force is not None:
                forces[:, :, column] += (equations.further_torque(other) - further) / step
            if nz:
                rates[:, :, column] = (equations.state_rates(other) - state_rates) / step
    for k, step_z in enumerate(_STEP * np.eye(nz)):
        other = motion._replace(z=motion.z + step_z)
        forces[:, :, 2 * m + k] = (equations.further_torque(other) - further) / _STEP
        rates[:, :, 2 * m + k] = (equations.state_rates(other) - state_rates) / _STEP
    joints: list[tuple[int, int, Array]] = []  # parameter, coordinate, and torques (I, nv) by its acceleration
    for k, (moved, other) in enumerate(zip(perturbed, others, strict=True)):
        added = _added_joints(chain, moved.arm.chain)
        held = other._replace(a=np.where(np.isin(np.arange(other.a.shape[1]), added), 0.0, other.a))
        change = _parameter_derivatives(equations, moved, held, (inertial, further, state_rates))
        forces[:, :, 2 * m + nz + k], rates[:, :, 2 * m + nz + k] = change
        for joint in added.tolist():
            by_unit = _EquationsOfMotion(moved.arm, held).inertia_of(joint, held)
            joints.append((k, joint, np.delete(by_unit, added, axis=1)))
    transposed = np.swapaxes(shapes, 1, 2)
    modal = transposed @ inertia @ shapes
    lower = np.concatenate([-np.linalg.solve(modal, transposed @ forces), rates], axis=1)
    moving = []
    for k, joint, by_unit in joints:
        accelerations = np.asarray(np.linalg.solve(modal, transposed @ by_unit[:, :, None])[:, :, 0], dtype=float)
        q, v, a = (
            np.asarray(values[:, joint] / perturbed[k].step) for values in (others[k].q, others[k].v, others[k].a)
        )
        moving.append(_AddedJoint(k, accelerations, q, v, a))
    return [
        _Coefficients(
            lower[part, :, : 2 * m + nz],
            lower[part, :, 2 * m + nz :],
            tuple(one.during(part) for one in moving),
        )
        for part in motion.parts
    ]


def _parameter_derivatives(
    equations: _EquationsOfMotion, perturbed: PerturbedArm, motion: _Motions, nominal: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Return forward differences of torques (I, nv) and internal states' rates (I, nz) by a parameter.

    The motions are the perturbed arm's, with joints that only it has.
    """
    inertial, further, state_rates = nominal
    chain, (other_arm, step) = equations.arm.chain, perturbed
    other, nz = other_arm.chain, state_rates.shape[1]
    kept = np.delete(np.arange(other.size), _added_joints(chain, other))
    forces = motion.q[:, kept] * (other.stiffness[kept] - chain.stiffness)
    forces += motion.v[:, kept] * (other.damping[kept] - chain.damping)
    rates = np.zeros(state_rates.shape)
    if other_arm.effects == equations.arm.effects and _equal_links(chain, other, _OF_BODIES):
        if equations.force is not None and not np.array_equal(other.stiffness, chain.stiffness):
            forces = forces + _EquationsOfMotion(other_arm, motion).further_torque(motion) - further
        return forces / step, rates
    changed = _EquationsOfMotion(other_arm, motion)
    alike = chain.size == other.size and _equal_links(chain, other, _OF_BODIES)
    if changed.gravity != equations.gravity or not alike:
        forces = forces + changed.inertial_torque(motion)[:, kept] - inertial
    if sum(other_arm.states) > nz:  # internal states that only the perturbed arm has follow the motion as it is
        motion = motion.followed(other_arm)
    if equations.force is not None or changed.force is not None:
        forces = forces + changed.further_torque(motion)[:, kept] - further
    if nz:
        rates = changed.state_rates(motion)[:, :nz] - state_rates
    for part, path, given, really in zip(motion.parts, motion.paths, equations.driven, changed.driven, strict=True):
        if not np.array_equal(really.tau, given.tau, equal_nan=True):
            forces[part, chain.active] -= torque_at(really, path.time) - torque_at(given, path.time)
    return forces / step, rates / step


def _added_joints(chain: Chain, other: Chain) -> Indices:
    """Coordinates of joints that another chain has in addition."""
    known = set(chain.joint_names)
    return np.array([k for k, name in enumerate(other.joint_names) if name not in known], dtype=np.intp)


def _with_added_joints(trajectory: Trajectory, chain: Chain, arm: Arm, observed: Observations) -> Trajectory:
    """Return a motion with the joints that another arm has in addition, moved by the reactions to the motion as it is.

    To first order in their compliance. A root joint, whose spring is far stiffer than the inertia that it carries is
    heavy, turns by its reaction over the stiffness. A base, which has a mass of its own, starts at rest and swings.
    With a joint that moves nothing, as that of a motor without inertia, no arm can be simulated: the motion is NaN.
    """
    other = arm.chain
    added = _added_joints(chain, other)
    if not added.size:
        return trajectory
    kept = np.delete(np.arange(other.size), added)
    q, v, a = (np.zeros((len(trajectory.time), other.size)) for _ in range(3))
    q[:, kept], v[:, kept], a[:, kept] = trajectory.q, trajectory.v, trajectory.a
    still = _Motions.of([replace(trajectory, q=q, v=v, a=a)], [observed])
    if sum(arm.states) > trajectory.z.shape[1]:
        still = still.followed(arm)
    equations = _EquationsOfMotion(arm, still)
    reactions = equations.inertial_torque(still) + equations.further_torque(still)
    inertia = equations.mechanism.mass_matrix(q[:1])[0]
    if np.linalg.matrix_rank(inertia, hermitian=True) < other.size:
        return replace(trajectory, q=np.full_like(q, np.nan), v=v, a=a)
    elapsed = trajectory.step * np.arange(len(trajectory.time))
    for joint in added.tolist():
        mass, stiffness, damping = inertia[joint, joint], other.stiffness[joint], other.damping[joint]
        if joint >= other.base_size:
            turn = CubicSpline(elapsed, -reactions[:, joint] / stiffness)
            q[:, joint], v[:, joint], a[:, joint] = (turn(elapsed, order) for order in range(3))
            continue
        oscillator = [[0.0, 1.0], [-stiffness / mass, -damping / mass]]
        reaction, inputs = reactions[:, joint], [[0.0], [-1 / mass]]
        _, _, swing = signal.lsim((oscillator, inputs, np.eye(2), np.zeros((2, 1))), reaction, elapsed)
        q[:, joint], v[:, joint] = swing.T
        a[:, joint] = -(reaction + stiffness * q[:, joint] + damping * v[:, joint]) / mass
    return replace(trajectory, q=q, v=v, a=a)


def _equal_links(chain: Chain, other: Chain, fields: Sequence[str]) -> bool:
    """Return True if two chains have the same base, and links that are equal in some fields."""
    if chain.base != other.base:
        return False
    links = list(zip(chain.links, other.links, strict=True))
    return all(np.array_equal(getattr(one, field), getattr(two, field)) for one, two in links for field in fields)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _propagators(coefficients: _Coefficients, interval: float) -> tuple[Array, Array]:
    """Return transition matrices (K, d, d) of K intervals of three instants each, and the forcing's part (K, d, p).

    An interval's matrix is its mean by Simpson's rule, its forcing the quadratic through the three instants. Added
    joints follow reactions that may have kinks, so that their accelerations cannot be integrated. The unknowns of an
    interval are therefore the arm's motion and that by which the joint carries it at the inertia in the middle: in the
    sum, only changes of that inertia remain beside the accelerations.
    """
    state, forcing, joints = coefficients
    lower, size = state.shape[1:]
    upper = size - lower  # modal coordinates, whose rates of change are unknowns themselves
    L = np.zeros((len(state), size, size))
    L[:, :upper, upper : 2 * upper] = np.eye(upper)
    L[:, upper:] = state
    parts = [slice(k, len(L) - 2 + k, 2) for k in (0, 1, 2)]
    F = np.zeros((3, len(L) // 2, size, forcing.shape[2]))
    for own, part in zip(F, parts, strict=True):
        own[:, upper:] = forcing[part]
        for joint in joints:
            by = joint.inertia[parts[1]]
            own[:, upper:, joint.column] -= np.einsum(
                "kij,kj->ki", state[part, :, : 2 * upper], joint.carried(part, by)
            )
            own[:, upper : 2 * upper, joint.column] -= (joint.inertia[part] - by) * joint.a[part, None]
    (L1, L2, L3), (F1, F2, F3) = (L[part] for part in parts), F
    flow, phi1, phi2, phi3 = phi_functions((L1 + 4 * L2 + L3) / 6, interval, upper)
    forced = interval * (phi1 @ F1 + phi2 @ (4 * F2 - 3 * F1 - F3) + 4 * phi3 @ (F1 - 2 * F2 + F3))
    for joint in joints:
        before, after = (joint.carried(part, joint.inertia[parts[1]]) for part in (parts[0], parts[2]))
        forced[:, :, joint.column] += np.einsum("kij,kj->ki", flow[:, :, : 2 * upper], before)
        forced[:, : 2 * upper, joint.column] -= after
    return flow, forced


@dataclass(frozen=True)
class Linearization:
    """Linearization of a run: derivatives of its predictions by initial state and parameters.

    Attributes:
        observed: the measurements.
        arm: the arm that was simulated.
        basis: m modes.
        perturbed: p arms, each with one parameter changed.
        trajectory: the motion linearised about; its number of steps is a multiple of two strides.
        stride: integrator steps in half an interval.
        trajectories: the motion for each of the perturbed arms, with joints that only it has.
        coefficients: those of the variational equations along the whole trajectory; None: not computed yet.
    """

    observed: Observations
    arm: Arm
    basis: ModalBasis
    perturbed: Sequence[PerturbedArm]
    trajectory: Trajectory
    stride: int
    trajectories: tuple[Trajectory, ...]
    coefficients: _Coefficients | None = None

    @classmethod
    def of(
        cls,
        observed: Observations,
        arm: Arm,
        basis: ModalBasis,
        perturbed: Sequence[PerturbedArm],
        trajectory: Trajectory,
        stride: int,
    ) -> Self:
        """Linearize a motion; arguments as the attributes."""
        moved = tuple(_with_added_joints(trajectory, arm.chain, other, observed) for other, _ in perturbed)
        return cls(observed, arm, basis, perturbed, trajectory, stride, moved)

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
        behind, ahead = float(np.max(delays, initial=0.0)), float(np.max(-delays, initial=0.0))
        first = 0
        part: Trajectory | None = None
        for chunk in self._chunks():
            part = chunk if part is None else _join_trajectories(part, chunk, behind + ahead)
            at_end = part.time[-1] >= self.trajectory.time[-1]
            last = time.size if at_end else int(np.searchsorted(time, part.time[-1] - ahead, side="left"))
            if last <= first:
                continue
            camera, markers, angles = observed.rows_between(first, last)
            by_angles = self._encoder_slopes(part, angles)
            by_markers = self._marker_slopes(part, exposures[..., camera], time[observed.frames[camera]])
            flat = by_markers.reshape(-1, by_markers.shape[2])
            slopes = np.concatenate([flat[observed.markers[markers] - camera.start * by_markers.shape[1]], by_angles])
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
        if self.coefficients or any(sum(arm.states) > nz for arm, _ in self.perturbed):
            chunk_size = rows.size  # internal states that only perturbed arms have are followed from the start
        for first in range(0, rows.size - 1, chunk_size):
            part = rows[first : first + chunk_size + 1]
            coefficients = self.coefficients or self._coefficients_along(part)
            flow, forced = _propagators(coefficients, 2 * self.stride * trajectory.step)
            states = np.empty((len(flow) + 1, 2 * size + nz, count))
            states[0] = state
            for k in range(len(flow)):
                state = flow[k] @ state
                state[:, 2 * slow_count :] += forced[k]
                states[k + 1] = state
            a = coefficients.by_state[::2, :size] @ states
            a[:, :, 2 * slow_count :] += coefficients.accelerations[::2]
            columns = (states[:, :size], states[:, size : 2 * size], a, states[:, 2 * size :])
            copies = (np.ascontiguousarray(np.swapaxes(x, 1, 2)) for x in columns)
            yield Trajectory(trajectory.time[part[::2]], *copies)

    @cached_property
    def rows(self) -> Indices:
        """Indices of the trajectory's instants at which coefficients are evaluated."""
        return np.arange(0, len(self.trajectory.time), self.stride)

    @property
    def max_chunk(self) -> int:
        """Number of instants whose coefficients are held in memory at once."""
        size = int(2 * self.basis.shapes.shape[1] + self.trajectory.z.shape[1])
        return 2 * max(20, _MOST_COEFFICIENTS // size**2)

    def _coefficients_along(self, rows: Indices) -> _Coefficients:
        return _coefficients_of([self], [rows])[0]

    def _initial_internal_states(self) -> Array:
        """Return derivatives (nz, 2 slow + p) of the internal states at the start."""
        q, slow_count = self.trajectory.q[0], self.basis.slow_count
        observed = self.observed
        z = observed.internal_states(self.arm, q)
        shapes = self.basis.shapes[:, :slow_count].T
        by_angles = [(observed.internal_states(self.arm, q + _STEP * shape) - z) / _STEP for shape in shapes]
        by_rates = [np.zeros(z.size)] * slow_count
        by_parameters = [
            (observed.internal_states(arm, path.q[0])[: z.size] - z) / step
            for (arm, step), path in zip(self.perturbed, self.trajectories, strict=True)
        ]
        return np.stack([*by_angles, *by_rates, *by_parameters], axis=1)

    def _marker_slopes(self, part: Trajectory, exposures: Array, stamps: Array) -> Array:
        """Return derivatives (F, 2 k, 2 slow + p) of marker coordinates, seen at instants (F,) or (k, F)."""
        arcs, q, elapsed = self.observed.arcs, self.trajectory.angles(exposures), self.trajectory.elapsed(exposures)
        by_modes = arcs.slopes(self.arm, q, elapsed, self.basis.shapes)
        modes = np.swapaxes(part.angles(exposures), -2, -1)
        if exposures.ndim == 1:
            slopes = by_modes @ modes
        else:
            by_marker = by_modes.reshape(len(by_modes), len(exposures), 2, by_modes.shape[2])
            slopes = (by_marker @ np.swapaxes(modes, 0, 1)).reshape(*by_modes.shape[:2], modes.shape[-1])
        base: Array | None = None
        first = slopes.shape[2] - len(self.perturbed)
        for k, (other, step) in enumerate(self.perturbed, start=first):
            # Markers are measured at the same places unless sensors, joints or curves differ.
            chain, path = self.arm.chain, self.trajectories[k - first]
            alike = chain.size == other.chain.size and _equal_links(chain, other.chain, _OF_CURVES)
            if self.arm.sensors != other.sensors or not alike:
                base = arcs.measured_positions(self.arm, q, elapsed) if base is None else base
                changed = arcs.frames(other, path, stamps)
                slopes[:, :, k] += ((changed - base) / step).reshape(len(base), 2 * base.shape[1])
        return slopes

    def _encoder_slopes(self, part: Trajectory, angles: slice) -> Array:
        """Return derivatives (r, 2 slow + p) of the encoder values with indices `angles`."""
        observed, active = self.observed, self.arm.chain.active
        rows = slice(angles.start - observed.markers.size, angles.stop - observed.markers.size)
        instants, joints = np.divmod(observed.angles[rows], max(active.size, 1))
        if not joints.size:
            return np.zeros((0, part.q.shape[1]))
        by_active = self.basis.shapes[active].T
        theta = Trajectory(part.time, part.q @ by_active, part.v @ by_active, part.a @ by_active, part.z)
        all_slopes = theta.angles(observed.recording.time[instants])
        slopes: Array = np.take_along_axis(all_slopes, joints[:, None, None], axis=2)[:, :, 0]
        seen = self.trajectory.angles(observed.recording.time)[:, active]
        for k, (other, step) in enumerate(self.perturbed, start=slopes.shape[1] - len(self.perturbed)):
            if other.sensors != self.arm.sensors:
                change = other.encoder_angles(seen) - self.arm.encoder_angles(seen)
                slopes[:, k] += change.ravel()[observed.angles[rows]] / step
        return slopes


def with_coefficients(linearizations: Sequence[Linearization]) -> Iterator[Linearization]:
    """Yield linearizations with their coefficients; those of neighbouring short ones of the same arm in one batch."""
    group: list[Linearization] = []
    for each in linearizations:
        if group and not _is_compatible(group, each):
            yield from _with_shared_coefficients(group)
            group = []
        group.append(each)
    yield from _with_shared_coefficients(group)


def _is_compatible(group: Sequence[Linearization], other: Linearization) -> bool:
    """Return True if a linearization has the arms of a group and its number of modes, and fits into memory with it."""
    first, (one, two) = group[0], (group[0].observed.recording, other.observed.recording)
    arms = [(first.arm, other.arm), *((a.arm, b.arm) for a, b in zip(first.perturbed, other.perturbed, strict=True))]
    return (
        all(a is b for a, b in arms)
        and first.basis.shapes.shape == other.basis.shapes.shape
        and (one.payload, one.gravity) == (two.payload, two.gravity)
        and sum(each.rows.size for each in (*group, other)) <= first.max_chunk
    )


def _with_shared_coefficients(group: Sequence[Linearization]) -> Iterator[Linearization]:
    if len(group) < 2:
        yield from group
        return
    for each, coefficients in zip(group, _coefficients_of(group, [each.rows for each in group]), strict=True):
        yield replace(each, coefficients=coefficients)


def _coefficients_of(group: Sequence[Linearization], rows: Sequence[Indices]) -> list[_Coefficients]:
    """Return the coefficients of linearizations of the same arm, each at some rows of its trajectory."""
    observed = [each.observed for each in group]

    def motions(paths: Sequence[Trajectory]) -> _Motions:
        return _Motions.of([path.at(own) for path, own in zip(paths, rows, strict=True)], observed)

    motion, changed = (
        motions([each.trajectory for each in group]),
        zip(*(each.trajectories for each in group), strict=True),
    )
    # Most perturbed arms have no joint of their own, and move as the arm does.
    others = [motion if paths[0] is group[0].trajectory else motions(paths) for paths in changed]
    return _coefficients(group[0].arm, [each.basis for each in group], group[0].perturbed, motion, others)


def _join_trajectories(before: Trajectory, after: Trajectory, overlap: float) -> Trajectory:
    """Prepend the last `overlap` seconds of a chunk to the next one."""
    if overlap <= 0:
        return after
    kept = before.time < after.time[0] - 1e-12
    kept &= before.time >= after.time[0] - overlap - 2 * after.step
    parts = zip((before.time, *before.motion), (after.time, *after.motion), strict=True)
    return Trajectory(*(np.concatenate([one[kept], two]) for one, two in parts))
