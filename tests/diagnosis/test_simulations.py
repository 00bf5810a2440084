"""Simulations over whole recordings: what a model of segments is shown with, and each cause's absence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from tests.diagnosis.rigs import chain_of, point_of, recorded
from tests.report.diagnoses import pair
from vjm.diagnosis import simulations
from vjm.diagnosis.simulations import open_loop, simulate_without_each_cause
from vjm.effects import ViscousFriction
from vjm.errors import SimulationDivergedError
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.simulation.arm import Arm
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run


def test_recordings_that_an_open_loop_leaves_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Segments of a wrong model may be followed all the same."""
    point = point_of(chain_of(), (), recorded(Arm(chain_of()), 1))

    def diverging(arms: Sequence[Arm], observed: Sequence[Observations], *rest: object) -> list[tuple[Run, bool]]:
        if any(one.recording.file == "drive_1.csv" for one in observed):
            raise SimulationDivergedError(1.0, 0.005, "no remedy")
        return fit_initial_states(arms, observed, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(simulations, "fit_initial_states", diverging)
    in_parts = TrajectoryFit(replace(point, runs=(*point.runs, *point.runs)))
    found = open_loop(in_parts, point.problem.observed).point
    assert [run.observed.recording.file for run in found.runs] == ["drive_0.csv"]
    assert len(found.problem.observed) == 1


def test_a_fit_that_was_given_up_is_shown_from_its_most_likely_states() -> None:
    """One that follows its recordings is shown as it is."""
    point = point_of(chain_of(), (), recorded(Arm(chain_of()), 1))
    fit, whole = TrajectoryFit(point), point.problem.observed
    assert open_loop(fit, whole) is fit
    drifting = np.eye(2 * point.chain.size)[point.chain.size]  # rad/s of the hub
    lost = TrajectoryFit(point.problem.point(point.x, [state + drifting for state in point.states]))
    assert lost.misfit > 100
    shown = open_loop(lost, whole)
    assert shown.misfit == pytest.approx(1.0, abs=0.05)
    assert np.array_equal(shown.point.x, point.x)


def test_what_was_present_before_a_change_stays_when_a_cause_is_left_out() -> None:
    diagnosis = pair()
    causes = [cause.effect for cause in diagnosis.causes]
    friction = ViscousFriction(link=0, coefficient=0.05)
    model = replace(diagnosis.model, effects=(friction, *causes), reference_effects=1)
    first = diagnosis.most_improved
    assert first is not None
    without = simulate_without_each_cause(replace(diagnosis, model=model)).causes[0].without
    assert without is not None
    assert first.simulated is not None
    near = first.simulated.simulation
    expected = replace(model, effects=(friction, causes[1])).replay(first.recording, near)
    np.testing.assert_allclose(without.simulation.markers, expected.simulation.markers, rtol=0, atol=1e-12)
    frictionless = replace(model, effects=(causes[1],), reference_effects=0).replay(first.recording, near)
    assert np.abs(without.simulation.markers - frictionless.simulation.markers).max() > 1e-4


def test_a_single_cause_leaves_the_model_fitted_without_it() -> None:
    diagnosis = pair()
    first = diagnosis.most_improved
    assert first is not None
    (cause,) = simulate_without_each_cause(replace(diagnosis, causes=diagnosis.causes[:1])).causes
    assert cause.without is first.reference
