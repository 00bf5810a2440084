"""Where nothing is wrong nothing is said; errors are what noise makes of the values; it does not take long."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tests.diagnosis.trajectories import MOTION, STILL, found, simulated
from vjm.diagnosis.symptoms import Symptoms

Array = NDArray[np.float64]


def clean(seed: int) -> list[Symptoms]:
    """Return the symptoms of a drive, two decays and a quiet record, all as simulated."""
    small = replace(MOTION, amplitudes=(0.05, 0.005), slew=(0.0, 0.4))
    clamped = found(
        simulated(4 * seed + 2, clamped=True, kind="decay", duration=8, rate=30, frames=1, file="clamped.csv")
    )
    driven = found(
        simulated(4 * seed),
        simulated(4 * seed + 1, small, small, kind="decay", file="decay.csv"),
        simulated(4 * seed + 3, STILL, STILL, kind="quiet", file="quiet.csv"),
    )
    return [driven, clamped]


def test_nothing_is_said_of_clean_recordings_and_errors_are_right() -> None:
    pulls = defaultdict(list)
    chances = []
    for seed in range(12):
        for result in clean(seed):
            assert [each.sentence for each in result.significant] == []
            assert result.headlines() == ()
            for each in result.found:
                chances.append(each.p_value)
                pulls[each.kind].append(each.value / each.std)
    for kind in ("offset", "gain", "delay", "drift", "amplitude", "phase", "frequency", "damping", "slow_delay"):
        assert 0.75 < np.std(pulls[kind]) < 1.25, kind
    assert np.mean(np.array(chances) < 0.01) < 0.01  # chances do not promise too much


def test_coloured_noise_is_not_taken_for_motion() -> None:
    def coloured(rng: np.random.Generator, like: Array) -> Array:
        values = rng.standard_normal((len(like) + 20, *like.shape[1:]))
        window = 0.7 ** np.arange(20)
        window /= np.sqrt(np.sum(window**2))
        smooth = np.apply_along_axis(lambda column: np.convolve(column, window)[20 : 20 + len(like)], 0, values)
        return np.asarray(smooth)

    for seed in range(6):
        result = found(simulated(seed, noise=coloured))
        assert {each.kind for each in result.significant} <= {"slow_drift"}


def test_seven_recordings_take_a_second_or_two() -> None:
    recordings = [simulated(k, file=f"{k}.csv") for k in range(7)]
    found(*recordings[:1])
    start = time.process_time()
    found(*recordings)
    assert time.process_time() - start < 3
