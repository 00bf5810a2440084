"""How good a model is: torque errors, natural frequencies and open-loop replays beside the measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vjm.chain.curve import curve_map
from vjm.chain.layout import chain_layouts
from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.experiment.spectrum import MeasuredModes, match, mode_shapes
from vjm.identification.outliers import without_outliers
from vjm.identification.prepare import Data, Prepared, driving_torque, prepare
from vjm.identification.records import ModeComparison, TorqueData
from vjm.identification.torque_method import MATCH_TOLERANCE, noise_factor, seen_errors, whiten
from vjm.model.modes import modes
from vjm.model.torque import objective, torque_errors
from vjm.records import Array, Complex, Experiment, Progress, Recording, RecordingComparison, Rig, SimulatedRecording
from vjm.simulation.model import Model


def model_shapes(chain: Chain, rig: Rig, payload: float) -> Array:
    """(m, k) lateral deflections of the markers in their link frames, in each mode of the model."""
    found = modes(chain, payload).shapes
    rows = []
    for link, own, part in zip(chain.links, rig.links, chain.passive_slices, strict=True):
        slope = curve_map(link, own.markers).jacobian(np.zeros(link.virtual_joints))
        rows.append(slope[:, 1] @ found[part])
    return np.concatenate(rows).T


def assurance(model: Array, measured: Complex) -> float:
    """MAC of two shapes (k,): one where they are the same up to a factor, zero where they have nothing in common."""
    power = np.vdot(model, model).real * np.vdot(measured, measured).real
    return float(np.abs(np.vdot(model, measured)) ** 2 / max(power, 1e-300))


def measured_shape(
    rig: Rig, frequency: float, tolerance: float, prepared: Sequence[Prepared], seen: Sequence[MeasuredModes]
) -> Complex | None:
    """(k,) the deflection of all markers in the measured mode nearest to a frequency [Hz]; None where none is near.

    Of all recordings, and of free and forced motion, the one shape that explains most.
    """
    parts = []
    for one, found in zip(prepared, seen, strict=True):
        if not found.frequencies.size:
            continue
        nearest = int(np.argmin(np.abs(found.frequencies - frequency)))
        if abs(found.frequencies[nearest] / frequency - 1) < tolerance:
            torque = driving_torque(one.recording)
            parts.append(mode_shapes(one.angles.time, _lateral(rig, one), found, torque)[nearest])
    if not parts:
        return None
    left, _, _ = np.linalg.svd(np.concatenate(parts, axis=1), full_matrices=False)
    shape: Complex = left[:, 0]
    return shape


def _lateral(rig: Rig, prepared: Prepared) -> Array:
    """(F, k) the shape functions' lateral deflections at the markers, in the link frames [m]."""
    pairs = zip(rig.links, prepared.angles.shapes, strict=True)
    return np.hstack([shape.evaluate(link.markers) for link, shape in pairs])


_COARSE = 2.0  # times the integrator's default step, for models that miss by more than its error anyway


def prepared_for(chain: Chain, rig: Rig, data: Data) -> tuple[Prepared, ...]:
    """The recordings' angles and derivatives at a chain's own cuts."""
    cuts = chain_layouts(chain)
    same = all(
        np.array_equal(one.lengths, two.lengths) and np.array_equal(one.cells, two.cells)
        for one, two in zip(cuts, data.plan.cuts, strict=True)
    )
    if same:
        return data.prepared
    return tuple(prepare(rig, cuts, one.recording, data.settings, one) for one in data.prepared)


def objective_of(chain: Chain, prepared: Sequence[Prepared], found: Chain) -> float | None:
    """J of a chain: mean square of its torque errors under the weights of the chain found; None without recordings."""
    if not prepared:
        return None
    return objective(whiten(seen_errors(chain, one), noise_factor(found, one)) for one in prepared)


def torque_data(prepared: Prepared, nominal: Chain, found: Chain) -> TorqueData:
    """One recording with its torque errors before and after."""
    recording, d = prepared.recording, prepared.derivatives
    before, after = (
        torque_errors(chain, d.value, d.rate, d.acceleration, prepared.torque, recording.payload, recording.gravity)
        for chain in (nominal, found)
    )
    return TorqueData(recording, prepared.angles, d, prepared.torque, before, after)


def compare_modes(
    model: Model, payload: float, prepared: Sequence[Prepared], seen: Sequence[MeasuredModes], least: int
) -> tuple[ModeComparison, ...]:
    """The model's modes beside the measured ones: all up to the last measured one, and at least `least`.

    Args:
        model: the identified one.
        payload: that of the recordings compared with [kg].
        prepared: the recordings; those with another payload are left out.
        seen: modes of those with the payload, in order.
        least: number of modes.
    """
    found = modes(model.chain, payload)
    shapes = model_shapes(model.chain, model.rig, payload)
    alike = [one for one in prepared if one.recording.payload == payload]
    rows = []
    for frequency, ratio, shape in zip(found.frequencies, found.damping_ratios, shapes, strict=True):
        mode = match(float(frequency), seen, MATCH_TOLERANCE)
        measured = measured_shape(model.rig, float(frequency), MATCH_TOLERANCE, alike, seen)
        rows.append(
            ModeComparison(
                frequency_model=float(frequency),
                frequency_measured=None if mode is None else mode.frequency,
                frequency_std=None if mode is None else mode.frequency_std,
                damping_model=float(ratio),
                damping_measured=None if mode is None else mode.damping_ratio,
                mac=None if measured is None else assurance(shape, measured),
            )
        )
    last = max([k + 1 for k, row in enumerate(rows) if row.frequency_measured is not None], default=0)
    return tuple(rows[: max(last, least)])


def fit_recordings(
    experiment: Experiment,
    model: Model,
    others: Sequence[Model | None],
    progress: Progress | None = None,
    states: Mapping[str, Array] | None = None,
) -> tuple[RecordingComparison, ...]:
    """Open-loop replay of every recording by the model and, when they are asked for, by others to compare it with.

    Coordinates that cannot be right, and outliers, are left out of the recordings and counted.

    Args:
        experiment: the recordings.
        model: the identified one.
        others: the nominal one, and the torque method's; None where there is none.
        progress: told (text, done, total) while it runs.
        states: (2 nv,) most likely initial states, as far as they are known, by recording file.
    """
    tell = progress or (lambda *_: None)
    tell("replaying recordings", 0, 2)
    recordings = experiment.cleaned_recordings
    replayed = _replayed(model, recordings, states or {})
    kept, again = list(recordings), []
    tell("replaying recordings", 1, 2)
    for k, (recording, (found, _)) in enumerate(zip(recordings, replayed, strict=True)):
        if found is not None:
            kept[k], count = without_outliers(recording, found.simulation.markers, model.marker_noise)
            again += [k] if count else []
    for k, repeated in zip(again, _replayed(model, [kept[k] for k in again], states or {}), strict=True):
        replayed[k] = repeated
    tell("replaying recordings", 2, 2)
    reference, alternative = (_simulated_by(other, kept) for other in others)
    noise = (model.marker_noise, model.encoder_noise)
    return tuple(
        RecordingComparison(
            recording=recording,
            noise=noise,
            simulated=simulated,
            reference=reference[k],
            alternative=alternative[k],
            left_out=_measured(experiment.recordings[k]) - _measured(recording),
            problem=problem,
        )
        for k, (recording, (simulated, problem)) in enumerate(zip(kept, replayed, strict=True))
    )


def _measured(recording: Recording) -> int:
    """Number of marker coordinates."""
    return int(np.isfinite(recording.markers).sum())


def _simulated_by(model: Model | None, recordings: Sequence[Recording]) -> list[SimulatedRecording | None]:
    """Simulations by a model to compare with; None where there is no model, or it cannot simulate a recording."""
    if model is None:
        return [None] * len(recordings)
    return [simulated for simulated, _ in _replayed(model, recordings, {}, _COARSE)]


def _replayed(
    model: Model, recordings: Sequence[Recording], states: Mapping[str, Array], step_multiple: float = 1.0
) -> list[tuple[SimulatedRecording | None, str]]:
    """Each recording's replay, or why there is none."""
    if not recordings:
        return []
    try:
        return [
            (each, "") for each in model.replays(recordings, [states.get(r.file) for r in recordings], step_multiple)
        ]
    except (InsufficientDataError, SimulationDivergedError) as error:
        if len(recordings) == 1:
            return [(None, str(error))]
    return [_replayed(model, [each], states, step_multiple)[0] for each in recordings]
