"""Warnings and notes on an identification, in sentences with numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vjm.experiment.checks import camera_rate
from vjm.identification.records import ModeComparison
from vjm.identification.training_data import TrainingData
from vjm.identification.uncertainty import Whiteness
from vjm.identification.virtual_joints import FREQUENCY_TOLERANCE, JointChoice
from vjm.markers.shape import required_markers, visible_modes
from vjm.records import Estimate, Link, Recording, RecordingComparison

# Levels of practical significance: what is merely certain, but smaller, needs no warning.
_MANY_NOISES = 1.5  # times the noise, of an RMS residual: the model's own error is as large as the noise
_LARGE_CHI2 = 1.5  # mean square of weighted residuals
_STRONG_CORRELATION = 0.2  # of neighbouring residuals: their standard error is widened by a fifth
_FREQUENCY_MISMATCH = 0.02  # relative
_MIN_MOTION = 10.0  # times the angles' noise: a stiffness is then right to some per cent
_MIN_FRAMES_PER_PERIOD = 2.5  # Nyquist's two, and a margin


def marker_warnings(link: Link, joints: int | None) -> list[str]:
    """Warn where a link's markers are too few for the modes asked for (eq. 1): as many as the joints asked for."""
    if joints is None:
        return []
    visible, needed = visible_modes(len(link.markers)), required_markers(joints)
    if needed <= len(link.markers):
        return []
    return [
        f"link {link.name}: {len(link.markers)} markers show {visible} bending mode(s); the {joints} modes of "
        f"{joints} virtual joints need {needed} markers (k >= 2 l / lambda_min, eq. 1)"
    ]


def identification_notes(data: TrainingData, joints: Sequence[JointChoice], decisions: Sequence[str]) -> list[str]:
    """Say which modes links show, how many joints they got, what was decided, and what only the masses determine."""
    links = zip(data.rig.links, data.shape.orders, joints, strict=True)
    notes = [*(_joint_note(*link, data.parameters) for link in links), *decisions]
    torque = any(np.isfinite(recording.tau).any() for recording in data.recordings)
    weight = any(any(recording.gravity) for recording in data.recordings)
    payload = any(recording.payload for recording in data.recordings) or any(link.payload for link in data.rig.links)
    if not (torque or weight or payload):
        names = " and ".join(link.name for link in data.rig.links)
        notes.append(
            "without torque, gravity or a known payload only stiffness relative to mass is seen: the bending stiffness "
            f"of {names} is as right as the mass in the experiment file; "
            "a recording with a known payload would tell both"
        )
    return notes


def _joint_note(link: Link, order: int, choice: JointChoice, parameters: str) -> str:
    plural = "s" if len(link.markers) > 1 else ""
    modes = "only mode 1 is" if order == 1 else f"modes 1 to {order} are"
    text = f"link {link.name}: {len(link.markers)} marker{plural}, {modes} seen; n = {choice.joints} virtual joints"
    if parameters == "uniform":
        text += f", whose natural frequencies are right to {100 * choice.error:.2g} %"
    return text


def data_warnings(data: TrainingData, joints: Sequence[JointChoice]) -> list[str]:
    """Warn about the recordings, their repeats, the modes they show and the numbers of joints."""
    warnings = []
    for link, order, choice in zip(data.rig.links, data.shape.orders, joints, strict=True):
        if order == 1:
            warnings.append(_joint_note(link, order, choice, data.parameters))
        if data.parameters == "uniform" and choice.error > 10 * FREQUENCY_TOLERANCE:
            warnings.append(f"link {link.name}: n = {choice.joints} is too small for the modes seen; ask for more")
        warnings += marker_warnings(link, choice.joints if choice.requested else None)
    for one in data.prepared:
        angles, name = one.angles, one.recording.file
        if angles.unsolved:
            frames = f"{angles.unsolved} of {len(angles.time)} frames"
            warnings.append(f"{name}: {frames} give no angles and were left out")
        motion = np.nanstd(angles.q, axis=0) / np.sqrt(np.maximum(np.diag(angles.covariance), 1e-300))
        if motion.max() < _MIN_MOTION:
            warnings.append(
                f"{name}: the arm moves only {motion.max():.1f} times its angles' noise; it can tell little"
            )
    fastest = max((float(m.frequencies[-1]) for m in data.modes if m.frequencies.size), default=0.0)
    for one in data.prepared:
        rate = camera_rate(one.recording)
        if fastest and rate < _MIN_FRAMES_PER_PERIOD * fastest:
            warnings.append(
                f"{one.recording.file}: the camera takes {rate:.3g} frames/s, {rate / fastest:.2g} a period of the "
                f"{fastest:.3g} Hz mode; at least {_MIN_FRAMES_PER_PERIOD} are needed"
            )
    return warnings + _repeat_warnings(data)


def _repeat_warnings(data: TrainingData) -> list[str]:
    """Warn where recordings of one label do not repeat each other: are farther apart than three times their noise."""
    groups: dict[str, list[Recording]] = {}
    for recording in data.recordings:
        if recording.repeat is not None:
            groups.setdefault(recording.repeat, []).append(recording)
    warnings = []
    for label, (first, *others) in groups.items():
        for other in others:
            distance, noise = _distance(first, other), data.noise[0]
            if distance > 3 * np.sqrt(2) * noise:
                warnings.append(
                    f"{first.file} and {other.file} are labelled repeats of {label!r}, but their markers are "
                    f"{1e3 * distance:.3g} mm rms apart, {distance / noise:.3g} times the noise: something changed "
                    "between them"
                )
    return warnings


def _distance(one: Recording, other: Recording) -> float:
    """RMS distance of the same coordinates at the same time after the start [m]."""
    squares = [np.zeros(0)]
    for k in np.ndindex(one.markers.shape[1:]):
        mine, theirs = (np.isfinite(recording.markers[(slice(None), *k)]) for recording in (one, other))
        if mine.sum() < 2 or theirs.sum() < 2:
            continue
        time, reference = one.time[mine] - one.time[0], other.time[theirs] - other.time[0]
        inside = time <= reference[-1]
        values = np.interp(time[inside], reference, other.markers[(theirs, *k)])
        squares.append((one.markers[(mine, *k)][inside] - values) ** 2)
    pooled = np.concatenate(squares)
    return float(np.sqrt(np.mean(pooled))) if pooled.size else 0.0


def fit_warnings(
    recordings: Sequence[RecordingComparison],
    parameters: Sequence[Estimate] = (),
    whiteness: Sequence[Whiteness] = (),
    modes: Sequence[ModeComparison] = (),
) -> list[str]:
    """Warn where residuals are no noise, modes differ, recordings are not followed or parameters not determined."""
    warnings = [
        f"{one.file}: what the model leaves is {one.chi2**0.5:.3g} times the noise, and no noise (neighbouring "
        f"residuals correlate by up to {one.correlation:.2g}): it lacks something; the standard errors allow for "
        "that, the values may be off by more"
        for one in whiteness
        if one.coloured and (one.correlation > _STRONG_CORRELATION or one.chi2 > _LARGE_CHI2)
    ]
    for number, mode in enumerate(modes, start=1):
        if mode.frequency_measured is None:
            continue
        error = mode.frequency_model / mode.frequency_measured - 1
        if abs(error) > _FREQUENCY_MISMATCH:
            warnings.append(
                f"mode {number}: the model's {mode.frequency_model:.4g} Hz is {100 * abs(error):.2g} % "
                f"{'above' if error > 0 else 'below'} the recordings' {mode.frequency_measured:.4g} Hz; "
                "method torque+frequency holds it there"
            )
    warnings += [f"{each.recording.file}: {each.problem}" for each in recordings if each.problem]
    for each in recordings:
        if each.left_out:
            plural = "s" if each.left_out > 1 else ""
            warnings.append(
                f"{each.recording.file}: {each.left_out} marker coordinate{plural} left out: impossible beside the "
                "other markers, clipped, or far from the frames around"
            )
    for each in recordings:
        if each.simulated is not None and each.simulated.marker_rms > _MANY_NOISES * each.noise[0]:
            warnings.append(
                f"{each.recording.file}: the model misses the markers by {1e3 * each.simulated.marker_rms:.3g} mm rms, "
                f"{each.simulated.marker_rms / each.noise[0]:.3g} times their noise"
            )
        if each.simulated is not None and each.simulated.status != "converged":
            warnings.append(f"{each.recording.file}: no initial state was found that follows the recording")
    missing = [estimate.name for estimate in parameters if not estimate.identifiable]
    if missing:
        warnings.append(f"not determined by the recordings: {', '.join(missing)}")
    return warnings
