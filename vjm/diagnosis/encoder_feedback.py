"""Fits with encoder feedback: a weak spring and damper hold the simulated joints near the angles that were measured.

A joint that sticks a moment too early is off for good, so that open-loop fits of stick-slip are lost among local
minima. With feedback they are not (an observer in the prediction-error method: Ljung, System Identification, 1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vjm.chain.virtual_links import Chain
from vjm.diagnosis.candidate_fit import CandidateFit, refit
from vjm.diagnosis.fit_cache import StoppingRule
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.trajectory_fit import TrajectoryProblem
from vjm.records import Array
from vjm.simulation.arm import EncoderFeedback
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.integrate import locked_joint_frequencies
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run

# Times the slowest vibration, and the damping ratio. Measured on dry friction: with softer feedback (0.6), fits still
# lose their way; with stiffer (1.5), the torque is known half as well.
_FREQUENCY = 1.0
_RATIO = 0.2
_FEW = 6  # simulations to improve an initial state by, open loop


def feedback_possible(candidate_fit: CandidateFit) -> bool:
    """Return True if encoders measured anything of a joint that moves."""
    recordings = [run.observed.recording for run in candidate_fit.point.runs]
    return bool(candidate_fit.point.chain.active.size) and any(np.isfinite(each.theta).any() for each in recordings)


def fit_with_feedback(candidate_fit: CandidateFit) -> CandidateFit | None:
    """Fit the same effects with encoder feedback; None where that cannot be simulated.

    A fit of recordings that it could not follow may have ended anywhere: the nominal chain is a start as well.
    """
    point, (problem, nominal), best = candidate_fit.point, _held_problem(candidate_fit), None
    runs = tuple(replace(run, observed=each) for run, each in zip(point.runs, problem.observed, strict=True))
    for x in (nominal, point.x):
        start = replace(candidate_fit.fit, point=replace(point, problem=problem, x=x, runs=runs))
        patience = StoppingRule(np.inf, np.inf if best is None else best.chi2)
        found = refit(replace(candidate_fit, fit=start), candidate_fit.effects, patience)
        if found is not None and (best is None or found.chi2 < best.chi2):
            best = found
    return best


def nominal_with_feedback(candidate_fit: CandidateFit) -> CandidateFit | None:
    """Simulate the nominal chain with encoder feedback, fitting initial states only; None where that fails."""
    problem, x = _held_problem(candidate_fit)
    try:
        found = fit_initial_states(problem.arms(x), problem.observed, step_multiple=problem.step_multiple)
    except (InsufficientDataError, SimulationDivergedError):
        return None
    return CandidateFit.unfitted(problem, x, [run for run, _ in found])


def fit_open_loop(candidate_fit: CandidateFit, free: CandidateFit) -> CandidateFit | None:
    """Fit the effects that were found with feedback open loop, to the same recordings as an open-loop fit."""
    observed = free.point.problem.observed
    point = candidate_fit.point
    runs = tuple(replace(run, observed=each) for run, each in zip(point.runs, observed, strict=True))
    problem = replace(point.problem, observed=observed)
    start = replace(candidate_fit.fit, point=replace(point, problem=problem, runs=runs))
    return refit(CandidateFit(start), candidate_fit.effects, StoppingRule(np.inf))


def without_feedback(candidate_fit: CandidateFit, free: CandidateFit) -> CandidateFit:
    """Simulate the same parameters open loop, from initial states that are as likely as can be found.

    Args:
        candidate_fit: with feedback, or without.
        free: of the same recordings, open loop.
    """
    if not candidate_fit.uses_feedback:
        return candidate_fit
    point, observed = candidate_fit.point, free.point.problem.observed
    arms = [run.arm.with_feedback(None) for run in point.runs]
    found = fit_initial_states(arms, observed, [run.state for run in point.runs], point.problem.step_multiple, _FEW)
    problem = replace(point.problem, observed=observed)
    again = replace(point, problem=problem, runs=tuple(run for run, _ in found))
    return replace(candidate_fit, fit=replace(candidate_fit.fit, point=again))


def simulate_open_loop(
    candidate_fit: CandidateFit, observed: Sequence[Observations], states: Sequence[Array | None] | None = None
) -> list[tuple[Run, bool]]:
    """Simulate recordings that were not fitted open loop; also return whether their initial states were found.

    Initial states of fits with feedback are looked for with feedback, and improved open loop.

    Args:
        candidate_fit: with feedback, or without.
        observed: the recordings.
        states: (2 nv,) found before for the same recordings; None: not yet.

    Raises:
        InsufficientDataError, SimulationDivergedError: as `fit_initial_states`.
    """
    point = candidate_fit.point
    arms, step_multiple = (
        point.problem.varied.arms(point.x, [each.recording for each in observed]),
        point.problem.step_multiple,
    )
    if not candidate_fit.uses_feedback:
        return fit_initial_states(arms, observed, states, step_multiple)
    known = [True] * len(observed)
    if states is None:
        initial_fits = fit_initial_states(
            arms, [_guided(each, _nominal(candidate_fit)) for each in observed], step_multiple=step_multiple
        )
        states, known = [run.state for run, _ in initial_fits], [found for _, found in initial_fits]
    return [
        (run, found)
        for (run, _), found in zip(fit_initial_states(arms, observed, states, step_multiple, _FEW), known, strict=True)
    ]


def _held_problem(candidate_fit: CandidateFit) -> tuple[TrajectoryProblem, Array]:
    """Recordings with feedback, and the coordinates (p,) with the nominal chain's."""
    point, chain = candidate_fit.point, _nominal(candidate_fit)
    start = point.problem.parametrisation.start
    observed = tuple(_guided(run.observed, chain) for run in point.runs)
    return replace(point.problem, observed=observed), np.concatenate([start, point.x[start.size :]])


def _guided(observed: Observations, chain: Chain) -> Observations:
    """Recording with feedback; a quiet one as it is, since nothing drifts in it."""
    if observed.recording.kind == "quiet":
        return observed
    frequency = _FREQUENCY * locked_joint_frequencies(chain)[0]
    return observed.with_feedback(EncoderFeedback.of(observed.recording, chain, observed.noise[1], frequency, _RATIO))


def _nominal(candidate_fit: CandidateFit) -> Chain:
    parametrisation = candidate_fit.point.problem.parametrisation
    return parametrisation.chain(parametrisation.start)
