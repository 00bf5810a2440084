"""Explanations whose simulations are held near the angles that encoders measured, and those set free again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vjm.chain.virtual_links import Chain
from vjm.diagnosis.candidate_fit import Explanation, refit
from vjm.diagnosis.fit_cache import Patience
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.trajectory_fit import Point, TrajectoryFit, TrajectoryProblem
from vjm.simulation.encoder_feedback import Guide
from vjm.simulation.initial_state import most_likely
from vjm.simulation.integrate import locked_frequencies
from vjm.simulation.measurement import Observed
from vjm.simulation.run import Run

Array = NDArray[np.float64]

# Times the slowest vibration, and the damping ratio. Measured on dry friction: held more softly (0.6), fits still lose
# their way; more tightly (1.5), the torque is known half as well.
_FREQUENCY = 1.0
_RATIO = 0.2
_FEW = 6  # simulations to improve an initial state by, open loop


def can_be_held(explanation: Explanation) -> bool:
    """Whether encoders measured anything of a joint that moves."""
    recordings = [run.observed.recording for run in explanation.point.runs]
    return bool(explanation.point.chain.active.size) and any(np.isfinite(each.theta).any() for each in recordings)


def held(explanation: Explanation) -> Explanation | None:
    """The same effects, fitted with simulations held; None where that cannot be simulated.

    A fit of recordings that it could not follow may have ended anywhere: the nominal chain is a start as well.
    """
    point, (problem, nominal), best = explanation.point, _held_problem(explanation), None
    runs = tuple(replace(run, observed=each) for run, each in zip(point.runs, problem.observed, strict=True))
    for x in (nominal, point.x):
        start = replace(explanation.fit, point=replace(point, problem=problem, x=x, runs=runs))
        patience = Patience(np.inf, np.inf if best is None else best.chi2)
        found = refit(replace(explanation, fit=start), explanation.effects, patience)
        if found is not None and (best is None or found.chi2 < best.chi2):
            best = found
    return best


def held_at_nominal(explanation: Explanation) -> Explanation | None:
    """The same with nothing fitted but initial states, at the nominal chain; None where that cannot be simulated."""
    problem, x = _held_problem(explanation)
    try:
        found = most_likely(problem.arms(x), problem.observed, coarse=problem.coarse)
    except (InsufficientDataError, SimulationDivergedError):
        return None
    return Explanation(TrajectoryFit(Point(problem, x, tuple(run for run, _ in found)), False, 0))


def released(explanation: Explanation, free: Explanation) -> Explanation | None:
    """The effects of an explanation that was held, fitted open loop to the same recordings as a free one."""
    observed = free.point.problem.observed
    point = explanation.point
    runs = tuple(replace(run, observed=each) for run, each in zip(point.runs, observed, strict=True))
    problem = replace(point.problem, observed=observed)
    start = replace(explanation.fit, point=replace(point, problem=problem, runs=runs))
    return refit(Explanation(start), explanation.effects, Patience(np.inf))


def freed(explanation: Explanation, free: Explanation) -> Explanation:
    """The same parameters, simulated open loop from initial states that are as likely as can be found.

    Args:
        explanation: held, or not.
        free: of the same recordings, not held.
    """
    if not explanation.is_held:
        return explanation
    point, observed = explanation.point, free.point.problem.observed
    arms = [run.arm.guided(None) for run in point.runs]
    found = most_likely(arms, observed, [run.state for run in point.runs], point.problem.coarse, _FEW)
    problem = replace(point.problem, observed=observed)
    again = replace(point, problem=problem, runs=tuple(run for run, _ in found))
    return replace(explanation, fit=replace(explanation.fit, point=again))


def replayed(
    explanation: Explanation, observed: Sequence[Observed], states: Sequence[Array | None] | None = None
) -> list[tuple[Run, bool]]:
    """Recordings that were not fitted, open loop, and whether their initial states were found.

    Where fits were held, initial states are looked for with simulations held, and improved open loop.

    Args:
        explanation: held, or not.
        observed: the recordings.
        states: (2 nv,) found before for the same recordings; None: not yet.

    Raises:
        InsufficientDataError, SimulationDivergedError: as `most_likely`.
    """
    point = explanation.point
    arms, coarse = point.problem.varied.arms(point.x, [each.recording for each in observed]), point.problem.coarse
    if not explanation.is_held:
        return most_likely(arms, observed, states, coarse)
    known = [True] * len(observed)
    if states is None:
        begun = most_likely(arms, [_guided(each, _nominal(explanation)) for each in observed], coarse=coarse)
        states, known = [run.state for run, _ in begun], [found for _, found in begun]
    return [
        (run, found) for (run, _), found in zip(most_likely(arms, observed, states, coarse, _FEW), known, strict=True)
    ]


def _held_problem(explanation: Explanation) -> tuple[TrajectoryProblem, Array]:
    """The same recordings, held, and the coordinates (p,) with the nominal chain's."""
    point, chain = explanation.point, _nominal(explanation)
    start = point.problem.parametrisation.start
    observed = tuple(_guided(run.observed, chain) for run in point.runs)
    return replace(point.problem, observed=observed), np.concatenate([start, point.x[start.size :]])


def _guided(observed: Observed, chain: Chain) -> Observed:
    """The same recording, whose simulations are held; a quiet one as it is, since nothing drifts in it."""
    if observed.recording.kind == "quiet":
        return observed
    frequency = _FREQUENCY * locked_frequencies(chain)[0]
    return observed.held(Guide.of(observed.recording, chain, observed.noise[1], frequency, _RATIO))


def _nominal(explanation: Explanation) -> Chain:
    parametrisation = explanation.point.problem.parametrisation
    return parametrisation.chain(parametrisation.start)
