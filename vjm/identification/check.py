"""Check of an experiment before identification, and warnings about data and fits, in sentences with numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import median_abs_deviation

from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError, VjmError
from vjm.experiment.checks import overlapping_samples
from vjm.experiment.records import require_experiment
from vjm.experiment.spectrum import sensor_noise
from vjm.identification.mistakes import find_mistakes
from vjm.identification.mistakes.evidence import seen_modes
from vjm.identification.parameters import PARAMETRISATIONS, Parametrisation
from vjm.identification.records import ModeComparison, Whiteness
from vjm.identification.torque_method import fit_torque
from vjm.identification.training_data import FREQUENCY_TOLERANCE, JointChoice, TrainingData
from vjm.identification.trajectory_fit import DIVERGED_MISFIT, TrajectoryFit
from vjm.identification.uncertainty import Information
from vjm.model.modes import modes
from vjm.records import Array, Estimate, Experiment, Link, Record, Recording, RecordingComparison, Result, Rig
from vjm.text import counted, listed, millimetres, number, ratio
from vjm.threads import on_one_thread

# Practical significance of residuals: the model's own error is as large as the noise, or widens standard errors by a
# fifth. What is certain but smaller needs no warning.
_LARGE_RESIDUAL = 1.5  # RMS over noise
_MOTION = 10.0  # over noise: of less, a stiffness is right to no better than some per cent
_MIN_FRAMES_PER_PERIOD = 2.5  # Nyquist's two, and a margin


@dataclass(frozen=True, repr=False)
class RecordingOverview(Record):
    """One recording in numbers.

    Attributes:
        recording: as it was read.
        duration: from the first row to the last [s].
        frame_rate: of the camera [Hz].
        sensor_rate: of the encoder [Hz]; None where there is none.
        frames: number of rows in which the camera saw anything.
        missing: number of marker coordinates that it did not see in those, though it did in others.
        noise: 1-sigma of a marker coordinate in this recording alone [m].
        motion: standard deviation of the coordinate that moves most, over that noise.
        modes: (m,) frequencies of the bending that it shows [Hz].
    """

    recording: Recording
    duration: float
    frame_rate: float
    sensor_rate: float | None
    frames: int
    missing: int
    noise: float
    motion: float
    modes: Array


def overview(rig: Rig, recording: Recording) -> RecordingOverview:
    """Return one recording in numbers."""
    frames, time = recording.frames, recording.time
    markers = recording.markers[frames].reshape(frames.size, -1)
    markers = markers[:, np.isfinite(markers).any(axis=0)]
    encoder = time[np.isfinite(recording.theta).any(axis=1)]
    noise = sensor_noise(replace(rig, marker_noise=None), [recording])[0]
    return RecordingOverview(
        recording,
        float(np.ptp(time)),
        1.0 / float(np.median(np.diff(time[frames]))),
        1.0 / float(np.median(np.diff(encoder))) if encoder.size > 1 else None,
        frames.size,
        int(np.count_nonzero(~np.isfinite(markers))),
        noise,
        float(np.nanstd(markers, axis=0).max()) / noise,
        seen_modes(rig, recording, 3),
    )


@dataclass(frozen=True, repr=False)
class Check(Result):
    """Doubts about an experiment, and which parameters its recordings determine."""

    experiment: Experiment
    warnings: tuple[str, ...]  # what is wrong or doubtful
    modes: Array  # (m,) natural frequencies expected from the nominal values [Hz]
    virtual_joints: tuple[int, ...]  # n of each link that `identify` would take; empty where nothing can be identified
    # For each parametrisation, the parameters and whether the training recordings determine them.
    identifiable: dict[str, tuple[Estimate, ...]]
    problem: str = ""  # why nothing can be identified, a line for each reason; empty where something can
    overviews: tuple[RecordingOverview, ...] = ()  # of the recordings, in the experiment's order


@on_one_thread
def check(experiment: Experiment) -> Check:
    """Say what is wrong with a loaded experiment, what can be identified from it and what cannot be told apart.

    The standard errors are those that the recordings allow at the uniform link that fits them.

    Raises:
        ExperimentError: no experiment.
    """
    require_experiment(experiment)
    rig = experiment.rig
    mistakes = find_mistakes(experiment)
    findings = [*experiment.warnings, *(str(mistake) for mistake in mistakes if not mistake.certain)]
    if not experiment.with_role("holdout"):
        findings.append("no recording is held out, so that no prediction can be tested: give one the role 'holdout'")
    problem = "\n".join(str(mistake) for mistake in mistakes if mistake.certain)
    joints = [link.virtual_joints or 6 for link in rig.links]  # enough for the slowest few frequencies
    try:
        expected = modes(nominal_chain(rig, rig_layouts(rig, joints))).frequencies
    except VjmError:
        if not problem:
            raise
        expected = np.empty(0)  # of numbers that are absurd
    overviews = tuple(overview(rig, recording) for recording in experiment.recordings)
    findings += [
        f"{one.recording.file}: it moves by {motion:.3g} × its noise, though the recording is of kind 'quiet'"
        for one in overviews
        if one.recording.kind == "quiet" and (motion := _usual_motion(one)) > _MOTION
    ]
    if problem:
        return Check(experiment, tuple(findings), expected, (), {}, problem, overviews)
    try:
        data = {kind: TrainingData.of(experiment, kind) for kind in PARAMETRISATIONS}
        identifiable = {kind: _identifiable(training_data) for kind, training_data in data.items()}
    except InsufficientDataError as error:
        problem = str(error)
        about_markers = [text for link in rig.links for text in _marker_warnings(link, link.virtual_joints)]
        return Check(experiment, (*findings, *about_markers, problem), expected, (), {}, problem, overviews)
    warnings = (*findings, *data_warnings(data["uniform"]))
    choices = tuple(choice.joints for choice in data["uniform"].joints)
    return Check(experiment, warnings, expected, choices, identifiable, overviews=overviews)


def _usual_motion(one: RecordingOverview) -> float:
    """Return a recording's motion over its noise, of which single frames, glitches of the camera, are no part."""
    markers = one.recording.markers.reshape(one.recording.time.size, -1)
    seen = markers[:, np.isfinite(markers).any(axis=0)]
    return float(median_abs_deviation(seen, scale="normal", nan_policy="omit").max()) / one.noise


@np.errstate(over="ignore", invalid="ignore")  # of parameters that the recordings do not determine
def _identifiable(data: TrainingData) -> tuple[Estimate, ...]:
    fit = fit_torque(data)
    if data.parameters != "uniform":
        problem = fit.refined(data.parameters)
        fit = problem.evaluate(problem.parametrisation.start)
    parametrisation, information = fit.problem.parametrisation, Information.of_torque_errors(fit)
    physical = parametrisation.physical_covariance(fit.x, information.covariance)
    return estimates(parametrisation, fit.x, information, physical)


def estimates(
    parametrisation: Parametrisation,
    x: Array,
    information: Information,
    physical: Array,
    shift: Array | None = None,
) -> tuple[Estimate, ...]:
    """Return every parameter with its errors and whether the data determine it, in words.

    Args:
        parametrisation: of the chain.
        x: (p,) coordinates.
        information: of the recordings.
        physical: (p, p) covariance of the physical parameters.
        shift: (p,) what more virtual joints would change of the coordinates; None where that was not measured.
    """
    values = parametrisation.physical(x)
    std = np.sqrt(np.maximum(np.diag(physical), 0))
    correlation = physical / np.maximum(np.outer(std, std), 1e-300)
    at_bound, visible = information.held, information.visible
    shifts = [None] * x.size if shift is None else (parametrisation.jacobian(x) @ shift).tolist()
    result = []
    for k, coordinate in enumerate(parametrisation.coordinates):
        reason = remedy = ""
        if not visible[k]:
            reason = "the recordings do not respond to it"
        elif at_bound[k]:
            reason = "at its bound"
        elif not std[k] <= 0.5 * max(abs(values[k]), 1e-300):  # within two standard errors it may be zero
            reason = _uncertain(k, parametrisation, std[k] / max(abs(values[k]), 1e-300), correlation[k])
        if reason:
            remedy = _remedy(parametrisation, k, x)
            if parametrisation.kind != "uniform" and at_bound[k]:
                remedy += "; or fewer parameters (--parameters uniform)"
        error = float(std[k]) if np.isfinite(std[k]) and visible[k] else None
        fields = (coordinate.name, float(values[k]), error, coordinate.unit)
        more_joints = None if error is None else shifts[k]
        result.append(Estimate(*fields, not reason, reason, remedy, more_joints, nonnegative=True))
    return tuple(result)


def _uncertain(k: int, parametrisation: Parametrisation, relative_std: float, correlation: Array) -> str:
    """Explain why parameter k has so large a standard error."""
    magnitudes = np.abs(correlation)
    magnitudes[k] = 0.0
    partner = int(np.argmax(magnitudes))
    reason = f"its standard error is {100 * relative_std:.0f} % of its value"
    if relative_std > 100:  # the number itself says nothing
        reason = "the recordings determine it only in combination with other parameters"
    if magnitudes[partner] > 0.9:  # the partner alone explains more than 80 % of the variance
        name = parametrisation.coordinates[partner].name
        reason += f"; correlation {correlation[partner]:+.2f} with {name}"
    elif parametrisation.coordinates[k].group == "damping":
        reason += "; the motion decays too little"
    return reason


def _remedy(parametrisation: Parametrisation, k: int, x: Array) -> str:
    """Name the recording that would determine parameter k."""
    coordinate = parametrisation.coordinates[k]
    group, shared = coordinate.group, coordinate.index < 0
    if group == "hub":
        return "a driven recording whose torque changes faster, in which hub inertia matters more"
    if group not in ("stiffness", "damping"):
        return "a recording with another known payload, or one that excites higher modes"
    if group == "stiffness" and shared:
        return "a recording with larger deflection, or with more markers"
    mode = _mode_to_excite(parametrisation.chain(x), coordinate.link, coordinate.index)
    if group == "stiffness":
        return f"markers nearer to this joint, or a recording that excites {mode}, which bends it most"
    detail = "whose amplitude falls by more in each period" if shared else "which bends this joint most"
    return f"a longer free decay, or one that excites {mode}, {detail}"


def _mode_to_excite(chain: Chain, link: int, index: int) -> str:
    """Name the one of the four slowest modes with most elastic energy in a joint; for a whole link, the second."""
    natural_modes = modes(chain, gravity=(0.0, 0.0))
    count = min(4, natural_modes.frequencies.size)  # faster ones are hard to excite
    energy = chain.stiffness[:, None] * natural_modes.shapes[:, :count] ** 2
    share = energy / np.maximum(energy.sum(axis=0), 1e-300)
    joint = chain.passive_slices[link].start + index
    mode = min(1, count - 1) if index < 0 else int(np.argmax(share[joint]))
    return f"mode {mode + 1} (about {natural_modes.frequencies[mode]:.2g} Hz)"


def identification_notes(data: TrainingData, decisions: Sequence[str]) -> tuple[str, ...]:
    """Say which modes links show, how many joints they got, what was decided, and what only the masses determine."""
    rig, links = data.rig, zip(data.rig.links, data.shape.orders, data.joints, strict=True)
    notes = [*(_joint_note(*link, data.parameters) for link in links), *decisions]
    torque = any(np.isfinite(recording.tau).any() for recording in data.recordings)
    weight = any(any(recording.gravity) for recording in data.recordings)
    payload = any(recording.payload for recording in data.recordings) or any(link.payload for link in rig.links)
    if not (torque or weight or payload):
        names = " and ".join(link.name for link in rig.links)
        notes.append(
            "without torque, gravity or a known payload only the ratio of stiffness to mass is observable: the bending "
            f"stiffness of {names} is only as accurate as the given mass; a recording with a known payload would "
            "separate the two"
        )
    return tuple(notes)


def _joint_note(link: Link, order: int, choice: JointChoice, parameters: str) -> str:
    text = f"link {link.name}: {counted(len(link.markers), 'marker')}, {counted(order, 'shape function')}"
    text += f", {counted(choice.joints, 'virtual joint')}"
    if parameters == "uniform":
        short = {1: "frequency of mode 1", 2: "frequencies of modes 1 and 2"}
        modes = short.get(order, f"frequencies of modes 1 to {order}")
        text += f" ({modes} accurate to {number(100 * choice.error, 2)} %)"
    return text


def data_warnings(data: TrainingData) -> list[str]:
    """Warn about the recordings, their repeats, the modes they show and the numbers of joints."""
    warnings = []
    for link, order, choice in zip(data.rig.links, data.shape.orders, data.joints, strict=True):
        coarse = data.parameters == "uniform" and choice.error > 10 * FREQUENCY_TOLERANCE
        if order == 1 or coarse:
            remedy = "; --virtual-joints sets more" if coarse else ""
            warnings.append(f"{_joint_note(link, order, choice, data.parameters)}{remedy}")
        warnings += _marker_warnings(link, choice.joints if choice.requested else None)
    for prepared in data.prepared:
        angles, name = prepared.angles, prepared.recording.file
        if angles.unsolved:
            frames = f"{angles.unsolved} of {len(angles.time)} frames"
            warnings.append(f"{name}: {frames} lack markers or an encoder angle for the joint angles and were left out")
        motion = float(np.max(np.nanstd(angles.q, axis=0) / np.sqrt(np.maximum(np.diag(angles.covariance), 1e-300))))
        if motion < _MOTION:
            warnings.append(
                f"{name}: the motion is only {motion:.1f} × the noise of the joint angles; it determines little"
            )
    fastest = max((float(m.frequencies[-1]) for m in data.modes if m.frequencies.size), default=0.0)
    for prepared in data.prepared:
        rate = 1 / float(np.median(np.diff(prepared.angles.time)))
        if fastest and rate < _MIN_FRAMES_PER_PERIOD * fastest:
            warnings.append(
                f"{prepared.recording.file}: the camera takes {rate:.3g} frames/s, {rate / fastest:.2g} a period of "
                f"the {fastest:.3g} Hz mode; at least {_MIN_FRAMES_PER_PERIOD} are needed"
            )
    return warnings + _repeat_warnings(data)


def _marker_warnings(link: Link, joints: int | None) -> list[str]:
    """Warn where a link's markers are too few for the modes asked for (eq. 1): as many as the joints asked for."""
    count = len(link.markers)  # markers show as many modes, see vjm.markers.shape
    if joints is None or joints <= count:
        return []
    return [
        f"link {link.name}: {count} markers show {count} bending mode(s); the {joints} modes of "
        f"{joints} virtual joints need {joints} markers (k >= 2 l / lambda_min, eq. 1)"
    ]


def stopped_remedy(fit: TrajectoryFit | None) -> str:
    """Say what to do about a search that stopped before its minimum; None: of torque errors."""
    if fit is None or fit.misfit < DIVERGED_MISFIT:
        return "the search stopped early: identify fewer parameters, or add recordings with more motion"
    worst = max(fit.point.runs, key=lambda run: run.chi2 / max(run.expected_chi2, 1))
    return (
        f"residual {ratio(fit.misfit)} × noise, largest in {worst.observed.recording.file}: check each torque's unit, "
        "sign, joint and sampling times, and the masses, lengths and payloads of the experiment file; if these are "
        "right, the model lacks something, such as friction in a joint: `vjm diagnose` names it"
    )


def _repeat_warnings(data: TrainingData) -> list[str]:
    """Warn where recordings of one label do not repeat each other: are farther apart than three times their noise."""
    groups: dict[str, list[Recording]] = {}
    for recording in data.recordings:
        if recording.repeat is not None:
            groups.setdefault(recording.repeat, []).append(recording)
    warnings = []
    for label, (first, *repeats) in groups.items():
        for repeat in repeats:
            distance, noise = _distance(first, repeat), data.noise[0]
            if distance > 3 * np.sqrt(2) * noise:
                warnings.append(
                    f"{first.file} and {repeat.file} are labelled repeats of {label!r}, but their markers are "
                    f"{millimetres(distance)} RMS apart, {ratio(distance / noise)} × noise: something changed between "
                    "them"
                )
    return warnings


def _distance(first: Recording, second: Recording) -> float:
    """Return the RMS distance of the same coordinates at the same time after the start [m]."""
    columns = zip(*(recording.markers.reshape(recording.time.size, -1).T for recording in (first, second)), strict=True)
    pairs = [overlapping_samples(first, second, *column) for column in columns]
    differences = np.concatenate([np.zeros(0), *(x - y for x, y in pairs)])
    return float(np.sqrt(np.mean(differences**2))) if differences.size else 0.0


def failure_of(experiment: Experiment, recordings: Sequence[RecordingComparison]) -> str:
    """Return why an identified model must not be used even if its search converged; empty if it may be used.

    Args:
        experiment: as it was read.
        recordings: beside the model's simulations.
    """
    read = {recording.file: recording for recording in experiment.recordings}
    rig = experiment.rig
    names = [column for link in rig.links for column in link.marker_columns]
    reasons = []
    for comparison in recordings:
        file, cleaned = comparison.recording.file, comparison.recording
        before, after = (
            np.isfinite(recording.markers).any(axis=0).ravel().tolist() for recording in (read[file], cleaned)
        )
        missing = [
            name
            for name, was_measured, is_measured in zip(names, before, after, strict=True)
            if was_measured and not is_measured
        ]
        if missing:
            reasons.append(f"{file}: every value of {', '.join(missing)} was left out as impossible")
        rms = None if comparison.simulated is None else comparison.simulated.marker_rms
        if cleaned.role == "holdout" and (rms is None or not np.isfinite(rms)):
            reasons.append(f"{file}: held out, but the model could not be simulated over it")
        # Exact data have hardly any noise; what is less than a millionth of the arm is none.
        noise = max(comparison.noise[0], 1e-6 * sum(link.length for link in rig.links))
        if rms is not None and rms > 100 * noise:  # as large as motions are: the model follows nothing
            reasons.append(f"{file}: residual {ratio(rms / noise)} × noise")
    suffix = f", and {len(reasons) - 1} more such" if len(reasons) > 1 else ""
    return f"{reasons[0]}{suffix}; see the warnings, and what vjm check says" if reasons else ""


def fit_warnings(
    recordings: Sequence[RecordingComparison],
    parameters: Sequence[Estimate] = (),
    whiteness: Sequence[Whiteness] = (),
    modes: Sequence[ModeComparison] = (),
) -> list[str]:
    """Warn where residuals are no noise, modes differ, recordings are not followed or parameters not determined."""
    correlated = [
        f"{test.file} ({ratio(test.mean_square**0.5)} × noise, correlation up to {test.correlation:.2f})"
        for test in whiteness
        # A fifth of the noise power: what is left of exact data is correlated, and far below any noise.
        if test.correlated
        and (test.correlation * min(test.mean_square, 1.0) > 0.2 or test.mean_square > _LARGE_RESIDUAL**2)
    ]
    excessive = [
        f"{test.file} ({ratio(test.mean_square**0.5)} × noise)"
        for test in whiteness
        if test.excessive and not test.correlated and test.mean_square > _LARGE_RESIDUAL**2
    ]
    warnings = []
    if correlated:
        warnings.append(
            f"unmodelled dynamics: the residual of all sensors is correlated in {listed(correlated)}; standard errors "
            "include the correlation, values may be off by more"
        )
    if excessive:
        warnings.append(
            f"the residual is white noise, but larger than the sensors' in {listed(excessive)}: theirs is taken to be "
            "too small; marker_noise and encoder_noise of [sensors] set it"
        )
    for k, mode in enumerate(modes, start=1):
        error = 0.0 if mode.frequency_measured is None else mode.frequency_model / mode.frequency_measured - 1
        if abs(error) > 0.02:  # 4 % of a stiffness
            warnings.append(
                f"mode {k}: {mode.frequency_model:.4g} Hz in the model, {100 * abs(error):.2g} % "
                f"{'above' if error > 0 else 'below'} the measured {mode.frequency_measured:.4g} Hz; "
                "method torque+frequency fits the measured one"
            )
    warnings += [
        f"{comparison.recording.file}: {comparison.problem}" for comparison in recordings if comparison.problem
    ]
    warnings += [
        f"{comparison.recording.file}: {counted(comparison.left_out, 'marker coordinate')} left out: inconsistent with "
        "the other markers, clipped, or outliers in time"
        for comparison in recordings
        if comparison.left_out
    ]
    for comparison in recordings:
        if comparison.simulated is not None and comparison.simulated.marker_rms > _LARGE_RESIDUAL * comparison.noise[0]:
            rms, nominal = (
                comparison.simulated.marker_rms,
                None if comparison.reference is None else comparison.reference.marker_rms,
            )
            suffix = "" if nominal is None or nominal > rms else f"; the nominal model's is {millimetres(nominal)}"
            size = f"{millimetres(rms)} RMS, {ratio(rms / comparison.noise[0])} × noise"
            warnings.append(f"{comparison.recording.file}: marker residual {size}{suffix}")
        if comparison.simulated is not None and comparison.simulated.status != "converged":
            warnings.append(f"{comparison.recording.file}: no initial state was found that follows the recording")
    missing = [estimate.name for estimate in parameters if not estimate.identifiable]
    if missing:
        warnings.append(f"not determined by the recordings: {', '.join(missing)}")
    return warnings
