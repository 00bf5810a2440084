"""One thing is wrong, and its size is known: the symptom that tells of it has that size, within its error."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.diagnosis.trajectories import (
    ARCS,
    CLAMPED,
    FREQUENCIES,
    INERTIA,
    MOTION,
    RIG,
    STILL,
    Motion,
    assert_found,
    found,
    kinds,
    simulated,
    the,
)
from vjm.diagnosis.symptoms import Symptoms
from vjm.records import NO_PAYLOAD, Payload

Array = NDArray[np.float64]
seeds = pytest.mark.parametrize("seed", [0, 1, pytest.param(2, marks=pytest.mark.slow)])


@seeds
def test_frequency(seed: int) -> None:
    slower = replace(MOTION, frequencies=(0.996 * FREQUENCIES[0], FREQUENCIES[1]))
    result = found(simulated(seed, slower))
    assert_found(result, the(result, "frequency", mode=0), -0.004)
    first = result.headlines(1)[0]
    assert first.kind == "frequency"
    assert first.share > 0.8
    words = r"frequency at 1\.2 Hz is 0\.(39|4[01]) % lower than in the model\."
    assert re.fullmatch(f"drive.csv: {words}", first.sentence)
    assert the(result, "frequency", mode=1) not in result.significant


@seeds
@pytest.mark.parametrize("clamped", [False, True])
def test_frequency_of_the_second_mode(seed: int, clamped: bool) -> None:
    faster = replace(MOTION, frequencies=(FREQUENCIES[0], 1.003 * FREQUENCIES[1]))
    result = found(simulated(seed, faster, clamped=clamped, kind="decay"))
    assert_found(result, the(result, "frequency", mode=1), 0.003)
    assert the(result, "frequency", mode=0) not in result.significant


def test_a_frequency_that_is_far_off_has_lost_whole_periods() -> None:
    result = found(
        simulated(0, replace(MOTION, frequencies=(1.2 * 1.2, 7.5)), clamped=True, kind="decay", duration=8.0)
    )
    found_ = the(result, "frequency", mode=0)
    assert found_.value == pytest.approx(0.2, rel=0.1)
    assert "gains 1." in found_.sentence
    assert "periods" in found_.sentence


@seeds
def test_damping(seed: int) -> None:
    result = found(simulated(seed, replace(MOTION, decays=(0.20, 0.5))))
    assert_found(result, the(result, "damping", mode=0), 0.05 / (2 * np.pi * 1.2))
    first = result.headlines(1)[0]
    assert first.kind == "damping"
    assert "is higher than in the model" in first.sentence


@seeds
def test_amplitude_and_phase(seed: int) -> None:
    other = replace(MOTION, amplitudes=(0.08, 0.01 * np.exp(0.1)), phases=(0.5, 1.4))
    result = found(simulated(seed, other))
    gain = the(result, "amplitude", mode=1)
    assert gain.p_value < 1e-5
    assert abs(gain.value - 0.1) < 4 * gain.std < 0.02
    assert_found(result, the(result, "phase", mode=0), 0.1)
    assert the(result, "frequency", mode=0) not in result.significant
    assert the(result, "damping", mode=1) not in result.significant
    assert "leads the model by" in the(result, "phase", mode=0).sentence


@seeds
def test_what_is_no_vibration(seed: int) -> None:
    result = found(simulated(seed, replace(MOTION, slew=(0.303, 0.3))))
    assert_found(result, the(result, "slow_amplitude"), 0.01)
    assert "is 1.0 % larger than simulated" in the(result, "slow_amplitude").sentence
    assert not kinds(result) & {"frequency", "phase", "damping", "camera_lag"}


@seeds
def test_shape(seed: int) -> None:
    """One marker moves more than the others in the second mode."""
    extra = 0.2 * MOTION.modes(np.arange(2500) / 500)[:, 1] * (ARCS[2] ** 2 * (3.6 - 4.6 * ARCS[2]))

    def change(t: Array, markers: Array, theta: Array) -> tuple[Array, Array]:
        markers = markers.copy()
        markers[:, 2, 1] += extra
        return markers, theta

    result = found(simulated(seed, clamped=True, kind="decay", change=change))
    symptom = the(result, "mode_shape", "beam.m3.y", 1)
    assert symptom.p_value < 1e-5
    assert symptom.value == pytest.approx(np.log(1.2), abs=4 * symptom.std + 0.01)  # the others' mean moves a little


@seeds
def test_offset_in_the_links_own_axes(seed: int) -> None:
    def change(t: Array, markers: Array, theta: Array) -> tuple[Array, Array]:
        across = np.stack([-np.sin(theta), np.cos(theta)], axis=2)
        return markers + 2e-3 * (np.arange(5) == 2)[:, None] * across, theta

    result = found(simulated(seed, change=change))
    assert_found(result, the(result, "offset", "beam.m3 across"), 2e-3)
    assert kinds(result) == {"offset"}
    assert result.headlines(1)[0].sentence == (
        "drive.csv: beam.m3 across is offset by +2.0 mm from the model throughout."
    )


@seeds
def test_gain_and_drift_of_the_encoder(seed: int) -> None:
    result = found(simulated(seed, change=lambda t, m, theta: (m, 1.002 * theta)))
    assert_found(result, the(result, "gain", "beam.theta"), 2e-3)
    result = found(simulated(seed, change=lambda t, m, theta: (m, theta + 1e-3 * t[:, None] / t[-1])))
    assert_found(result, the(result, "drift", "beam.theta"), 1e-3)


@seeds
def test_lag_of_the_camera(seed: int) -> None:
    result = found(*(simulated(10 * seed + k, lag=4e-3, file=f"{k}.csv") for k in range(3)))
    assert_found(result, the(result, "camera_lag"), 4e-3)
    assert result.headlines(1)[0].sentence == "Camera is 4.0 ms late relative to the encoders."
    assert_found(result, the(result, "delay", "camera"), 4e-3)
    assert the(result, "camera_clock") not in result.significant
    delay = next(each for each in result.headlines() if each.kind == "delay")
    assert "also in 2 others" in delay.sentence


@seeds
def test_clock_of_the_camera(seed: int) -> None:
    result = found(simulated(seed, clock=1.002))
    assert_found(result, the(result, "camera_clock"), 2e-3)
    assert "runs 0.20 % fast" in the(result, "camera_clock").sentence


def test_what_both_sensors_show_late_is_no_lag() -> None:
    late = replace(MOTION, phases=tuple(p - 2 * np.pi * f * 4e-3 for p, f in zip(MOTION.phases, FREQUENCIES)))  # noqa: B905
    result = found(simulated(0, late, clamped=False))
    assert the(result, "camera_lag") not in result.significant


def pushed(acceleration: Callable[[Array, Array], Array]) -> Callable[[Array, Array, Array], tuple[Array, Array]]:
    """A change: the joint gets a further acceleration, of its angle and velocity [rad/s^2], and the link follows."""

    def change(t: Array, markers: Array, theta: Array) -> tuple[Array, Array]:
        push = acceleration(theta[:, 0], np.gradient(theta[:, 0], t))
        more = np.cumsum(np.cumsum(push)) * t[1] ** 2
        more -= np.polyval(np.polyfit(t, more, 1), t)
        turned = theta[:, 0] + more
        angle = np.arctan2(markers[..., 1], markers[..., 0]) + more[:, None]
        radius = np.hypot(markers[..., 0], markers[..., 1])
        moved = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=2)
        return moved, turned[:, None]

    return change


@seeds
def test_missing_torque_that_changes_with_direction(seed: int) -> None:
    result = found(simulated(seed, change=pushed(lambda theta, rate: -0.5 * np.sign(rate))))
    symptom = the(result, "against_sign", "beam.theta")
    assert symptom.unit == "N m"
    assert_found(result, symptom, -INERTIA, 0.2)
    assert "jumps down by 0.02" in symptom.sentence
    torque = [each for each in result.significant if each.kind.startswith("against") and each.unit == "N m"]
    assert {each.kind for each in torque} == {"against_sign"}


@seeds
def test_missing_torque_against_velocity_and_angle(seed: int) -> None:
    for k, kind, push, truth in (
        (1, "against_velocity", lambda theta, rate: -2.0 * rate, -2.0),
        (0, "against_angle", lambda theta, rate: -8.0 * theta, -8.0),
    ):
        result = found(simulated(seed, change=pushed(push)))
        torque = [symptom for symptom in result.found if symptom.unit == "N m"]
        assert {symptom.kind for symptom in torque if symptom.p_value < 1e-3} == {kind}
        profile = next(one for one in result.recordings[0].profiles if one.quantity == "torque")
        estimate = profile.fit.changes[k]
        # The change is over the range of the motion from its 5 % quantile to its 95 % quantile.
        motion_range = np.subtract(*np.percentile((profile.position, profile.velocity)[k], [95, 5]))
        assert abs(estimate.value / motion_range - INERTIA * truth) < 4 * estimate.std / motion_range


@seeds
def test_tone_in_motion_and_at_rest(seed: int) -> None:
    def change(t: Array, markers: Array, theta: Array) -> tuple[Array, Array]:
        return markers + 3e-4 * np.sin(2 * np.pi * 13.2 * t)[:, None, None] * np.array([0.0, 1.0]), theta

    for truth, kind in ((replace(MOTION, slew=(0.0, 0.4)), "driven"), (STILL, "quiet")):
        result = found(simulated(seed, truth, truth, change=change, kind=kind))
        symptom = the(result, "quiet_tone" if kind == "quiet" else "tone")
        assert_found(result, symptom, 3e-4, 0.15)
        assert "at 13.2 Hz; the model does not" in symptom.sentence


@seeds
def test_noise_at_rest(seed: int) -> None:
    louder = found(
        simulated(seed, STILL, STILL, kind="quiet", noise=lambda r, like: 1.5 * r.standard_normal(like.shape))
    )
    assert the(louder, "noise_size", "camera").value == pytest.approx(0.5, abs=0.05)
    assert {"noise_size"} == kinds(louder)
    rounding = found(simulated(seed, STILL, STILL, kind="quiet", noise=lambda r, like: np.full_like(like, 0.3)))
    assert not {"noise_size", "noise_correlation", "quiet_tone"} & kinds(rounding)

    def coloured(rng: np.random.Generator, like: Array) -> Array:
        white = rng.standard_normal(like.shape)
        values = white.copy()
        for k in range(1, len(values)):
            values[k] = 0.6 * values[k - 1] + 0.8 * white[k]
        return values

    red = found(simulated(seed, STILL, STILL, kind="quiet", noise=coloured))
    assert_found(red, the(red, "noise_correlation", "encoder"), 0.6)

    def one_coordinate_rounded(rng: np.random.Generator, like: Array) -> Array:
        values = coloured(rng, like)
        values[:, 0] = 0.3
        return values

    some = found(simulated(seed, STILL, STILL, kind="quiet", noise=one_coordinate_rounded))
    assert_found(some, the(some, "noise_correlation", "camera"), 0.6)
    assert "(lag-one correlation +0." in the(red, "noise_correlation", "encoder").sentence


@seeds
def test_frequency_with_amplitude(seed: int) -> None:
    pairs = [(replace(MOTION, amplitudes=(0.08 / k, 0.01), hardening=0.02 / k**2), k) for k in (1, 2)]
    result = found(
        *(
            simulated(
                10 * seed + k,
                truth,
                replace(truth, hardening=0.0),
                clamped=True,
                kind="decay",
                duration=10,
                file=f"{k}.csv",
            )
            for truth, k in pairs
        )
    )
    symptom = the(result, "frequency_with_amplitude", mode=0)
    amplitudes = np.concatenate(
        [free.amplitude for one in result.recordings for free in one.modes.free if not free.mode]
    )
    small, large = amplitudes.min() / 0.08, amplitudes.max() / 0.08
    assert symptom in result.significant
    assert symptom.value == pytest.approx(0.02 * (large**2 - small**2), rel=0.1)
    assert "higher at " in symptom.sentence
    assert "model: the same" in symptom.sentence
    assert the(result, "damping_with_amplitude") not in result.significant


@seeds
def test_damping_with_amplitude(seed: int) -> None:
    truth = replace(MOTION, drag=0.3)
    result = found(simulated(seed, truth, MOTION, clamped=True, kind="decay", duration=10))
    symptom = the(result, "damping_with_amplitude", mode=0)
    amplitudes = np.concatenate(
        [free.amplitude for one in result.recordings for free in one.modes.free if not free.mode]
    )
    small, large = amplitudes.min() / 0.08, amplitudes.max() / 0.08
    assert symptom in result.significant
    assert symptom.value == pytest.approx(0.3 * (large - small) / (2 * np.pi * 1.2), rel=0.1)


def test_a_residual_that_grows_and_one_that_wanders() -> None:
    growing = found(simulated(0, replace(MOTION, frequencies=(1.205, 7.5))))
    growth = the(growing, "growth")
    assert growth in growing.significant
    assert growth.value > 1
    assert "growth" in [each.kind for each in growing.headlines(2)]
    slow = found(simulated(0, change=lambda t, m, theta: (m, theta + 2e-3 * np.cos(2 * np.pi * 0.5 * t)[:, None])))
    wander = the(slow, "slow_drift", "beam.theta")
    assert wander in slow.significant
    assert wander.value == pytest.approx(2e-3 / 2**0.5, rel=0.1)
    assert wander.local_share > 0.9


def test_a_payload_of_one_recording_has_frequencies_of_its_own() -> None:
    loaded = replace(MOTION, frequencies=(1.0, 6.6))
    truth = replace(loaded, frequencies=(1.0, 6.6 * 1.003))
    heavy = simulated(1, truth, loaded, file="heavy.csv")
    heavy = replace(heavy, recording=replace(heavy.recording, payload=0.05))
    result = Symptoms.of(RIG, [simulated(0), heavy], {NO_PAYLOAD: FREQUENCIES, Payload(0.05): (1.0, 6.6)})
    found_ = the(result, "frequency", mode=1)
    assert_found(result, found_, 0.003)
    assert {each.recording for each in result.significant} == {"heavy.csv"}


def test_two_faults_are_both_told_and_the_larger_first() -> None:
    truth: Motion = replace(MOTION, frequencies=(0.996 * 1.2, 7.5))
    result = found(*(simulated(k, truth, lag=2e-3, file=f"{k}.csv") for k in range(2)))
    order = [each.kind for each in result.headlines(12)]
    assert order.index("frequency") < order.index("camera_lag")
    assert the(result, "camera_lag").value == pytest.approx(2e-3, rel=0.1)
    assert [each.share for each in result.found] == sorted((each.share for each in result.found), reverse=True)


@seeds
def test_a_payload_is_not_taken_for_softening(seed: int) -> None:
    """A recording with a payload is off in frequency and larger; neither recording changes with amplitude."""
    light = replace(MOTION, amplitudes=(0.02, 0.01))
    heavy = replace(MOTION, frequencies=(0.99 * 1.2, 7.5))
    both = [
        simulated(2 * seed, light, light, clamped=True, kind="decay", duration=10, file="light.csv"),
        simulated(2 * seed + 1, heavy, MOTION, clamped=True, kind="decay", duration=10, file="heavy.csv"),
    ]
    both[1] = replace(both[1], recording=replace(both[1].recording, payload=0.05))
    result = Symptoms.of(CLAMPED, both, {NO_PAYLOAD: FREQUENCIES, Payload(0.05): FREQUENCIES})
    assert the(result, "frequency", mode=0).value == pytest.approx(-0.01, rel=0.05)
    assert "frequency_with_amplitude" not in kinds(result)
    trend = the(result, "frequency_with_amplitude", mode=0)
    assert abs(trend.value) < 2e-3


def test_a_delay_of_many_frames_is_found_by_correlation() -> None:
    result = found(simulated(0, lag=0.06))
    assert the(result, "delay", "camera").value == pytest.approx(0.06, rel=0.02)
