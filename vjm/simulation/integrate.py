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
from vjm.simulation.exponential import exponential
from vjm.simulation.integrators import Drive, Steps, System, runge_kutta, sample
from vjm.simulation.measurement import Arcs, view

# Steps a period of the locked arm's slowest mode; measured on 1 m chains of 4 to 40 joints bent by an eighth of their
# length, or driven: the tip stays within 1e-6 m for 10 s. The error grows with the arm's length and the fourth power of
# the step; the top modes of larger chains, however fast, are in the part that is advanced exactly.
INTEGRATORS = {"exponential": exponential, "rk4": runge_kutta}

_STEPS_A_PERIOD = 60.0
_MORE_A_JOINT = 16.0
_MOST_STEPS_A_PERIOD = 220.0
# Where an active joint further out swings the arm's outer part about fast: a joint's worth, and at most.
_ELBOW_STEPS_A_JOINT = 880.0
_MOST_ELBOW_STEPS = 5200.0
REFERENCE_STEP = 1e-4  # s, section 6.4
_LEAST_STEPS = 20
_HALF_INTERVAL = 1 / 140  # periods of the slowest mode
_HALF_INTERVAL_ELBOW = 1 / 600  # where the arm changes its shape altogether
_ABOUT_EQUAL = 1.5  # durations within this factor are advanced together
_MOST_TOGETHER = 128  # coordinates; what Pinocchio keeps for a model grows with their third power, 10 GB for 432
_MOST_COARSE = 2.0  # times the step that effects ask for


def default_step(chain: Chain, payload: float = 0.0) -> float:
    """Step of the exponential integrator [s] that keeps the tip within 1e-6 m of the reference over 10 s."""
    slowest, _ = locked_frequencies(chain, payload)
    longer = sum(link.length for link in chain.links) ** -0.25
    most = max(link.virtual_joints for link in chain.links)
    steps = min(_STEPS_A_PERIOD + _MORE_A_JOINT * most, _MOST_STEPS_A_PERIOD)
    if (chain.active > 0).any():
        steps = min(_ELBOW_STEPS_A_JOINT * most, _MOST_ELBOW_STEPS)
    return float(longer / (steps * slowest))


def locked_frequencies(chain: Chain, payload: float = 0.0) -> tuple[float, float]:
    """Natural frequencies of the slowest and the fastest mode with the active joints locked [Hz]."""
    M, D, K, rest = linearise(chain, payload, (0.0, 0.0))
    p = chain.passive
    locked = modes_of(M[np.ix_(p, p)], D[np.ix_(p, p)], K[np.ix_(p, p)], rest[p]).frequencies
    return float(locked[0]), float(locked[-1])


def rollouts(
    arms: Sequence[Arm],
    recordings: Sequence[Recording],
    q: Sequence[Array],
    v: Sequence[Array],
    integrator: str = "exponential",
    step: float | None = None,
    step_multiple: float = 1.0,
    longest: float = np.inf,
) -> list[Steps]:
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
        numbers of steps are multiples of two `half_interval`s.

    Raises:
        ChoiceError: unknown integrator.
        InsufficientDataError: no torque measured at an active joint.
        SimulationDivergedError: a trajectory left the finite numbers.
    """
    if integrator not in INTEGRATORS:
        raise ChoiceError("integrator", integrator, INTEGRATORS)
    driven = [arm.inputs(recording) for arm, recording in zip(arms, recordings, strict=True)]
    found: list[Steps | None] = [None] * len(arms)
    for group in _alike(arms, driven):
        first, own = driven[group[0]], [arms[k] for k in group]
        h = min(_step_of(own[0].chain, first, integrator, step, step_multiple), longest, _allowed(own, step_multiple))
        counts = [_count(arms[k].chain, driven[k], h) for k in group]
        drive = Drive.of([driven[k] for k in group], h, max(counts))
        system = System.of(own, [driven[k].payload for k in group], first.gravity)
        angles, rates = (np.stack([np.asarray(each[k], dtype=float) for k in group]) for each in (q, v))
        states = np.stack([arm.rest(angle) for arm, angle in zip(own, angles, strict=True)])
        with np.errstate(over="ignore", invalid="ignore"):  # what diverges is noticed, and said
            steps = INTEGRATORS[integrator](system, angles, rates, states, drive)
        for c, (k, count) in enumerate(zip(group, counts, strict=True)):
            rows = slice(count + 1)
            time = driven[k].time[0] + steps.time[rows]
            found[k] = Steps(time, *(values[rows, c : c + 1] for values in (steps.q, steps.v, steps.a, steps.z)))
    return [each for each in found if each is not None]


def _alike(arms: Sequence[Arm], recordings: Sequence[Recording]) -> list[list[int]]:
    """Indices of runs that can be advanced together: as many unknowns, the same gravity, about equally long."""
    groups: list[list[int]] = []
    for k in np.argsort([_duration(recording) for recording in recordings], kind="stable").tolist():
        for group in groups:
            first = recordings[group[0]]
            short = _duration(recordings[k]) <= _ABOUT_EQUAL * _duration(first)
            same = recordings[k].gravity == first.gravity and _unknowns(arms[k]) == _unknowns(arms[group[0]])
            if short and same and (len(group) + 1) * arms[k].chain.size <= _MOST_TOGETHER:
                group.append(k)
                break
        else:
            groups.append([k])
    return groups


def _allowed(arms: Sequence[Arm], step_multiple: float) -> float:
    """Step that the effects allow [s]."""
    return min(arm.longest_step for arm in arms) * min(step_multiple, _MOST_COARSE)


def _unknowns(arm: Arm) -> tuple[int, int]:
    return arm.chain.size, sum(arm.states)


def _duration(recording: Recording) -> float:
    return float(recording.time[-1] - recording.time[0])


def _step_of(chain: Chain, recording: Recording, integrator: str, step: float | None, step_multiple: float) -> float:
    if step is None:
        step = step_multiple * default_step(chain, recording.payload) if integrator == "exponential" else REFERENCE_STEP
    if not 0 < step < np.inf:
        raise ShapeError("step", step, "a positive number of seconds")
    duration = _duration(recording)
    return min(step, duration / _LEAST_STEPS) if duration > 0 else step


def half_interval(chain: Chain, recording: Recording, step: float) -> int:
    """Number of steps [s] in half an interval over which derivatives of the motion are advanced at once."""
    slowest, _ = locked_frequencies(chain, recording.payload)
    periods = _HALF_INTERVAL_ELBOW if (chain.active > 0).any() else _HALF_INTERVAL
    return max(1, int(periods / (slowest * step) + 1e-9))


def _count(chain: Chain, recording: Recording, step: float) -> int:
    multiple = 2 * half_interval(chain, recording, step)
    count = max(1, int(np.ceil(_duration(recording) / step - 1e-9)))
    return multiple * -(-count // multiple)


def rollout(
    chains: Sequence[Chain],
    recording: Recording,
    q: ArrayLike,
    v: ArrayLike,
    integrator: str = "exponential",
    step: float | None = None,
) -> tuple[Array, Array]:
    """Angles of several copies of a chain over one recording, all driven by its torque.

    Args:
        chains: C chains with the same coordinates.
        recording: gives the instants, torque, gravity and payload.
        q, v: (C, nv) initial angles [rad] and rates [rad/s].
        integrator: `exponential` or `rk4`.
        step: [s]; None: the integrator's default.

    Returns:
        q, v (T, C, nv) at the recording's instants [rad, rad/s].

    Raises:
        ChoiceError, InsufficientDataError, SimulationDivergedError: as `rollouts`.
    """
    arms = [Arm(chain) for chain in chains]
    runs = rollouts(arms, [recording] * len(arms), [*np.atleast_2d(q)], [*np.atleast_2d(v)], integrator, step)
    angles, rates = zip(*(sample(run, recording.time) for run in runs), strict=True)
    return np.concatenate(angles, axis=1), np.concatenate(rates, axis=1)


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
        ChoiceError, InsufficientDataError, SimulationDivergedError: as `rollout`.
    """
    whole = arm if isinstance(arm, Arm) else Arm(arm)
    steps = rollouts([whole], [recording], [np.asarray(q)], [np.asarray(v)], integrator, step)[0]
    return simulation(whole, Arcs.of(rig), recording, steps)


def simulation(arm: Arm, arcs: Arcs, recording: Recording, steps: Steps) -> Simulation:
    """A trajectory at a recording's instants, as its sensors would show it."""
    angles, rates = (each[:, 0] for each in sample(steps, recording.time))
    markers = view(arm, arcs, steps, recording.time)
    theta = angles[:, arm.chain.active]
    for effect in arm.sensors:
        theta = effect.encoder_angles(theta)
    return Simulation(recording.time, angles, rates, theta, markers)
