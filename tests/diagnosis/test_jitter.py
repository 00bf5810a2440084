"""Frames taken at random instants: what a screen promises of their variance, and what a fit finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.diagnosis.rigs import NOISE, RIG, chain_of, point_of, recorded
from vjm.diagnosis.candidate_fit import StoppingRule, information_of, refit
from vjm.diagnosis.cross_validation import _prediction_errors
from vjm.diagnosis.screen import Screen
from vjm.effects import TimestampJitter
from vjm.identification.trajectory_fit import Point, TrajectoryFit, fit_trajectory
from vjm.simulation.arm import Arm

JITTER = 0.004


def point(jitter: float, correlation: float = 0.0) -> Point:
    """Return a right model beside recordings whose frames were taken at random instants."""
    right = point_of(chain_of(), (), recorded(Arm(chain_of()), 1, correlation=correlation))
    random, taken = np.random.default_rng(3), []
    for run in right.runs:
        observed, time = run.observed, run.observed.recording.time[run.observed.frames]
        late = np.clip(time + jitter * random.normal(size=time.size), time[0], time[-1])
        shown, expected = (observed.arcs.positions_in_frames(run.arm, run.trajectory, each) for each in (late, time))
        markers = observed.recording.markers.copy()
        markers[observed.frames] += shown - expected
        taken.append(replace(observed.recording, markers=markers))
    return point_of(chain_of(), (), taken, correlation=correlation)


def fitted(jitter: float, correlation: float = 0.0) -> tuple[TrajectoryFit, Screen]:
    """The model without the effect, and the screen beside it."""
    start = point(jitter, correlation)
    fit = fit_trajectory(start.problem, start.x, None, start.states)
    return fit, Screen.of(fit.point, (), TimestampJitter().variants(RIG, []))


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_jitter_is_found_with_its_standard_error(correlation: float) -> None:
    before, screen = fitted(JITTER, correlation)
    assert before.misfit > 1.2
    after = refit(before, (screen.effects[0].at(screen.best_sizes([0])),), StoppingRule())
    assert after is not None
    (found,) = after.effects
    std = float(np.sqrt(information_of(after).covariance[-1, -1]))
    assert std < 0.15 * after.point.x[-1]
    truth = replace(found, jitter=JITTER).coordinates
    assert abs(after.point.x[-1:] - truth) < 3 * std
    assert after.misfit == pytest.approx(1.0, abs=0.03)  # what is left is noise, made white
    assert np.std(after.point.runs[1].residual) == pytest.approx(1.0, abs=0.04)
    # With few parameters a recording is predicted nearly as well from the other one as it is fitted.
    predicted = _prediction_errors(after)
    judged = np.flatnonzero(np.isfinite(predicted))
    assert judged.size
    assert predicted[judged] == pytest.approx([after.point.runs[k].chi2 for k in judged], rel=0.05)
    if not correlation:
        assert screen.statistics[0] == pytest.approx(before.chi2 - after.chi2, rel=0.05)


def test_without_jitter_nothing_is_promised() -> None:
    _, screen = fitted(0.0)
    assert screen.one_sided.all()
    assert screen.statistics[0] < 6.6  # exceeded once in 200
    smallest = TimestampJitter().placed(RIG, None).at(screen.std(0) * 3).jitter
    assert 0.0 < smallest < JITTER / 2


def test_larger_noise_is_not_taken_for_jitter() -> None:
    recordings = recorded(Arm(chain_of()), 1, noise=(1.3 * NOISE[0], NOISE[1]))
    start = point_of(chain_of(), (), recordings)
    fit = fit_trajectory(start.problem, start.x, None, start.states)
    assert fit.misfit > 1.2
    assert Screen.of(fit.point, (), TimestampJitter().variants(RIG, [])).statistics[0] < 6.6
