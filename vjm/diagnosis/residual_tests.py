"""Tests of what a fitted model leaves of the recordings: is it noise, does it repeat, and which force resembles it?

White residuals of a right model have unit variance at every frequency. Their discrete cosine coefficients are summed
over octaves and compared with chi-square (a band-wise version of Bartlett's cumulated periodogram: Brockwell and
Davis, Time Series: Theory and Methods, section 10.2). The bands follow from the number of samples alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import stats
from scipy.fft import dct

from vjm.chain.virtual_links import Chain
from vjm.diagnosis.records import RepeatComparison, ResidualBand, ResidualTest
from vjm.diagnosis.screen import Screen
from vjm.effects.effect import Effect, LinkEffect, StateFunction, magnitude, shape_parameter
from vjm.identification.trajectory_fit import Point
from vjm.records import Array, Payload, Rig
from vjm.simulation.run import Run, by_recording

_LEAST_COEFFICIENTS = 20  # of a band: their sum of squares is then known within a third (sqrt(2/20))


def residual_test(runs: Sequence[Run]) -> ResidualTest:
    """Test whether the residuals of recordings are white noise of unit variance, by recording, sensor and octave.

    The p-value is twice the smaller one of the total's and the bands', which Bonferroni's correction makes one.
    """
    bands = sorted((band for run in runs for band in _bands(run)), key=lambda band: (band.p_value, -band.excess))
    if not bands:
        return ResidualTest((), 1.0, 0.0)
    excess, count = sum(band.excess for band in bands), sum(band.count for band in bands)
    total = float(stats.chi2.sf(excess + count, count))
    return ResidualTest(tuple(bands), min(1.0, 2 * min(bands[0].p_value * len(bands), total)), excess)


def _bands(run: Run) -> Iterator[ResidualBand]:
    """Yield octaves of one recording's sensors; the noise level is that of the upper half, in which no arm moves."""
    observed = run.observed
    markers, angles = observed.on_grid(run.residual)
    time = observed.recording.time
    for sensor, series, instants in (("markers", markers, time[observed.frames]), ("encoder", angles, time)):
        rows = np.isfinite(series).any(axis=1)
        is_input = sensor == "encoder" and observed.encoders_are_input
        if is_input or rows.sum() < 2 * _LEAST_COEFFICIENTS:
            continue
        known = np.isfinite(series[rows])
        channels = known.all(axis=0) if known.all(axis=0).any() else known.mean(axis=0) > 0.5
        squares = dct(np.nan_to_num(series[rows][:, channels]), axis=0, norm="ortho") ** 2
        period = 2 * max(float(np.ptp(instants[rows])), 1e-300)  # coefficient k has k/2 periods
        upper = len(squares) // 2
        noise = float(np.clip(np.mean(squares[upper:]), 1.0, 1.3))  # more than a misjudged noise is a signal there
        while upper:
            lower = upper // 2 if squares[: upper // 2].size >= _LEAST_COEFFICIENTS else 0
            count, statistic = squares[lower:upper].size, float(squares[lower:upper].sum()) / noise
            chance, frequencies = float(stats.chi2.sf(statistic, count)), (lower / period, upper / period)
            yield ResidualBand(observed.recording.file, sensor, frequencies, count, statistic - count, chance)
            upper = lower


def compare_repeats(runs: Sequence[Run]) -> RepeatComparison | None:
    """Compare the residuals of recordings that share a `repeat` label, each with the next; None where there are none.

    The runs are of recordings, or of their segments, each from an initial state of its own.
    """
    sums, differences = np.zeros(0), np.zeros(0)
    for first, second in _repeated_residuals(runs):
        sums, differences = np.r_[sums, first + second], np.r_[differences, first - second]
    if sums.size < 100:  # an RMS is then known within 7 % (1/sqrt(2 N))
        return None
    common, individual = (float(np.sqrt(np.mean(part**2) / 2)) for part in (sums, differences))
    return RepeatComparison(common, individual, runs[0].observed.noise[0])


def _repeated_residuals(runs: Sequence[Run]) -> Iterator[tuple[Array, Array]]:
    """Yield pairs of residuals (N,), (N,) of the same marker coordinates at the same instants since the start."""
    for label in sorted({label for run in runs if (label := run.observed.recording.repeat) is not None}):
        repeats = by_recording([run for run in runs if run.observed.recording.repeat == label]).values()
        for (times, residuals), (later_times, later_residuals) in pairwise(map(_marker_residuals, repeats)):
            if times.size < 2 or later_times.size < 2:
                continue
            nearest = np.clip(np.searchsorted(later_times, times), 1, later_times.size - 1)
            nearest -= (times - later_times[nearest - 1]) < (later_times[nearest] - times)
            # A tenth of a frame: within it an arm moves a tenth of what one frame shows of it.
            together = np.abs(later_times[nearest] - times) < 0.1 * np.median(np.diff(times))
            first, second = residuals[together], later_residuals[nearest[together]]
            measured = np.isfinite(first) & np.isfinite(second)
            yield first[measured], second[measured]


def _marker_residuals(runs: Sequence[Run]) -> tuple[Array, Array]:
    """Return instants since a recording's start (F,) [s] and its markers' residuals (F, 2 k), in units of the noise.

    The runs are of the recording, or of its segments.
    """
    times = [run.observed.recording.time[run.observed.frames] - run.observed.began for run in runs]
    residuals = np.concatenate([run.observed.on_grid(run.residual)[0] for run in runs])
    order = np.argsort(np.concatenate(times), kind="stable")
    return np.concatenate(times)[order], residuals[order]


_REST = 0.01  # rad per unit of time, 0.3 % of the rate of a swing by one radian in the first mode; less is rest
# In words, and as functions of time, angle [rad] and rate, in the link's unit of time.
_SHAPES: tuple[tuple[str, Callable[[Array, Array, Array], Array]], ...] = (
    ("constant", lambda t, q, v: np.ones_like(q)),
    ("odd in position (spring)", lambda t, q, v: q),
    ("even in position", lambda t, q, v: q**2),
    ("odd in position (nonlinear spring)", lambda t, q, v: q**3),
    ("odd in velocity (damper)", lambda t, q, v: v),
    ("even in velocity", lambda t, q, v: v**2),
    ("odd in velocity (quadratic)", lambda t, q, v: v * np.abs(v)),
    ("odd in velocity (dry friction)", lambda t, q, v: np.tanh(v / _REST)),
    ("growing with time", lambda t, q, v: t[..., None] * q),
)


@dataclass(frozen=True)
class _Probe(LinkEffect):
    """A torque of a given shape at an active joint, or a bending moment all along a link."""

    torque: float = magnitude("N m", 0.01, in_rig_units=True)
    bending: int = shape_parameter("", 0, integer=True, grid=(0, 1))
    shape: int = shape_parameter("", 0, integer=True, grid=tuple(range(len(_SHAPES))))

    id = "probe"

    def force(self, chain: Chain, payload: Payload) -> StateFunction:
        """Return torques (..., nv) on the joint, or on the link's, by curvature times length."""
        link, shape, unit = self.link_of(chain), _SHAPES[self.shape][1], self.units(chain)[2]
        joint = chain.joint_names.index(f"{link.name}_joint") if not self.bending else 0
        joints = self.virtual_joints(chain) if self.bending else slice(joint, joint + 1)
        scale = link.length / link.cells if self.bending else np.ones(1)

        def torque(time: Array, q: Array, v: Array, z: Array) -> Array:
            return self.torque * shape(time / unit, q[..., joints] * scale, v[..., joints] * scale * unit)

        return self.force_on(joints, torque)


def describe_residual(point: Point, effects: tuple[Effect, ...], rig: Rig) -> str:
    """Describe the generic force that explains most of a fit's residuals, beside its model's effects.

    It is named where it explains more than all the rest.
    """
    probes = [probe for probe in _Probe().variants(rig, []) if probe.bending or probe.link in rig.active_links]
    statistics = Screen.of(point, effects, probes).statistics
    best = int(np.argmax(statistics))
    percent, probe = 100 * statistics[best] / max(point.chi2 - point.expected_chi2, 1.0), probes[best]
    if percent < 50:
        return f"no torque or bending moment of a simple law would explain more than {np.ceil(percent):.0f} % of it"
    force = "a bending moment in" if probe.bending else "a torque at the joint of"
    resemblance = f"{force} {rig.links[probe.link or 0].name}, {_SHAPES[probe.shape][0]}"
    return f"it resembles {resemblance}, which would explain {min(percent, 100):.0f} % of it"
