"""Recordings of chains themselves, with or without effects: what is true of them is known exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from tests.simulation.integrators import simulate
from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.diagnosis.candidate_fit import StoppingRule
from vjm.diagnosis.noise import Noise
from vjm.diagnosis.segments import fit_segments
from vjm.effects import Effect
from vjm.identification.parameters import Parametrisation
from vjm.identification.trajectory_fit import Point, TrajectoryFit, TrajectoryProblem
from vjm.records import Link, Recording, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.measurement import Observations
from vjm.simulation.run import InitialStatePrior, simulate_runs

NOISE = (3e-4, 1e-4)
LINK = Link("beam", "revolute", 1.0, 0.44, 1.97, (0.2, 0.4, 0.6, 0.8, 1.0), hub_inertia=0.02)
RIG = Rig("rig", (LINK,), marker_noise=NOISE[0], encoder_noise=NOISE[1])


def first_seconds(recording: Recording, duration: float) -> Recording:
    """A recording's beginning, of a duration in s."""
    return _only(recording, recording.time <= recording.time[0] + duration)


def last_seconds(recording: Recording, duration: float) -> Recording:
    """A recording's end, of a duration in s."""
    return _only(recording, recording.time >= recording.time[-1] - duration)


def _only(recording: Recording, rows: NDArray[np.bool_]) -> Recording:
    return replace(recording, **{name: getattr(recording, name)[rows] for name in ("time", "markers", "theta", "tau")})


def chain_of(joints: int = 3) -> Chain:
    return Chain("rig", (uniform_chain(LINK, layout(1.0, joints), kelvin_voigt=5e-4),))


def recorded(
    arm: Arm,
    seed: int,
    condition: str | None = None,
    duration: float = 2.0,
    noise: tuple[float, float] = NOISE,
    correlation: float = 0.0,
    factor: float = 1.0,
) -> list[Recording]:
    """Two drives of different size, as a camera at 100 Hz and an encoder at 200 Hz see them.

    Args:
        arm: what moves.
        seed: of the noise.
        condition: of the recordings.
        duration: of each [s].
        noise: 1-sigma of a marker coordinate [m] and of an angle [rad].
        correlation: of a marker's noise from frame to frame.
        factor: times the usual size of the drives.
    """
    time = np.arange(round(200 * duration) + 1) / 200
    found = []
    for k, size in enumerate((0.05 * factor, 0.12 * factor)):
        torque = size * np.sin(2 * np.pi * (0.9 + 0.3 * k) * time) + 0.4 * size * np.sin(2 * np.pi * 3.1 * time + k)
        empty = np.full((time.size, 5, 2), np.nan)
        blank = Recording(
            time, empty, torque[:, None], torque[:, None], kind="driven", role="train", file=f"drive_{k}.csv"
        )
        rest = np.zeros(arm.chain.size)
        motion = simulate(arm, RIG, blank, rest, rest)
        random = np.random.default_rng([seed, k])
        markers = np.full(motion.markers.shape, np.nan)
        white = random.standard_normal(motion.markers[::2].shape)
        white[0] /= np.sqrt(1 - correlation**2)
        colour = np.sqrt(1 - correlation**2) * lfilter([1.0], [1.0, -correlation], white, axis=0)
        markers[::2] = motion.markers[::2] + noise[0] * colour
        theta = motion.theta + noise[1] * random.standard_normal(motion.theta.shape)
        found.append(replace(blank, theta=theta, markers=markers, condition=condition))
    return found


def point_of(
    chain: Chain,
    effects: Sequence[Effect],
    recordings: Sequence[Recording],
    noise: tuple[float, float] = NOISE,
    correlation: float = 0.0,
) -> Point:
    """An arm at rest at the start of recordings, beside them."""
    parametrisation = Parametrisation(chain, "uniform", (0,))
    colour = Noise(noise[0], np.array([correlation] if correlation else []), "")
    observed = tuple(colour.whitened(Observations.of(RIG, each, noise)) for each in recordings)
    problem = TrajectoryProblem(parametrisation, observed)
    arm = Arm.of(chain, effects)
    starts = [InitialStatePrior.of(arm, each) for each in recordings]
    rest = np.zeros(2 * arm.chain.size)
    runs = simulate_runs([arm] * len(starts), observed, starts, [rest] * len(starts), 1.0)
    return Point(problem, parametrisation.start, tuple(runs))


def in_segments(recordings: list[Recording]) -> TrajectoryFit:
    """The chain without effects, fitted to segments of one and a half periods."""
    point = point_of(chain_of(), (), recordings)
    start = TrajectoryFit(point)
    return fit_segments(start, point.problem.observed, point.problem.first_horizon(point.x) / 2, StoppingRule())
