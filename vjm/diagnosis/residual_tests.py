"""Where something acts that no candidate explains, and what it looks like: generic forces."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import stats
from scipy.fft import dct

from vjm.chain.virtual_links import Chain
from vjm.diagnosis.directions import screen
from vjm.effects.effect import Effect, Motion, magnitude, shape_parameter
from vjm.identification.trajectory_fit import Point
from vjm.records import Array, Rig
from vjm.simulation.run import Run

_EDGES = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # Hz
_NOISE_FROM = 0.5  # of the highest frequency: beyond, a camera or encoder shows nothing but noise
_MISJUDGED = 1.3  # times the mean square expected: more is no misjudged noise but something in the recording
_LEAST = 20  # coefficients of a band that is looked at


@dataclass(frozen=True)
class Band:
    """One kind of sensor of one recording in one band of frequencies.

    Attributes:
        file: the recording's.
        sensor: `markers` or `encoder`.
        band: lowest and highest frequency [Hz].
        excess: sum of squares beyond what noise has there, in units of the noise.
        p_value: that noise alone has so much.
    """

    file: str
    sensor: str
    band: tuple[float, float]
    excess: float
    p_value: float


@dataclass(frozen=True)
class ResidualTest:
    """What is left of all recordings.

    Attributes:
        bands: the least likely first.
        p_value: that noise alone leaves as much in any band, or in all together.
        excess: sum of squares of all bands beyond that of noise, in units of the noise.
    """

    bands: tuple[Band, ...]
    p_value: float
    excess: float


def residual_test(runs: Sequence[Run], expected: float = 1.0) -> ResidualTest:
    """Judge the residuals of recordings.

    Args:
        runs: beside what was measured; their residuals are white where they are noise.
        expected: mean square of a residual that is taken as noise.
    """
    cells = [cell for run in runs for cell in _cells(run)]
    found, total, freedom = [], 0.0, 0
    for run, sensor, band, squares, count, level in cells:
        power = expected * float(np.clip(level / expected, 1.0, _MISJUDGED))
        p = float(stats.chi2.sf(squares / power, count))
        found.append(Band(run.observed.recording.file, sensor, band, squares / power - count, p))
        total, freedom = total + squares / power, freedom + count
    if not found:
        return ResidualTest((), 1.0, 0.0)
    together = float(stats.chi2.sf(total, freedom))
    smallest = min(min(each.p_value for each in found) * len(found), together)
    ordered = tuple(sorted(found, key=lambda each: (each.p_value, -each.excess)))
    return ResidualTest(ordered, min(1.0, 2 * smallest), total - freedom)


def _cells(run: Run) -> Iterator[tuple[Run, str, tuple[float, float], float, int, float]]:
    """Sums of squares over a band, their number, and the mean square where there is nothing but noise."""
    seen = run.observed
    markers, angles = seen.spread(run.residual)
    time = seen.recording.time
    for sensor, series, instants in (("markers", markers, time[seen.frames]), ("encoder", angles, time)):
        rows = np.isfinite(series).any(axis=1)
        if rows.sum() < 2 * _LEAST:
            continue
        values, instants = series[rows], instants[rows]
        complete = np.isfinite(values).all(axis=0)
        if not complete.any():
            values, complete = np.nan_to_num(values), np.isfinite(values).mean(axis=0) > 0.5
        coefficients = dct(values[:, complete], axis=0, norm="ortho") ** 2
        highest = 0.5 * (len(instants) - 1) / max(float(np.ptp(instants)), 1e-300)
        frequencies = np.linspace(0.0, highest, len(coefficients))
        level = float(np.mean(coefficients[frequencies > _NOISE_FROM * highest]))
        edges = [*(edge for edge in _EDGES if edge < _NOISE_FROM * highest), _NOISE_FROM * highest]
        for low, high in pairwise(edges):
            inside = coefficients[(frequencies >= low) & (frequencies < high)]
            if inside.size >= _LEAST:
                yield run, sensor, (low, high), float(inside.sum()), int(inside.size), level


_TOGETHER = 0.1  # frames by which instants of two recordings may differ
_LEAST_REPEATS = 100  # values


@dataclass(frozen=True)
class Repeated:
    """What a model leaves of markers in recordings that repeat each other, in units of the noise.

    Noise alone gives one for both, since no two recordings share it. What a model gets wrong every time is in the
    first; in the second is what differs from one recording to the next.

    Attributes:
        common: RMS of the sum of two recordings' residuals over the square root of two.
        own: the same of their difference.
        noise: of a marker coordinate [m].
    """

    common: float
    own: float
    noise: float

    @property
    def share(self) -> float:
        """Of the mean square beyond noise, what repeats; NaN where there is none."""
        common, own = (max(each**2 - 1.0, 0.0) for each in (self.common, self.own))
        return common / (common + own) if common + own > 0 else float("nan")


def repeated(runs: Sequence[Run]) -> Repeated | None:
    """From recordings that share a `repeat` label, each beside the next; None where there are none.

    Args:
        runs: beside what was measured; initial states are each one's own.
    """
    sums, differences = np.zeros(0), np.zeros(0)
    for one, two in _pairs(runs):
        sums, differences = np.r_[sums, (one + two) / np.sqrt(2)], np.r_[differences, (one - two) / np.sqrt(2)]
    if sums.size < _LEAST_REPEATS:
        return None
    common, own = (float(np.sqrt(np.mean(each**2))) for each in (sums, differences))
    return Repeated(common, own, runs[0].observed.noise[0])


def _pairs(runs: Sequence[Run]) -> Iterator[tuple[Array, Array]]:
    """(N,), (N,) residuals of the same marker coordinates at the same instants since the start."""
    for label in sorted({each for run in runs if (each := run.observed.recording.repeat) is not None}):
        for one, two in pairwise(run for run in runs if run.observed.recording.repeat == label):
            (times, residuals), (others, there) = _frames(one), _frames(two)
            nearest = np.clip(np.searchsorted(others, times), 1, others.size - 1) if others.size > 1 else None
            if nearest is None or times.size < 2:
                continue
            nearest -= (times - others[nearest - 1]) < (others[nearest] - times)
            near = np.abs(others[nearest] - times) < _TOGETHER * np.median(np.diff(times))
            first, second = residuals[near], there[nearest[near]]
            seen = np.isfinite(first) & np.isfinite(second)
            yield first[seen], second[seen]


def _frames(run: Run) -> tuple[Array, Array]:
    """(F,) instants since the start [s] and (F, 2 k) markers' residuals, in units of the noise."""
    seen = run.observed
    time = seen.recording.time
    return time[seen.frames] - time[0], seen.spread(run.residual)[0]


def noise_told(found: Repeated | None) -> str:
    """What repeats say of the noise, as part of a sentence."""
    if found is None:
        return "no recording that was fitted repeats another"
    return f"recordings that repeat each other differ by {1e3 * found.own * found.noise:.2g} mm beside the model"


def remains_told(found: Repeated | None) -> str:
    """Whether what is left happens every time; empty where repeats do not say."""
    if found is None or not np.isfinite(found.share):
        return ""
    share = 100 * found.share
    if share >= 50:
        return f"{share:.0f} % of it is the same in recordings that repeat each other: the arm does this every time"
    return (
        f"{100 - share:.0f} % of it differs between recordings that repeat each other: a disturbance, or something "
        "that sticks, slips or has changed from one to the next"
    )


_SOME = 1.0  # per cent; what explains less says nothing

_Shape = Callable[[Array, Array, Array], Array]

# In words, and as functions of time [s], angle [rad] and rate [rad/s].
_SHAPES: tuple[tuple[str, _Shape], ...] = (
    ("constant", lambda t, q, v: np.ones_like(q)),
    ("odd in position (a spring)", lambda t, q, v: q),
    ("even in position", lambda t, q, v: q**2),
    ("odd in position (a spring that stiffens or softens)", lambda t, q, v: q**3),
    ("odd in velocity (a damper)", lambda t, q, v: v),
    ("even in velocity", lambda t, q, v: v**2),
    ("odd in velocity (growing with its square)", lambda t, q, v: v * np.abs(v)),
    ("odd in velocity (as friction: it follows its sign)", lambda t, q, v: np.tanh(v / 0.02)),
    ("growing with time", lambda t, q, v: t[..., None] * q),
)


@dataclass(frozen=True)
class JointProbe(Effect):
    """A torque of a given shape at the active joint."""

    torque: float = magnitude("N m", 0.01)
    shape: int = shape_parameter("", 0, integer=True, grid=tuple(range(len(_SHAPES))))

    id = "joint_probe"
    clause = "a torque at the joint of {link}"

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Active joints."""
        return rig.active_links

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Of that shape."""
        names = [f"{link.name}_joint" for link in chain.links]
        joint = chain.joint_names.index(names[self.link or 0])
        shape = _SHAPES[self.shape][1]

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            found = np.zeros(q.shape)
            found[..., joint] = self.torque * shape(time, q[..., [joint]], v[..., [joint]])[..., 0]
            return found

        return force


@dataclass(frozen=True)
class BendingProbe(Effect):
    """A bending moment of a given shape in all of a link."""

    moment: float = magnitude("N m", 0.01)
    shape: int = shape_parameter("", 0, integer=True, grid=tuple(range(len(_SHAPES))))

    id = "bending_probe"
    clause = "a bending moment in {link}"

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Every link."""
        return tuple(range(len(rig.links)))

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Of that shape, in the link's curvature times its length."""
        part, link = chain.passive_slices[self.link or 0], chain.links[self.link or 0]
        scale = link.length / link.cells
        shape = _SHAPES[self.shape][1]

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            found = np.zeros(q.shape)
            found[..., part] = self.moment * shape(time, q[..., part] * scale, v[..., part] * scale)
            return found

        return force


def described(point: Point, present: tuple[Effect, ...], rig: Rig) -> str:
    """Where what is left acts and what it looks like, in words: the probe that explains most of it."""
    variants = [v for probe in (JointProbe(), BendingProbe()) for v in probe.variants(rig, [])]
    seen = screen(point, present, variants)
    best = int(np.argmax(seen.statistics))
    probe = seen.effects[best]
    if seen.statistics[best] <= 0:
        return ""
    shape = _SHAPES[int(probe.values["shape"])][0]
    where = probe.clause.format(link=rig.links[probe.link or 0].name)
    share = 100 * seen.statistics[best] / max(point.chi2 - point.count, 1.0)
    return f"most like {where}, {shape}, which would explain {min(share, 100):.0f} % of it" if share >= _SOME else ""
