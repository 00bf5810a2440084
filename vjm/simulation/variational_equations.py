"""Variational equations: how a motion changes with its initial state and with parameters, to first order.

Their coefficients along given motions, in the arm's natural modes, and the propagators over short intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from scipy import linalg
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from vjm.chain.virtual_links import Chain, have_equal_links
from vjm.effects.effect import is_nonsmooth
from vjm.model.dynamics import mechanism_of
from vjm.model.modes import linearise
from vjm.records import Array, Indices, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.exponential import flow_and_response
from vjm.simulation.integrate import locked_joint_frequencies
from vjm.simulation.measurement import DIFFERENCE_STEP, Observations
from vjm.simulation.nonsmooth import ContactCoefficients, DryFrictionCoefficients, Pieces
from vjm.simulation.system import Trajectory, torque_at

# Modes whose phase changes by less in an interval are slow [rad]; derivatives, which are interpolated inside it, are
# right to 3 % up to there.
_SLOW_PHASE = 3.2
_MAX_MODES = 16  # bounds the cost, which grows with the cube of the number of modes
_OMITTED_COMPLIANCE = 1e-3  # share of a static deflection that omitted modes may have: far below those 3 %
# What of links rigid-body dynamics depends on: virtual links, and what is at either end.
_OF_RODS = ("lengths", "masses", "mass_centers", "inertias", "rest_curvature")
_OF_BODIES = (*_OF_RODS, "hub_inertia", "hub_radius", "root_inertia", "payload_body")


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
    def of(cls, chain: Chain, recording: Recording, interval: float, nonsmooth: bool = False) -> ModalBasis:
        """Return the modes of an arm with free active joints; slow ones turn by less than 3.2 rad in an interval [s].

        Fast modes respond quasi-statically, and are omitted where they add nothing to a static deflection. Where the
        arm is nonsmooth, a joint that is stiff in contact turns freely apart from it: none of the first 16 is omitted.
        """
        M, _, K, _ = linearise(chain, recording.payload_body, recording.gravity, recording.initial_theta)
        squares, shapes = linalg.eigh(K, M)
        slow_count = int(np.count_nonzero(np.sqrt(np.maximum(squares, 0.0)) * interval < _SLOW_PHASE))
        # Compliances of the modes that bend the arm; limited, as that of an arm about to buckle would be infinite.
        slowest, _ = locked_joint_frequencies(chain, recording.payload_body)
        compliance = 1 / np.maximum(squares[chain.active.size :], (2 * np.pi * slowest) ** 2)
        needed = np.count_nonzero(np.cumsum(compliance[::-1]) > _OMITTED_COMPLIANCE * np.sum(compliance))
        slow_count = min(max(slow_count, chain.active.size + 1), chain.size, _MAX_MODES)
        count = chain.size if nonsmooth else max(slow_count, chain.active.size + int(needed))
        return cls(shapes[:, : min(count, _MAX_MODES)], slow_count)

    @property
    def states(self) -> Array:
        """(2 nv, 2 slow) initial angles and rates by each slow mode's coordinate and rate."""
        shapes = self.shapes[:, : self.slow_count]
        return np.asarray(linalg.block_diag(shapes, shapes))


class PerturbedArm(NamedTuple):
    """The arm with one parameter changed by a small step, in the parameter's unit."""

    arm: Arm
    step: float


class Motions(NamedTuple):
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

    def followed(self, arm: Arm, other: Arm) -> Self:
        """Return the motions of an arm with the internal states that another one would have along them in addition."""
        longest = max(len(path.time) for path in self.paths)
        # Shorter motions are padded with their last instant.
        shown = np.stack(
            [np.minimum(np.arange(longest), part.stop - part.start - 1) + part.start for part in self.parts]
        )
        time, q, v = (values[shown.T] for values in (self.elapsed, self.q, self.v))
        start = [
            observed.internal_states(other, path.q[0]) for observed, path in zip(self.observed, self.paths, strict=True)
        ]
        states = other.follow(time, q, v, np.stack(start))
        z = np.concatenate([states[: len(path.time), k] for k, path in enumerate(self.paths)])
        z[:, other.states_of(arm)] = self.z  # as they are: a difference of rounding would be one over a small step
        return self._replace(z=z)


class _EquationsOfMotion:
    """An arm's equations of motion along given motions of I instants, without contacts and dry friction."""

    def __init__(self, arm: Arm, motions: Motions) -> None:
        self.arm = arm
        self.driven = [arm.inputs(observed.recording) for observed in motions.observed]
        self.gravity, self.payload = self.driven[0].gravity, self.driven[0].payload_body
        self.mechanism = mechanism_of(arm.chain, self.payload, self.gravity)
        self.force = arm.forces(self.payload)

    def has_bodies_of(self, other: Arm, motion: Motions) -> bool:
        """Return True if another arm has the same bodies in these motions, and carries the same payload."""
        payload = other.inputs(motion.observed[0].recording).payload_body
        return payload == self.payload and have_equal_links(self.arm.chain, other.chain, _OF_BODIES)

    def inertial_torque(self, motion: Motions) -> Array:
        """Return M a + h (I, nv)."""
        return self.mechanism.inverse_dynamics(motion.q, motion.v, motion.a)

    def inertia(self, motion: Motions, joints: Indices) -> Array:
        """Return columns (I, nv, r) of the mass matrices: torques on all joints by unit accelerations of r of them."""
        zeros = np.zeros(motion.v.shape)
        bias, indices = self.mechanism.inverse_dynamics(motion.q, zeros, zeros), np.arange(motion.v.shape[1])
        units = (np.broadcast_to((indices == joint).astype(float), zeros.shape) for joint in joints.tolist())
        return np.stack([self.mechanism.inverse_dynamics(motion.q, zeros, unit) - bias for unit in units], axis=2)

    def further_torque(self, motion: Motions) -> Array:
        """Return the effects' forces, with reversed sign (I, nv)."""
        if self.force is None:
            return np.zeros(motion.q.shape)
        return -self.force(motion.elapsed, motion.q, motion.v, motion.z)

    def state_rates(self, motion: Motions) -> Array:
        """Return rates of change of the internal states (I, nz)."""
        return self.arm.state_rates(motion.elapsed, motion.q, motion.v, motion.z)


class _InertialForcing(NamedTuple):
    """Modal accelerations by a parameter that are proportional to r accelerations of the motion, or of added joints.

    Joints that only the perturbed arm has move by a multiple of the parameter, and carry the others with them.
    """

    column: int  # the parameter's
    inertia: Array  # (I, m, r) with reversed sign
    q: Array  # (I, r)
    v: Array
    a: Array

    def during(self, part: slice) -> Self:
        """Return the forcing at some of its instants."""
        return self._replace(inertia=self.inertia[part], q=self.q[part], v=self.v[part], a=self.a[part])


def _carried(by: Array, first: _InertialForcing, later: _InertialForcing, elapsed: Array) -> Array:
    """Return modal coordinates and rates (P, 2 m) that accelerations of inertia (P, m, r) make in times (P,) [s]."""
    q = later.q - first.q - elapsed[:, None] * first.v
    return np.concatenate([_times(by, q), _times(by, later.v - first.v)], axis=1)


def _times(matrices: Array, vectors: Array) -> Array:
    """Return products (K, m) of matrices (K, m, r) and vectors (K, r)."""
    return np.asarray(np.matmul(matrices, vectors[:, :, None])[:, :, 0])


class Coefficients(NamedTuple):
    """Coefficients of the variational equations along a motion of I instants.

    They are derivatives of m modal accelerations and nz internal states' rates, without dry friction and contacts.
    Those by the parameters do not include inertial forcing, either.
    """

    by_state: Array  # (I, m + nz, 2 m + nz), by modal coordinates, rates and internal states
    by_parameters: Array  # (I, m + nz, p)
    inertial: tuple[_InertialForcing, ...]
    friction: DryFrictionCoefficients | None
    contacts: tuple[ContactCoefficients, ...]

    def accelerations(self, states: Array, instants: slice, pieces: Pieces | None) -> Array:
        """Return the modal accelerations (R, m, c) at instants, one in each piece if there are pieces.

        Args:
            states: (R, 2 m + nz, c) derivatives of modal coordinates, rates and internal states by c unknowns, the last
                p of which are the parameters.
            instants: R of those along the motion.
            pieces: of the intervals; None where no joint sticks or touches.
        """
        by_state, by_parameters = self.at(instants, pieces)
        forced = by_parameters[:, : self.modes].copy()
        for forcing in self.inertial:
            forced[:, :, forcing.column] -= _times(forcing.inertia[instants], forcing.a[instants])
        total: Array = by_state[:, : self.modes] @ states
        total[:, :, total.shape[2] - forced.shape[2] :] += forced
        if self.friction is None or pieces is None:
            return total
        return self.friction.at(instants).locked(pieces.held) @ total

    @property
    def modes(self) -> int:
        """Number of modal coordinates, m."""
        return int(self.by_state.shape[2] - self.by_state.shape[1])

    def at(self, instants: slice, pieces: Pieces | None) -> tuple[Array, Array]:
        """Return coefficients (R, ...) by state and parameters at instants, with what joints do in as many pieces.

        Without what holds joints, which takes part of the sum.
        """
        by_state, by_parameters, m = self.by_state[instants], self.by_parameters[instants], self.modes
        if pieces is None:
            return by_state, by_parameters
        by_state, by_parameters = by_state.copy(), by_parameters.copy()
        for k, contact in enumerate(self.contacts):
            touching = pieces.side[:, k] != 0.0
            by_state[:, :m, : 2 * m] += contact.at(instants).by_state(touching)
            by_parameters[:, :m] += touching[:, None, None] * contact.by_parameters[instants]
        if self.friction is not None:
            by_parameters[:, :m] += np.einsum("kj,kjmp->kmp", pieces.direction, self.friction.by_parameters[instants])
        return by_state, by_parameters

    def jumps(self, pieces: Pieces) -> dict[int, tuple[Array, Array]]:
        """Return by what matrices of state and parameters (2 m + nz, ...) derivatives jump at pieces' beginnings.

        A small change of a joint's rate ends where it stops; where it turns round, the share of the acceleration that
        friction had been adding is lost. Where a joint comes to a flank, the damper's push sets in at once.

        Source: M. di Bernardo et al., Piecewise-smooth Dynamical Systems, Springer 2008, section 2.5 (saltation).
        """
        m, size, p = self.modes, self.by_state.shape[2], self.by_parameters.shape[2]
        arrivals = [contact.at(slice(0, -2, 2)).arrival(pieces.met[:, k]) for k, contact in enumerate(self.contacts)]
        stopped = None
        if self.friction is not None:
            stopped = self.friction.at(slice(0, -2, 2)).stopped(pieces.held, pieces.lost)
        changed = np.flatnonzero((pieces.lost != 0.0).any(axis=1) | (pieces.met != 0.0).any(axis=1))
        jumps = {}
        for k in changed.tolist():
            by_state, by_parameters = np.eye(size), np.zeros((size, p))
            for of_angles, of_parameters in arrivals:
                by_state[m : 2 * m, :m] += of_angles[k]
                by_parameters[m : 2 * m] += of_parameters[k]
            if stopped is not None:
                by_state[m : 2 * m] = stopped[k] @ by_state[m : 2 * m]
                by_parameters[m : 2 * m] = stopped[k] @ by_parameters[m : 2 * m]
            jumps[k] = by_state, by_parameters
        return jumps


# Unbounded growth is noticed by `Run.linearized`, which refuses derivatives that are not finite.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def coefficients_along(
    arm: Arm,
    bases: Sequence[ModalBasis],
    perturbed: Sequence[PerturbedArm],
    motion: Motions,
    others: Sequence[Motions],
) -> list[Coefficients]:
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
    inertial, further_torque = equations.inertial_torque(motion), equations.further_torque(motion)
    state_rates = equations.state_rates(motion)
    lengths = [len(path.time) for path in motion.paths]
    shapes = np.repeat(np.stack([basis.shapes for basis in bases]), lengths, axis=0)  # (I, nv, m)
    m, nz = shapes.shape[2], motion.z.shape[1]
    forces = np.zeros((len(motion.q), chain.size, 2 * m + nz + len(perturbed)))
    rates = np.zeros((len(motion.q), nz, 2 * m + nz + len(perturbed)))
    by_state = _state_derivatives(equations, motion, shapes)
    forces[:, :, : 2 * m + nz], rates[:, :, : 2 * m + nz], inertia = by_state
    forcing: list[tuple[int, Array, Motions, Indices]] = []  # parameter, torques (I, nv, r) by accelerations, of joints
    # A motion that is given is kept up by a heavy armature: its inertia and its torque cancel where they are sampled
    # at the same instants only.
    impulsive = is_nonsmooth(arm.effects) and not chain.armature
    at_rest = equations.inertial_torque(motion._replace(a=np.zeros(motion.a.shape))) if impulsive else inertial
    for k, (moved, varied) in enumerate(zip(perturbed, others, strict=True)):
        indices, added = np.arange(varied.a.shape[1]), _added_joints(chain, moved.arm.chain)
        # Accelerations that may jump, or peak in impacts, are not forces to be interpolated between instants.
        changed = impulsive and (added.size > 0 or not equations.has_bodies_of(moved.arm, motion))
        separate = indices if changed else added
        held = varied._replace(a=np.where(np.isin(indices, separate), 0.0, varied.a))
        nominal = (at_rest if changed else inertial, further_torque, state_rates)
        change = _parameter_derivatives(equations, moved, held, nominal)
        forces[:, :, 2 * m + nz + k], rates[:, :, 2 * m + nz + k] = change
        if separate.size:
            shared = np.delete(indices, added)
            by_unit = _EquationsOfMotion(moved.arm, held).inertia(held, separate)[:, shared]
            if changed:
                by_unit[:, :, shared] -= inertia
            forcing.append((k, by_unit / moved.step, varied, separate))
    transposed = np.swapaxes(shapes, 1, 2)
    modal = transposed @ inertia @ shapes
    lower = np.concatenate([-np.linalg.solve(modal, transposed @ forces), rates], axis=1)
    inertial_forcing = []
    for k, by_unit, path, joints in forcing:
        by_acceleration = np.asarray(np.linalg.solve(modal, transposed @ by_unit), dtype=float)
        accelerating = (values[:, joints] for values in (path.q, path.v, path.a))
        inertial_forcing.append(_InertialForcing(k, by_acceleration, *accelerating))
    friction = _dry_friction(arm, bases, perturbed, motion, others, modal)
    contacts = _contacts(arm, bases, perturbed, motion, modal)
    return [
        Coefficients(
            lower[part, :, : 2 * m + nz],
            lower[part, :, 2 * m + nz :],
            tuple(term.during(part) for term in inertial_forcing),
            of_joints,
            touching,
        )
        for part, of_joints, touching in zip(motion.parts, friction, contacts, strict=True)
    ]


def _state_derivatives(equations: _EquationsOfMotion, motion: Motions, shapes: Array) -> tuple[Array, Array, Array]:
    """Return derivatives of torques (I, nv, 2 m + nz) and internal states' rates (I, nz, 2 m + nz), and the inertia.

    They are by coordinates and rates of modes of shapes (I, nv, m), and by internal states. The inertia is (I, nv, nv).
    """
    arm, chain, further_torque = equations.arm, equations.arm.chain, equations.further_torque(motion)
    state_rates = equations.state_rates(motion)
    # Steps small at every joint: those of fast modes, whose shapes are large, must not take a force across its kink.
    steps = DIFFERENCE_STEP / np.abs(shapes).max(axis=1)
    m, nz = shapes.shape[2], motion.z.shape[1]
    forces, rates = np.zeros((len(motion.q), chain.size, 2 * m + nz)), np.zeros((len(motion.q), nz, 2 * m + nz))
    by_angle, by_rate, inertia = equations.mechanism.derivatives(motion.q, motion.v, motion.a)
    stiffness, damping = arm.springs
    forces[:, :, :m] = by_angle @ shapes + stiffness[:, None] * shapes
    forces[:, :, m : 2 * m] = by_rate @ shapes + damping[:, None] * shapes
    for j in range(m) if nz or equations.force is not None else ():
        shape, step = shapes[:, :, j], steps[:, j, None]
        turned, sped = motion._replace(q=motion.q + step * shape), motion._replace(v=motion.v + step * shape)
        for column, varied in ((j, turned), (m + j, sped)):
            if equations.force is not None:
                forces[:, :, column] += (equations.further_torque(varied) - further_torque) / step
            if nz:
                rates[:, :, column] = (equations.state_rates(varied) - state_rates) / step
    if arm.has_dry_friction:  # its slope by the rate is the same in either direction
        active = arm.chain.active
        turning = motion.v[:, active]
        faster = turning + DIFFERENCE_STEP * np.sign(turning)
        slope = (arm.friction_torques(faster) - arm.friction_torques(turning)) / DIFFERENCE_STEP
        forces[:, active, m : 2 * m] += slope[:, :, None] * shapes[:, active]
    for k, step_z in enumerate(DIFFERENCE_STEP * np.eye(nz)):
        varied = motion._replace(z=motion.z + step_z)
        forces[:, :, 2 * m + k] = (equations.further_torque(varied) - further_torque) / DIFFERENCE_STEP
        rates[:, :, 2 * m + k] = (equations.state_rates(varied) - state_rates) / DIFFERENCE_STEP
    return forces, rates, inertia


def _dry_friction(
    arm: Arm,
    bases: Sequence[ModalBasis],
    perturbed: Sequence[PerturbedArm],
    motion: Motions,
    others: Sequence[Motions],
    modal: Array,
) -> list[DryFrictionCoefficients | None]:
    """Return dry friction's coefficients along each motion, from modal mass matrices (I, m, m); None without any."""
    if not arm.has_dry_friction:
        return [None] * len(bases)
    chain = arm.chain
    torques = arm.friction_torques(motion.v[:, chain.active])
    changes = np.zeros((*torques.shape, len(perturbed)))
    for k, ((other_arm, step), varied) in enumerate(zip(perturbed, others, strict=True)):
        changes[:, :, k] = (other_arm.friction_torques(varied.v[:, other_arm.chain.active]) - torques) / step
    coefficients: list[DryFrictionCoefficients | None] = []
    for basis, part in zip(bases, motion.parts, strict=True):
        rates = basis.shapes[chain.active]
        response = np.asarray(np.linalg.solve(modal[part], np.tile(rates.T, (len(modal[part]), 1, 1))))
        by_parameters = -np.swapaxes(response, 1, 2)[:, :, :, None] * changes[part, :, None, :]
        coefficients.append(DryFrictionCoefficients(rates, response, by_parameters))
    return coefficients


def _contacts(
    arm: Arm, bases: Sequence[ModalBasis], perturbed: Sequence[PerturbedArm], motion: Motions, modal: Array
) -> list[tuple[ContactCoefficients, ...]]:
    """Return the contacts' coefficients along each motion, from modal mass matrices (I, m, m)."""
    found: list[tuple[ContactCoefficients, ...]] = []
    for basis, part in zip(bases, motion.parts, strict=True):
        coefficients = []
        for k, contact in enumerate(arm.contacts):
            others = [moved.arm.contacts[k] for moved in perturbed]
            q, v, turns = motion.q[part, contact.joint], motion.v[part, contact.joint], basis.shapes[contact.joint]
            response = np.linalg.solve(modal[part], np.broadcast_to(turns, (q.size, turns.size))[:, :, None])[:, :, 0]
            steps = np.array([moved.step for moved in perturbed])
            changes = [other.resistance(q, v) - contact.resistance(q, v) for other in others]
            pushes = np.stack(changes, axis=1) / steps if changes else np.zeros((q.size, 0))
            gaps = np.array([other.gap - contact.gap for other in others]) / steps
            by_parameters = -(np.sign(q)[:, None] * response)[:, :, None] * pushes[:, None, :]
            coefficients.append(ContactCoefficients(contact, turns, response, by_parameters, gaps))
        found.append(tuple(coefficients))
    return found


def _parameter_derivatives(
    equations: _EquationsOfMotion, perturbed: PerturbedArm, motion: Motions, nominal: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Return forward differences of torques (I, nv) and internal states' rates (I, nz) by a parameter.

    The motions are the perturbed arm's, with joints that only it has.
    """
    inertial, further_torque, state_rates = nominal
    chain, (other_arm, step) = equations.arm.chain, perturbed
    if other_arm.chain.armature != chain.armature:  # a heavier drive of as much more torque: their sum is rounded
        other_arm = Arm(replace(other_arm.chain, armature=chain.armature), other_arm.effects)
    other_chain, nz = other_arm.chain, state_rates.shape[1]
    shared = np.delete(np.arange(other_chain.size), _added_joints(chain, other_chain))
    (stiffness, damping), (other_stiffness, other_damping) = equations.arm.springs, other_arm.springs
    forces = motion.q[:, shared] * (other_stiffness[shared] - stiffness)
    forces += motion.v[:, shared] * (other_damping[shared] - damping)
    rates = np.zeros(state_rates.shape)
    if other_arm.effects == equations.arm.effects and have_equal_links(chain, other_chain, _OF_BODIES):
        if equations.force is not None and not np.array_equal(other_chain.stiffness, chain.stiffness):
            forces = forces + _EquationsOfMotion(other_arm, motion).further_torque(motion) - further_torque
        return forces / step, rates
    changed = _EquationsOfMotion(other_arm, motion)
    unchanged = chain.size == other_chain.size and equations.has_bodies_of(other_arm, motion)
    if changed.gravity != equations.gravity or not unchanged:
        forces = forces + changed.inertial_torque(motion)[:, shared] - inertial
    if sum(other_arm.state_counts) > nz:  # internal states that only the perturbed arm has follow the motion as it is
        motion = motion.followed(equations.arm, other_arm)
    if equations.force is not None or changed.force is not None:
        forces = forces + changed.further_torque(motion)[:, shared] - further_torque
    if nz:
        rates = changed.state_rates(motion)[:, other_arm.states_of(equations.arm)] - state_rates
    for part, path, before, after in zip(motion.parts, motion.paths, equations.driven, changed.driven, strict=True):
        if not np.array_equal(after.tau, before.tau, equal_nan=True):
            forces[part, chain.active] -= torque_at(after, path.time) - torque_at(before, path.time)
    return forces / step, rates / step


def _added_joints(chain: Chain, extended: Chain) -> Indices:
    """Coordinates of joints that another chain has in addition."""
    known = set(chain.joint_names)
    return np.array([k for k, name in enumerate(extended.joint_names) if name not in known], dtype=np.intp)


def with_added_joints(
    paths: Sequence[Trajectory], arm: Arm, other: Arm, observed: Sequence[Observations]
) -> list[Trajectory]:
    """Return motions of an arm with the joints that another one has in addition, moved by the reactions to them.

    To first order in their compliance. A root joint, whose spring is far stiffer than the inertia that it carries is
    heavy, turns by its reaction over the stiffness, and falls across its gap where this reaction changes sign. A base,
    which has a mass of its own, starts at rest and swings.
    With a joint that moves nothing, as that of a motor without inertia, no arm can be simulated: the motion is NaN, as
    it is where a reaction is not finite.
    """
    extended = other.chain
    added = _added_joints(arm.chain, extended)
    if not added.size:
        return list(paths)
    shared = np.delete(np.arange(extended.size), added)
    wider = [_widened(path, shared, extended.size) for path in paths]
    motion = Motions.of(wider, observed)
    if sum(other.state_counts) > motion.z.shape[1]:
        motion = motion.followed(arm, other)
    equations = _EquationsOfMotion(other, motion)
    reactions = equations.inertial_torque(motion) + equations.further_torque(motion)
    inertia = equations.mechanism.mass_matrix(np.stack([path.q[0] for path in wider]))
    movable = np.linalg.matrix_rank(inertia, hermitian=True) == extended.size
    for path, part, mass_matrix, moves in zip(wider, motion.parts, inertia, movable, strict=True):
        if not moves or not np.isfinite(reactions[part][:, added]).all():
            path.q[:] = np.nan
            continue
        mobility = np.linalg.inv(mass_matrix)
        for joint in added.tolist():
            reaction, stiffness, damping = reactions[part, joint], extended.stiffness[joint], extended.damping[joint]
            if joint < extended.base_size:
                mass = mass_matrix[joint, joint]
                q, v = _swing(-reaction / mass, stiffness / mass, damping / mass, path.step)
                moved = np.stack([q, v, -(reaction + stiffness * q + damping * v) / mass])
            else:
                turn = CubicSpline(path.time, -reaction / stiffness)
                moved = np.array([turn(path.time, order) for order in range(3)])
                for contact in (each for each in other.contacts if each.joint == joint):
                    moved = moved + contact.fall(path.time, -mobility[joint, joint] * reaction)
            path.q[:, joint], path.v[:, joint], path.a[:, joint] = moved
        if path.impacts is not None and path.impacts.path.time.size:
            closely, evenly = path.impacts.path, replace(path, impacts=None)
            closely.q[:, added], closely.v[:, added] = (each[:, added] for each in evenly.sample(closely.time))
            closely.a[:, added] = evenly.between((closely.time - path.time[0]) / path.step).a[:, added]
    return wider


def _widened(path: Trajectory, shared: Indices, size: int) -> Trajectory:
    """Return the motion of some joints as that of more joints, zero for the others."""
    wider = np.zeros((3, len(path.time), size))
    wider[:, :, shared] = path.q, path.v, path.a
    q, v, a = wider
    impacts = path.impacts
    if impacts is not None:
        impacts = replace(impacts, path=_widened(impacts.path, shared, size))
    return replace(path, q=q, v=v, a=a, impacts=impacts)


def _swing(push: Array, stiffness: float, damping: float, step: float) -> tuple[Array, Array]:
    """Return position and rate (I,) of an oscillator that starts at rest, under a push (I,) that is linear in a step.

    All are divided by its mass: q'' + damping q' + stiffness q = push. Steps are advanced exactly, as one recursion of
    second order for either (Cayley and Hamilton).
    """
    system = np.zeros((4, 4))  # its state, the push, and what this changes by in a step
    system[0, 1], system[1, :3], system[2, 3] = step, (-stiffness * step, -damping * step, step), 1.0
    advanced = linalg.expm(system)
    (qq, qv), (vq, vv) = A = advanced[:2, :2]
    by_push, by_change = advanced[:2, 2], advanced[:2, 3]
    pushed_q, pushed_v = np.outer(by_push, push[:-1]) + np.outer(by_change, np.diff(push))
    # From x' = A x + w: q'' - tr(A) q' + det(A) q = w_q' - vv w_q + qv w_v, and so for the rate; ' is one step later.
    recursion = [1.0, -np.trace(A), np.linalg.det(A)]
    q = lfilter([1.0, -vv], recursion, pushed_q) + lfilter([0.0, qv], recursion, pushed_v)
    v = lfilter([1.0, -qq], recursion, pushed_v) + lfilter([0.0, vq], recursion, pushed_q)
    return np.r_[0.0, q], np.r_[0.0, v]


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def propagators(coefficients: Coefficients, durations: Array, pieces: Pieces | None = None) -> tuple[Array, Array]:
    """Return transition matrices (P, d, d) of intervals of three instants each, and the forcing's part (P, d, p).

    An interval's matrix is its mean by Simpson's rule, its forcing the quadratic through the three instants. Inertial
    forcing follows accelerations that may have kinks, jumps or peaks, and cannot be interpolated. The unknowns of an
    interval are therefore the arm's motion and what these accelerations make of it since its beginning, at the inertia
    in its middle: in the sum, only changes of that inertia remain beside the accelerations.

    Where joints stick or touch, intervals are in pieces. A joint that is held takes no part in the motion; one that
    touches has a further spring and damper.

    Args:
        coefficients: along the intervals, or their pieces.
        durations: (P,) of the intervals, or their pieces [s].
        pieces: of the intervals, P in all; None where no joint sticks or touches: the intervals themselves.
    """
    instants = slice(0, -2, 2), slice(1, -1, 2), slice(2, None, 2)
    sampled = [coefficients.at(each, pieces) for each in instants]
    states, forcings = [by_state for by_state, _ in sampled], [by_parameters for _, by_parameters in sampled]
    inertial = [[term.during(each) for each in instants] for term in coefficients.inertial]
    count, lower, size = states[0].shape
    upper = size - lower  # modal coordinates, whose rates of change are unknowns themselves
    interval, friction = float(durations.max()), coefficients.friction
    shares = durations / interval
    if friction is not None and pieces is not None:
        friction = friction.at(instants[1])
        moving = np.zeros((count, lower, lower))
        moving[:] = np.eye(lower)
        moving[:, :upper, :upper] = friction.locked(pieces.held)
        states, forcings = [moving @ each for each in states], [moving @ each for each in forcings]
        by_joints = moving[:, :upper, :upper]
        inertial = [[term._replace(inertia=by_joints @ term.inertia) for term in terms] for terms in inertial]
    elapsed = [share * durations for share in (0.0, 0.5, 1.0)]
    L, F = np.zeros((3, count, size, size)), np.zeros((3, count, size, forcings[0].shape[2]))
    L[:, :, :upper, upper : 2 * upper] = np.eye(upper)
    for k in range(3):
        L[k, :, upper:], F[k, :, upper:] = states[k], forcings[k]
        for terms in inertial:
            first, middle, now = terms[0], terms[1], terms[k]
            carried = _carried(middle.inertia, first, now, elapsed[k])
            F[k, :, upper:, now.column] -= _times(states[k][:, :, : 2 * upper], carried)
            F[k, :, upper : 2 * upper, now.column] -= _times(now.inertia - middle.inertia, now.a)
    L, F = L * shares[:, None, None], F * shares[:, None, None]
    quadratic = F[0], 4 * F[1] - 3 * F[0] - F[2], 4 * (F[0] - 2 * F[1] + F[2])
    flow, response = flow_and_response((L[0] + 4 * L[1] + L[2]) / 6, interval, upper, quadratic)
    forced = interval * response
    for first, middle, last in inertial:
        forced[:, : 2 * upper, last.column] -= _carried(middle.inertia, first, last, elapsed[2])
    return flow, forced
