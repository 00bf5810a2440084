"""Integration of the equations of motion: recordings' torques in, trajectories out.

Chains are stiff in K and smooth in everything else. All copies of a `System` advance together, each under its own
torque, by a fourth-order exponential Runge-Kutta method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError, ShapeError, SimulationDivergedError
from vjm.model.modes import locked_modes
from vjm.records import NO_PAYLOAD, Array, Indices, Mask, Payload, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.exponential import internal_stage, linear_part, phi_functions, runge_kutta_stages
from vjm.simulation.impacts import PATH_SHARES, ContactSteps
from vjm.simulation.stick_slip import FrictionWeights, StickSlip, multiply
from vjm.simulation.system import Drive, System, Trajectory, as_slice

_LEAST_STEPS = 20  # of a short recording
_MOST_STEPS = 2e7  # of a long one: several GiB, and a day of an arm that swings once in a second
# Half an interval over which derivatives of the motion are advanced, in periods of the slowest mode; shorter where an
# elbow changes the arm's shape altogether.
_HALF_INTERVAL, _HALF_INTERVAL_ELBOW = 1 / 140, 1 / 600
_SIMILAR_DURATIONS = 1.5  # durations within this factor are advanced together
_DIVERGED = 1e3  # rad; no joint turns so far
_STEPS_BETWEEN_CHECKS = 50  # whether the motion has diverged; a check takes a twentieth of a step's time
# With an elbow: joints a link from which on steps are as much shorter as there are more, and for so many the angle
# between those at which the linear part is taken [rad]; it shrinks with the square of the joints. Errors of 24 joints
# are four times those of eight then, and were seventy times as large with the same steps and angle.
_FEW_JOINTS, _ELBOW_GRID = 8, 0.05


def simulate_trajectories(
    arms: Sequence[Arm],
    recordings: Sequence[Recording],
    q: Sequence[Array],
    v: Sequence[Array],
    step: float | None = None,
    step_multiple: float = 1.0,
    longest: float = np.inf,
    began: Sequence[float] | None = None,
    z: Sequence[Array] | None = None,
) -> list[Trajectory]:
    """Simulate several recordings, or several copies over one, all advanced together where they are alike.

    Args:
        arms: C arms, one a run.
        recordings: C recordings: each gives instants, torque, gravity and payload.
        q, v: C initial angles (nv,) [rad] and rates (nv,) [rad/s].
        step: [s]; None: `default_step`.
        step_multiple: multiple of the default step to take.
        longest: step allowed [s].
        began: C instants at which the recordings began [s], where they are parts of longer ones; None: their first.
        z: C initial internal states (nz,); None: those of a recording's start.

    Returns:
        C trajectories, from the recording's first instant to its last or a little beyond: their numbers of steps are
        multiples of two `steps_per_half_interval`s.

    Raises:
        InsufficientDataError: no torque measured at an active joint, or a recording too long to be simulated.
        ShapeError: a step that is not a positive number.
        SimulationDivergedError: a trajectory left the finite numbers.
    """
    driven = [arm.inputs(recording) for arm, recording in zip(arms, recordings, strict=True)]
    starts = [float(recording.time[0]) for recording in driven] if began is None else began
    trajectories: dict[int, Trajectory] = {}
    for group in _similar(arms, driven):
        group = _adjacent(group, arms, driven)
        first, copies = driven[group[0]], [arms[k] for k in group]
        h = step_multiple * default_step(copies[0].chain, first.payload_body) if step is None else step
        if not 0 < h < np.inf:
            raise ShapeError("step", h, "a positive number of seconds")
        if _duration(first) > 0:
            h = min(h, _duration(first) / _LEAST_STEPS)
        h = min(h, longest, min(arm.longest_step for arm in copies) * min(step_multiple, 2.0))
        counts = [_step_count(arms[k].chain, driven[k], h) for k in group]
        drive = Drive.of([driven[k] for k in group], [starts[k] for k in group], h, max(counts))
        system = System.of(copies, [driven[k].payload_body for k in group], first.gravity)
        angles, rates = (np.stack([np.asarray(values[k], dtype=float) for k in group]) for values in (q, v))
        states = np.stack([arms[k].initial_states(np.asarray(q[k])) if z is None else z[k] for k in group])
        with np.errstate(all="ignore"):  # divergence is noticed, and raised
            batch, contacts = _integrate(system, angles, rates, states, drive)
        for copy, (k, count) in enumerate(zip(group, counts, strict=True)):
            motion = (values[: count + 1, copy] for values in batch.motion)
            friction = None if batch.friction is None else batch.friction.of_copy(copy, count)
            time = driven[k].time[0] + batch.time[: count + 1]
            impacts = None if contacts is None else contacts.impacts(copy, count, float(time[0]))
            trajectories[k] = Trajectory(time, *motion, start=starts[k], friction=friction, impacts=impacts)
    return [trajectories[k] for k in range(len(arms))]


def _similar(arms: Sequence[Arm], recordings: Sequence[Recording]) -> list[list[int]]:
    """Return the indices of runs that can be advanced together: as many unknowns, same gravity, similar durations."""
    kinds = [
        (recording.gravity, arm.chain.size, sum(arm.state_counts))
        for arm, recording in zip(arms, recordings, strict=True)
    ]
    durations = [_duration(recording) for recording in recordings]
    groups: list[list[int]] = []
    for k in np.argsort(durations, kind="stable").tolist():
        for group in groups:
            if durations[k] <= _SIMILAR_DURATIONS * durations[group[0]] and kinds[k] == kinds[group[0]]:
                group.append(k)
                break
        else:
            groups.append([k])
    return groups


def _adjacent(group: list[int], arms: Sequence[Arm], recordings: Sequence[Recording]) -> list[int]:
    """Return the runs, the first one first, in an order in which those of the same arm and payload are adjacent."""
    places: dict[tuple[int | Payload, ...], int] = {}

    def place(k: int) -> tuple[int, int]:
        mechanism = id(arms[k].chain), recordings[k].payload_body
        return places.setdefault(mechanism, len(places)), places.setdefault((id(arms[k].effects),), len(places))

    return sorted(group, key=place)


def _duration(recording: Recording) -> float:
    return float(recording.time[-1] - recording.time[0])


def default_step(chain: Chain, payload: Payload = NO_PAYLOAD) -> float:
    """Return the exponential integrator's step [s] that keeps the tip within a millionth of the arm's length.

    Measured over ten periods of chains of 4 to 40 joints bent by an eighth of their length, or driven. The error grows
    with the arm's length and the fourth power of the step; the top modes of larger chains, however fast, are in the
    part that is advanced exactly. A further link is swung about by the one before: measured on two links that turn by
    2 rad in a period; one that whirls needs shorter steps. As the inertia between an elbow's grid angles is not in the
    exact part, so do more joints.
    """
    slowest, _ = locked_joint_frequencies(chain, payload)
    joints = max(link.virtual_joints for link in chain.links)
    # Derivatives are advanced over two steps at least: the motion alone would allow longer ones.
    steps_a_period = (
        min(60.0 + 16.0 * joints, 220.0) if len(chain.links) == 1 else 880.0 * max(joints / _FEW_JOINTS, 1.0)
    )
    return 1.0 / (steps_a_period * slowest)


@lru_cache(maxsize=64)
def locked_joint_frequencies(chain: Chain, payload: Payload = NO_PAYLOAD) -> tuple[float, float]:
    """Return the lowest and the highest natural frequency with the active joints locked [Hz]."""
    frequencies = locked_modes(chain, payload, (0.0, 0.0))[0].frequencies
    return float(frequencies[0]), float(frequencies[-1])


def steps_per_half_interval(chain: Chain, recording: Recording, step: float) -> int:
    """Return the number of steps [s] in half an interval over which derivatives are advanced at once."""
    slowest, _ = locked_joint_frequencies(chain, recording.payload_body)
    periods = _HALF_INTERVAL_ELBOW if chain.elbows.size else _HALF_INTERVAL
    # A period may be far longer than the recording, beyond which nothing need be simulated.
    longest = min(periods / slowest, max(_duration(recording), step))
    return max(1, int(longest / step + 1e-9))


def _step_count(chain: Chain, recording: Recording, step: float) -> int:
    duration = _duration(recording)
    if duration > _MOST_STEPS * step:
        slowest, _ = locked_joint_frequencies(chain, recording.payload_body)
        raise InsufficientDataError(
            f"simulation of {recording.file or 'a recording'}",
            f"its {duration:.4g} s are {duration / step:.2g} steps, for the model's slowest mode has {slowest:.4g} Hz",
            f"check times, lengths, masses and stiffness; {_MOST_STEPS:g} steps are possible",
        )
    multiple = 2 * steps_per_half_interval(chain, recording, step)
    count = max(1, int(np.ceil(duration / step - 1e-9)))
    return multiple * -(-count // multiple)


def _integrate(system: System, q: Array, v: Array, z: Array, drive: Drive) -> tuple[Trajectory, ContactSteps | None]:
    """Return the copies' trajectory from time zero by exponential Runge-Kutta steps of stiff order 4 in 5 stages.

    The linear part (M at zero passive angles, D, K) is advanced exactly whatever the step; the steps only have to
    resolve what the bending itself changes. Where an active joint further out bends the arm, the linear part is taken
    at the nearest of a grid of its angles. As M turns with the elbow, what remains is as stiff as the springs are: the
    four stages of Cox and Matthews lose two orders there, and need steps eight times shorter. Internal states of
    effects are advanced by the explicit method of order four that the five stages become where the linear part is zero.
    Its stability polynomial is that of the classical Runge-Kutta method: steps of up to 2.78 time constants are stable.

    Source: as of `runge_kutta_stages`.
    """
    n, count, step, elapsed = q.shape[1], len(drive.start), drive.step, drive.first - drive.began
    path = Trajectory(step * np.arange(count + 1.0), *(np.empty((count + 1, *like.shape)) for like in (q, q, q, z)))
    # From the quadratic's torque at the start of each step to the torque itself, for what lies between steps.
    missing = drive.ends[:-1] - drive.start
    start, middle, end = torques = _of_all_joints(system, drive)
    contacts = ContactSteps(system, (q, v), torques, elapsed, step) if system.has_contacts else None
    joints, sticks = as_slice(system.active), system.has_dry_friction
    friction = StickSlip(system.friction_torques, torques, joints, step) if sticks else None
    propagator = _LinearPropagator(system, step, None if contacts is None else contacts.touching)
    of_flanks = 0.0 if contacts is None else contacts.torque  # changed in place
    has_further_forces, z_rates = system.has_further_forces, np.empty((5, *z.shape))
    # Neither a control law or effect nor the linear part at an elbow's angle is evaluated at what is not finite.
    unchecked = 1 if propagator.elbows.size or has_further_forces else _STEPS_BETWEEN_CHECKS

    # The next stage's torques, the state at the step's start and the accelerations of the stages so far: of these, the
    # next stage is one product. For few copies most of the time is Python's and NumPy's, so that arrays are made once.
    y = np.concatenate([start[0] + of_flanks, q, v, np.empty((len(q), 5 * n))], axis=1)
    applied, x, a = y[:, :n], y[:, n : 3 * n], [y[:, k * n : (k + 1) * n] for k in range(3, 8)]
    known = [y[:, : k * n] for k in range(3, 9)]
    stage = multiply(known[0], propagator.at(x).first)
    at_stage, q, v, torque = stage[:, : 2 * n], stage[:, :n], stage[:, n : 2 * n], stage[:, 2 * n :]

    def accelerate_at(number: int, k: float, z: Array) -> Array:
        """Note the accelerations of a stage, k steps from the start, and return rates of internal states."""
        rates = z
        if has_further_forces:
            force, rates = system.further_forces(elapsed + k * step, q, v, z)
            np.add(torque, force, out=torque)
        system.accelerations(q, v, torque, a[number - 1])
        return rates

    def advance(number: int, weights: _Weights, torque: Array) -> None:
        applied[:] = torque if contacts is None else torque + of_flanks
        multiply(known[number - 1], weights[number - 1], stage)

    def record(k: int, a: Array, z: Array) -> None:
        path.q[k], path.v[k], path.a[k], path.z[k] = q, v, a, z
        if k % unchecked == 0 or k == count:
            _require_finite(path.q, range(max(k - unchecked, 0), k + 1), drive)

    for k in range(count):
        weights = propagator.at(x)
        z_rates[0] = accelerate_at(1, k, z)
        at_once, further = missing[k], None
        if friction is not None:
            further, missing_friction = friction.over_step(k, known[1], weights.friction)
            a[0] += multiply(further, weights.response)
            at_once = at_once + missing_friction
        record(k, a[0] + multiply(at_once, weights.response), z)
        advance(2, weights, middle[k])
        z_rates[1] = accelerate_at(2, k + 0.5, internal_stage(z, z_rates[:1], step))
        advance(3, weights, middle[k])
        z_rates[2] = accelerate_at(3, k + 0.5, internal_stage(z, z_rates[:2], step))
        advance(4, weights, end[k])
        z_rates[3] = accelerate_at(4, k + 1, internal_stage(z, z_rates[:3], step))
        advance(5, weights, middle[k])
        z_rates[4] = accelerate_at(5, k + 0.5, internal_stage(z, z_rates[:4], step))
        advance(6, weights, start[k + 1])  # the first stage of the next step
        z_end = internal_stage(z, z_rates[:5], step)
        if contacts is not None and contacts.advance(k, known[1], weights.paths, further, at_stage, (z, z_end)):
            x[:], applied[:] = at_stage, start[k + 1] + of_flanks
            multiply(known[0], propagator.at(x).first, stage)
        x[:], z = at_stage, z_end
    accelerate_at(1, count, z)
    record(count, a[0], z)
    return path if friction is None else replace(path, friction=friction.history), contacts


def _require_finite(q: Array, steps: range, drive: Drive) -> None:
    """Raise SimulationDivergedError if a copy's angles (S, C, nv) leave the finite numbers within some steps."""
    largest: Array = np.abs(q[steps.start : steps.stop]).max(axis=2)
    if not largest.max() < _DIVERGED:
        row = int(np.argmax(~(largest < _DIVERGED).all(axis=1)))
        first = float(drive.first[np.argmax(~(largest[row] < _DIVERGED))])
        remedy = "take smaller steps, or check the model's masses, stiffness and torque"
        raise SimulationDivergedError(first + drive.step * max(steps[row] - 1, 0), drive.step, remedy)


def _of_all_joints(system: System, drive: Drive) -> tuple[Array, Array, Array]:
    """Return torques on all joints at the steps' starts and the last one's end (S + 1, C, nv), middles and ends."""
    parts = np.concatenate([drive.start, drive.ends[-1:]]), drive.middle, drive.end
    start, middle, end = (np.zeros((len(active), *system.stiffness.shape)) for active in parts)
    for torques, active in zip((start, middle, end), parts, strict=True):
        torques[:, :, system.active] = active
    return start, middle, end


class _Weights(NamedTuple):
    """Matrices of the steps (C, ...), transposed.

    `first` to `fifth` take the torques at a stage, the state at the step's start and the accelerations of the stages so
    far, side by side, to the state at the stage and these torques with those of springs and dampers; `end` does so for
    the end of the step. `response` takes active torques (n_a,) to accelerations (nv,), the further ones are
    `FrictionWeights` and those of `ContactSteps`. One copy stands for all where they are equal.
    """

    first: Array
    second: Array
    third: Array
    fourth: Array
    fifth: Array
    end: Array
    response: Array
    by_motion: Array
    by_friction: Array
    by_torque: Array
    mobility: Array
    later: Array
    paths: Array

    @property
    def friction(self) -> FrictionWeights:
        """Weights for dry friction."""
        return FrictionWeights(self.by_motion, self.by_friction, self.by_torque, self.mobility, self.later)


class _LinearPropagator:
    """Matrices of the steps at the copies' elbow angles and contacts, each computed once."""

    def __init__(self, system: System, step: float, touching: Mask | None) -> None:
        """Begin with joints (C, n_c) in contact, if there are gaps; the array is looked at again for each step."""
        self.system, self.step = system, step
        self.touching = np.zeros((len(system.arms), 0), dtype=bool) if touching is None else touching
        self.elbows = system.active[system.active > 0]  # joints further out that bend the arm, or beyond a moving base
        joints = max(link.virtual_joints for arm in system.arms for link in arm.chain.links)
        self.grid = _ELBOW_GRID / max(joints / _FEW_JOINTS, 1.0) ** 2  # between angles of an elbow [rad]
        self.known: dict[tuple[int, ...], _Weights] = {}
        self.gathered: tuple[list[tuple[int, ...]], _Weights] | None = None  # keys of the copies' own matrices
        self.current: tuple[bytes, _Weights] | None = None
        all_copies = np.arange(len(system.arms))
        straight = self._inertia(np.zeros((all_copies.size, self.elbows.size)), all_copies)
        parts = (straight, system.stiffness, system.damping, *map(np.asarray, system.contacts))
        self.equal = all((part == part[0]).all() for part in parts)

    def at(self, x: Array) -> _Weights:
        """Return those at angles x (C, >= nv)."""
        if self.current is not None and not (self.elbows.size or self.touching.size):
            return self.current[1]
        angles = x[:, self.elbows]
        angles = np.where(np.abs(angles) < _DIVERGED, angles, 0.0)  # of what has diverged, which is noticed afterwards
        places = np.concatenate([np.round(angles / self.grid), self.touching], axis=1)
        if self.current is None or self.current[0] != places.tobytes():
            self.current = places.tobytes(), self._gathered(places)
        return self.current[1]

    def _gathered(self, places: Array) -> _Weights:
        keys = [(0 if self.equal else copy, *place) for copy, place in enumerate(places.astype(int).tolist())]
        missing = {key: copy for copy, key in enumerate(keys) if key not in self.known}
        if missing:
            copies = np.array([*missing.values()])
            stiffness, damping = self.system.springs(self.touching)
            inertia = self._inertia(places[copies, : self.elbows.size], copies)
            computed = self._weights(inertia, stiffness[copies], damping[copies])
            self.known |= {key: _Weights(*parts) for key, *parts in zip(missing, *computed, strict=True)}
        if len(set(keys)) == 1:
            return _Weights(*(part[None] for part in self.known[keys[0]]))
        if self.gathered is None:
            chosen = zip(*(self.known[key] for key in keys), strict=True)
            self.gathered = keys, _Weights(*(np.stack(parts) for parts in chosen))
        current_keys, weights = self.gathered
        for copy, key in enumerate(keys):
            if key != current_keys[copy]:
                current_keys[copy] = key
                for part, matrix in zip(weights, self.known[key], strict=True):
                    part[copy] = matrix
        return weights

    def _inertia(self, places: Array, copies: Indices) -> Array:
        """Return mass matrices (c, nv, nv) of copies at zero angles, except the elbows', at places (c, elbows)."""
        q = np.zeros((copies.size, self.system.stiffness.shape[1]))
        q[:, self.elbows] = self.grid * places
        inertia = np.empty((*q.shape, q.shape[1]))
        for group, mechanism in self.system.mechanisms:
            selected = np.isin(copies, np.arange(len(self.system.arms))[group])
            if selected.any():
                inertia[selected] = mechanism.mass_matrix(q[selected])
        return inertia

    def _weights(self, inertia: Array, stiffness: Array, damping: Array) -> _Weights:
        """Return the matrices of copies, from mass matrices (c, nv, nv) and springs (c, nv)."""
        n, step = inertia.shape[1], self.step
        try:
            inverse: Array = np.asarray(np.linalg.inv(inertia), dtype=float)
        except np.linalg.LinAlgError as error:
            problem, remedy = "a joint moves nothing that has inertia", "give its hub or its links mass"
            raise SimulationDivergedError(0.0, step, remedy, problem) from error
        springs = np.zeros((len(inertia), n, 2 * n))
        springs[:, range(n), range(n)], springs[:, range(n), range(n, 2 * n)] = -stiffness, -damping
        L = linear_part(inverse, stiffness, damping)
        stages, halves, wholes = runge_kutta_stages(L, step)
        applied = np.zeros((len(inertia), 3 * n, n))  # torques are added to those of springs and dampers
        applied[:, 2 * n :] = np.eye(n)
        by_accelerations = _by_accelerations(L[:, n:], stages)
        with_springs = (np.concatenate([stage, springs @ stage], axis=1) for stage in by_accelerations)
        weights = [np.concatenate([applied, stage], axis=2) for stage in with_springs]
        response = inverse[:, :, self.system.active]
        friction = _friction_weights(step, L[:, n:], response, self.system.active, halves, wholes)
        paths = _paths_by_motion(L, step) if self.system.has_contacts else np.zeros((len(L), 0, 4 * n))
        return _Weights._make(_transposed(part) for part in (*weights, response, *friction, paths))


def _friction_weights(
    step: float, rate: Array, response: Array, active: Indices, half: tuple[Array, ...], full: tuple[Array, ...]
) -> list[Array]:
    """Return the matrices of `FrictionWeights`, not transposed.

    Args:
        step: [s].
        rate: (C, n, 2 n) from states to linear accelerations.
        response: (C, n, n_a) from active torques to accelerations.
        active: coordinates of the active joints.
        half, full: exp, phi_1, phi_2, phi_3 of half a step and of a step, the last three times the step.
    """
    n, (half_flow, half1, half2, half3), (flow, phi1, phi2, phi3) = rate.shape[1], half, full
    joints = np.zeros((active.size, 2 * n))
    joints[range(active.size), n + active] = 1.0

    def mean(changes: Array) -> Array:
        """Return mean accelerations of the joints from changes of the state over half a step."""
        return joints @ changes * (2 / step)

    # Changes of the state by itself, by what remains, and by the quadratic torque in the middle and at the end.
    first = half_flow - np.eye(2 * n), half1 / 2, half2 - half3, half3 / 2 - half2 / 4
    whole = flow - half_flow, phi1 - half1 / 2, 4 * phi2 - 8 * phi3 - first[2], 4 * phi3 - phi2 - first[3]
    state, remainder, middle, end = (
        np.concatenate([mean(a), mean(b)], axis=1) for a, b in zip(first, whole, strict=True)
    )
    by_start = np.zeros((*state.shape[:2], n))
    by_start[:, :, active] = -(middle + end) @ response
    by_motion = np.concatenate([by_start, state - remainder @ rate, remainder], axis=2)
    by_friction = (middle + end - remainder) @ response
    by_torque = np.concatenate([middle @ response, end @ response], axis=2)
    pushed = half1 / 2 @ response
    return [
        by_motion,
        by_friction,
        by_torque,
        mean(pushed),
        mean(half_flow @ pushed - pushed),
    ]


def _paths_by_motion(L: Array, step: float) -> Array:
    """Return matrices (C, 3 n s, 4 n) to angles, rates and accelerations at s shares of a step [s], side by side.

    They are by torques, angles, rates and accelerations at its start; what remains beside the linear part L (C, 2 n,
    2 n) stays as it is there.
    """
    copies, n, count = len(L), L.shape[1] // 2, PATH_SHARES.size
    rate, identity = L[:, n:], np.eye(n)
    flow, phi1, *_ = phi_functions((L * PATH_SHARES[:, None, None, None]).reshape(-1, 2 * n, 2 * n), step, n)
    by_acceleration = step * np.repeat(PATH_SHARES, copies)[:, None, None] * phi1[:, :, n:]
    rates = np.tile(rate, (count, 1, 1))
    states = np.concatenate([flow - by_acceleration @ rates, by_acceleration], axis=2)
    remainder = np.concatenate([-rates, np.broadcast_to(identity, (len(rates), n, n))], axis=2)
    moved = np.concatenate([states, rates @ states + remainder], axis=1).reshape(count, copies, 3 * n, 3 * n)
    paths = np.zeros((copies, count, 3 * n, 4 * n))
    paths[:, :, :, n:] = moved.swapaxes(0, 1)
    return paths.reshape(copies, -1, 4 * n)


def _by_accelerations(rate: Array, stages: Sequence[Sequence[Array]]) -> list[Array]:
    """Return matrices (C, 2 n, 2 n + s n) that lead to stages 1, 2, ... from the s stages' accelerations before each.

    Args:
        rate: (C, n, 2 n) from states to linear accelerations.
        stages: of the second and later ones, as of `runge_kutta_stages`.
    """
    size = rate.shape[2]
    found: list[Array] = [np.broadcast_to(np.eye(size), (len(rate), size, size))]
    for flow, *weights in stages:
        stage = np.concatenate([flow, *weights], axis=2)
        for weight, earlier in zip(weights, found, strict=True):
            stage[:, :, : earlier.shape[2]] -= weight @ rate @ earlier
        found.append(stage)
    return found


def _transposed(matrices: Array) -> Array:
    return np.ascontiguousarray(np.swapaxes(matrices, 1, 2))
