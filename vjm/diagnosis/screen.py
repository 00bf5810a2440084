"""The score screen: what each absent effect would explain of the residuals, everything else being free.

One more column of the linearised least-squares problem stands for each size of each candidate. Initial states and the
parameters already there are projected out of all columns (a refit absorbs most of many effects), so statistics, guessed
sizes, smallest detectable sizes and likenesses between candidates all follow from what is left (Rao's score test).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from vjm.diagnosis.extension import adds_joint
from vjm.effects.effect import Effect, Key
from vjm.errors import SimulationDivergedError
from vjm.experiment.records import REFERENCE
from vjm.identification.trajectory_problem import Point
from vjm.simulate.arm import Arm
from vjm.simulate.run import Run, Start, run_all, transferred
from vjm.simulate.sensitivity import Moved
from vjm.simulate.triangle import Triangle

Array = NDArray[np.float64]

_STEP = 0.1  # everyday sizes, over which the slope is taken
_JOINT_STEP = 0.05  # the same where all has to be simulated again, and its curvature told from its slope
_ABSORBED = 1e-7  # share of a direction's square left once all else has been projected out, below which it is none
_LARGEST = 1e12  # slope, in units of the noise


@dataclass(frozen=True)
class Screen:
    """What is left of candidates' directions and of the residuals once all other parameters are chosen best.

    Attributes:
        effects: V absent effects.
        parts: the columns of each one's sizes.
        R: (c + 1, c + 1) triangle with R^T R their inner products; the last column stands for the residuals.
        whole: (c,) squares of the directions before anything was projected out; infinite where they have no end.
    """

    effects: tuple[Effect, ...]
    parts: tuple[slice, ...]
    R: Array
    whole: Array

    @cached_property
    def products(self) -> Array:
        """(c + 1, c + 1) inner products of directions and residuals."""
        result: Array = self.R.T @ self.R
        return result

    @cached_property
    def absorbed(self) -> NDArray[np.bool_]:
        """(V,) whether other parameters explain all that an effect would do."""
        left = np.diag(self.products)[:-1] <= _ABSORBED * self.whole
        return np.array([bool(left[part].any()) for part in self.parts])

    @cached_property
    def statistics(self) -> Array:
        """(V,) by how much each alone would lower chi^2; zero where absorbed, or on the wrong side of a bound."""
        return np.array([self._gain([k]) for k in range(len(self.effects))])

    @cached_property
    def p_values(self) -> Array:
        """(V,) that noise alone makes this one effect look as needed."""
        return tail(self.statistics, *self.kinds)

    @property
    def kinds(self) -> tuple[Array, Array]:
        """(V,) numbers of sizes, and (V,) whether the null is a bound of the only size."""
        sizes = np.array([part.stop - part.start for part in self.parts])
        return sizes, np.array([is_one_sided(effect) for effect in self.effects])

    def one_each(self, chosen: Iterable[int]) -> list[int]:
        """Of several variants of one effect at one place the one that explains most; the most needed first."""
        return one_each(self.effects, sorted(chosen, key=lambda k: -self.statistics[k]))

    def pair(self, one: int, other: int) -> float:
        """By how much two effects together would lower chi^2."""
        return self._gain([one, other])

    def guess(self, chosen: Sequence[int]) -> Array:
        """(s,) best sizes of some effects together, in everyday sizes."""
        columns = self._columns(chosen)
        found = np.linalg.lstsq(self.R[:, columns], self.R[:, -1], rcond=1e-10)[0]
        return np.asarray(found)

    def std(self, k: int) -> Array:
        """(s,) standard errors of effect k's sizes, each with the others known, in everyday sizes."""
        return np.asarray(1 / np.sqrt(np.maximum(np.diag(self.products)[self.parts[k]], 1e-300)))

    @cached_property
    def likeness(self) -> Array:
        """(V, V) largest cosine between what two effects can do to the residuals."""
        bases = [np.linalg.qr(self.R[:, part])[0] for part in self.parts]
        found = np.eye(len(bases))
        for i, one in enumerate(bases):
            for j, other in enumerate(bases[:i]):
                found[i, j] = found[j, i] = np.linalg.norm(one.T @ other, 2)
        return found

    def draws(self, count: int, seed: int) -> Array:
        """(count, V) statistics under noise alone."""
        c = len(self.R) - 1
        scale = np.sqrt(np.maximum(np.diag(self.products)[:c], 1e-300))
        directions = self.R[:, :c] / scale
        noise = np.random.default_rng(seed).standard_normal((count, len(self.R))) @ directions
        found = np.zeros((count, len(self.parts)))
        for k, part in enumerate(self.parts):
            if self.absorbed[k]:
                continue
            if part.stop - part.start == 1:
                one = noise[:, part.start]
                found[:, k] = np.where(one > 0, one, 0.0) ** 2 if is_one_sided(self.effects[k]) else one**2
            else:
                inside = np.linalg.pinv(directions[:, part].T @ directions[:, part])
                found[:, k] = np.einsum("di,ij,dj->d", noise[:, part], inside, noise[:, part])
        return found

    def _gain(self, chosen: Sequence[int]) -> float:
        if any(self.absorbed[k] for k in chosen):
            return 0.0
        guess = self.guess(chosen)
        first = 0
        for k in chosen:
            if is_one_sided(self.effects[k]) and guess[first] < 0:
                return 0.0 if len(chosen) == 1 else max(self._gain([other]) for other in chosen if other != k)
            first += self.parts[k].stop - self.parts[k].start
        columns = self._columns(chosen)
        left = self.R[:, -1] - self.R[:, columns] @ guess
        return float(self.R[:, -1] @ self.R[:, -1] - left @ left)

    def _columns(self, chosen: Sequence[int]) -> list[int]:
        return [column for k in chosen for column in range(self.parts[k].start, self.parts[k].stop)]


def tail(statistics: Array, sizes: Array, one_sided: Array) -> Array:
    """(V,) probability of larger statistics under noise: chi-square, half of it at a bound."""
    found = np.asarray(stats.chi2.sf(statistics, sizes))
    return np.where(one_sided, np.where(statistics > 0, found / 2, 1.0), found)


def is_one_sided(effect: Effect) -> bool:
    """Whether the null is a bound of an effect's only size."""
    lower, upper = effect.bounds
    return effect.sizes == 1 and bool(lower[0] == 0 or upper[0] == 0)


def one_each(effects: Sequence[Effect], order: Iterable[int]) -> list[int]:
    """Of several variants of one effect at one place the first in an order."""
    first: dict[Key, int] = {}
    for k in order:
        first.setdefault(effects[k].key, k)
    return list(first.values())


def screen(
    point: Point, present: Sequence[Effect], variants: Sequence[Effect], again: tuple[Effect, slice] | None = None
) -> Screen:
    """Screen absent effects beside a fit.

    Args:
        point: the fit.
        present: effects that it already has.
        variants: absent effects, one a place and choice of inner parameters.
        again: one of those present, with its coordinates, that is told among the others instead of projected out; it
            comes first.
    """
    counts = [variant.sizes for variant in variants]
    stops = np.cumsum(counts, dtype=int).tolist()
    parts = tuple(slice(stop - count, stop) for stop, count in zip(stops, counts, strict=True))
    secants = [_secants(point, present, variant) if _jumps(point, variant) else None for variant in variants]
    moved = point.problem.moved(point.x)
    total, whole = int(sum(counts)), np.zeros(int(sum(counts)))
    triangles = []
    for k, run in enumerate(point.runs):
        own = [_moved(run, point, present, variant) for variant in variants]
        given = [None if each is None else each[k] for each in secants]
        rows = _Rows(run, (*moved[k], *(each for several in own for each in several)), given, parts)
        columns = 2 * run.basis.slow + point.x.size + total
        triangle = Triangle.of(rows.counted(), columns).with_rows(*run.preferred(columns))
        triangles.append(triangle.eliminated(2 * run.basis.slow).R)
        whole += rows.squares
    stacked = np.vstack(triangles)
    if again is None:
        together = Triangle.of([(stacked[:, :-1], stacked[:, -1])], point.x.size + total)
        return Screen(tuple(variants), parts, together.eliminated(point.x.size).R, whole)
    effect, part = again
    told = [*range(part.start, part.start + effect.sizes)]
    order = [k for k in range(stacked.shape[1]) if k not in told]
    order[point.x.size - len(told) : point.x.size - len(told)] = told
    stacked = stacked[:, order]
    together = Triangle.of([(stacked[:, :-1], stacked[:, -1])], point.x.size + total)
    shifted = [slice(each.start + len(told), each.stop + len(told)) for each in parts]
    whole = np.concatenate([np.zeros(len(told)), whole])
    R = together.eliminated(point.x.size - len(told)).R
    return Screen((effect, *variants), (slice(0, len(told)), *shifted), R, whole)


def _jumps(point: Point, variant: Effect) -> bool:
    """Whether the effect has no slope at its null, being a joint that is not there then."""
    return adds_joint(variant, point.chain)


def _unit(variant: Effect, size: int, by: float) -> Effect:
    coordinates = np.where(np.arange(variant.coordinates.size) < variant.sizes, 0.0, variant.coordinates)
    coordinates[size] = by
    return variant.at(coordinates)


def _moved(run: Run, point: Point, present: Sequence[Effect], variant: Effect) -> list[Moved]:
    """The arm with each size of an effect moved off its null; as it is where the slope has to be found otherwise."""
    absent = run.observed.recording.condition == REFERENCE or _jumps(point, variant)
    if absent:
        return [Moved(run.arm, _STEP)] * variant.sizes
    effects = [Arm.of(point.chain, (*present, _unit(variant, size, _STEP))) for size in range(variant.sizes)]
    return [Moved(arm, _STEP) for arm in effects]


def _secants(point: Point, present: Sequence[Effect], variant: Effect) -> list[Array]:
    """For each recording, (N,) slope of the whitened predictions where the effect leaves its null, to second order.

    A joint that gives way a little shifts frequencies, which in a long recording is soon out of proportion. Infinite
    where it moves nothing, beside a wrong fit.
    """
    null = [run.residual for run in point.runs]
    sizes = [_unit(variant, 0, size) for size in (_JOINT_STEP, 2 * _JOINT_STEP)]
    try:
        one, two = _residuals(point, present, sizes)
    except SimulationDivergedError:
        return [np.full(each.size, np.inf) for each in null]
    return [(3 * r0 - 4 * r1 + r2) / (2 * _JOINT_STEP) for r0, r1, r2 in zip(null, one, two, strict=True)]


def _residuals(point: Point, present: Sequence[Effect], added: Sequence[Effect]) -> list[list[Array]]:
    """For each further effect and each recording, (N,) whitened residuals with it, all else as it is."""
    arms, states, starts = [], [], []
    for effect in added:
        extended = Arm.of(point.chain, (*present, effect))
        for run in point.runs:
            absent = run.observed.recording.condition == REFERENCE
            arms.append(run.arm if absent else extended)
            states.append(run.state if absent else transferred(run.chain, extended.chain, run.state))
            starts.append(Start.of(arms[-1], run.observed.recording))
    count = len(point.runs)
    observed = [run.observed for run in point.runs] * len(added)
    found = [run.residual for run in run_all(arms, observed, starts, states, point.problem.coarse)]
    return [found[first : first + count] for first in range(0, len(found), count)]


class _Rows:
    """Rows of one recording's linearised problem, with slopes that were found otherwise in their places."""

    def __init__(
        self, run: Run, moved: Sequence[Moved], secants: Sequence[Array | None], parts: Sequence[slice]
    ) -> None:
        self.run = run
        self.moved = moved
        self.secants = secants
        self.parts = parts
        self.squares = np.zeros(parts[-1].stop if parts else 0)

    def counted(self) -> Iterator[tuple[Array, Array]]:
        """Derivatives and residuals, as far as the loss lets them count."""
        residual = self.run.residual
        kept = np.sqrt(self.run.observed.loss.slope(residual**2))
        count = self.squares.size
        for measured, part in self.run.slopes(self.moved):
            first = part.shape[1] - count
            for given, columns in zip(self.secants, self.parts, strict=True):
                if given is not None:
                    part[:, first + columns.start] = given[measured]
            # Beside a motion that is all wrong an effect's slope may grow beyond all bounds: it says nothing then.
            wild = ~(np.abs(part[:, first:]) < _LARGEST).all(axis=0)
            part[:, first:][:, wild] = 0.0
            self.squares[wild] = np.inf
            self.squares += np.sum(part[:, first:] ** 2, axis=0)
            yield kept[measured, None] * part, kept[measured] * residual[measured]
