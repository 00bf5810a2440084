"""Fits to segments of recordings, each with an initial state of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vjm
from tests.diagnosis.rigs import chain_of, first_seconds, in_segments, point_of, recorded
from vjm.diagnosis.candidate_fit import StoppingRule, fit_segments, refit, segments
from vjm.effects import ClampCompliance
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.records import REFERENCE
from vjm.simulation.arm import Arm
from vjm.simulation.run import state_at


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
    start = in_segments([without, changed])
    fit = refit(start, [replace(clamp, compliance=2e-3)])
    assert fit is not None
    whole = point_of(chain_of(), (), [without, changed]).problem.observed
    found = fit_segments(fit, whole, 2 * float(np.ptp(start.point.runs[0].observed.recording.time)), StoppingRule())
    assert 2 < len(found.point.runs) < len(start.point.runs)
    assert len({run.chain.size for run in found.point.runs}) == 2
    assert found.misfit == pytest.approx(1.0, abs=0.03)
    assert found.effects[0].values["compliance"] == pytest.approx(clamp.compliance, rel=0.02)
