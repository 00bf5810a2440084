"""Open-loop simulation of a recording: its torque in, angles and markers out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from vjm.chain.virtual_links import Chain
from vjm.errors import ChoiceError, ShapeError
from vjm.model.modes import linearise, modes_of
from vjm.records import Array, Recording, Rig, Simulation
from vjm.simulation.arm import Arm
from vjm.simulation.integrators import INTEGRATORS
from vjm.simulation.measurement import MarkerArcs
from vjm.simulation.system import Drive, System, Trajectory

_REFERENCE_STEP = 1e-4  # s, section 6.4
_LEAST_STEPS = 20  # of a short recording
# Half an interval over which derivatives of the motion are advanced, in periods of the slowest mode; shorter where an
# elbow changes the arm's shape altogether.
_HALF_INTERVAL, _HALF_INTERVAL_ELBOW = 1 / 140, 1 / 600
_SIMILAR_DURATIONS = 1.5  # durations within this factor are advanced together
_MOST_TOGETHER = 128  # coordinates; what Pinocchio keeps for a model grows with their third power, 10 GB for 432


def default_step(chain: Chain, payload: float = 0.0) -> float:
    """Return the exponential integrator's step [s] that keeps the tip within 1e-6 m of the reference over 10 s.

    Measured on 1 m chains of 4 to 40 joints bent by an eighth of their length, or driven. The error grows with the
    arm's length and the fourth power of the step; the top modes of larger chains, however fast, are in the part that is
    advanced exactly. An active joint further out swings the arm's outer part about fast.
    """
    slowest, _ = locked_joint_frequencies(chain, payload)
    joints = max(link.virtual_joints for link in chain.links)
    steps_a_period = min(60.0 + 16.0 * joints, 220.0)
    if (chain.active > 0).any():
        steps_a_period = min(880.0 * joints, 5200.0)
    return float(sum(link.length for link in chain.links) ** -0.25 / (steps_a_period * slowest))


def locked_joint_frequencies(chain: Chain, payload: float = 0.0) -> tuple[float, float]:
    """Return the lowest and the highest natural frequency with the active joints locked [Hz]."""
    M, D, K, rest = linearise(chain, payload, (0.0, 0.0))
    p = chain.passive
    frequencies = modes_of(M[np.ix_(p, p)], D[np.ix_(p, p)], K[np.ix_(p, p)], rest[p]).frequencies
    return float(frequencies[0]), float(frequencies[-1])


def simulate_trajectories(
    arms: Sequence[Arm],
    recordings: Sequence[Recording],
    q: Sequence[Array],
    v: Sequence[Array],
    integrator: str = "exponential",
    step: float | None = None,
    step_multiple: float = 1.0,
    longest: float = np.inf,
) -> list[Trajectory]:
    """Simulate several recordings, or several copies over one, all advanced together where they are alike.

    Args:
        arms: C arms, one a run.
        recordings: C recordings: each gives instants, torque, gravity and payload.
        q, v: C initial angles (nv,) [rad] and rates (nv,) [rad/s].
        integrator: `exponential` or `rk4`.
        step: [s]; None: `default_step` or, for `rk4`, 100 us.
        step_multiple: multiple of the default step to take.
        longest: step allowed [s].

    Returns:
        C trajectories of one copy each, from the recording's first instant to its last or a little beyond: their
        numbers of steps are multiples of two `steps_per_half_interval`s.

    Raises:
        ChoiceError: unknown integrator.
        InsufficientDataError: no torque measured at an active joint.
        SimulationDivergedError: a trajectory left the finite numbers.
    """
    if integrator not in INTEGRATORS:
        raise ChoiceError("integrator", integrator, INTEGRATORS)
    driven = [arm.inputs(recording) for arm, recording in zip(arms, recordings, strict=True)]
    trajectories: dict[int, Trajectory] = {}
    for group in _similar(arms, driven):
        first, copies = driven[group[0]], [arms[k] for k in group]
        allowed = min(arm.longest_step for arm in copies) * min(step_multiple, 2.0)
        h = min(_step(copies[0].chain, first, integrator, step, step_multiple), longest, allowed)
        counts = [_step_count(arms[k].chain, driven[k], h) for k in group]
        drive = Drive.of([driven[k] for k in group], h, max(counts))
        system = System.of(copies, [driven[k].payload for k in group], first.gravity)
        angles, rates = (np.stack([np.asarray(values[k], dtype=float) for k in group]) for values in (q, v))
        states = np.stack([arm.initial_states(angle) for arm, angle in zip(copies, angles, strict=True)])
        with np.errstate(over="ignore", invalid="ignore"):  # divergence is noticed, and raised
            together = INTEGRATORS[integrator](system, angles, rates, states, drive)
        for c, (k, count) in enumerate(zip(group, counts, strict=True)):
            rows = slice(count + 1)
            motion = (values[rows, c : c + 1] for values in (together.q, together.v, together.a, together.z))
            trajectories[k] = Trajectory(driven[k].time[0] + together.time[rows], *motion)
    return [trajectories[k] for k in range(len(arms))]


def _similar(arms: Sequence[Arm], recordings: Sequence[Recording]) -> list[list[int]]:
    """Indices of runs that can be advanced together: as many unknowns, the same gravity, about equally long."""
    kinds = [
        (recording.gravity, arm.chain.size, sum(arm.states)) for arm, recording in zip(arms, recordings, strict=True)
    ]
    durations = [_duration(recording) for recording in recordings]
    groups: list[list[int]] = []
    for k in np.argsort(durations, kind="stable").tolist():
        for group in groups:
            similar = durations[k] <= _SIMILAR_DURATIONS * durations[group[0]] and kinds[k] == kinds[group[0]]
            if similar and (len(group) + 1) * arms[k].chain.size <= _MOST_TOGETHER:
                group.append(k)
                break
        else:
            groups.append([k])
    return groups


def _duration(recording: Recording) -> float:
    return float(recording.time[-1] - recording.time[0])


def _step(chain: Chain, recording: Recording, integrator: str, step: float | None, step_multiple: float) -> float:
    if step is None:
        exact = integrator != "exponential"
        step = _REFERENCE_STEP if exact else step_multiple * default_step(chain, recording.payload)
    if not 0 < step < np.inf:
        raise ShapeError("step", step, "a positive number of seconds")
    duration = _duration(recording)
    return min(step, duration / _LEAST_STEPS) if duration > 0 else step


def steps_per_half_interval(chain: Chain, recording: Recording, step: float) -> int:
    """Return the number of steps [s] in half an interval over which derivatives are advanced at once."""
    slowest, _ = locked_joint_frequencies(chain, recording.payload)
    periods = _HALF_INTERVAL_ELBOW if (chain.active > 0).any() else _HALF_INTERVAL
    return max(1, int(periods / (slowest * step) + 1e-9))


def _step_count(chain: Chain, recording: Recording, step: float) -> int:
    multiple = 2 * steps_per_half_interval(chain, recording, step)
    count = max(1, int(np.ceil(_duration(recording) / step - 1e-9)))
    return multiple * -(-count // multiple)


def simulate(
    arm: Chain | Arm,
    rig: Rig,
    recording: Recording,
    q: ArrayLike,
    v: ArrayLike,
    integrator: str = "exponential",
    step: float | None = None,
) -> Simulation:
    """Simulate one recording open loop from a given initial state.

    Args:
        arm: a chain, or one with effects.
        rig: says where the markers are.
        recording: gives the instants, torque, gravity and payload.
        q, v: (nv,) initial angles [rad] and rates [rad/s].
        integrator: `exponential` or `rk4`.
        step: [s]; None: the integrator's default.

    Raises:
        ChoiceError, InsufficientDataError, SimulationDivergedError: as `simulate_trajectories`.
    """
    arm = arm if isinstance(arm, Arm) else Arm(arm)
    trajectories = simulate_trajectories([arm], [recording], [np.asarray(q)], [np.asarray(v)], integrator, step)
    return sensor_readings(arm, MarkerArcs.of(rig), recording, trajectories[0])


def sensor_readings(arm: Arm, arcs: MarkerArcs, recording: Recording, trajectory: Trajectory) -> Simulation:
    """Return a trajectory at a recording's instants, with the readings of its sensors."""
    angles, rates = (values[:, 0] for values in trajectory.sample(recording.time))
    markers = arcs.frames(arm, trajectory, recording.time)
    return Simulation(recording.time, angles, rates, arm.encoder_angles(angles[:, arm.chain.active]), markers)
