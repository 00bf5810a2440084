"""The score screen: what each absent effect would explain of the residuals, everything else being free.

One more column of the linearised least-squares problem stands for each size of each candidate. Initial states and the
parameters already there are projected out of all columns (a refit absorbs most of many effects), so statistics, guessed
sizes, smallest detectable sizes and likenesses between candidates all follow from what is left (Rao's score test).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from vjm.effects.effect import Effect, Key

Array = NDArray[np.float64]

_ABSORBED = 1e-7  # share of a direction's square left once all else has been projected out, below which it is none


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
