"""The recording to make next is the one in which what cannot be told apart would differ most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from tests.diagnosis.rigs import chain_of, point_of, recorded
from vjm.diagnosis.candidate_fit import refit
from vjm.diagnosis.next_experiment import _scaled, propose_recordings
from vjm.effects import CameraRotation, ClampCompliance, CubicStiffness, Effect, EncoderOffset, StiffnessDrift
from vjm.identification.trajectory_fit import Point, TrajectoryFit
from vjm.records import Recording
from vjm.simulation.arm import Arm

CUBIC = CubicStiffness(link=0, coefficient=0.3)
DRIFT = StiffnessDrift(link=0, rate=-0.01)


def drives(truth: Effect, seed: int, factor: float = 1.0) -> list[Recording]:
    return recorded(Arm.of(chain_of(), (truth,)), seed, factor=factor)


def fitted(recordings: Sequence[Recording], *effects: Effect) -> list[TrajectoryFit]:
    """Explanations of some drives, one for each effect."""
    start = TrajectoryFit(point_of(chain_of(), (), recordings))
    found = [refit(start, [effect]) for effect in effects]
    assert all(each is not None for each in found)
    return [each for each in found if each is not None]


@pytest.mark.parametrize("seed", [7, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (8, 9))])
def test_what_a_recording_is_worth_is_known_before_it_is_made(seed: int) -> None:
    """Another amplitude tells what depends on it from what does not; and once it is recorded, it does."""
    small = drives(CUBIC, seed)[:1]
    best, other = fitted(small, CUBIC, DRIFT)
    proposed = propose_recordings(best, [other])
    (twice,) = [each.difference for each in proposed if "twice the amplitude" in each.text]
    assert twice == max(each.difference for each in proposed)
    assert proposed[0].difference == twice
    (large,) = (replace(each, file="large.csv") for each in drives(CUBIC, seed + 100, factor=2.0)[:1])
    both = fitted([*small, large], CUBIC, DRIFT)
    found = both[1].chi2 - both[0].chi2
    guessed = best.effects[0].values["coefficient"]  # which small drives show roughly
    assert found == pytest.approx(twice * (CUBIC.coefficient / guessed) ** 2, rel=0.2)


def test_twins_are_told_apart_by_nothing_on_the_menu() -> None:
    """Without gravity a turned camera and an encoder's offset are the same in every recording."""
    camera, encoder = CameraRotation(angle=0.02), EncoderOffset(link=0, offset=-0.02)
    best, other = fitted(drives(camera, 7), camera, encoder)
    assert all(each.difference < 1 for each in propose_recordings(best, [other]))


@pytest.mark.slow
def test_the_nearest_of_several_counts() -> None:
    clamp = ClampCompliance(link=0, compliance=0.002)
    best, *others = fitted(drives(CUBIC, 7)[:1], CUBIC, DRIFT, clamp)
    each = [{one.text: one.difference for one in propose_recordings(best, [other])} for other in others]
    for one in propose_recordings(best, others):
        assert one.difference == pytest.approx(min(given[one.text] for given in each))
    assert np.isfinite([one.difference for one in propose_recordings(best, others)]).all()


def test_where_an_alternative_diverges_a_recording_is_compared_with_itself_or_not_at_all() -> None:
    best, other = fitted(drives(CUBIC, 7)[:2], CUBIC, DRIFT)
    first, second = (
        replace(other, point=Point(replace(other.point.problem, observed=(run.observed,)), other.point.x, (run,)))
        for run in other.point.runs
    )
    assert all(one.difference == 0 for one in propose_recordings(best, [first]))  # the larger drive is missing
    expected = [one.difference for one in propose_recordings(best, [other])]
    assert [one.difference for one in propose_recordings(best, [second])] == pytest.approx(expected, rel=0.5)


def test_given_motion_is_scaled_with_the_torque() -> None:
    """A joint that turns as given has no other input than its accelerations."""
    (drive, _) = drives(CUBIC, 1)
    turning = replace(drive, input="motion", acceleration=np.ones(drive.theta.shape))
    state, active = np.arange(1.0, 9.0), chain_of().active
    for recording in (drive, turning):
        scaled, start = _scaled(2.0, recording, state, active)
        assert start == pytest.approx(np.where(np.isin(np.arange(8), active), state, 2 * state))
        assert np.array_equal(scaled.tau, 2 * recording.tau, equal_nan=True)
    assert scaled.acceleration is not None
    assert (scaled.acceleration == 2.0).all()
