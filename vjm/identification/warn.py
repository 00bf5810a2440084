"""What a user should know before trusting an identification, in sentences with numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vjm.experiment.checks import camera_rate
from vjm.experiment.spectrum import MeasuredModes
from vjm.identification.prepare import Prepared
from vjm.identification.records import ModeComparison
from vjm.identification.uncertainty import Whiteness
from vjm.identification.virtual_joints import FREQUENCY_TOLERANCE, JointChoice
from vjm.markers.shape import required_markers, visible_modes
from vjm.records import Estimate, Experiment, Link, Recording, RecordingComparison, Rig

_LEAST_SAMPLES_A_PERIOD = 2.5
_MANY_NOISES = 1.5  # a training replay this many times the noise is not followed
_LEAST_MOTION = 10.0  # times the noise
_LARGEST_MISMATCH = 0.02
_CORRELATED = 0.2  # of neighbouring residuals: worth a warning
_REPEATED = 3.0  # times what the noise of two recordings explains
_MUCH = 1.5  # mean square of the weighted residuals: worth a warning


def marker_warnings(link: Link, modes: int | None) -> list[str]:
    """Whether the markers can show the modes asked for (eq. 1): as many as the virtual joints asked for."""
    if modes is None:
        return []
    seen, needed = visible_modes(len(link.markers)), required_markers(modes)
    if needed <= len(link.markers):
        return []
    return [
        f"link {link.name}: {len(link.markers)} markers show {seen} bending mode(s); the {modes} modes of "
        f"{modes} virtual joints need {needed} markers (k >= 2 l / lambda_min, eq. 1)"
    ]


def joint_notes(experiment: Experiment, orders: Sequence[int], joints: Sequence[JointChoice], kind: str) -> list[str]:
    """Which modes each link shows and how many virtual joints it got, a sentence a link."""
    found = []
    for link, order, choice in zip(experiment.rig.links, orders, joints, strict=True):
        plural = "s" if len(link.markers) > 1 else ""
        modes = "only mode 1 is" if order == 1 else f"modes 1 to {order} are"
        text = f"link {link.name}: {len(link.markers)} marker{plural}, {modes} seen; n = {choice.joints} virtual joints"
        if kind == "uniform":
            text += f", whose natural frequencies are right to {100 * choice.error:.2g} %"
        found.append(text)
    return found


def data_warnings(
    experiment: Experiment,
    prepared: Sequence[Prepared],
    orders: Sequence[int],
    joints: Sequence[JointChoice],
    seen: Sequence[MeasuredModes],
    parametrisation: str,
) -> list[str]:
    """About the recordings, the modes they show and the number of joints."""
    notes = joint_notes(experiment, orders, joints, parametrisation)
    found = []
    for link, order, choice, note in zip(experiment.rig.links, orders, joints, notes, strict=True):
        if order == 1:
            found.append(note)
        if parametrisation == "uniform" and choice.error > 10 * FREQUENCY_TOLERANCE:
            found.append(f"link {link.name}: n = {choice.joints} is too small for the modes seen; ask for more")
        found += marker_warnings(link, choice.joints if choice.asked else None)
    for one in prepared:
        found += _recording_warnings(one)
    fastest = max((float(m.frequencies[-1]) for m in seen if m.frequencies.size), default=0.0)
    for one in prepared:
        rate = camera_rate(one.recording)
        if fastest and rate < _LEAST_SAMPLES_A_PERIOD * fastest:
            found.append(
                f"{one.recording.file}: the camera takes {rate:.3g} frames/s, {rate / fastest:.2g} a period of the "
                f"{fastest:.3g} Hz mode; at least {_LEAST_SAMPLES_A_PERIOD} are needed"
            )
    return found


def _recording_warnings(prepared: Prepared) -> list[str]:
    found = []
    angles, name = prepared.angles, prepared.recording.file
    if angles.unsolved:
        found.append(f"{name}: {angles.unsolved} of {len(angles.time)} frames give no angles and were left out")
    motion = np.nanstd(angles.q, axis=0) / np.sqrt(np.maximum(np.diag(angles.covariance), 1e-300))
    if motion.max() < _LEAST_MOTION:
        found.append(f"{name}: the arm moves only {motion.max():.1f} times its angles' noise; it can tell little")
    return found


def mode_warnings(comparison: Sequence[ModeComparison]) -> list[str]:
    """Where the model's frequencies are not those of the recordings."""
    found = []
    for number, mode in enumerate(comparison, start=1):
        if mode.frequency_measured is None:
            continue
        off = mode.frequency_model / mode.frequency_measured - 1
        if abs(off) > _LARGEST_MISMATCH:
            found.append(
                f"mode {number}: the model's {mode.frequency_model:.4g} Hz is {100 * abs(off):.2g} % "
                f"{'above' if off > 0 else 'below'} the recordings' {mode.frequency_measured:.4g} Hz; "
                "method torque+frequency holds it there"
            )
    return found


def residual_warnings(whiteness: Sequence[Whiteness]) -> list[str]:
    """Where what the model leaves is no noise."""
    return [
        f"{one.file}: what the model leaves is {one.chi2**0.5:.3g} times the noise, and no noise (neighbouring "
        f"residuals correlate by up to {one.correlation:.2g}): it lacks something; the standard errors allow for "
        "that, the values may be off by more"
        for one in whiteness
        if one.coloured and (one.correlation > _CORRELATED or one.chi2 > _MUCH)
    ]


def repeat_warnings(recordings: Sequence[Recording], noise: float) -> list[str]:
    """Recordings of one label that do not repeat each other.

    Args:
        recordings: T instants each, without coordinates that cannot be right.
        noise: 1-sigma of a marker coordinate [m].
    """
    groups: dict[str, list[Recording]] = {}
    for recording in recordings:
        if recording.repeat is not None:
            groups.setdefault(recording.repeat, []).append(recording)
    found = []
    for label, group in groups.items():
        for other in group[1:]:
            off, apart = _apart(group[0], other, noise)
            if apart:
                found.append(
                    f"{group[0].file} and {other.file} are labelled repeats of {label!r}, but their markers are "
                    f"{1e3 * off:.3g} mm rms apart, {off / noise:.3g} times the noise: something changed between them"
                )
    return found


def _apart(one: Recording, other: Recording, noise: float) -> tuple[float, bool]:
    """RMS distance of the same coordinates at the same time after the start [m]; whether it is more than noise."""
    squares = []
    for k in np.ndindex(one.markers.shape[1:]):
        mine, theirs = (np.isfinite(each.markers[(slice(None), *k)]) for each in (one, other))
        if mine.sum() < 2 or theirs.sum() < 2:
            continue
        time, reference = one.time[mine] - one.time[0], other.time[theirs] - other.time[0]
        inside = time <= reference[-1]
        values = np.interp(time[inside], reference, other.markers[(theirs, *k)])
        squares.append((one.markers[(mine, *k)][inside] - values) ** 2)
    if not squares:
        return 0.0, False
    off = float(np.sqrt(np.mean(np.concatenate(squares))))
    return off, off > _REPEATED * np.sqrt(2) * noise


def scale_notes(rig: Rig, recordings: Sequence[Recording]) -> list[str]:
    """What nothing but the experiment file's masses holds."""
    torque = any(np.isfinite(recording.tau).any() for recording in recordings)
    weight = any(any(recording.gravity) for recording in recordings)
    payload = any(recording.payload for recording in recordings) or any(link.payload for link in rig.links)
    if torque or weight or payload:
        return []
    names = " and ".join(link.name for link in rig.links)
    return [
        "without torque, gravity or a known payload only stiffness relative to mass is seen: the bending stiffness of "
        f"{names} is as right as the mass in the experiment file; a recording with a known payload would tell both"
    ]


def result_warnings(recordings: Sequence[RecordingComparison], parameters: Sequence[Estimate]) -> list[str]:
    """About the fit."""
    found = [f"{fit.recording.file}: {fit.problem}" for fit in recordings if fit.problem]
    for fit in recordings:
        if fit.left_out:
            plural = "s" if fit.left_out > 1 else ""
            found.append(
                f"{fit.recording.file}: {fit.left_out} marker coordinate{plural} left out: impossible beside the other "
                "markers, clipped, or far from the frames around"
            )
    for fit in recordings:
        if fit.simulated is not None and fit.simulated.marker_rms > _MANY_NOISES * fit.noise[0]:
            found.append(
                f"{fit.recording.file}: the model misses the markers by {1e3 * fit.simulated.marker_rms:.3g} mm rms, "
                f"{fit.simulated.marker_rms / fit.noise[0]:.3g} times their noise"
            )
        if fit.simulated is not None and fit.simulated.status != "converged":
            found.append(f"{fit.recording.file}: no initial state was found that follows the recording")
    missing = [e.name for e in parameters if not e.identifiable]
    if missing:
        found.append(f"not determined by the recordings: {', '.join(missing)}")
    return found
