"""A sinusoid in a residual, and what a quiet record is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from vjm.records import Array
from vjm.symptoms.records import Estimate
from vjm.symptoms.regression import estimate
from vjm.symptoms.signals import Channels, centred

_LEAST_FRAMES = 24
_OVERSAMPLING = 4  # of the spectrum, for the frequency of a peak
_LEAST_PERIODS = 2.0  # of a tone in the recording
_NEIGHBOURS = 12  # lines on either side whose median is the background
_SAME_BAND = 0.15  # of its frequency
_FALSE_ALARM = 1e-3  # chance that white noise passes the limit drawn in a spectrum
_BIASED = 0.03  # relative error of the noise that was given


class Spectrum(NamedTuple):
    """Amplitudes of a residual, root mean square over all coordinates.

    Attributes:
        frequency: (L,) [Hz].
        amplitude: (L,) of a sine in every coordinate [m or rad].
        white: what white noise of the known size would give; and
        limit: what it would pass anywhere in one recording of a thousand.
    """

    frequency: Array
    amplitude: Array
    white: float
    limit: float


@dataclass(frozen=True)
class Tone:
    """A sinusoid in a residual.

    Attributes:
        frequency: [Hz], with the standard error that white noise leaves.
        amplitude: of the coordinate that shows it most [m or rad].
        sensor: that coordinate.
        simulated: how much the simulation swings there [m or rad].
        described: misfit that it describes, in units of the noise squared.
    """

    frequency: Estimate
    amplitude: Estimate
    sensor: str
    simulated: float
    described: float


@dataclass(frozen=True)
class Quiet:
    """A sensor while nothing moves.

    Attributes:
        recording: index.
        channels: the sensor.
        size: root mean square over the noise that was given, less one.
        colour: correlation of one value with the next, any tone taken out.
        tone: a sinusoid that is certainly there; None where there is none.
        spectrum: of the residual; None where there are too few frames.
        described: misfit beyond the noise that was given, and that a value's dependence on the one before describes.
    """

    recording: int
    channels: Channels
    size: Estimate
    colour: Estimate
    tone: Tone | None
    spectrum: Spectrum | None
    described: tuple[float, float]


def quiet(index: int, channels: Channels) -> Quiet:
    """Size, colour and tone of a sensor's residual while nothing moves.

    Args:
        index: of the recording.
        channels: the sensor.
    """
    left = centred(channels.residual, channels.known)
    count = int(channels.known.sum()) - len(channels.names)
    chi2 = float(np.sum(left**2))
    ratio = np.sqrt(chi2 / max(count, 1)) - 1
    found = tone(channels, left, white=True)
    rest = left if found is None else left - _sine(channels, left, found.frequency.value)[0]
    pairs = channels.known[1:] & channels.known[:-1]
    powers = [max(float(np.sum(each**2 * pairs)), 1e-300) for each in (rest[1:], rest[:-1])]
    colour = float(np.sum(rest[1:] * rest[:-1] * pairs)) / float(np.sqrt(powers[0] * powers[1]))
    std = float(max(int(pairs.sum()), 1)) ** -0.5
    return Quiet(
        index,
        channels,
        estimate(float(ratio), float(np.hypot(np.sqrt(0.5 / max(count, 1)), _BIASED)), 0.0, 1),
        estimate(colour, std, 0.0, 1),
        found,
        spectrum(channels, left),
        (max(chi2 - count, 0.0), colour**2 * powers[0]),
    )


def tone(channels: Channels, left: Array, white: bool, bands: Sequence[float] = ()) -> Tone | None:
    """The largest sinusoid in a residual, if it stands out of what is beside it in the spectrum.

    Args:
        channels: the sensor.
        left: (F, C) the residual in units of the noise, zero where not measured.
        white: whether its background can only be white noise, independent in each coordinate.
        bands: frequencies [Hz] near which it is not looked for, since the simulation moves there.
    """
    found = _lines(channels, left, _OVERSAMPLING)
    if found is None:
        return None
    frequency, power = found
    lowest = _LEAST_PERIODS / float(channels.time[-1] - channels.time[0])
    apart = [np.abs(frequency - band) > max(_LEAST_PERIODS * lowest, _SAME_BAND * band) for band in bands]
    inside = (frequency >= lowest) & (frequency < 0.98 * frequency[-1])
    allowed = np.flatnonzero(np.logical_and.reduce([inside, *apart]))
    if not allowed.size:
        return None
    best = int(allowed[np.argmax(power[allowed])])
    chance = _chance(power, best, len(channels.names), white) * allowed.size / _OVERSAMPLING
    peak = _refined(channels, left, float(frequency[best]), float(frequency[1] - frequency[0]))
    sine, amplitudes = _sine(channels, left, peak)
    strongest = int(np.argmax(np.abs(amplitudes)))
    counts = channels.known.sum(axis=0)
    described = float(np.sum(sine * (2 * left - sine)))
    duration = float(channels.time[-1] - channels.time[0])
    signal = max(float(np.sum(counts * np.abs(amplitudes) ** 2)), 1e-300)
    size = float(np.abs(amplitudes[strongest])) * channels.noise
    rest = max(float(np.sum((left - sine) ** 2)) / max(int(counts.sum()), 1), 1.0)
    std = channels.noise * float(np.sqrt(2 * rest / counts[strongest]))
    value = Estimate(peak, float(np.sqrt(6 * rest / signal)) / (np.pi * duration), min(chance, 1.0))
    amplitude = Estimate(size, std, min(chance, 1.0))
    there = _swing(channels, strongest, peak)
    return Tone(value, amplitude, channels.names[strongest], there, described) if amplitude.sure else None


def spectrum(channels: Channels, left: Array) -> Spectrum | None:
    """Amplitude spectrum of a residual beside white noise; None where there are too few frames.

    Args:
        channels: the sensor.
        left: (F, C) the residual in units of the noise, zero where not measured.
    """
    found = _lines(channels, left, 1)
    if found is None:
        return None
    frequency, power = found
    white = channels.noise * float(np.sqrt(np.mean(4 / channels.known.sum(axis=0))))
    freedom = 2 * len(channels.names)
    limit = white * float(np.sqrt(special.chdtri(freedom, _FALSE_ALARM / frequency.size) / freedom))
    return Spectrum(frequency, white * np.sqrt(power), white, limit)


def _lines(channels: Channels, left: Array, oversampling: int) -> tuple[Array, Array] | None:
    """Frequencies (L,) [Hz], and mean power (L,) of the coordinates in units of white noise's."""
    time = channels.time
    if time.size < _LEAST_FRAMES:
        return None
    place = np.round((time - time[0]) / channels.step).astype(np.intp)
    count = int(place[-1]) + 1
    even = np.zeros((count, left.shape[1]))
    even[place] = left / np.sqrt(channels.known.sum(axis=0))
    size = oversampling * count
    power = np.mean(np.abs(np.fft.rfft(even, size, axis=0)[1:-1]) ** 2, axis=1)
    return np.asarray(np.fft.rfftfreq(size, channels.step)[1:-1], dtype=np.float64), power


def _chance(power: Array, best: int, columns: int, white: bool) -> float:
    """Chance that a line of the spectrum is as strong as the strongest."""
    near = np.abs(np.arange(power.size) - best)
    beside = power[(near > 2 * _OVERSAMPLING) & (near <= _NEIGHBOURS * _OVERSAMPLING)]
    background = max(float(np.median(beside)) if beside.size else 1.0, 1.0)
    ratio = float(power[best]) / background
    # White noise is independent in every coordinate; what a model misses may be the same in all of them.
    return float(special.chdtrc(2 * columns, 2 * columns * ratio)) if white else float(np.exp(-ratio * np.log(2)))


def _refined(channels: Channels, left: Array, peak: float, step: float) -> float:
    """Frequency at which a sine describes most, near the peak of a spectrum: the top of a parabola [Hz]."""
    places = peak + step * np.array([-1.0, 0.0, 1.0])
    below, at, above = (float(np.sum(_sine(channels, left, max(each, step / 2))[0] ** 2)) for each in places)
    bend = below - 2 * at + above
    return peak + step * float(np.clip(0.5 * (below - above) / bend, -1, 1)) if bend < 0 else peak


def _swing(channels: Channels, column: int, frequency: float) -> float:
    """Amplitude of the simulation at a frequency, through a window that lets nothing slower in [m or rad]."""
    time = channels.time
    window = np.sin(np.pi * (time - time[0]) / (time[-1] - time[0])) ** 4
    motion = channels.simulated[:, column] - np.average(channels.simulated[:, column], weights=window)
    wave = np.exp(-2j * np.pi * frequency * time)
    return float(2 * np.abs(np.sum(window * motion * wave)) / np.sum(window))


def _sine(channels: Channels, left: Array, frequency: float) -> tuple[Array, NDArray[np.complex128]]:
    """(F, C) the sine of a frequency in every coordinate, zero where not measured, and its complex amplitudes (C,)."""
    angle = 2 * np.pi * frequency * channels.time
    pair = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    known = channels.known.astype(float)
    normal = np.einsum("fc,fa,fb->cab", known, pair, pair) + 1e-9 * np.eye(2)
    found = np.linalg.solve(normal, (left.T @ pair)[:, :, None])[:, :, 0]
    return (pair @ found.T) * known, found[:, 0] - 1j * found[:, 1]
