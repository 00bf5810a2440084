"""Camera noise: its standard deviation and autocorrelation, from residuals that no motion of the arm can explain.

An arm moves its markers along a few directions, those of its joints and slow modes, and a shaking camera moves all of
them together; the noise of the markers is independent. Each frame's residuals are therefore projected onto the
orthogonal complement of these directions, in quiet recordings where there are any. An autoregression by Yule and
Walker's equations (Brockwell and Davis, Time Series: Theory and Methods, section 8.1) describes the correlation from
frame to frame, and whitens the residuals of all later fits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import sparse

from vjm.experiment.spectrum import LEAST_NOISE
from vjm.records import Array, Indices, Mask
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run
from vjm.text import number

_MAX_ORDER = 4  # of the autoregression; cameras filter over a few frames
_MIN_FRAMES = 60  # a standard deviation is known within 10 % from so many (1/sqrt(2 N))
_MAX_LAG = 40  # frames; over these a lag-one correlation of 0.9 has fallen to 0.015


@dataclass(frozen=True)
class Noise:
    """Noise of the camera."""

    std: float | None  # standard deviation of a marker coordinate [m]; None where the recordings do not determine it
    autoregression: Array  # (p,) coefficients from frame to frame; empty for white noise
    source: str  # how it was determined, in words

    @classmethod
    def of(cls, runs: Sequence[Run]) -> Self:
        """Estimate the noise from quiet recordings, or from all if there is none; the runs' model may be wrong."""
        quiet = [run for run in runs if run.observed.recording.kind == "quiet"]
        residuals = [part for part in map(_projected_residuals, quiet or runs) if part is not None]
        if not residuals:
            return cls(None, np.zeros(0), "assumed white: too few markers to separate noise from motion")
        source = "the moving recordings (no quiet one)"
        if quiet:
            source = "the quiet recording" + "s" * (len(quiet) > 1)
        std, correlation, count = _autocorrelation(residuals)
        least = LEAST_NOISE * max(link.length for link in runs[0].chain.links)
        if std < least:
            return cls(least, np.zeros(0), f"none: recordings exact to {number(1e3 * least, 2)} mm")
        coefficients = _autoregression(correlation, count)
        kind = f"coloured (lag-one correlation {correlation[1]:.2f})" if coefficients.size else "white"
        return cls(std, coefficients, f"{kind}, {number(1e3 * std, 2)} mm, estimated from {source}")

    def whitened(self, observed: Observations) -> Observations:
        """Return measurements with a matrix that whitens the noise of their markers; encoder noise is taken as white.

        Each coordinate is predicted by the autoregression from the last frames in which it was measured, across gaps
        too. The prediction errors over their standard deviations are white.
        """
        if not self.autoregression.size or not observed.marker_indices.size:
            return observed
        from statsmodels.tsa.arima_process import ArmaProcess  # takes a second to import

        correlation = ArmaProcess.from_coeffs(self.autoregression).acf(_MAX_LAG + 1)  # from lag 0 on
        frames, coordinates = np.divmod(observed.marker_indices, 2 * observed.recording.markers.shape[1])
        numbers = _frame_numbers(observed.recording.time[observed.frames])
        encoders = np.arange(observed.marker_indices.size, observed.count)
        entries = [(encoders, encoders, np.ones(encoders.size))]
        for channel in np.unique(coordinates):
            values = np.flatnonzero(coordinates == channel)
            entries += _prediction_errors(values, numbers[frames[values]], self.autoregression.size, correlation)
        rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
        shape = (observed.count, observed.count)
        return replace(observed, whitening=sparse.csr_array((values, (rows, columns)), shape=shape))


def _projected_residuals(run: Run) -> tuple[Indices, Array, float] | None:
    """Return frame numbers (F,), projected residuals (F, c) [m], and degrees of freedom per value, if enough."""
    observed = run.observed
    if observed.frames.size < _MIN_FRAMES:
        return None
    markers = observed.recording.markers[observed.frames].reshape(observed.frames.size, -1)
    coordinates = np.isfinite(markers).mean(axis=0) > 0.5
    complete = np.isfinite(markers[:, coordinates]).all(axis=1)
    time = observed.recording.time[observed.frames][complete]
    directions = run.basis.shapes[:, : run.basis.slow_count]
    if time.size < _MIN_FRAMES or coordinates.sum() <= directions.shape[1]:
        return None
    measured = markers[complete]
    shifts = _camera_shifts(measured, coordinates, directions.shape[1], len(run.chain.links))
    # An incomplete model may simulate the arm far from where it was. The fits start from the encoders' angles, with the
    # links bent as simulated and straight.
    simulated = run.trajectory.angles(time)
    for joint, theta in zip(run.chain.active, observed.recording.theta.T, strict=True):
        known = np.isfinite(theta)
        if known.any():
            simulated[:, joint] = np.interp(time, observed.recording.time[known], theta[known])
    straight = simulated.copy()
    straight[:, run.chain.passive] = 0.0
    residual, ranks = _fit_frames(run, time, simulated, directions, shifts, measured, coordinates)
    other, other_ranks = _fit_frames(run, time, straight, directions, shifts, measured, coordinates)
    better = np.sum(residual**2, axis=1) <= np.sum(other**2, axis=1)
    residual, ranks = np.where(better[:, None], residual, other), np.where(better, ranks, other_ranks)
    share = 1 - float(ranks.mean()) / coordinates.sum()
    return (_frame_numbers(time), residual - residual.mean(axis=0), share) if share > 0 else None


def _camera_shifts(markers: Array, coordinates: Mask, motions: int, links: int) -> Array:
    """Return the s directions (F, c, s) in which a shaking camera moves the c marker coordinates of each frame.

    With more markers than motions they are both axes. With as few markers as motions on a single link, a shift across
    the link cannot be told from a motion, and only the direction along the link is left.
    """
    frames, count = len(markers), int(coordinates.sum())
    axes = np.tile(np.eye(2), (markers.shape[1] // 2, 1))[coordinates]
    if coordinates.reshape(-1, 2).any(axis=1).sum() > motions:
        return np.broadcast_to(axes, (frames, *axes.shape))
    if links > 1 or count <= motions + 1 or not axes.any(axis=0).all():
        return np.zeros((frames, count, 0))
    radial = (markers[:, coordinates] @ axes) / axes.sum(axis=0)  # mean position of the markers, from the base
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    return np.asarray(radial @ axes.T)[:, :, None]


def _fit_frames(
    run: Run, time: Array, q: Array, directions: Array, shifts: Array, markers: Array, coordinates: Mask
) -> tuple[Array, Indices]:
    """Fit each frame's marker coordinates (F, 2 k) by Gauss-Newton, from angles q (F, nv).

    The unknowns are changes of the angles along directions (nv, m), and shifts of the coordinates (F, c, s).

    Returns:
        Residuals (F, c) [m]; and the numbers (F,) of independent ones among these directions and shifts. In its own
        frame a link's turn moves no marker, and where y alone is measured, neither does a shift along x.
    """
    residual, ranks, elapsed = np.zeros(0), np.zeros(len(q), dtype=np.intp), run.trajectory.elapsed(time)
    rounding = np.sqrt(np.finfo(float).eps)  # of the largest: what moves the markers by less does not move them
    for _ in range(12):  # steps are limited at first, and converge quadratically near the solution
        predicted = run.observed.arcs.measured_positions(run.arm, q, elapsed).reshape(len(q), -1)[:, coordinates]
        slopes = run.observed.arcs.jacobian(run.arm, q, elapsed, directions)[:, coordinates]
        slopes = np.concatenate([slopes, shifts], axis=2)
        difference = markers[:, coordinates] - predicted
        change = (np.linalg.pinv(slopes, rcond=rounding) @ difference[:, :, None])[:, :, 0]
        sizes = np.linalg.svd(slopes, compute_uv=False)
        ranks = np.count_nonzero(sizes > rounding * sizes[:, :1], axis=1)
        residual = difference - (slopes @ change[:, :, None])[:, :, 0]
        turn = change[:, : directions.shape[1]] @ directions.T
        largest = np.abs(turn).max(axis=1, keepdims=True)
        q = q + turn * np.minimum(1.0, 0.3 / np.maximum(largest, 1e-300))  # rad; sin x = x within 1.5 % up to there
        if largest.max() < 1e-3:  # rad; the linear residual is then right to 1e-6 of the arm's length
            break
    return residual, ranks


def _frame_numbers(time: Array) -> Indices:
    """Return the numbers (F,) of frames taken at instants (F,) [s]; dropped frames are counted too.

    Each interval is rounded by itself: the errors of rounded time stamps do not add up.
    """
    intervals = np.diff(time)
    single = intervals[intervals < 1.5 * np.median(intervals)].mean()  # of frames between which none was dropped
    numbers: Indices = np.r_[0, np.cumsum(np.maximum(np.round(intervals / single), 1))].astype(int)
    return numbers


def _autocorrelation(residuals: Sequence[tuple[Indices, Array, float]]) -> tuple[float, Array, int]:
    """Return the noise of a coordinate [m], its autocorrelation up to the largest order, and the degrees of freedom."""
    lags = range(_MAX_ORDER + 1)
    products, counts = np.zeros(len(lags)), np.zeros(len(lags))
    for numbers, residual, share in residuals:
        # Outliers are clipped at 3.5 standard deviations of each coordinate (1.4826 MAD), which normal noise exceeds
        # once in 2,000 times. They differ among coordinates, as the projection takes more from some than from others.
        limit = 3.5 * 1.4826 * np.median(np.abs(residual), axis=0)
        clipped = np.clip(residual, -limit, limit)
        series = np.full((numbers[-1] + 1, clipped.shape[1]), np.nan)  # a dropped frame is a row of NaN
        series[numbers] = clipped
        for lag in lags:
            pairs = series[lag:] * series[: len(series) - lag]
            products[lag] += np.nansum(pairs)
            counts[lag] += share * np.isfinite(pairs).sum()
    mean = products / np.maximum(counts, 1.0)
    return float(np.sqrt(mean[0])), mean / max(mean[0], 1e-300), int(counts[0])


def _autoregression(correlation: Array, count: int) -> Array:
    """Return Yule and Walker's coefficients (p,), up to the last lag with a significant partial autocorrelation."""
    from statsmodels.tsa.stattools import levinson_durbin  # takes a second to import

    _, _, partial, _, coefficients = levinson_durbin(correlation, _MAX_ORDER, isacov=True)
    # Four standard errors of 1/sqrt(N), which chance exceeds once in 16,000 times.
    # Below one, as those of any stationary process: what exact recordings leave is no noise at all.
    stationary = np.logical_and.accumulate(np.abs(partial[1:]) < 1)
    significant = np.flatnonzero(stationary & (np.abs(partial[1:]) > 4 / np.sqrt(max(count, 1))))
    order = int(significant[-1]) + 1 if significant.size else 0
    return np.asarray(coefficients[1 : order + 1, order])


def _prediction_errors(
    values: Indices, numbers: Indices, order: int, correlation: Array
) -> Iterator[tuple[Indices, Indices, Array]]:
    """Yield entries (row, column, value) of the whitening of one coordinate, by pattern of earlier frames."""
    count = values.size
    lags_before = np.full((count, order), -1)
    for k in range(order):
        lag = numbers[k + 1 :] - numbers[: count - k - 1]
        lags_before[k + 1 :, k] = np.where(lag <= _MAX_LAG, lag, -1)
    patterns, inverse = np.unique(lags_before, axis=0, return_inverse=True)
    for index, pattern in enumerate(patterns):
        rows = np.flatnonzero(inverse.ravel() == index)
        lags = pattern[pattern > 0]
        correlation_matrix = correlation[np.abs(lags[:, None] - lags[None, :])]
        weights = np.linalg.solve(correlation_matrix, correlation[lags]) if lags.size else np.zeros(0)
        std = np.sqrt(max(1 - float(weights @ correlation[lags]), 1e-6))  # of noise that is next to deterministic
        yield values[rows], values[rows], np.full(rows.size, 1 / std)
        for k, weight in enumerate(weights.tolist()):
            yield values[rows], values[rows - k - 1], np.full(rows.size, -weight / std)
