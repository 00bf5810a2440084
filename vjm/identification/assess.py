"""How good a model is: torque errors, natural frequencies and open-loop replays beside the measurements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vjm.chain.records import Chain
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.experiment.records import Experiment, Recording
from vjm.identification.prepare import Prepared
from vjm.identification.records import ModeComparison, RecordingFit, TorqueData
from vjm.identification.torque_fit import Progress, TorqueFit, noise_factor, seen_errors, whiten
from vjm.model import Model
from vjm.modes import modes
from vjm.simulate.initial_state import Replay
from vjm.spectrum import MeasuredModes, match
from vjm.torque import torque_errors

MATCH_TOLERANCE = 0.15  # a measured frequency this close to the model's is the same mode


def objective(fit: TorqueFit) -> float:
    """J at the minimum: mean weighted square of a row's torque error."""
    return float(np.sum([np.sum(r**2) for r in fit.residuals]) / np.sum([r.size for r in fit.residuals]))


def objective_of(chain: Chain, fit: TorqueFit, found: Chain) -> float:
    """J of another chain under the same weights, those of the found parameters."""
    residuals = [whiten(seen_errors(chain, one), noise_factor(found, one)) for one in fit.prepared]
    return float(np.sum([np.sum(r**2) for r in residuals]) / np.sum([r.size for r in residuals]))


def torque_data(prepared: Prepared, nominal: Chain, found: Chain) -> TorqueData:
    """One recording with its torque errors before and after."""
    recording, d = prepared.recording, prepared.derivatives
    before, after = (
        torque_errors(chain, d.value, d.rate, d.acceleration, prepared.torque, recording.payload, recording.gravity)
        for chain in (nominal, found)
    )
    return TorqueData(recording, prepared.angles, d, prepared.torque, before, after)


def compare_modes(
    chain: Chain, payload: float, seen: Sequence[MeasuredModes], least: int
) -> tuple[ModeComparison, ...]:
    """The model's modes beside the measured ones: all up to the last measured one, and at least `least`."""
    found = modes(chain, payload)
    rows = []
    for frequency, ratio in zip(found.frequencies, found.damping_ratios, strict=True):
        mode = match(float(frequency), seen, MATCH_TOLERANCE)
        rows.append(
            ModeComparison(
                float(frequency),
                None if mode is None else mode.frequency,
                None if mode is None else mode.frequency_std,
                float(ratio),
                None if mode is None else mode.damping_ratio,
            )
        )
    last = max([k + 1 for k, row in enumerate(rows) if row.frequency_measured is not None], default=0)
    return tuple(rows[: max(last, least)])


def fit_recordings(
    experiment: Experiment, model: Model, nominal: Model | None, progress: Progress | None = None
) -> tuple[RecordingFit, ...]:
    """Open-loop replay of every recording by the model and, for comparison, by the nominal one."""
    fits = []
    total = len(experiment.recordings)
    for k, recording in enumerate(experiment.recordings):
        if progress is not None:
            progress("replaying recordings", k, total)
        replayed, problem = _replay(model, recording)
        compared = _replay(nominal, recording)[0] if nominal is not None and replayed is not None else None
        fits.append(RecordingFit(recording, replayed, compared, model.marker_noise, model.encoder_noise, problem))
    if progress is not None:
        progress("replaying recordings", total, total)
    return tuple(fits)


def _replay(model: Model, recording: Recording) -> tuple[Replay | None, str]:
    try:
        return model.replay(recording), ""
    except (InsufficientDataError, SimulationDivergedError) as error:
        return None, str(error)
