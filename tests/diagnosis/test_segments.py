"""Fits to segments of recordings, each with an initial state of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vjm
from tests.diagnosis.rigs import RIG, chain_of, first_seconds, point_of, recorded
from tests.diagnosis.rigs import in_segments as fitted_in_segments
from vjm.diagnosis.candidate_fit import SearchOptions, StoppingRule, refit
from vjm.diagnosis.segments import (
    draw_segments,
    fit_all,
    fit_segments,
    fit_some,
    largest_chi2_in_all,
    segments,
    simulate_segments,
)
from vjm.diagnosis.selection import Search
from vjm.effects import ClampCompliance, CubicStiffness, TipPayload, ViscoelasticCreep
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.records import REFERENCE
from vjm.simulation.arm import Arm
from vjm.simulation.run import earlier_runs, state_at


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_wrong_initial_states_of_an_elbows_segments_do_not_hold_back_its_parameters(tmp_path: Path, seed: int) -> None:
    """The likelihood of such a state has several maxima, and one too long a step in it must not be all segments'."""
    pytest.importorskip("mujoco")
    from tests.mujoco_arm.two_links import write_two_link_experiment

    write_two_link_experiment(tmp_path, seed=1)
    experiment = vjm.load_experiment(tmp_path / "experiment.toml")
    training = first_seconds(next(each for each in experiment.recordings if each.file == "swing_2.csv"), 2.0)
    experiment = replace(experiment, recordings=(training,))
    fit = vjm.identify(experiment, virtual_joints=3, baselines=False).trajectory
    assert fit is not None
    whole, x, n = [run.observed for run in fit.point.runs], fit.point.x, fit.point.chain.size
    duration = fit.point.problem.first_horizon(x) / 2
    parts = tuple(part for one in whole for part in segments(one, duration))
    problem = replace(fit.point.problem, observed=parts, step_multiple=4.0)
    known = [state_at(fit.point.runs, part) for part in parts]
    random = np.random.default_rng(seed)
    away = [state + random.normal(size=2 * n) * np.repeat((0.01, 0.3), n) for state in known]  # rad, rad/s
    start = problem.simulated(1.05 * x, away, away, [1.0] * len(parts))
    found = fit_segments(TrajectoryFit(start), whole, duration, StoppingRule())
    assert found.misfit < 1.02


def test_a_joint_that_only_some_recordings_have_is_followed_in_their_segments() -> None:
    """In those known to be without an effect, the arm has fewer coordinates."""
    clamp = ClampCompliance(link=0, compliance=5e-3)
    without = recorded(Arm(chain_of()), 1, condition=REFERENCE)[0]
    changed = recorded(Arm.of(chain_of(), (clamp,)), 1)[1]
    start = fitted_in_segments([without, changed])
    fit = refit(start, [replace(clamp, compliance=2e-3)])
    assert fit is not None
    whole = point_of(chain_of(), (), [without, changed]).problem.observed
    found = fit_segments(fit, whole, 2 * float(np.ptp(start.point.runs[0].observed.recording.time)), StoppingRule())
    assert 2 < len(found.point.runs) < len(start.point.runs)
    assert len({run.chain.size for run in found.point.runs}) == 2
    assert found.misfit == pytest.approx(1.0, abs=0.03)
    assert found.effects[0].values["compliance"] == pytest.approx(clamp.compliance, rel=0.02)


@given(
    counts=st.lists(st.integers(1, 60), min_size=1, max_size=8),
    share=st.floats(0.0, 1.5),
    seed=st.integers(0, 9),
)
def test_some_segments_hold_the_values_asked_for_with_the_beginning_and_more_of_each_recording(
    counts: list[int], share: float, seed: int
) -> None:
    files = [file for file, count in enumerate(counts) for _ in range(count)]
    runs: list[Any] = [
        SimpleNamespace(observed=SimpleNamespace(count=100, recording=SimpleNamespace(file=file))) for file in files
    ]
    chosen = draw_segments(runs, 100 * share * len(runs), seed)
    assert sorted(set(chosen)) == sorted(chosen)
    assert len(chosen) >= min(share, 1.0) * len(runs) - 1e-9
    if len(chosen) < len(runs):
        assert len(chosen) <= len(runs) / 2
    for file, count in enumerate(counts):
        own = [k - files.index(file) for k in chosen if files[k] == file]
        assert own[0] == 0
        assert len(own) >= min(count, 2)


def test_a_fit_to_some_segments_goes_on_in_all_of_them() -> None:
    """With a memory, whose internal states follow the motion before a segment, in those not fitted as well."""
    creep = ViscoelasticCreep(link=0, ratio=0.1, time_constant=0.4)
    point = point_of(chain_of(), (), recorded(Arm.of(chain_of(), (creep,)), 1, duration=4.0))
    whole, duration = point.problem.observed, point.problem.first_horizon(point.x) / 2
    every = simulate_segments(TrajectoryFit(point), whole, duration)
    chosen = [k for k in range(len(every.runs)) if k % 3 == 0]
    start, every = fit_some(every, chosen, StoppingRule())
    assert len(start.point.runs) == len(chosen)
    some = refit(start, [replace(creep, ratio=0.05)])
    assert some is not None
    found = fit_all(some, every, StoppingRule())
    assert [run.observed.recording.time[0] for run in found.point.runs] == [
        run.observed.recording.time[0] for run in every.runs
    ]
    without = fit_segments(TrajectoryFit(point), whole, duration, StoppingRule())
    everywhere = refit(without, [replace(creep, ratio=0.05)])
    assert everywhere is not None
    assert everywhere.misfit == pytest.approx(1.0, abs=0.03)
    assert some.misfit == pytest.approx(1.0, abs=0.05)
    assert found.chi2 == pytest.approx(everywhere.chi2, abs=0.003 * everywhere.chi2)
    for fit in (some, found):
        assert fit.effects[0].values["ratio"] == pytest.approx(creep.ratio, rel=0.25)


@pytest.mark.parametrize("misfit", [1.0, 1.7])
def test_a_model_as_good_in_all_segments_as_in_some_is_not_given_up(misfit: float) -> None:
    """Whose chi^2 in few segments is uncertain; one that is worse by much is."""
    random, some, every = np.random.default_rng(1), 1000, 4000
    few, others = (misfit**2 * random.chisquare(count, 20000) for count in (some, every - some))
    limits: list[float] = []
    for chi2 in few:
        fit: Any = SimpleNamespace(misfit=np.sqrt(chi2 / some), point=SimpleNamespace(expected_chi2=some))
        limits.append(largest_chi2_in_all(fit, SimpleNamespace(expected_chi2=every)))  # type: ignore[arg-type]
    assert np.all(few + others < limits)
    assert np.mean(few + 1.4 * others > limits) > 0.9
    assert np.mean((np.array(limits) - few - others) / np.std(np.array(limits) - few - others) > 4) > 0.5


def test_segments_that_do_not_follow_one_another_do_not_start_from_each_others_ends() -> None:
    point = point_of(chain_of(), (), recorded(Arm(chain_of()), 1, duration=4.0))
    duration = point.problem.first_horizon(point.x) / 2
    runs = simulate_segments(TrajectoryFit(point), point.problem.observed, duration).runs
    first, second, third = [run for run in runs if run.observed.recording.file == "drive_0.csv"][:3]
    assert earlier_runs([first, second, third], third.observed) == [second]
    assert earlier_runs([first, third], third.observed) == []


@pytest.mark.slow
def test_a_search_that_begins_with_some_segments_ends_with_whole_recordings() -> None:
    """Of six seconds, half of the segments show which effect is missing, and where the rest starts.

    A point on the tip: chains of three joints say little of a body's radius.
    """
    payload = TipPayload(mass=0.01)
    start = TrajectoryFit(point_of(chain_of(), (), recorded(Arm.of(chain_of(24), (payload,)), 2, duration=6.0)))
    steps: list[str] = []
    search = Search(RIG, start, [TipPayload().nested(), CubicStiffness()], SearchOptions(), steps.append)
    result = search.run()
    (found,) = result.best.point.problem.effects_at(result.best.estimate)
    assert found.values["mass"] == pytest.approx(payload.mass, rel=0.02)
    assert steps.index("adding segments") < steps.index("lengthening segments")
    assert len(result.best.point.runs) == len(search.whole)
    assert result.best.misfit == pytest.approx(1.0, abs=0.03)
    counts = [fit.point.count for fit in result.segment_fits.values()]
    assert max(counts) <= start.point.count / 2
