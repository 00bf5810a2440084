"""Models beside the recordings of an experiment: open-loop simulations of every recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vjm.chain.curve import curve_map
from vjm.chain.layout import chain_layouts, nominal_chain
from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError, ShapeError, SimulationDivergedError
from vjm.experiment.spectrum import MeasuredModes, match, mode_shapes
from vjm.identification.check import fit_warnings
from vjm.identification.outliers import without_outliers
from vjm.identification.records import ModeComparison
from vjm.identification.torque_method import MODE_TOLERANCE
from vjm.identification.training_data import PreparedRecording, TrainingData
from vjm.model.modes import modes
from vjm.records import (
    Array,
    Complex,
    Experiment,
    Progress,
    Recording,
    RecordingComparison,
    Rig,
    SimulatedRecording,
    SimulatedResult,
)
from vjm.simulation.model import Model


@dataclass(frozen=True, repr=False)
class Comparison(SimulatedResult):
    """A given model beside the recordings of an experiment.

    Attributes:
        experiment: the recordings.
        model: the given model.
        nominal: of the experiment file's nominal values, with the same virtual links.
        covariance: (p, p) of the model's estimated parameters; empty where unknown.
        recordings: comparison of every recording, in the experiment's order.
        warnings: what a user should know.
    """

    experiment: Experiment
    model: Model
    nominal: Model
    covariance: Array
    recordings: tuple[RecordingComparison, ...]
    warnings: tuple[str, ...]


def compare(
    experiment: Experiment,
    model: Model,
    covariance: Array | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Simulate every recording of an experiment with a model, and with the nominal one.

    Args:
        experiment: the recordings.
        model: of the same rig.
        covariance: (p, p) of the model's estimated parameters; None where unknown.
        progress: told (text, done, total) while it runs.

    Raises:
        ShapeError: a model whose links are longer or shorter than the rig's.
    """
    for link, own in zip(model.chain.links, experiment.rig.links, strict=True):
        if abs(link.length - own.length) > 1e-3 * own.length:  # more than rounding in either file
            raise ShapeError(f"model, link {link.name}", f"length {link.length:.6g} m", f"the rig's {own.length:.6g} m")
    nominal = replace(model, chain=nominal_chain(experiment.rig, chain_layouts(model.chain)), estimates=(), effects=())
    recordings = compare_recordings(experiment, model, (nominal, None), progress)
    known = np.empty((0, 0)) if covariance is None else covariance
    warnings = (*experiment.warnings, *fit_warnings(recordings))
    return Comparison(experiment, model, nominal, known, recordings, warnings)


def compare_recordings(
    experiment: Experiment,
    model: Model,
    others: Sequence[Model | None],
    progress: Progress | None = None,
    states: Mapping[str, Array] | None = None,
) -> tuple[RecordingComparison, ...]:
    """Simulate every recording open loop with a model and with two others.

    Coordinates that cannot be right, and outliers, are left out of the recordings and counted.

    Args:
        experiment: the recordings.
        model: the identified one.
        others: the nominal one, and the torque method's; None where there is none.
        progress: told (text, done, total) while it runs.
        states: (2 nv,) most likely initial states, as far as they are known, by recording file.
    """
    report, known = progress or (lambda *_: None), states or {}
    report("replaying recordings", 0, 2)
    recordings = list(experiment.cleaned_recordings)
    simulated = _simulated(model, recordings, known)
    report("replaying recordings", 1, 2)
    trimmed = []
    for k, (recording, (fit, _)) in enumerate(zip(recordings, simulated, strict=True)):
        if fit is not None:
            recordings[k], count = without_outliers(recording, fit.simulation.markers, model.marker_noise)
            trimmed += [k] if count else []
    for k, again in zip(trimmed, _simulated(model, [recordings[k] for k in trimmed], known), strict=True):
        simulated[k] = again
    report("replaying recordings", 2, 2)
    # Others miss by more than the error of steps twice as long.
    columns = [
        [None] * len(recordings) if other is None else [fit for fit, _ in _simulated(other, recordings, {}, 2.0)]
        for other in others
    ]
    return tuple(
        RecordingComparison(
            recording=recording,
            noise=(model.marker_noise, model.encoder_noise),
            simulated=fit,
            reference=columns[0][k],
            alternative=columns[1][k],
            left_out=int(np.isfinite(experiment.recordings[k].markers).sum() - np.isfinite(recording.markers).sum()),
            problem=problem,
        )
        for k, (recording, (fit, problem)) in enumerate(zip(recordings, simulated, strict=True))
    )


def _simulated(
    model: Model, recordings: Sequence[Recording], states: Mapping[str, Array], step_multiple: float = 1.0
) -> list[tuple[SimulatedRecording | None, str]]:
    """Each recording's simulation, or why there is none."""
    if not recordings:
        return []
    try:
        known = [states.get(recording.file) for recording in recordings]
        return [(fit, "") for fit in model.replays(recordings, known, step_multiple)]
    except (InsufficientDataError, SimulationDivergedError) as error:
        if len(recordings) == 1:
            return [(None, str(error))]
    return [_simulated(model, [recording], states, step_multiple)[0] for recording in recordings]


def compare_modes(chain: Chain, data: TrainingData) -> tuple[ModeComparison, ...]:
    """Compare a chain's modes with the measured ones: up to the last measured one, and all that the markers show."""
    found = modes(chain, data.payload)
    shapes = _model_shapes(chain, data.rig, data.payload)
    alike = [one for one in data.prepared if one.recording.payload == data.payload]
    rows = []
    for frequency, ratio, shape in zip(found.frequencies.tolist(), found.damping_ratios.tolist(), shapes, strict=True):
        value, std, damping = match(frequency, data.modes, MODE_TOLERANCE) or (None, None, None)
        measured = _measured_shape(data.rig, frequency, alike, data.modes)
        rows.append(
            ModeComparison(
                frequency_model=frequency,
                frequency_measured=value,
                frequency_std=std,
                damping_model=ratio,
                damping_measured=damping,
                mac=None if measured is None else _modal_assurance(shape, measured),
            )
        )
    last = max([k + 1 for k, row in enumerate(rows) if row.frequency_measured is not None], default=0)
    return tuple(rows[: max(last, *data.shape.orders)])


def _model_shapes(chain: Chain, rig: Rig, payload: float) -> Array:
    """(m, k) lateral deflections of the markers in their link frames, in each mode of the model."""
    angles = modes(chain, payload).shapes
    rows = []
    for link, own, part in zip(chain.links, rig.links, chain.passive_slices, strict=True):
        slope = curve_map(link, own.markers).jacobian(np.zeros(link.virtual_joints))
        rows.append(slope[:, 1] @ angles[part])
    return np.concatenate(rows).T


def _modal_assurance(model: Array, measured: Complex) -> float:
    """MAC of two shapes (k,): one where they agree up to a factor, zero where they are orthogonal."""
    power = np.vdot(model, model).real * np.vdot(measured, measured).real
    return float(np.abs(np.vdot(model, measured)) ** 2 / max(power, 1e-300))


def _measured_shape(
    rig: Rig, frequency: float, prepared: Sequence[PreparedRecording], measured: Sequence[MeasuredModes]
) -> Complex | None:
    """(k,) deflection of all markers in the measured mode nearest to a frequency [Hz]; None where none is near.

    Of all recordings, and of free and forced motion, the one shape that explains most.
    """
    parts = []
    for one, known in zip(prepared, measured, strict=True):
        if not known.frequencies.size:
            continue
        nearest = int(np.argmin(np.abs(known.frequencies - frequency)))
        if abs(known.frequencies[nearest] / frequency - 1) < MODE_TOLERANCE:
            pairs = zip(rig.links, one.angles.shapes, strict=True)
            lateral = np.hstack([shape.evaluate(link.markers) for link, shape in pairs])
            parts.append(mode_shapes(one.angles.time, lateral, known, one.driving_torque)[nearest])
    if not parts:
        return None
    shape: Complex = np.linalg.svd(np.concatenate(parts, axis=1), full_matrices=False)[0][:, 0]
    return shape
