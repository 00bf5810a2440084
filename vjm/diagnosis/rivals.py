"""What cannot be told apart: explanations as good as the best, each cause replaced by another effect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.race import ALIKE
from vjm.diagnosis.records import Rival
from vjm.diagnosis.refit import Explanation, named
from vjm.diagnosis.screen import Screen, one_each, screen
from vjm.diagnosis.search import Found, Search
from vjm.effects import Effect

Array = NDArray[np.float64]

_MOST = 6  # alternatives refitted for each cause
_ALIKE = 0.5  # cosine from which what is slow to try is tried
_NEAR = 5.0  # times the tolerance that a linear guess may be off


def alternatives(found: Found, search: Search, cause: Effect, scale: float) -> tuple[Rival, ...]:
    """Effects that explain the recordings as well as one of the causes.

    Args:
        found: where the search ended.
        search: can fit more.
        cause: one of the best explanation's effects.
        scale: mean square of the residuals that is taken as noise.
    """
    best = found.best
    others = [effect for effect in best.effects if effect is not cause]
    variants = [v for v in search.looked.variants if v.key not in best.names]
    variants = [v for v in variants if not v.abrupt or cause.abrupt or _alike(found.first.seen, cause, v)]
    seen = _beside(best, cause, variants)
    guesses = _near(seen, cause, ALIKE * scale)
    search.replacements(best, others, [seen.effects[k] for k in guesses], [*guesses.values()])
    rest = named(others)
    rivals = []
    for names, tried in search.trials.tried.items():
        new = [effect for effect in tried.effects if effect.key not in rest]
        same = len(names) == len(best.names) and rest <= names and len(new) == 1 and names not in search.trials.stale
        if same and new[0].key != cause.key:
            worse = tried.chi2 - best.chi2
            if worse < ALIKE * scale:
                rivals.append(Rival(new[0], float(worse)))
    return tuple(sorted(rivals, key=lambda each: each.worse))


def _alike(first: Screen, cause: Effect, other: Effect) -> bool:
    """Whether another effect does to the model without effects about what the cause does."""
    one = [k for k, each in enumerate(first.effects) if each.key == cause.key]
    two = [k for k, each in enumerate(first.effects) if each.key == other.key]
    return any(first.likeness[i, j] > _ALIKE for i in one for j in two)


def _beside(best: Explanation, cause: Effect, variants: Sequence[Effect]) -> Screen:
    """The absent effects beside a cause, which is one among them."""
    part = next(p for effect, p in zip(best.effects, best.extension.parts, strict=True) if effect is cause)
    return screen(best.point, best.effects, variants, (cause, part))


def _near(seen: Screen, cause: Effect, tolerance: float) -> dict[int, Array]:
    """Absent effects that may do what the cause does, nearly: one variant each, and how large that takes."""
    size = cause.coordinates[: cause.sizes]
    own = seen.R[:, seen.parts[0]] @ size  # what the cause does to the residuals
    power = float(own @ own)
    guesses: dict[int, Array]
    lost, guesses = np.full(len(seen.effects), np.inf), {}
    for k in range(1, len(seen.effects)):
        columns = seen.R[:, seen.parts[k]]
        if seen.absorbed[k] or not np.isfinite(columns).all():
            continue
        guess = np.asarray(np.linalg.lstsq(columns, own, rcond=1e-10)[0])
        guesses[k] = guess
        lost[k] = power - float(np.sum((columns @ guess) ** 2))
    # A linear guess is the worse the larger the effect.
    close = [k for k in range(1, len(seen.effects)) if lost[k] < _NEAR * tolerance + 0.02 * power]
    chosen = one_each(seen.effects, sorted(close, key=lambda k: float(lost[k])))[:_MOST]
    return {k: guesses[k] for k in chosen}
