"""The cameras' noise: how large it is and how it is correlated in time, told from what no motion of the arm can be.

Markers move together, along what the arm's slow modes and joints make of them; each marker's noise is its own. What is
left of the frames' residuals outside that is noise, in a quiet recording first of all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import solve_toeplitz

from vjm.records import Array
from vjm.simulation.measurement import Observed, sampled
from vjm.simulation.run import Run

Indices = NDArray[np.int_]

_LAGS = 8  # frames
_MOST_ORDER = 4
_CERTAIN = 4.0  # standard errors of a partial correlation that is no accident
_LEAST_FRAMES = 60
_LONGEST_GAP = 40  # frames over which a correlation is followed
_TURNS = 12  # Newton steps from where a simulation has an arm to where its markers are
_LARGEST_TURN = 0.3  # rad of a joint a step
_STILL = 1e-3  # rad; closer, slopes tell the rest
_CLIP = 3.5  # robust standard deviations: an outlier is no noise


@dataclass(frozen=True)
class Noise:
    """A camera's noise.

    Attributes:
        size: 1-sigma of a marker coordinate as the recordings show it [m]; None where they cannot.
        colour: (p,) autoregression from one frame to the next; empty where it is white.
        source: in words, where this is from.
    """

    size: float | None
    colour: Array
    source: str


def camera_noise(runs: Sequence[Run]) -> Noise:
    """From recordings that a model follows, quiet ones where there are any.

    Args:
        runs: simulations beside what was measured.
    """
    quiet = [run for run in runs if run.observed.recording.kind == "quiet"]
    chosen = quiet or list(runs)
    found = [part for part in map(_outside, chosen) if part is not None]
    if not found:
        return Noise(None, np.zeros(0), "taken as white: too few markers to tell noise from motion")
    where = (
        "the quiet recording" + "s" * (len(quiet) > 1) if quiet else "the moving recordings, there being no quiet one"
    )
    size, correlation, count = _correlation(found)
    colour = _autoregression(correlation, count)
    kind = "white" if not colour.size else f"coloured (lag-one correlation {correlation[1]:.2f})"
    return Noise(size, colour, f"{kind}, {1e3 * size:.2g} mm, judged from {where}")


def _outside(run: Run) -> tuple[Array, Array, float] | None:
    """Frames' numbers (F,), residuals (F, c) [m] outside what the arm can do, and the share of freedom that leaves."""
    seen = run.observed
    if seen.frames.size < _LEAST_FRAMES:
        return None
    markers = seen.recording.markers[seen.frames].reshape(seen.frames.size, -1)
    channels = np.isfinite(markers).mean(axis=0) > 0.5
    complete = np.isfinite(markers[:, channels]).all(axis=1)
    time = seen.recording.time[seen.frames][complete]
    directions = run.basis.shapes[:, : run.basis.slow]
    if time.size < _LEAST_FRAMES or channels.sum() <= directions.shape[1]:
        return None
    # A model that lacks much may have moved the arm anywhere; encoders and markers say where it is.
    moved = sampled(run.steps, time)
    for joint, theta in zip(run.chain.active, seen.recording.theta.T, strict=True):
        known = np.isfinite(theta)
        if known.any():
            moved[:, joint] = np.interp(time, seen.recording.time[known], theta[known])
    straight = moved.copy()
    straight[:, run.chain.passive] = 0.0
    ways = [_beside(run, q, directions, markers[complete], channels) for q in (moved, straight)]
    nearer = np.argmin([np.sum(each**2, axis=1) for each in ways], axis=0)
    residual = np.where(nearer[:, None] == 0, *ways)
    ticks = np.round((time - time[0]) / np.median(np.diff(time)))
    return ticks, residual - residual.mean(axis=0), 1 - directions.shape[1] / channels.sum()


def _beside(run: Run, q: Array, directions: Array, markers: Array, channels: NDArray[np.bool_]) -> Array:
    """(F, c) residuals [m] of marker coordinates (F, 2 k) beside the arm where Newton's steps from q (F, nv) lead."""
    residual = np.zeros(0)
    for _ in range(_TURNS):
        shown = run.observed.arcs.shown(run.arm, q).reshape(len(q), -1)[:, channels]
        slopes = run.observed.arcs.slope(run.arm, q, directions)[:, channels]
        off = markers[:, channels] - shown
        change = (np.linalg.pinv(slopes) @ off[:, :, None])[:, :, 0]
        residual = off - (slopes @ change[:, :, None])[:, :, 0]
        turn = change @ directions.T
        most = np.abs(turn).max(axis=1, keepdims=True)
        q = q + turn * np.minimum(1.0, _LARGEST_TURN / np.maximum(most, 1e-300))
        if most.max() < _STILL:
            break
    return residual


def _correlation(found: Sequence[tuple[Array, Array, float]]) -> tuple[float, Array, int]:
    """Noise of a coordinate [m], its autocorrelation at lags 0 to _LAGS, and the number of values behind it."""
    power, products, counts = 0.0, np.zeros(_LAGS + 1), np.zeros(_LAGS + 1)
    weight = 0.0
    for ticks, residual, share in found:
        scale = 1.4826 * np.median(np.abs(residual))
        kept = np.clip(residual, -_CLIP * scale, _CLIP * scale)
        power, weight = power + float(np.sum(kept**2)), weight + share * kept.size
        numbers = ticks.astype(int)
        spread = np.full((numbers[-1] + 1, kept.shape[1]), np.nan)
        spread[numbers] = kept
        for lag in range(_LAGS + 1):
            pairs = spread[lag:] * spread[: len(spread) - lag]
            known = np.isfinite(pairs)
            products[lag] += np.sum(pairs[known])
            counts[lag] += share * known.sum()
    mean = products / np.maximum(counts, 1.0)
    return float(np.sqrt(power / weight)), mean / max(mean[0], 1e-300), int(counts[0])


def _autoregression(correlation: Array, count: int) -> Array:
    """(p,) Yule and Walker's coefficients, of the largest order whose partial correlation is no accident."""
    for order in range(_MOST_ORDER, 0, -1):
        coefficients = solve_toeplitz(correlation[:order], correlation[1 : order + 1])
        if abs(coefficients[-1]) > _CERTAIN / np.sqrt(max(count, 1)):
            return np.asarray(coefficients)
    return np.zeros(0)


def whitened(observed: Observed, noise: Noise) -> Observed:
    """The same measurements with their noise made white.

    Each coordinate is predicted from the last frames in which it was seen, however long ago; what cannot be predicted
    of it is white. Encoders are taken to be white.
    """
    if not noise.colour.size or not observed.markers.size:
        return observed
    covariance = _covariance(noise.colour)
    frames, channels = np.divmod(observed.markers, 2 * observed.recording.markers.shape[1])
    time = observed.recording.time[observed.frames]
    ticks = np.round((time - time[0]) / np.median(np.diff(time))).astype(int)
    order = noise.colour.size
    rows, columns, values = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0)]
    for channel in np.unique(channels):
        own = np.flatnonzero(channels == channel)
        for row, column, value in _predictors(own, ticks[frames[own]], order, covariance):
            rows.append(row)
            columns.append(column)
            values.append(value)
    rest = np.arange(observed.markers.size, observed.count)
    matrix = sparse.csr_array(
        (
            np.concatenate([*values, np.ones(rest.size)]),
            (np.concatenate([*rows, rest]), np.concatenate([*columns, rest])),
        ),
        shape=(observed.count, observed.count),
    )
    return replace(observed, whitening=matrix)


def _covariance(colour: Array) -> Array:
    """Autocorrelation of an autoregression at lags 0 to _LONGEST_GAP."""
    order = colour.size
    # The first lags solve Yule and Walker's equations; the recursion gives the others.
    system = np.eye(order + 1)
    for lag in range(order + 1):
        for k in range(order):
            system[lag, abs(lag - k - 1)] -= colour[k]
    found = np.zeros(_LONGEST_GAP + 1)
    found[: order + 1] = np.linalg.solve(system, np.r_[1.0, np.zeros(order)])
    for lag in range(order + 1, _LONGEST_GAP + 1):
        found[lag] = colour @ found[lag - order : lag][::-1]
    result: Array = found / found[0]
    return result


def _predictors(
    own: Indices, ticks: Indices, order: int, covariance: Array
) -> Iterator[tuple[Indices, Indices, Array]]:
    """Entries (row, column, value) of the whitening of one coordinate, for each pattern of frames before."""
    count = own.size
    before = np.full((count, order), -1)
    for k in range(order):
        lag = ticks[k + 1 :] - ticks[: count - k - 1]
        before[k + 1 :, k] = np.where(lag <= _LONGEST_GAP, lag, -1)
    patterns, which = np.unique(before, axis=0, return_inverse=True)
    for p, pattern in enumerate(patterns):
        at = np.flatnonzero(which.ravel() == p)
        lags = pattern[pattern > 0]
        inside = covariance[np.abs(lags[:, None] - lags[None, :])]
        weights = np.linalg.solve(inside, covariance[lags]) if lags.size else np.zeros(0)
        left = np.sqrt(max(1 - float(weights @ covariance[lags]), 1e-6))
        yield own[at], own[at], np.full(at.size, 1 / left)
        for k, weight in enumerate(weights.tolist()):
            yield own[at], own[at - k - 1], np.full(at.size, -weight / left)
