"""Simulations over whole recordings: what a model of segments is shown with, and each cause's absence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from tests.diagnosis.rigs import NOISE, RIG, chain_of, last_seconds, point_of, recorded
from tests.report.diagnoses import pair
from vjm.diagnosis import simulations
from vjm.diagnosis.records import Cause
from vjm.diagnosis.simulations import open_loop, simulate_without_each_cause, with_holdout_gains
from vjm.effects import Backlash, BaseCompliance, Effect, GearElasticity, ViscousFriction
from vjm.errors import SimulationDivergedError
from vjm.identification.trajectory_fit import Point, TrajectoryFit
from vjm.records import RecordingComparison
from vjm.simulation.arm import Arm
from vjm.simulation.initial_state import best_of_starts, fit_initial_states
from vjm.simulation.measurement import Observations
from vjm.simulation.model import Model
from vjm.simulation.run import Run


def lost_fit() -> TrajectoryFit:
    """The right chain, whose hub begins a radian a second too fast."""
    point = point_of(chain_of(), (), recorded(Arm(chain_of()), 1))
    drifting = np.eye(2 * point.chain.size)[point.chain.size]
    return TrajectoryFit(point.problem.point(point.x, [state + drifting for state in point.states]))


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


def test_a_recording_that_a_search_cannot_follow_is_shown_as_it_was_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = lost_fit()

    def diverging(*arguments: object) -> list[tuple[Run, bool]]:
        raise SimulationDivergedError(1.0, 0.005, "no remedy")

    monkeypatch.setattr(simulations, "fit_initial_states", diverging)
    assert open_loop(fit, fit.point.problem.observed).chi2 == fit.chi2


def test_a_fit_that_was_given_up_is_shown_from_its_most_likely_states() -> None:
    """One that follows its recordings is shown as it is."""
    fit = TrajectoryFit(point_of(chain_of(), (), recorded(Arm(chain_of()), 1)))
    assert open_loop(fit, fit.point.problem.observed) is fit
    lost = lost_fit()
    assert lost.misfit > 100
    shown = open_loop(lost, lost.point.problem.observed)
    assert shown.misfit == pytest.approx(1.0, abs=0.05)
    assert np.array_equal(shown.point.x, lost.point.x)


def test_after_the_deadline_a_state_is_the_one_that_its_search_began_with() -> None:
    """And is not said to have converged."""
    point = lost_fit().point
    arms, observed = [run.arm for run in point.runs], point.problem.observed
    stopped = fit_initial_states(arms, observed, point.states, deadline=-np.inf)
    assert all(np.array_equal(run.state, state) for (run, _), state in zip(stopped, point.states, strict=True))
    assert not any(converged for _, converged in stopped)
    assert all(converged for _, converged in fit_initial_states(arms, observed, point.states))


@pytest.mark.slow
@pytest.mark.parametrize("deadline", [-np.inf, np.inf])
def test_a_held_out_recording_with_play_begins_as_it_did_though_the_deadline_has_passed(deadline: float) -> None:
    """On either flank, in the middle of a motion, of which its first periods tell."""
    play = Backlash(link=0, gap=0.01)
    later = last_seconds(recorded(Arm.of(chain_of(), (play,)), 1, duration=3.0)[1], 1.5)
    point = point_of(chain_of(), (), [later])
    problem = replace(point.problem, effects=(play,))
    model = TrajectoryFit(Point(problem, np.r_[point.x, play.coordinates], ()))
    ((run, _),) = simulations._simulate(model, problem.observed, deadline=deadline)
    assert run.chi2 / run.expected_chi2 == pytest.approx(1.0, abs=0.1)


def test_a_start_that_cannot_be_simulated_costs_no_recording() -> None:
    runs = lost_fit().point.runs
    assert [*best_of_starts(runs, [(0, np.full(runs[0].state.size, 1e9))], 1.0)] == [*runs]
    found = best_of_starts(runs, [(1, runs[1].prior.rest)], 1.0)
    assert found[0] is runs[0]
    assert found[1].chi2 < runs[1].chi2


def test_without_friction_or_play_a_held_out_recording_begins_where_it_did_whatever_the_time() -> None:
    point = lost_fit().point
    found = simulations._simulate(TrajectoryFit(point), point.problem.observed, deadline=-np.inf)
    assert all(run.chi2 / run.expected_chi2 == pytest.approx(1.0, abs=0.1) for run, _ in found)


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
    near = first.simulated.simulation.initial_state
    expected = replace(model, effects=(friction, causes[1])).replay(first.recording, near)
    np.testing.assert_allclose(without.simulation.markers, expected.simulation.markers, rtol=0, atol=1e-12)
    frictionless = replace(model, effects=(causes[1],), reference_effects=0).replay(first.recording, near)
    assert np.abs(without.simulation.markers - frictionless.simulation.markers).max() > 1e-4


@pytest.mark.parametrize(
    "jointed",
    [GearElasticity(link=0, stiffness=30.0, motor_share=0.5, damping=0.05), BaseCompliance(stiffness=500.0, mass=1.0)],
    ids=["gear", "table"],
)
def test_a_cause_with_a_joint_of_its_own_may_be_left_out(jointed: Effect) -> None:
    """The model without it has fewer joints, and fewer initial states."""
    friction = ViscousFriction(link=0, coefficient=0.01)
    recordings = recorded(Arm.of(chain_of(), (friction, jointed)), 1)
    point = point_of(chain_of(), (), recordings)

    def fit_of(*effects: Effect) -> TrajectoryFit:
        problem = replace(point.problem, effects=effects)
        return TrajectoryFit(problem.point(np.concatenate([point.x, *(effect.coordinates for effect in effects)])))

    best, alone = fit_of(friction, jointed), {effect.key: fit_of(effect) for effect in (friction, jointed)}
    causes = [Cause(effect, {}, 0.0, 1.0, (), "") for effect in best.effects]
    shown = [run.simulated_recording(True) for run in best.point.runs]
    compared = [RecordingComparison(replace(run.recording, role="holdout"), NOISE, run, run) for run in shown]
    gained = with_holdout_gains(RIG, causes, compared, best, {fit.effect_keys: fit for fit in alone.values()})
    gains = [cause.holdout_gain for cause in gained]
    assert all(gain is not None and gain > 0 for gain in gains)
    model = Model(chain_of(), RIG, *NOISE, (), best.effects)
    diagnosis = replace(pair(), causes=tuple(causes), recordings=tuple(compared), model=model)
    without = [cause.without for cause in simulate_without_each_cause(diagnosis).causes]
    assert all(run is not None and run.marker_rms > 1.1 * NOISE[0] for run in without)


def test_a_single_cause_leaves_the_model_fitted_without_it() -> None:
    diagnosis = pair()
    first = diagnosis.most_improved
    assert first is not None
    (cause,) = simulate_without_each_cause(replace(diagnosis, causes=diagnosis.causes[:1])).causes
    assert cause.without is first.reference
