"""What may be given, and what is done with recordings that hold little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.symptoms.trajectories import FREQUENCIES, MOTION, RIG, followed, found
from vjm.errors import ShapeError
from vjm.experiment import Link, Recording, Rig
from vjm.symptoms.amplitude import free_stretch
from vjm.symptoms.find import symptoms
from vjm.symptoms.records import Followed
from vjm.symptoms.signals import observe


def test_arrays_that_do_not_fit_are_refused() -> None:
    good = followed(0)
    with pytest.raises(ShapeError, match="markers"):
        replace(good, markers=good.markers[:-1])
    with pytest.raises(ShapeError, match="theta"):
        replace(good, theta=np.full_like(good.theta, np.nan))
    with pytest.raises(ShapeError, match="noise"):
        replace(good, noise=(0.0, 1e-4))
    with pytest.raises(ShapeError, match="as the rig has them"):
        replace(good, rig=replace(RIG, links=(replace(RIG.links[0], markers=(0.5, 1.0)),)))
    with pytest.raises(ShapeError, match="frequencies"):
        symptoms([good], (1.0, -2.0))
    with pytest.raises(ShapeError, match=r"drive.csv"):
        symptoms([replace(good, frequencies=(1.0,))], FREQUENCIES)


@pytest.mark.parametrize("count", [1, 2, 9, 40, 200])
def test_short_recordings_tell_nothing_and_do_no_harm(count: int) -> None:
    whole = followed(0)
    recording = whole.recording
    part = replace(
        recording,
        time=recording.time[:count],
        theta=recording.theta[:count],
        tau=recording.tau[:count],
        markers=recording.markers[:count],
    )
    result = found(replace(whole, recording=part, markers=whole.markers[:count], theta=whole.theta[:count]))
    assert result.significant == ()


def test_sensors_that_are_missing_are_done_without() -> None:
    motion = replace(MOTION, slew=(0.05, 0.3))
    whole = followed(0, replace(motion, frequencies=(1.195, 7.5)), motion)
    recording = whole.recording
    for part in (
        replace(recording, markers=np.full_like(recording.markers, np.nan)),
        replace(recording, theta=np.full_like(recording.theta, np.nan)),
        replace(recording, markers=np.where([False, True], recording.markers, np.nan)),
    ):
        result = found(replace(whole, recording=part))
        assert result.headlines(1)[0].kind == "frequency", part
    blind = replace(
        recording, markers=np.full_like(recording.markers, np.nan), theta=np.full_like(recording.theta, np.nan)
    )
    assert found(replace(whole, recording=blind)).found == ()
    assert symptoms([], FREQUENCIES).found == ()


@pytest.mark.parametrize("factor", [1e-4, 30.0])
def test_a_motion_that_is_nothing_like_the_models_is_not_compared_with_it(factor: float) -> None:
    """An amplitude ratio of e^800 is none; what is shown is the residual."""
    small = replace(MOTION, amplitudes=(0.02 * factor, 0.005 * factor), slew=(0.1, 0.3))
    symptoms_ = found(followed(0, replace(MOTION, slew=(0.4, 0.35)), small))
    assert symptoms_.found
    assert all(symptom.band is None for symptom in symptoms_.found if symptom.kind in ("amplitude", "phase"))


def test_gaps_and_uneven_instants_do_not_move_the_values() -> None:
    whole = followed(0, replace(MOTION, frequencies=(1.195, 7.5)))
    recording = whole.recording
    markers = recording.markers.copy()
    markers[900:1200] = np.nan
    kept = np.sort(np.random.default_rng(0).choice(2500, 1800, replace=False))
    part = replace(
        recording,
        time=recording.time[kept],
        theta=recording.theta[kept],
        tau=recording.tau[kept],
        markers=markers[kept],
    )
    result = found(replace(whole, recording=part, markers=whole.markers[kept], theta=whole.theta[kept]))
    first = result.headlines(1)[0]
    assert first.kind == "frequency"
    assert abs(first.value + 0.005 / 1.2) < 4 * first.std


def test_unrolled_markers_keep_their_residuals() -> None:
    """Axes that turn with the link turn the residual, and do nothing else to it."""
    each = followed(0, replace(MOTION, slew=(1.5, 0.3)), replace(MOTION, slew=(1.5, 0.3)), lag=0.002)
    camera = observe(each)[0]
    turned = (camera.measured - camera.simulated).reshape(-1, 5, 2)
    plain = (each.recording.markers - each.markers)[each.recording.frames]
    assert np.allclose(np.hypot(*turned.transpose(2, 0, 1)), np.hypot(*plain.transpose(2, 0, 1)), equal_nan=True)
    assert camera.names[:2] == ("beam.m1 along", "beam.m1 across")
    speed = np.hypot(*camera.rate.reshape(-1, 5, 2).transpose(2, 0, 1))
    truth = np.hypot(*np.gradient(each.markers, each.recording.time, axis=0)[each.recording.frames].transpose(2, 0, 1))
    assert np.allclose(speed[2:-2], truth[2:-2], rtol=1e-3, atol=1e-3)


def test_markers_in_the_links_own_frame_are_left_as_they_are() -> None:
    links = (
        Link("upper", "revolute", 0.6, 0.3, 4.0, (0.3, 0.6), hub_inertia=0.01),
        Link("fore", "revolute", 0.4, 0.1, 1.0, (0.4,), hub_inertia=2e-3, markers_frame="link"),
    )
    time = np.arange(500) / 100
    theta = np.stack([0.5 * np.sin(time), 0.3 * np.cos(2 * time)], axis=1)
    x, y = np.cos(theta[:, :1]), np.sin(theta[:, :1])
    upper = np.stack([np.hstack([0.3 * x, 0.6 * x]), np.hstack([0.3 * y, 0.6 * y])], axis=2)
    fore = np.stack([np.full((500, 1), np.nan), 0.01 * np.sin(9 * time)[:, None]], axis=2)
    markers = np.concatenate([upper, fore], axis=1)
    recording = Recording(time, markers, theta, np.zeros_like(theta), kind="driven", role="train", file="a.csv")
    simulated = np.nan_to_num(markers, nan=0.4)
    camera, encoder = observe(Followed(Rig("elbow", links), recording, simulated, theta, (3e-4, 1e-4)))
    assert camera.names == ("upper.m1 along", "upper.m1 across", "upper.m2 along", "upper.m2 across", "fore.m1.y")
    assert encoder.names == ("upper.theta", "fore.theta")
    assert np.allclose(camera.measured[:, 4], fore[:, 0, 1])
    assert np.allclose(camera.residual, 0, atol=1e-6)


def test_free_motion_is_where_nothing_drives() -> None:
    time = np.arange(1000) / 100
    torque = np.where(time < 4, np.sin(6 * time), 0.0)[:, None]
    blank = np.zeros((1000, 1))
    recording = Recording(time, np.zeros((1000, 5, 2)), blank, torque, kind="driven", role="train", file="a.csv")
    stretch = free_stretch(recording)
    assert stretch is not None
    assert stretch == pytest.approx((4.0, 9.99), abs=0.02)
    assert free_stretch(replace(recording, tau=np.full_like(torque, np.nan))) is None
    assert free_stretch(replace(recording, kind="decay")) == (0.0, 9.99)
