"""Values from which searches for periodic effects start: peaks of the residuals' spectrum over time, or joint angle."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from vjm.effects.effect import Effect, JointEffect, Parameter
from vjm.errors import ShapeError
from vjm.model.modes import linearise
from vjm.records import REFERENCE, Array, Complex, Recording
from vjm.simulation.integrate import phi_functions
from vjm.simulation.run import Run, by_recording

_MOST_PEAKS = 3  # more tones at once have not been met

Peaks = tuple[list[float], float]  # the highest ones, and the number of independent values searched


def spectral_starts(
    parameter: Parameter, variants: Sequence[Effect], runs: Sequence[Run], over_time: Callable[[], Peaks]
) -> tuple[tuple[Effect, ...], float]:
    """Return variants of a periodic effect, at each place those of the highest peaks, and the tests each counts as.

    Args:
        parameter: the one whose values are the peaks: a frequency, or a number of waves in a turn.
        variants: one for each place at least.
        runs: simulations of recordings or of their segments.
        over_time: gives the peaks over time, as `temporal_peaks` does.
    """
    starts: list[Effect] = []
    independent = 0.0
    for variant in {variant.link: variant for variant in variants}.values():
        if parameter.from_spectrum == "joint_angle":
            peaks, count = _angular_peaks(variant, runs)
        else:
            peaks, count = over_time()
        independent += count
        changes: list[dict[str, Any]] = [{parameter.name: peak} for peak in peaks]
        starts += [replace(variant, **change) for change in changes]
    return tuple(starts), max(independent / max(len(starts), 1), 1.0)


def _angular_peaks(variant: Effect, runs: Sequence[Run]) -> Peaks:
    """Return numbers of waves in a turn whose torques explain most of the residuals, and how many are independent.

    The response to a torque is that of the arm's modes about rest.

    Raises:
        ShapeError: the effect is not at an active joint.
    """
    if not isinstance(variant, JointEffect):
        raise ShapeError(f"{variant.id}.from_spectrum", "joint_angle", "an effect at an active joint, or `time`")
    kinds = [(run, run.observed.recording) for run in runs]
    acting = [run for run, recording in kinds if recording.condition != REFERENCE and recording.kind != "quiet"]
    angles: dict[str, list[Array]] = {}
    fastest = 0.0  # rad of joint in half an interval of the derivatives
    for run in acting:
        path, joint = run.trajectory, variant.active_joint(run.chain)
        angles.setdefault(run.observed.recording.file, []).append(path.q[:, joint])
        fastest = max(fastest, float(np.abs(path.v[:, joint]).max()) * path.step * run.stride)
    turn = max((float(np.ptp(np.concatenate(parts))) for parts in angles.values()), default=0.0)
    (parameter,) = (parameter for parameter in variant.parameters if parameter.from_spectrum)
    resolution = 2 * np.pi / max(turn, 1e-9)  # the lowest number has one wave in the largest turn
    # Up to 2 rad of a wave in half an interval of the derivatives, whose error is then 1 % (2^4 / 2880).
    lowest, highest = max(resolution, parameter.lower), min(2.0 / max(fastest, 1e-9), parameter.upper)
    counts = np.arange(lowest, highest, resolution / 2)  # between two of them a peak loses 19 % at most
    if not counts.size:
        return [], 0.0
    normal, score = np.zeros((counts.size, 2, 2)), np.zeros((counts.size, 2))
    for run in acting:
        response, residual = _wave_responses(run, variant.active_joint(run.chain), counts)
        parts = response.real, response.imag
        normal += np.array([[np.sum(first * second, axis=0) for second in parts] for first in parts]).transpose(2, 0, 1)
        score += np.column_stack([residual @ part for part in parts])
    power = np.einsum("ci,cij,cj->c", score, np.linalg.pinv(normal), score)
    peaks: list[float] = []
    for k in np.argsort(power)[::-1].tolist():
        if len(peaks) < _MOST_PEAKS and all(abs(counts[k] - peak) > resolution for peak in peaks):
            peaks.append(float(counts[k]))
    return peaks, float(highest - lowest) / resolution


def _joint_angle(run: Run, joint: int) -> Array:
    """Return the angle (S + 1,) of a joint at the simulation's instants [rad]: measured or, failing that, simulated.

    Where a turn has many waves, a simulation that is a little off soon has the wrong phase.
    """
    recording, path = run.observed.recording, run.trajectory
    theta = recording.theta[:, int(np.searchsorted(run.chain.active, joint))]
    known = np.isfinite(theta)
    return np.interp(path.time, recording.time[known], theta[known]) if known.any() else path.q[:, joint]


def _wave_responses(run: Run, joint: int, counts: Array) -> tuple[Complex, Array]:
    """Return the predictions' responses (N, C) to torques exp(i count q) (C,) at a joint, and the residuals (N,).

    Both are weighted, and the modes' free motion from any initial state is projected out of them.
    """
    observed, path, chain = run.observed, run.trajectory, run.chain
    recording = run.arm.inputs(observed.recording)
    _, D, K, _ = linearise(chain, recording.payload, recording.gravity, recording.initial_theta)
    shapes = run.basis.shapes[:, : run.basis.slow_count]
    m, c = shapes.shape[1], counts.size
    oscillators = np.zeros((m, 2, 2))
    oscillators[:, 0, 1] = 1.0
    oscillators[:, 1, 0], oscillators[:, 1, 1] = (-np.diag(shapes.T @ matrix @ shapes) for matrix in (K, D))
    flow, phi1, phi2, _ = phi_functions(oscillators, path.step, 1)
    # Torques that are linear over each step.
    start_weights, end_weights = (path.step * shapes[joint, :, None] * phi[:, :, 1] for phi in (phi1 - phi2, phi2))
    waves = np.exp(1j * np.multiply.outer(_joint_angle(run, joint), counts))
    state = np.zeros((m, 2, c + 2 * m), dtype=complex)
    state[np.repeat(range(m), 2), np.tile((0, 1), m), c + np.arange(2 * m)] = 1.0
    moved = np.empty((len(path.time), m, c + 2 * m), dtype=np.complex64)  # memory takes the time
    moved[0] = state[:, 0]
    for k, (before, after) in enumerate(pairwise(waves)):
        state = flow @ state
        state[:, :, :c] += start_weights[..., None] * before + end_weights[..., None] * after
        moved[k + 1] = state[:, 0]

    def at(time: Array) -> Complex:
        k = np.clip(((time - path.time[0]) / path.step).astype(int), 0, len(path.time) - 2)
        share = ((time - path.time[k]) / path.step)[:, None, None]
        return np.asarray(moved[k] + share.astype(np.float32) * (moved[k + 1] - moved[k]))

    frames = observed.recording.time[observed.frames]
    slopes = observed.arcs.jacobian(run.arm, path.angles(frames), path.elapsed(frames), shapes)
    markers = (slopes @ at(frames)).reshape(-1, c + 2 * m)[observed.marker_indices]
    instants, joints = np.divmod(observed.angle_indices, max(chain.active.size, 1))
    by_mode = shapes[chain.active[joints]] if joints.size else np.zeros((0, m))
    angles = np.einsum("nm,nmc->nc", by_mode, at(observed.recording.time[instants]))
    columns = observed.whitened(observed.weights[:, None] * np.concatenate([markers, angles]))
    free = np.linalg.qr(columns[:, c:].real)[0]
    response = columns[:, :c] - free @ (free.T @ columns[:, :c])
    return np.asarray(response, dtype=complex), run.residual - free @ (free.T @ run.residual)


def temporal_peaks(recordings: Sequence[Recording], runs: Sequence[Run]) -> Peaks:
    """Return frequencies of the residuals' highest spectral peaks [Hz], and how many independent ones were searched.

    Peaks of quiet recordings, where nothing else moves, and of all together, where joints are free to move.
    """
    time = max((recording.time[recording.frames] for recording in recordings), key=lambda t: float(np.ptp(t)))
    duration, step = float(np.ptp(time)), float(np.median(np.diff(time)))
    highest = 0.45 / step  # nearer to half the sampling rate, a tone cannot be distinguished from its image
    frequencies = np.arange(1 / duration, highest, 1 / (4 * duration))  # between two of them a peak loses 5 % at most
    peaks: list[float] = []
    for chosen in ([run for run in runs if run.observed.recording.kind == "quiet"], runs):
        power, first = _power(chosen, frequencies), len(peaks)
        for k in np.argsort(power)[::-1].tolist() if chosen else ():
            # Half the width of the main lobe of Hann's window (Harris, Proceedings of the IEEE 66, 1978).
            if all(abs(frequencies[k] - peak) > 2.0 / duration for peak in peaks):
                peaks.append(float(frequencies[k]))
            if len(peaks) == first + _MOST_PEAKS:
                break
    return peaks, duration * highest


def _power(runs: Sequence[Run], frequencies: Array) -> Array:
    """Return the power (F,) of the residuals of all recordings, marker coordinates and encoders together."""
    power = np.zeros(frequencies.size)
    for parts in by_recording(runs).values():
        grids = [(run.observed.recording.time, *run.observed.on_grid(run.residual)) for run in parts]
        frames = [time[run.observed.frames] for run, (time, _, _) in zip(parts, grids, strict=True)]
        end = max(float(time[-1]) for time, _, _ in grids) - parts[0].observed.began
        for times, residuals in (
            (frames, [markers for _, markers, _ in grids]),
            ([time for time, _, _ in grids], [angles for _, _, angles in grids]),
        ):
            instants, residual = np.concatenate(times) - parts[0].observed.began, np.concatenate(residuals)
            known = np.isfinite(residual).any(axis=1)
            if known.any():
                # Hann's window: what drifts slowly must not leak into all other frequencies.
                window = np.sin(np.pi * instants[known] / max(end, 1e-300)) ** 2
                windowed = window[:, None] * np.nan_to_num(residual[known])
                spectrum = _fourier_transform(instants[known], windowed, frequencies)
                power += np.sum(np.abs(spectrum) ** 2, axis=1) / np.sum(window**2)
    return power


def _fourier_transform(time: Array, values: Array, frequencies: Array) -> Complex:
    """Return the Fourier sums (F, c) of values (T, c) at any instants (T,) [s], at evenly spaced frequencies [Hz].

    Each frequency is one of few coarse ones and one of few fine ones, so that 2 F^(1/2) T exponentials do for F T.
    """
    fine = math.isqrt(frequencies.size - 1) + 1
    fine_phases = np.exp(-2j * np.pi * np.outer(frequencies[:fine] - frequencies[0], time))
    coarse_phases = np.exp(-2j * np.pi * np.outer(frequencies[::fine], time))
    shifted = (fine_phases[:, :, None] * values).transpose(1, 0, 2).reshape(time.size, -1)
    return np.asarray((coarse_phases @ shifted).reshape(-1, values.shape[1])[: frequencies.size])
