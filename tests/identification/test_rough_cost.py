"""When the search ends where the cost does not fall as its slopes promise."""

from __future__ import annotations

import numpy as np
import pytest

from tests.diagnosis.rigs import chain_of, point_of, recorded
from vjm.identification import trajectory_fit
from vjm.identification.trajectory_fit import Point, _Step, fit_trajectory
from vjm.simulation.arm import Arm


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(("rise", "given_up"), [(0.1, True), (10.0, False)])
def test_a_step_that_promises_little_and_keeps_nothing_ends_the_search(
    monkeypatch: pytest.MonkeyPatch, seed: int, rise: float, given_up: bool
) -> None:
    """What promises much is tried in ever smaller steps instead."""
    point = point_of(chain_of(), (), recorded(Arm(chain_of()), seed))
    best = fit_trajectory(point.problem, point.x, None, [run.state for run in point.runs]).point
    R = best.gathered()[0].R[:-1, :-1]
    direction = np.linalg.solve(R, np.eye(len(R))[0])  # raises the cost by one, with the best initial states
    x = best.x + np.sqrt(rise) * direction
    seen: list[float] = []

    def rough(at: Point, step: _Step) -> Point:
        seen.append(step.predicted)
        return at

    monkeypatch.setattr(trajectory_fit, "_attempt", rough)
    fit = fit_trajectory(best.problem, x, None, [run.state for run in best.runs])
    assert rise < seen[0] < 3 * rise  # of the states that were best before, more is promised
    assert (len(seen) == 1) == given_up
    assert fit.converged
