"""Residuals of a right model pass their test, in any unit of time; a signal in them is found in its band."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from tests.diagnosis import rigs
from vjm.diagnosis.residual_tests import describe_residual, residual_test
from vjm.effects import Effect, JointSpring, MarkerOffset
from vjm.identification.trajectory_fit import fit_trajectory
from vjm.records import Array, Link, Recording, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run

RIG = Rig("rig", (Link("beam", "revolute", 1.0, 0.4, 2.0, (0.5, 1.0)),))
COUNT = 800


def run_of(markers: Array, angles: Array, rate: float = 100.0) -> Run:
    """Residuals (T, 4) and (T, 1) of a recording, in units of the noise; NaN where nothing was measured."""
    time = np.arange(len(markers)) / rate
    recording = Recording(
        time=time, markers=markers.reshape(-1, 2, 2), theta=angles, tau=angles, kind="driven", file="a.csv"
    )
    observed = Observations.of(RIG, recording, (1.0, 1.0))
    return cast(Run, SimpleNamespace(observed=observed, residual=observed.values))


def noise(seed: int, rate: float = 100.0, size: float = 1.0) -> Run:
    random = np.random.default_rng(seed)
    return run_of(size * random.standard_normal((COUNT, 4)), size * random.standard_normal((COUNT, 1)), rate)


def test_noise_is_rejected_no_more_often_than_the_level_says() -> None:
    p = np.array([residual_test([noise(2 * seed), noise(2 * seed + 1)]).p_value for seed in range(200)])
    assert np.mean(p < 0.1) < 0.15
    assert np.mean(p < 0.01) < 0.03


@pytest.mark.parametrize("size", [0.9, 1.1])
def test_a_little_misjudged_noise_is_no_signal(size: float) -> None:
    assert min(residual_test([noise(seed, size=size)]).p_value for seed in range(20)) > 1e-4


@pytest.mark.parametrize(("frequency", "size"), [(0.06, 0.2), (1.1, 0.4), (2.2, 0.4), (20.0, 0.5)])
def test_a_small_signal_is_found_in_its_band(frequency: float, size: float) -> None:
    """A fraction of the noise, in all markers: from a drift within the recording to a fast mode."""
    run = noise(3)
    signal = size * np.sin(2 * np.pi * frequency * run.observed.recording.time)
    markers = run.observed.recording.markers.reshape(COUNT, 4) + signal[:, None]
    found = residual_test([run_of(markers, run.observed.recording.theta)])
    assert found.p_value < 1e-5
    low, high = found.bands[0].frequencies
    assert found.bands[0].sensor == "markers"
    assert low <= frequency <= high
    assert found.excess > 0


def test_scaling_time_scales_bands_alone() -> None:
    one, slow = residual_test([noise(1)]), residual_test([noise(1, rate=0.1)])
    assert (slow.p_value, slow.excess) == (one.p_value, one.excess)
    for band, other in zip(one.bands, slow.bands, strict=True):
        assert other.frequencies == pytest.approx(tuple(1e-3 * edge for edge in band.frequencies))
        assert replace(other, frequencies=band.frequencies) == band


def test_gaps_and_short_recordings_are_borne() -> None:
    run = noise(1)
    markers = run.observed.recording.markers.reshape(COUNT, 4).copy()
    markers[100:140, :2] = np.nan
    markers[300:400] = np.nan
    assert residual_test([run_of(markers, run.observed.recording.theta)]).p_value > 0.01
    short = run_of(markers[:30], run.observed.recording.theta[:30])
    assert residual_test([short]).bands == ()
    assert residual_test([short]).p_value == 1.0


@pytest.mark.parametrize(
    ("hidden", "expected"),
    [
        (
            JointSpring(link=0, stiffness=0.002),
            r"it resembles a torque at the joint .*, odd in position \(spring\), .*",
        ),
        (
            MarkerOffset(marker=1, across=0.003),
            "no torque or bending moment of a simple law would explain more than .*",
        ),
    ],
    ids=["spring", "marker"],
)
def test_a_force_is_named_that_explains_most_of_a_residual(hidden: Effect, expected: str) -> None:
    chain = rigs.chain_of()
    point = rigs.point_of(chain, (), rigs.recorded(Arm.of(chain, (hidden,)), 1))
    text = describe_residual(fit_trajectory(point.problem, point.x).point, (), rigs.RIG)
    assert re.fullmatch(expected, text)
    assert (int(text.split()[-4]) >= 50) is text.startswith("it resembles")
