"""Fits to segments of recordings, each with an initial state of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vjm
from tests.diagnosis.rigs import first_seconds
from vjm.diagnosis.candidate_fit import StoppingRule, fit_segments, segments
from vjm.identification.trajectory_fit import TrajectoryFit
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
