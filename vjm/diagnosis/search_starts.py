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
from vjm.simulation.exponential import phi_functions
from vjm.simulation.run import Run, by_recording, linearize

_MOST_PEAKS = 3  # more tones at once have not been met
_MOST_EXAMINED = 30  # highest peaks of the residuals' spectrum: with nine sidebands above it, a tone has been the tenth
# Share of a direction's square below which its projection leaves only rounding: slopes are right to 3e-4.
ABSORBED = 1e-7

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
    _, D, K, _ = linearise(chain, recording.payload_body, recording.gravity, recording.initial_theta)
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
    """Return frequencies of sines that explain most of the residuals [Hz], and how many independent ones were searched.

    Those of quiet recordings, where nothing else moves, and of all together, where joints are free to move. Some of the
    residuals' highest spectral peaks are sidebands of a tone: what initial states take up of it, segment by segment,
    leaves peaks at multiples of the segments' rate around its own, which may be higher. None of these explains more of
    the residuals than a sine of the tone's very frequency, once initial states have been projected out of the sines.
    """
    time = max((recording.time[recording.frames] for recording in recordings), key=lambda t: float(np.ptp(t)))
    duration, step = float(np.ptp(time)), float(np.median(np.diff(time)))
    highest = 0.45 / step  # nearer to half the sampling rate, a tone cannot be distinguished from its alias
    frequencies = np.arange(1 / duration, highest, 1 / (4 * duration))  # between two of them a peak loses 5 % at most
    # Half the width of the main lobe of Hann's window (Harris, Proceedings of the IEEE 66, 1978).
    distance = 2.0 / duration
    grouped = [*by_recording(runs).values()]
    quiet = [k for k, parts in enumerate(grouped) if parts[0].observed.recording.kind == "quiet"]
    choices = [chosen for chosen in (quiet, [*range(len(grouped))]) if chosen]
    power = np.stack([_power(parts, frequencies) for parts in grouped])
    examined = sorted(
        {f for k in choices for f in _first_apart(frequencies, power[k].sum(axis=0), distance, _MOST_EXAMINED)}
    )
    explained = np.stack([_explained(parts, np.array(examined)) for parts in grouped])
    peaks: list[float] = []
    for chosen in choices:
        peaks += _first_apart(examined, explained[chosen].sum(axis=0), distance, _MOST_PEAKS, peaks)
    return peaks, duration * highest


def _first_apart(
    frequencies: Array | Sequence[float], heights: Array, distance: float, count: int, known: Sequence[float] = ()
) -> list[float]:
    """Return those of frequencies (F,) with the highest values, apart by a distance, and from known ones."""
    found: list[float] = []
    for k in np.argsort(heights)[::-1].tolist():
        if all(abs(frequencies[k] - other) > distance for other in (*known, *found)):
            found.append(float(frequencies[k]))
        if len(found) == count:
            break
    return found


def _window(instants: Array, parts: Sequence[Run]) -> Array:
    """Return Hann's window (N,) over a recording: what drifts slowly must not leak into all other frequencies."""
    end = max(float(run.observed.recording.time[-1]) for run in parts) - parts[0].observed.began
    return np.asarray(np.sin(np.pi * instants / max(end, 1e-300)) ** 2)


def _power(parts: Sequence[Run], frequencies: Array) -> Array:
    """Return the power (F,) of a recording's residuals, marker coordinates and encoders together."""
    power, began = np.zeros(frequencies.size), parts[0].observed.began
    grids = [(run.observed.recording.time, *run.observed.on_grid(run.residual)) for run in parts]
    frames = [time[run.observed.frames] for run, (time, _, _) in zip(parts, grids, strict=True)]
    for times, residuals in (
        (frames, [markers for _, markers, _ in grids]),
        ([time for time, _, _ in grids], [angles for _, _, angles in grids]),
    ):
        instants, residual = np.concatenate(times) - began, np.concatenate(residuals)
        known = np.isfinite(residual).any(axis=1)
        if known.any():
            window = _window(instants[known], parts)
            spectrum = _fourier_transform(
                instants[known], window[:, None] * np.nan_to_num(residual[known]), frequencies
            )
            power += np.sum(np.abs(spectrum) ** 2, axis=1) / np.sum(window**2)
    return power


def _explained(parts: Sequence[Run], frequencies: Array) -> Array:
    """Return the decrease (F,) of a recording's windowed chi^2 by a sine of each frequency, initial states refitted.

    The sine has an amplitude and a phase of its own in each channel, a marker's coordinate or an encoder.
    """
    began, count, channels = parts[0].observed.began, frequencies.size, parts[0].observed.channel_count
    normal, score = np.zeros((count, 2, channels, 2, channels)), np.zeros((count, 2, channels))
    for run, linearization in zip(parts, linearize(parts, [()] * len(parts)), strict=True):
        slopes = np.empty((run.residual.size, 2 * run.basis.slow_count))
        for measured, chunk in run.jacobian(linearization):
            slopes[measured] = chunk
        free = np.linalg.qr(slopes)[0]
        instants = run.observed.recording.time[run.observed.instants] - began
        phases, window = 2 * np.pi * np.outer(frequencies, instants), _window(instants, parts)
        weighted_free, weighted_residual = (
            window * values.T for values in (free, run.residual - free @ (free.T @ run.residual))
        )
        # Products Q^T E and Q^T W E of cosines and sines E in each channel with the free motions Q and the window W.
        absorbed, weighted = np.zeros((2, count, free.shape[1], 2, channels))
        for channel in range(channels):
            rows = run.observed.channels == channel
            waves = np.stack([np.cos(phases[:, rows]), np.sin(phases[:, rows])], axis=1)
            absorbed[..., channel] = (waves @ free[rows]).swapaxes(1, 2)
            weighted[..., channel] = (waves @ weighted_free[:, rows].T).swapaxes(1, 2)
            normal[:, :, channel, :, channel] += (window[rows] * waves) @ waves.swapaxes(1, 2)
            score[..., channel] += waves @ weighted_residual[rows]
        absorbed, weighted = (part.reshape(count, -1, 2 * channels) for part in (absorbed, weighted))
        transposed = absorbed.swapaxes(1, 2)
        overlap = transposed @ weighted
        change = transposed @ (weighted_free @ free) @ absorbed - overlap - overlap.swapaxes(1, 2)
        normal += change.reshape(normal.shape)
        score -= (transposed @ (free.T @ weighted_residual)).reshape(score.shape)
    unknowns = 2 * channels
    inverse = np.linalg.pinv(normal.reshape(count, unknowns, unknowns), rcond=ABSORBED, hermitian=True)
    gradient = score.reshape(count, unknowns)
    return np.asarray(np.einsum("fi,fij,fj->f", gradient, inverse, gradient))


def _fourier_transform(time: Array, values: Array, frequencies: Array) -> Complex:
    """Return the Fourier sums (F, c) of values (T, c) at any instants (T,) [s], at evenly spaced frequencies [Hz].

    Each frequency is one of few coarse ones and one of few fine ones, so that 2 F^(1/2) T exponentials do for F T.
    """
    fine = math.isqrt(frequencies.size - 1) + 1
    fine_phases = np.exp(-2j * np.pi * np.outer(frequencies[:fine] - frequencies[0], time))
    coarse_phases = np.exp(-2j * np.pi * np.outer(frequencies[::fine], time))
    shifted = (fine_phases[:, :, None] * values).transpose(1, 0, 2).reshape(time.size, -1)
    return np.asarray((coarse_phases @ shifted).reshape(-1, values.shape[1])[: frequencies.size])
