"""What may be given, and what is done with recordings that hold little."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from tests.diagnosis.trajectories import CLAMPED, FREQUENCIES, MOTION, RIG, found, simulated
from vjm.diagnosis.symptoms import Symptom, Symptoms
from vjm.diagnosis.symptoms.channels import Channels
from vjm.diagnosis.symptoms.modes import _Fit, _free_interval
from vjm.records import NO_PAYLOAD, Link, Payload, Recording, Rig, SimulatedRecording, Simulation


def cut(whole: SimulatedRecording, rows: object, **changes: object) -> SimulatedRecording:
    """Return the rows of a recording and of its simulation, further fields of the recording changed."""
    recording, simulation = whole.recording, whole.simulation
    measured = {name: getattr(recording, name)[rows] for name in ("time", "theta", "tau", "markers")}
    own = {name: getattr(simulation, name)[rows] for name in ("time", "theta", "markers", "q", "v")}
    recording = replace(recording, **(measured | changes))  # type: ignore[arg-type]
    return replace(whole, recording=recording, simulation=replace(simulation, **own))


@pytest.mark.parametrize("count", [1, 2, 9, 40, 200])
def test_short_recordings_tell_nothing_and_do_no_harm(count: int) -> None:
    assert found(cut(simulated(0), slice(count))).significant == ()


def test_sensors_that_are_missing_are_done_without() -> None:
    motion = replace(MOTION, slew=(0.05, 0.3))
    whole = simulated(0, replace(motion, frequencies=(1.195, 7.5)), motion)
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
    assert Symptoms.of(RIG, [], {NO_PAYLOAD: FREQUENCIES}).found == ()


def test_slopes_of_the_oscillators_are_those_of_what_they_change(monkeypatch: pytest.MonkeyPatch) -> None:
    fits: list[_Fit] = []
    solve = _Fit.solve
    monkeypatch.setattr(_Fit, "solve", lambda fit, residual: (fits.append(fit), solve(fit, residual))[1])
    found(simulated(0, replace(MOTION, slew=(0.4, 0.35))))
    (fit,) = fits
    assert len(fit.modes) == 2
    still = np.zeros(12)
    moved = np.array([0.1, 0.2, 0.05, 0.1, -0.1, 0.1, -0.02, 0.2, 0.02, 1e-3, 2e-3, 1e-4])
    # Four times the amplitude in logarithms, and growth, are out of bounds, where nothing changes.
    outside = np.where(np.arange(12) == 0, 4.0, np.where(np.arange(12) == 2, -9.0, moved))
    for x in (still, moved, outside):
        steps = 1e-6 * np.eye(12)
        expected = np.stack([(fit.change(x + step) - fit.change(x - step)) / 2e-6 for step in steps], axis=1)
        scale = np.abs(expected).max(axis=0) + 1e-3
        np.testing.assert_allclose(fit.jacobian(x) / scale, expected / scale, atol=1e-3)
    assert not fit.jacobian(outside)[:, [0, 2]].any()


@pytest.mark.parametrize("factor", [1e-4, 30.0])
def test_a_motion_that_is_nothing_like_the_models_is_not_compared_with_it(factor: float) -> None:
    """An amplitude ratio of e^800 is none; what is shown is the residual."""
    small = replace(MOTION, amplitudes=(0.02 * factor, 0.005 * factor), slew=(0.1, 0.3))
    symptoms_ = found(simulated(0, replace(MOTION, slew=(0.4, 0.35)), small))
    assert symptoms_.found
    assert all(symptom.mode is None for symptom in symptoms_.found if symptom.kind in ("amplitude", "phase"))


def test_gaps_and_uneven_instants_do_not_move_the_values() -> None:
    whole = simulated(0, replace(MOTION, frequencies=(1.195, 7.5)))
    markers = whole.recording.markers.copy()
    markers[900:1200] = np.nan
    kept = np.sort(np.random.default_rng(0).choice(2500, 1800, replace=False))
    result = found(cut(whole, kept, markers=markers[kept]))
    first = result.headlines(1)[0]
    assert first.kind == "frequency"
    assert abs(first.value + 0.005 / 1.2) < 4 * first.std


def test_unrolled_markers_keep_their_residuals() -> None:
    """Axes that turn with the link turn the residual, and do nothing else to it."""
    each = simulated(0, replace(MOTION, slew=(1.5, 0.3)), replace(MOTION, slew=(1.5, 0.3)), lag=0.002)
    camera = Channels.of(RIG, each)[0]
    turned = np.where(camera.known, camera.noise * camera.residual, np.nan).reshape(-1, 5, 2)
    plain = each.marker_residual[each.recording.frames]
    assert np.allclose(np.hypot(*turned.transpose(2, 0, 1)), np.hypot(*plain.transpose(2, 0, 1)), equal_nan=True)
    assert camera.names[:2] == ("beam.m1 along", "beam.m1 across")
    speed = np.hypot(*camera.rate.reshape(-1, 5, 2).transpose(2, 0, 1))
    velocity = np.gradient(each.simulation.markers, each.recording.time, axis=0)[each.recording.frames]
    truth = np.hypot(*velocity.transpose(2, 0, 1))
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
    simulation = Simulation(time, theta, theta, theta, np.nan_to_num(markers, nan=0.4))
    whole = SimulatedRecording(recording, simulation, (3e-4, 1e-4), "converged")
    camera, encoder = Channels.of(Rig("elbow", links), whole)
    assert camera.names == ("upper.m1 along", "upper.m1 across", "upper.m2 along", "upper.m2 across", "fore.m1.y")
    assert encoder.names == ("upper.theta", "fore.theta")
    assert np.allclose(camera.residual, 0, atol=1e-6)


def test_free_motion_is_where_nothing_drives() -> None:
    time = np.arange(1000) / 100
    torque = np.where(time < 4, np.sin(6 * time), 0.0)[:, None]
    blank = np.zeros((1000, 1))
    recording = Recording(time, np.zeros((1000, 5, 2)), blank, torque, kind="driven", role="train", file="a.csv")
    stretch = _free_interval(recording)
    assert stretch is not None
    assert stretch == pytest.approx((4.0, 9.99), abs=0.02)
    assert _free_interval(replace(recording, tau=np.full_like(torque, np.nan))) is None
    assert _free_interval(replace(recording, kind="decay")) == (0.0, 9.99)


def test_a_torque_that_ends_after_the_camera_leaves_no_free_motion() -> None:
    """The only interval without torque may lie behind the camera's last frame."""
    whole = simulated(0)
    recording = whole.recording
    last = recording.time.size - 40
    markers, torque = recording.markers.copy(), np.ones((recording.time.size, 1))
    markers[last:], torque[last + 2 :] = np.nan, 0.0
    result = found(replace(whole, recording=replace(recording, kind="driven", markers=markers, tau=torque)))
    assert all(not one.modes.free for one in result.recordings)


def test_free_motion_that_the_camera_misses_is_left_out() -> None:
    decay = simulated(0, clamped=True, kind="decay", duration=10)
    time, markers = decay.recording.time, decay.recording.markers.copy()
    markers[(time > 3) & (time < 7), 0] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = found(replace(decay, recording=replace(decay.recording, markers=markers)))
    (free,) = result.recordings[0].modes.free[:1]
    assert len(free.time) > 3
    assert not ((free.time > 4) & (free.time < 6)).any()


@pytest.mark.parametrize("change", [-1e5, 1e5])
def test_what_grows_or_decays_at_once_is_no_free_motion(change: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the model is far off, a mode may be fitted with any decay."""
    decay = simulated(0, clamped=True, kind="decay", duration=10)
    fits: list[_Fit] = []
    solve = _Fit.solve
    monkeypatch.setattr(_Fit, "solve", lambda fit, residual: (fits.append(fit), solve(fit, residual))[1])
    assert found(decay).recordings[0].modes.free
    (fit,) = fits
    changes = np.zeros((len(fit.modes), 4))
    assert fit.free_motion(0, changes, decay.recording) is not None
    changes[:, 2] = change
    assert fit.free_motion(0, changes, decay.recording) is None


def test_conditions_are_told_in_words() -> None:
    decay = simulated(0, clamped=True, kind="decay", duration=10)
    loaded = replace(decay, recording=replace(decay.recording, payload=0.05, condition="reference"))
    assert {free.condition for free in found(decay).recordings[0].modes.free} == {""}
    result = Symptoms.of(CLAMPED, [loaded], {Payload(0.05): FREQUENCIES})
    assert {free.condition for free in result.recordings[0].modes.free} == {"payload 50 g, reference"}


@pytest.mark.parametrize(
    ("seen_in", "suffix"),
    [
        (("a.csv", None, "b.csv"), "; also in 1 other."),
        ((None, "a.csv", "b.csv"), "."),  # of several together: it names none
        (("a.csv", None), "."),
        (("a.csv", "b.csv", "c.csv", "b.csv"), "; also in 2 others."),
    ],
)
def test_a_symptom_of_several_recordings_together_is_no_other_recording(
    seen_in: tuple[str | None, ...], suffix: str
) -> None:
    seen = (Symptom("tone", file, None, None, 1.0, 0.1, "m", 1e-9, 0.5, 0.5, "It hums.") for file in seen_in)
    (headline,) = replace(found(simulated(0)), found=tuple(seen)).headlines()
    assert headline.sentence == f"It hums{suffix}"
