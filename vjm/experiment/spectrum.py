"""Sensor noise, natural frequencies and damping ratios of the recordings themselves.

A recording is a sum of damped oscillations, free ones from its start and, where a torque was measured, the responses
of the same oscillators to it. Peaks of the spectrum start a nonlinear least-squares fit of frequencies and damping
ratios, finer than a bin, everything linear (amplitudes, phases, offsets) being projected out (variable projection).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats
from scipy.optimize import least_squares
from scipy.signal import lfilter, periodogram

from vjm.experiment.checks import DEFAULT_NOISE
from vjm.experiment.records import Array, Complex, Recording, Rig

# Of a link's length, and of an angle of one radian: exact data still need a finite weight, at which errors of
# simulations hide (1e-8 after an abrupt start).
LEAST_NOISE = 1e-7


def sensor_noise(rig: Rig, recordings: Sequence[Recording]) -> tuple[float, float]:
    """Return marker noise [m] and encoder noise [rad]: the experiment's, else as measured, else as much as may be."""
    length = max(link.length for link in rig.links)
    markers, encoder = measured_noise(recordings)
    markers = max(markers, LEAST_NOISE * length) if np.isfinite(markers) else DEFAULT_NOISE * length
    encoder = max(encoder, LEAST_NOISE) if np.isfinite(encoder) else DEFAULT_NOISE
    return rig.marker_noise or markers, rig.encoder_noise or encoder


def measured_noise(recordings: Sequence[Recording]) -> tuple[float, float]:
    """Return marker noise [m] and encoder noise [rad], medians over recordings; NaN where they do not show it.

    Where there are quiet recordings, only these are used, unless a sensor reads the same value throughout. Rounding to
    steps q, of which an arm at rest shows nothing, is a noise of q / sqrt(12) at least (W. R. Bennett, Bell System
    Technical Journal 27, 1948).
    """
    quiet = [recording.kind == "quiet" for recording in recordings]
    markers = [recording.markers.reshape(recording.time.size, -1) for recording in recordings]
    return _median_noise(markers, quiet), _median_noise([recording.theta for recording in recordings], quiet)


def _median_noise(signals: Sequence[Array], quiet: Sequence[bool]) -> float:
    noise = np.array([white_noise(samples) for samples in signals])
    for chosen in (np.array(quiet), np.isfinite(noise)):
        if np.isfinite(noise[chosen]).any():
            return max(float(np.nanmedian(noise[chosen])), _resolution(signals) / 12**0.5)
    return float("nan")


def _resolution(signals: Sequence[Array]) -> float:
    """Return the smallest step between two values of one column of signals (T, m)."""
    columns = np.concatenate(signals).T
    steps = [np.diff(np.unique(column[np.isfinite(column)])) for column in columns]
    return min((float(step.min()) for step in steps if step.size), default=0.0)


def white_noise(samples: Array) -> float:
    """Return the 1-sigma of the white part of evenly sampled signals (T, m), without those that are constant.

    NaN if all are, and for fewer than 16 complete rows.
    """
    known = np.isfinite(samples)
    least = np.min(samples, axis=0, where=known, initial=np.inf)
    values = samples[:, (known & (samples > least)).any(axis=0)]
    values = values[np.isfinite(values).all(axis=1)]
    if not values.size or len(values) < 16:
        return float("nan")
    # Ends that differ would leak over the whole spectrum: the window and the second difference of a line take that out.
    line = np.linspace(0, 1, len(values))[:, None]
    detrended = values - values[:1] * (1 - line) - values[-1:] * line
    # Bins hold noise power times an exponential variate; the few with motion do not move a low quantile of them.
    power = periodogram(detrended, window="blackmanharris", detrend=False, axis=0)[1][4:-1] / 2  # of both sides
    low = 0.3  # of the spectrum's bins: motion fills few of them, noise fills all
    return float(np.sqrt(np.quantile(power, low) / -np.log(1 - low)))


_RECENT = 16  # oscillators whose motion is kept: a step of a fit asks for that of each several times


class Oscillators:
    """Basis functions of oscillators with given frequencies and damping ratios, at the camera's instants (T,) [s].

    The torque is instants (U,) [s] and torques (U, n_a) [N m]; None for free motion.
    """

    def __init__(self, time: Array, torque: tuple[ArrayLike, ArrayLike] | None) -> None:
        self.time = time - time[0] if time.size else time
        self.inputs: list[Array] = []
        self._recent: dict[tuple[float, float], Array] = {}
        if torque is None or time.size == 0:
            return
        knots, values = np.asarray(torque[0], dtype=float), np.asarray(torque[1], dtype=float)
        step = float(np.median(np.diff(knots)))
        self.step = min(step, float(np.median(np.diff(time))))
        grid = np.arange(int(np.ceil(self.time[-1] / self.step)) + 2) * self.step
        for column in values.T:
            sampled = np.interp(time[0] + grid, knots, column)
            if np.ptp(sampled) > 0:
                self.inputs.append(sampled)

    def columns(self, values: Array) -> Array:
        """Return (T, 1 + 2 m (1 + inputs)): offset, free and forced motion of m oscillators (Hz, ratio) (m, 2)."""
        return np.hstack([np.ones((self.time.size, 1)), *(self.motion(*row) for row in values.tolist())])

    def motion(self, frequency: float, ratio: float) -> Array:
        """Return free and forced motion (T, 2 (1 + inputs)) of one oscillator [Hz], each at most one in size."""
        if (frequency, ratio) not in self._recent:
            pole = 2 * np.pi * frequency * (-ratio + 1j * np.sqrt(max(1 - ratio**2, 1e-12)))
            responses = self.responses(pole)
            sizes = np.maximum(np.abs(responses).max(axis=0), 1e-300)
            if len(self._recent) == _RECENT:
                del self._recent[next(iter(self._recent))]
            self._recent[frequency, ratio] = responses.view(float) / np.repeat(sizes, 2)
        return self._recent[frequency, ratio]

    def responses(self, pole: complex) -> Complex:
        """Return the free motion exp(pole t) of a pole [1/s] and its responses to the inputs, (T, 1 + inputs)."""
        return np.stack([np.exp(pole * self.time), *(self._forced(pole, signal) for signal in self.inputs)], axis=1)

    def _forced(self, pole: complex, signal: Array) -> Complex:
        """Return the response of z' = pole z + u at the camera's instants, exact for u linear between its samples."""
        h = self.step
        flow = np.exp(pole * h)
        first = (flow - 1) / pole
        second = (flow - 1 - pole * h) / (pole**2 * h)
        response = np.concatenate(
            [[0.0], lfilter([1.0], [1.0, -flow], (first - second) * signal[:-1] + second * signal[1:])]
        )
        # Between grid instants: exact propagation from the one before, with the torque frozen in its linear piece.
        k = np.minimum((self.time / h + 1e-9).astype(int), signal.size - 2)
        remainder = self.time - k * h
        decay = np.exp(pole * remainder)
        slope = (signal[k + 1] - signal[k]) / h
        zeroth = (decay - 1) / pole
        result: Complex = decay * response[k] + zeroth * signal[k] + (zeroth - remainder) / pole * slope
        return result


_FALSE_ALARM = 1e-6  # probability that noise alone shows a mode
_SEPARATION = 0.2  # relative; a peak closer to a known mode is part of that mode's
_MOST_FRAMES = 20_000  # of a longer recording, the part used
_LARGEST_STD = 0.1  # relative; a frequency less sure than this is no measurement


@dataclass(frozen=True)
class MeasuredModes:
    """Modes seen in one recording, slowest first."""

    frequencies: Array  # (m,) undamped natural frequencies [Hz]
    damping_ratios: Array  # (m,) fractions of critical damping
    frequency_std: Array  # (m,) standard errors [Hz]
    damping_std: Array  # (m,) standard errors


def measure_modes(
    time: ArrayLike, signals: ArrayLike, noise: float, most: int, torque: tuple[ArrayLike, ArrayLike] | None = None
) -> MeasuredModes:
    """Fit up to `most` modes to the deflections of one recording.

    Args:
        time: (T,) [s].
        signals: (T, c) lateral deflections in the link frames [m]; frames with NaN are left out.
        noise: 1-sigma of a signal [m].
        most: number of modes at most.
        torque: instants (U,) [s] and joint torques (U, n_a) [N m] that drove the motion; None for free motion.
    """
    t, y = _complete(time, signals)
    oscillators = Oscillators(t, torque)
    values = np.zeros((0, 2))
    residual, _ = _project(oscillators.columns(values), y)
    for _ in range(2 * most):
        if len(values) == most or len(t) <= 8 * (len(values) + 1):
            break
        start = _peak(t, residual / noise, values[:, 0] if len(values) else np.empty(0))
        if start is None:
            break
        values = _pruned(oscillators, y, noise, _fit(oscillators, y, noise, values, start))
        residual, _ = _project(oscillators.columns(values), y)
    std = _standard_errors(oscillators, y, values)
    order = np.argsort(values[:, 0])
    certain = order[std[order, 0] < _LARGEST_STD * values[order, 0]]
    return MeasuredModes(values[certain, 0], values[certain, 1], std[certain, 0], std[certain, 1])


def match(expected: float, measured: Sequence[MeasuredModes], tolerance: float) -> tuple[float, float, float] | None:
    """Return the measured mode nearest to an expected frequency [Hz], averaged over the recordings that show it.

    The largest relative distance is the tolerance. Frequency [Hz], its standard error [Hz] and the damping ratio are
    inverse-variance means; None where no mode is near.
    """
    tables = [
        np.stack([modes.frequencies, modes.frequency_std, modes.damping_ratios, modes.damping_std])
        for modes in measured
        if modes.frequencies.size
    ]
    nearest = [table[:, np.argmin(np.abs(table[0] - expected))] for table in tables]
    rows = [row for row in nearest if abs(row[0] / expected - 1) < tolerance]
    if not rows:
        return None
    f, f_std, d, d_std = np.array(rows).T
    floor = 5e-4 * f  # standard error below which recordings are not trusted: amplitudes differ between them
    weights = 1 / (f_std**2 + floor**2)
    ratio = np.average(d, weights=1 / np.maximum(d_std, 1e-6) ** 2)
    return float(np.average(f, weights=weights)), float(weights.sum() ** -0.5), float(ratio)


def mode_shapes(
    time: ArrayLike, signals: ArrayLike, modes: MeasuredModes, torque: tuple[ArrayLike, ArrayLike] | None = None
) -> Complex:
    """Return the deflection shapes of the m modes found in a recording; further arguments as in `measure_modes`.

    Returns:
        (m, c, r) deflections of the modes' free motion and of their response to each of r - 1 torques, as RMS values
        over the recording [m].
    """
    t, y = _complete(time, signals)
    values = np.column_stack([modes.frequencies, modes.damping_ratios])
    columns = Oscillators(t, torque).columns(values)
    _, amplitudes = _project(columns, y)
    sizes = np.sqrt(np.mean(columns**2, axis=0))
    pairs = (amplitudes[1:] * sizes[1:, None]).reshape(len(values), -1, 2, y.shape[1])
    return np.moveaxis(pairs[:, :, 0] - 1j * pairs[:, :, 1], 1, 2)


def _complete(time: ArrayLike, signals: ArrayLike) -> tuple[Array, Array]:
    """Return the frames in which everything was measured; of a very long recording, its beginning."""
    t, y = np.asarray(time, dtype=float), np.asarray(signals, dtype=float)
    complete = np.flatnonzero(np.isfinite(y).all(axis=1))[:_MOST_FRAMES]
    return t[complete], y[complete]


def _project(columns: Array, y: Array) -> tuple[Array, Array]:
    """Return the residual of y (T, c) after a least-squares fit by the columns, and the amplitudes."""
    amplitudes, *_ = np.linalg.lstsq(columns, y, rcond=1e-10)
    return y - columns @ amplitudes, np.asarray(amplitudes)


def _peak(time: Array, residual: Array, known: Array) -> float | None:
    """Return the frequency [Hz] of a residual's largest peak that is neither noise nor part of a known mode's."""
    step = float(np.median(np.diff(time)))
    count = round((time[-1] - time[0]) / step) + 1
    even = np.zeros((count, residual.shape[1]))
    even[np.clip(np.round((time - time[0]) / step).astype(int), 0, count - 1)] = residual
    frequency, density = periodogram(even, 1 / step, "hann", 4 * count, detrend=False, axis=0)
    power = density.sum(axis=1) / step
    allowed = frequency > 2 / (count * step)
    for mode in known:
        allowed &= np.abs(frequency / mode - 1) > _SEPARATION
    threshold = stats.chi2.isf(_FALSE_ALARM / count, 2 * residual.shape[1])
    power = np.where(allowed, power, 0.0)
    best = int(np.argmax(power))
    return float(frequency[best]) if power[best] > threshold else None


def _fit(oscillators: Oscillators, y: Array, noise: float, known: Array, start: float) -> Array:
    """Add a mode near `start` [Hz] and refine all of them, from the likeliest of a few first guesses."""
    top = 0.5 / float(np.median(np.diff(oscillators.time)))
    bin_width = 1 / max(float(oscillators.time[-1]), 1e-300)

    def residual(x: Array) -> Array:
        return _project(oscillators.columns(x.reshape(-1, 2)), y)[0].ravel() / noise

    # Damping of metals, of plastics and of joints; a padded peak is within a quarter of a bin of the frequency.
    pairs = product((0.002, 0.01, 0.05), (-0.25, 0.0, 0.25))
    guesses = [np.vstack([known, [start + shift * bin_width, ratio]]) for ratio, shift in pairs]
    first = min(guesses, key=lambda guess: float(np.sum(residual(guess) ** 2)))
    lower = np.column_stack([0.5 * first[:, 0], np.zeros(len(first))]).ravel()
    upper = np.column_stack([np.minimum(1.5 * first[:, 0], top), np.full(len(first), 0.7)]).ravel()
    scale = np.column_stack([first[:, 0], np.full(len(first), 1.0)]).ravel()
    initial = np.clip(first.ravel(), lower + 1e-9, upper - 1e-9)

    def slopes(x: Array) -> Array:
        return -projected_jacobian(oscillators, y, x.reshape(-1, 2)) / noise

    result = least_squares(residual, initial, slopes, bounds=(lower, upper), x_scale=1e-2 * scale, max_nfev=30)
    refined: Array = np.asarray(result.x).reshape(-1, 2)
    return refined


def projected_jacobian(oscillators: Oscillators, y: Array, values: Array, basis: Array | None = None) -> Array:
    """Return the slopes (T c, 2 m) of the fitted motion over frequencies and damping ratios, amplitudes projected out.

    The slopes of the projected residual but for a part that the residual is normal to, which leaves the gradient exact
    (L. Kaufman, A variable projection method for solving separable nonlinear least squares problems, BIT 15, 1975).
    An orthonormal basis (T, k) of further motion is projected out as well; y (T, c) is normal to it already.
    """
    columns = project_out(basis, oscillators.columns(values))
    _, amplitudes = _project(columns, y)
    slopes = []
    for pair, pair_amplitudes in zip(values, np.split(amplitudes[1:], len(values)), strict=True):
        here = oscillators.motion(*pair.tolist())
        for k, step in enumerate(1e-6 * np.maximum(np.abs(pair), 1e-3)):
            moved = pair.copy()
            moved[k] += step
            change = (oscillators.motion(*moved.tolist()) - here) / (moved[k] - pair[k])
            slopes.append((change @ pair_amplitudes).ravel())
    along = project_out(basis, np.stack(slopes, axis=1).reshape(len(y), -1))
    return _project(columns, along)[0].reshape(y.size, -1)


def project_out(basis: Array | None, columns: Array) -> Array:
    """Return columns (T, k) without what an orthonormal basis (T, b) explains of them; None: as they are."""
    return columns if basis is None else columns - basis @ (basis.T @ columns)


def _pruned(oscillators: Oscillators, y: Array, noise: float, values: Array) -> Array:
    """Drop the modes that later ones have made superfluous: they explain no more than noise would."""
    retained = values
    for row in values:
        reduced = retained[~(retained == row).all(axis=1)]
        sum_with, sum_without = (
            float(np.sum(_project(oscillators.columns(v), y)[0] ** 2)) / noise**2 for v in (retained, reduced)
        )
        freedom = 2 * (1 + len(oscillators.inputs)) * y.shape[1] + 2
        # A model error in the residual counts as noise here: a mode has to stand out of what is left anyway.
        scale = max(sum_with / y.size, 1.0)
        if (sum_without - sum_with) / scale < stats.chi2.isf(_FALSE_ALARM, freedom):
            retained = reduced
    return retained


def _standard_errors(oscillators: Oscillators, y: Array, values: Array) -> Array:
    """Return the (m, 2) standard errors of frequencies [Hz] and damping ratios, the residual itself taken as noise."""
    if len(values) == 0:
        return np.empty((0, 2))
    columns = oscillators.columns(values)
    residual, _ = _project(columns, y)
    matrix = projected_jacobian(oscillators, y, values)
    freedom = max(residual.size - columns.shape[1] * y.shape[1] - values.size, 1)
    covariance = np.linalg.pinv(matrix.T @ matrix) * float(np.sum(residual**2)) / freedom
    return np.sqrt(np.maximum(np.diag(covariance), 0)).reshape(-1, 2)
