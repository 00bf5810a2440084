"""Open-loop simulation of a recording: its torque in, angles and markers out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vjm.chain.curve import marker_positions
from vjm.chain.records import Chain
from vjm.errors import ChoiceError, InsufficientDataError, ShapeError
from vjm.experiment.records import Recording, Rig
from vjm.modes import linearise, modes_of
from vjm.simulate.integrators import INTEGRATORS, System, sample

Array = NDArray[np.float64]

# The remainder that the exponential integrator's steps resolve follows the slowest and the fastest mode of the locked
# arm; measured on 1 m chains of 4 to 10 joints bent by an eighth of their length: the tip stays within 1e-6 m for 10 s.
# The error grows with the arm's length and the fourth power of the step.
_STEPS_A_PERIOD = 140.0
_TOP_MODE_STEP = 0.8  # periods of the fastest mode
_ELBOW_STEP = 0.015  # the same where an active joint further out bends the arm and so changes its mass matrix
REFERENCE_STEP = 1e-4  # s, section 6.4
_LEAST_STEPS = 20


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


def default_step(chain: Chain, payload: float = 0.0) -> float:
    """Step of the exponential integrator [s] that keeps the tip within 1e-6 m of the reference over 10 s."""
    M, D, K, rest = linearise(chain, payload, (0.0, 0.0))
    p = chain.passive
    locked = modes_of(M[np.ix_(p, p)], D[np.ix_(p, p)], K[np.ix_(p, p)], rest[p]).frequencies
    longer = sum(link.length for link in chain.links) ** -0.25
    top = _TOP_MODE_STEP if (chain.active == 0).all() else _ELBOW_STEP
    return float(longer * min(1 / (_STEPS_A_PERIOD * locked[0]), top / locked[-1]))


def measured_torque(chain: Chain, recording: Recording) -> tuple[Array, Array]:
    """Instants (T',) [s] and torques (T', n_a) [N m] at which all the active joints' torques were measured.

    Raises:
        InsufficientDataError: an active joint without measured torque: what drives it is unknown.
    """
    if chain.active.size == 0:
        return recording.time[:1], np.zeros((1, 0))
    known = np.isfinite(recording.tau).all(axis=1)
    if known.sum() < 2:
        raise InsufficientDataError(
            f"simulation of {recording.file}",
            "no torque was measured at its active joints",
            "record the column LINK.tau",
        )
    return recording.time[known], recording.tau[known]


def _grid(chain: Chain, recording: Recording, wanted: float) -> tuple[Array, float]:
    """Joint torques (2 S + 1, nv) at the ends and middles of the steps, and the step [s]."""
    knots, torque = measured_torque(chain, recording)
    duration = float(recording.time[-1] - recording.time[0])
    step = min(wanted, duration / _LEAST_STEPS) if duration > 0 else wanted
    if knots.size > 1:
        # A torque that is linear between knots has kinks there: whole steps begin at them, and none passes over one.
        spacing = float(np.median(np.diff(knots)))
        step = spacing / np.ceil(spacing / step)
    count = max(1, int(np.ceil(duration / step - 1e-9)))
    instants = recording.time[0] + step / 2 * np.arange(2 * count + 1)
    spread = np.zeros((instants.size, chain.size))
    for column, at in enumerate(chain.active):
        spread[:, at] = np.interp(instants, knots, torque[:, column])
    return spread, step


def rollout(
    chains: Sequence[Chain],
    recording: Recording,
    q: ArrayLike,
    v: ArrayLike,
    integrator: str = "exponential",
    step: float | None = None,
) -> tuple[Array, Array]:
    """Angles of several copies of a chain over a recording, all driven by its torque.

    Args:
        chains: C chains with the same coordinates.
        recording: gives the instants, torque, gravity and payload.
        q, v: (C, nv) initial angles [rad] and rates [rad/s].
        integrator: `exponential` or `rk4`.
        step: [s]; None: `default_step` or, for `rk4`, 100 us.

    Returns:
        q, v (T, C, nv) at the recording's instants [rad, rad/s].

    Raises:
        ChoiceError: unknown integrator.
        InsufficientDataError: no torque measured at an active joint.
        SimulationDivergedError: the trajectory left the finite numbers.
    """
    if integrator not in INTEGRATORS:
        raise ChoiceError("integrator", integrator, INTEGRATORS)
    if step is None:
        step = default_step(chains[0], recording.payload) if integrator == "exponential" else REFERENCE_STEP
    if not 0 < step < np.inf:
        raise ShapeError("step", step, "a positive number of seconds")
    angles, rates = np.asarray(q, dtype=float), np.asarray(v, dtype=float)
    torque, step = _grid(chains[0], recording, step)
    system = System.of(chains, recording.payload, recording.gravity)
    steps = INTEGRATORS[integrator](system, angles, rates, torque, float(recording.time[0]), step)
    return sample(steps, recording.time)


def marker_arcs(rig: Rig) -> tuple[tuple[Array, ...], tuple[bool, ...]]:
    """For each link, its markers' arc lengths [m] and whether they are given in the link frame."""
    return (
        tuple(np.array(link.markers) for link in rig.links),
        tuple(link.markers_frame == "link" for link in rig.links),
    )


def simulate(
    chain: Chain,
    rig: Rig,
    recording: Recording,
    q: ArrayLike,
    v: ArrayLike,
    integrator: str = "exponential",
    step: float | None = None,
) -> Simulation:
    """Simulate one recording open loop from a given initial state.

    Args:
        chain: the arm.
        rig: says where the markers are.
        recording: gives the instants, torque, gravity and payload.
        q, v: (nv,) initial angles [rad] and rates [rad/s].
        integrator: `exponential` or `rk4`.
        step: [s]; None: the integrator's default.

    Raises:
        ChoiceError, InsufficientDataError, SimulationDivergedError: as `rollout`.
    """
    angles, rates = rollout([chain], recording, np.atleast_2d(q), np.atleast_2d(v), integrator, step)
    path = angles[:, 0]
    return Simulation(
        recording.time, path, rates[:, 0], path[:, chain.active], marker_positions(chain, path, *marker_arcs(rig))
    )
