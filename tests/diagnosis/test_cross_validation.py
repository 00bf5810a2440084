"""Effects must be determined by the recordings, and predict those that they were not fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.diagnosis.rigs import RIG, chain_of, point_of, recorded
from vjm.diagnosis.candidate_fit import refit
from vjm.diagnosis.cross_validation import _prediction_errors, is_determined, predicts_better
from vjm.effects import BaseCompliance, Effect, JointSpring, TorqueOffset
from vjm.identification.trajectory_fit import TrajectoryFit, fit_trajectory
from vjm.records import Recording
from vjm.simulation.arm import Arm
from vjm.simulation.least_squares import SquareRootInformation


def linear(
    jacobians: Sequence[np.ndarray],
    residuals: Sequence[np.ndarray],
    repeats: Sequence[str | None],
    held: Sequence[bool] | None = None,
) -> Any:
    """A fit whose recordings are exactly linear in its coordinates, at its minimum, without effects."""
    count = jacobians[0].shape[1]
    parts = [SquareRootInformation.of([rows], count) for rows in zip(jacobians, residuals, strict=True)]
    observed = [SimpleNamespace(recording=SimpleNamespace(file=f"{k}.csv", repeat=r)) for k, r in enumerate(repeats)]
    prior = np.zeros((0, count)), np.zeros(0)
    problem = SimpleNamespace(prior=lambda x: prior, parts=(), reference_effects=0)
    runs = [SimpleNamespace(observed=one, log_determinant=0.0) for one in observed]
    fixed = np.zeros(count, dtype=bool) if held is None else np.array(held)
    point = SimpleNamespace(problem=problem, x=np.zeros(count), runs=runs, linearizations=parts, held=fixed)
    return SimpleNamespace(point=point, effects=(), new_effects=())


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("repeats", [(None,) * 4, ("a", None, "a", None)], ids=["single", "repeats"])
def test_each_group_is_predicted_by_the_best_parameters_of_the_others(seed: int, repeats: tuple[str | None]) -> None:
    random = np.random.default_rng(seed)
    jacobians = [random.standard_normal((count, 3)) for count in (20, 19, 22, 24)]
    residuals = [random.standard_normal(len(rows)) for rows in jacobians]
    expected = []
    for left_out in ([0, 2], [1], [3]) if repeats[0] else ([0], [1], [2], [3]):
        others = [k for k in range(4) if k not in left_out]
        x = np.linalg.lstsq(
            np.vstack([jacobians[k] for k in others]), np.concatenate([residuals[k] for k in others]), rcond=None
        )[0]
        expected.append(sum(float(np.sum((residuals[k] - jacobians[k] @ x) ** 2)) for k in left_out))
    assert _prediction_errors(cast(TrajectoryFit, linear(jacobians, residuals, repeats))) == pytest.approx(expected)


def test_coordinates_at_a_bound_stay_there_when_recordings_are_left_out() -> None:
    random = np.random.default_rng(4)
    jacobians = [random.standard_normal((20, 3)) for _ in range(3)]
    residuals = [random.standard_normal(20) for _ in range(3)]
    known = linear([rows[:, [0, 2]] for rows in jacobians], residuals, (None,) * 3)
    held = linear(jacobians, residuals, (None,) * 3, (False, True, False))
    assert _prediction_errors(held) == pytest.approx(_prediction_errors(known))


def test_one_recording_alone_predicts_nothing() -> None:
    assert np.isnan(_prediction_errors(linear([np.eye(2)], [np.ones(2)], [None]))).all()


def several(effects: Sequence[Effect], seed: int) -> list[Recording]:
    """Two recordings of each arm with one effect more."""
    parts = [recorded(Arm.of(chain_of(), (effect,)), seed + k) for k, effect in enumerate(effects)]
    return [replace(one, file=f"{k}_{one.file}") for k, part in enumerate(parts) for one in part]


def fits_with(effect: Effect, recordings: list[Recording]) -> tuple[TrajectoryFit, TrajectoryFit]:
    """Fits without and with an effect."""
    point = point_of(chain_of(), (), recordings)
    without = fit_trajectory(point.problem, point.x)
    found = refit(without, [effect])
    assert found is not None
    return without, found


@pytest.mark.parametrize("seed", [1, 2])
def test_an_effect_that_is_there_is_determined_and_predicts(seed: int) -> None:
    truth = JointSpring(link=0, stiffness=0.01)
    without, found = fits_with(truth, several([truth, truth], seed))
    assert is_determined(found, found.effects[0], 0.01)
    assert found.chi2 < _prediction_errors(found).sum() < _prediction_errors(without).sum()
    assert predicts_better(found, without)


@pytest.mark.parametrize("seed", [1, 2])
def test_an_effect_that_differs_from_recording_to_recording_does_not_predict(seed: int) -> None:
    """Its mean is far from zero by noise alone, so that a test of significance is passed."""
    offsets = [TorqueOffset(link=0, column=0, offset=value) for value in (6e-4, -5e-4)]
    without, found = fits_with(offsets[0], several(offsets, seed))
    assert without.chi2 - found.chi2 > 100
    assert not predicts_better(found, without)


def test_an_effect_that_one_recording_shows_is_not_judged_by_the_others() -> None:
    """They know nothing of it, and predict that recording as if it were absent."""
    truth = JointSpring(link=0, stiffness=0.01)
    recordings = recorded(Arm.of(chain_of(), (truth,)), 1)
    quiet = [replace(one, condition="reference") for one in recorded(Arm.of(chain_of()), 2)]
    without, found = fits_with(truth, [recordings[1], *(replace(one, file=f"r_{one.file}") for one in quiet)])
    errors = _prediction_errors(found)
    assert np.isnan(errors[0])
    assert np.isfinite(errors[1:]).all()
    assert predicts_better(found, without)


def test_a_size_within_its_error_is_not_determined() -> None:
    absent = JointSpring(link=0, stiffness=0.01)
    point = point_of(chain_of(), (), recorded(Arm.of(chain_of()), 3))
    found = refit(fit_trajectory(point.problem, point.x), [absent])
    assert found is not None
    assert not is_determined(found, found.effects[0], 0.01)


def test_a_table_is_determined_however_far_its_direction_is_from_where_the_search_began() -> None:
    """At 45 degrees from there its compliance is all in the second of the two that a search varies."""
    truth = BaseCompliance(stiffness=500.0, mass=1.0, direction=1.3).placed(RIG, None)
    recordings = recorded(Arm.of(chain_of(), (truth,)), 1, factor=3.0)
    point = point_of(chain_of(), (), recordings)
    turned = replace(truth, start=truth.direction - np.pi / 4)
    assert turned.coordinates[0] == pytest.approx(0.0, abs=1e-12)
    found = refit(fit_trajectory(point.problem, point.x), [turned])
    assert found is not None
    assert found.misfit == pytest.approx(1.0, abs=0.05)
    assert is_determined(found, found.effects[0], 0.01)
