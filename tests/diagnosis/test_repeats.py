"""What recordings that repeat one experiment say of the noise, and of what is left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.diagnosis.rigs import chain_of, point_of, recorded
from vjm.diagnosis.residual_tests import compare_repeats
from vjm.diagnosis.segments import simulate_segments
from vjm.effects import TorqueGain
from vjm.identification.trajectory_fit import Point, TrajectoryFit
from vjm.records import Recording
from vjm.simulation.arm import Arm
from vjm.simulation.run import Run

# Of a torque: 2 % more than is told to the model, in every one of several recordings or in the last one alone.
MORE = TorqueGain(link=0, gain=1.02)


def runs_of(seeds: list[int], wrong: list[bool], late: float = 0.0) -> tuple[Run, ...]:
    """Recordings of one drive, each with noise of its own."""
    recordings: list[Recording] = []
    for k, (seed, more) in enumerate(zip(seeds, wrong, strict=True)):
        one = recorded(Arm.of(chain_of(), (MORE,) if more else ()), seed)[0]
        recordings.append(replace(one, file=f"{k}.csv", repeat="drive", time=one.time + k * late))
    point: Point = point_of(chain_of(), (), recordings)
    return point.runs


@pytest.mark.parametrize("seed", [1, 5, 9])
@pytest.mark.parametrize("late", [0.0, 3.0])
def test_noise_is_nobodys_twice(seed: int, late: float) -> None:
    found = compare_repeats(runs_of([seed, seed + 1, seed + 2], [False] * 3, late))
    assert found is not None
    assert (found.common, found.individual) == (pytest.approx(1.0, abs=0.05), pytest.approx(1.0, abs=0.05))


def test_what_a_model_gets_wrong_every_time_repeats() -> None:
    found = compare_repeats(runs_of([1, 2], [True, True]))
    assert found is not None
    assert found.individual == pytest.approx(1.0, abs=0.05)
    assert found.common > 3
    assert found.recurring_share > 0.95


def test_what_happens_once_does_not_repeat() -> None:
    found = compare_repeats(runs_of([1, 2], [False, True]))
    assert found is not None
    assert found.recurring_share == pytest.approx(0.0, abs=0.02)
    opposite = compare_repeats([*runs_of([1], [True]), mirrored(runs_of([1, 2], [True, True])[1])])
    assert opposite is not None
    assert opposite.recurring_share < 0.1


def test_segments_are_compared_with_those_of_the_same_time() -> None:
    whole = runs_of([1, 2], [True, True], late=3.0)
    point: Point = point_of(chain_of(), (), [run.observed.recording for run in whole])
    segments = simulate_segments(TrajectoryFit(point), point.problem.observed, 0.5)
    assert len(segments.runs) > 4
    found = compare_repeats(segments.runs)
    assert found is not None
    assert found.individual == pytest.approx(1.0, abs=0.05)
    assert found.recurring_share > 0.8


def mirrored(run: Run) -> Run:
    """A recording in which the model is wrong the other way."""
    found = replace(run)
    found.__dict__["residual"] = -run.residual
    return found


def test_nothing_is_said_without_repeats_or_of_frames_at_other_instants() -> None:
    one, two = runs_of([1, 2], [False, False])
    alone = replace(two, observed=replace(two.observed, recording=replace(two.observed.recording, repeat=None)))
    assert compare_repeats([one, alone]) is None
    recording = two.observed.recording
    shifted = np.r_[recording.time[:1], recording.time[1:] + 0.004]
    between = replace(two, observed=replace(two.observed, recording=replace(recording, time=shifted)))
    between.__dict__["residual"] = two.residual
    assert compare_repeats([one, between]) is None
