"""Natural modes of a model beside those measured in the recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vjm.chain.curve import curve_map
from vjm.chain.virtual_links import Chain
from vjm.experiment.spectrum import MeasuredModes, match, mode_shapes
from vjm.identification.records import ModeComparison
from vjm.identification.torque_method import MODE_TOLERANCE
from vjm.identification.training_data import PreparedRecording, TrainingData
from vjm.model.modes import modes
from vjm.records import Array, Complex, Rig


def compare_modes(chain: Chain, data: TrainingData) -> tuple[ModeComparison, ...]:
    """Compare a chain's modes with the measured ones: up to the last measured one, and all that the markers show."""
    found = modes(chain, data.payload)
    shapes = _model_shapes(chain, data.rig, data.payload)
    alike = [one for one in data.prepared if one.recording.payload == data.payload]
    rows = []
    for frequency, ratio, shape in zip(found.frequencies.tolist(), found.damping_ratios.tolist(), shapes, strict=True):
        mode = match(frequency, data.modes, MODE_TOLERANCE)
        measured = _measured_shape(data.rig, frequency, alike, data.modes)
        rows.append(
            ModeComparison(
                frequency_model=frequency,
                frequency_measured=None if mode is None else mode.frequency,
                frequency_std=None if mode is None else mode.frequency_std,
                damping_model=ratio,
                damping_measured=None if mode is None else mode.damping_ratio,
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
