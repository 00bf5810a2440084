"""Mode shapes: those of the model beside those of the recordings, by the modal assurance criterion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vjm.chain.curve import curve_map
from vjm.chain.records import Chain
from vjm.experiment.records import Rig
from vjm.identification.prepare import Prepared, driving_torque
from vjm.modes import modes
from vjm.spectrum import MeasuredModes, mode_shapes

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


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
