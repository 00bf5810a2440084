"""Derivatives of what was measured by initial states and parameters: of the motion, and of how sensors show it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from vjm.simulate.arm import Arm
from vjm.simulate.basis import Basis
from vjm.simulate.observation import Observed, instants, sampled, view
from vjm.simulate.sensitivity import Moved, sensitivities
from vjm.simulate.steps import Steps, sample

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


def jacobian(
    observed: Observed, arm: Arm, basis: Basis, moved: Sequence[Moved], steps: Steps, stride: int
) -> Iterator[tuple[Indices, Array]]:
    """Weighted derivatives of what was measured, one stretch of time after another.

    Args:
        observed: what was measured.
        arm, basis, moved, steps, stride: as in `sensitivities`.

    Yields:
        What was measured in the stretch, (r,) indices of `observed.values`, and the derivatives (r, 2 slow + p) of its
        predictions, times their weights.
    """
    recording = observed.recording
    time = recording.time
    # Frames show the arm at instants of their own: what they show may have been in the stretch before, or the next.
    seen = instants(arm, observed.arcs, steps, time[observed.frames])
    late = time[observed.frames] - seen
    behind, ahead = float(np.max(late, initial=0.0)), float(np.max(-late, initial=0.0))
    first = 0
    part: Steps | None = None
    for stretch in sensitivities(arm, basis, moved, recording, steps, stride):
        part = stretch if part is None else _joined(part, stretch, behind + ahead)
        ends_here = part.time[-1] >= steps.time[-1]
        last = time.size if ends_here else int(np.searchsorted(time, part.time[-1] - ahead, side="left"))
        if last <= first:
            continue
        frames, markers, angles = observed.between(first, last)
        by_angles = _encoder_slopes(observed, arm, basis, moved, steps, part, angles)
        camera = slice(*np.searchsorted(observed.frames, (first, last)).tolist())
        by_markers = _marker_slopes(observed, arm, basis, moved, steps, part, seen[..., camera], time[frames])
        flat = by_markers.reshape(-1, by_markers.shape[2])
        derivatives = np.concatenate([flat[observed.markers[markers] - camera.start * by_markers.shape[1]], by_angles])
        measured = np.r_[markers, angles]
        yield measured, observed.weights[measured, None] * derivatives
        first = last


def _joined(before: Steps, after: Steps, overlap: float) -> Steps:
    """A stretch with the end of the one before."""
    if overlap <= 0:
        return after
    kept = before.time < after.time[0] - 1e-12
    kept &= before.time >= after.time[0] - overlap - 2 * after.step
    parts = ((getattr(before, name)[kept], getattr(after, name)) for name in ("time", "q", "v", "a", "z"))
    return Steps(*(np.concatenate(pair) for pair in parts))


def _marker_slopes(
    observed: Observed,
    arm: Arm,
    basis: Basis,
    moved: Sequence[Moved],
    steps: Steps,
    part: Steps,
    seen: Array,
    stamps: Array,
) -> Array:
    """(F, 2 k, 2 slow + p) derivatives of the marker coordinates of frames seen at instants (F,) or (k, F)."""
    arcs, path = observed.arcs, sampled(steps, seen)
    by_state = arcs.slope(arm, path, basis.shapes)
    if seen.ndim == 1:
        found = by_state @ np.swapaxes(sample(part, seen)[0], 1, 2)
    else:
        rates = np.stack([np.swapaxes(sample(part, own)[0], 1, 2) for own in seen], axis=1)
        shaped = by_state.reshape(len(by_state), len(seen), 2, by_state.shape[2])
        found = (shaped @ rates).reshape(len(by_state), 2 * len(seen), rates.shape[-1])
    base: Array | None = None
    for k, (other, by) in enumerate(moved):
        if _sees_alike(arm, other):
            continue
        base = arcs.shown(arm, path) if base is None else base
        there = view(other, arcs, steps, stamps)
        found[:, :, found.shape[2] - len(moved) + k] += ((there - base) / by).reshape(len(base), 2 * base.shape[1])
    return found


def _encoder_slopes(
    observed: Observed,
    arm: Arm,
    basis: Basis,
    moved: Sequence[Moved],
    steps: Steps,
    part: Steps,
    angles: slice,
) -> Array:
    """(r, 2 slow + p) derivatives of the encoders' values `angles`."""
    active = arm.chain.active
    offset = observed.markers.size
    flat = observed.angles[angles.start - offset : angles.stop - offset]
    rows, joints = np.divmod(flat, max(active.size, 1))
    if not flat.size:
        return np.zeros((0, part.q.shape[1]))
    by_active = basis.shapes[active].T
    told = Steps(part.time, part.q @ by_active, part.v @ by_active, part.a @ by_active, part.z)
    slope = sample(told, observed.recording.time[rows])[0]
    found: Array = np.take_along_axis(slope, joints[:, None, None], axis=2)[:, :, 0]
    for k, (other, by) in enumerate(moved):
        if other.sensors != arm.sensors:
            change = (observed.encoders(other, steps) - observed.encoders(arm, steps)) / by
            found[:, found.shape[1] - len(moved) + k] += change[angles.start - offset : angles.stop - offset]
    return found


def _sees_alike(arm: Arm, other: Arm) -> bool:
    """Whether two arms' markers are seen at the same places where their joints have the same angles."""
    return arm.sensors == other.sensors and all(
        np.array_equal(one.lengths, two.lengths)
        and np.array_equal(one.cells, two.cells)
        and one.rest_curvature == two.rest_curvature
        for one, two in zip(arm.chain.links, other.chain.links, strict=True)
    )
