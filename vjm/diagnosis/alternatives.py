"""What cannot be told apart: explanations as good as the best, each cause replaced by another effect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vjm.diagnosis.candidate_fit import CandidateFit
from vjm.diagnosis.directions import directions
from vjm.diagnosis.fit_cache import ALIKE
from vjm.diagnosis.records import Alternative
from vjm.diagnosis.screen import Screen, one_each
from vjm.diagnosis.selection import Search, SearchResult
from vjm.effects import Effect
from vjm.effects.effect import Key
from vjm.records import Array

_MOST = 6  # alternatives refitted for each cause
_ALIKE = 0.5  # cosine from which what is slow to try is tried
_NEAR = 5.0  # times the tolerance that a linear guess may be off


def find_alternatives(
    found: SearchResult, search: Search, causes: Sequence[Effect], scale: float
) -> dict[Key, tuple[Alternative, ...]]:
    """For each cause, effects that explain the recordings as well when they take its place.

    Args:
        found: where the search ended.
        search: can fit more.
        causes: of the best explanation's effects.
        scale: mean square of the residuals that is taken as noise.
    """
    if not causes:
        return {}
    best = found.best
    variants = [v for v in search.candidate_set.variants if v.key not in best.names]
    # What sticks or rattles is slow to try: only where it may look like the cause.
    wanted = {
        cause.key: [
            k
            for k, v in enumerate(variants)
            if not v.nonsmooth or cause.nonsmooth or _alike(found.first.seen, cause, v)
        ]
        for cause in causes
    }
    shown = sorted({k for several in wanted.values() for k in several})
    beside = directions(best.point, best.effects, [variants[k] for k in shown], search.workers)
    alternatives = {}
    for cause in causes:
        part = next(p for effect, p in zip(best.effects, best.extension.parts, strict=True) if effect is cause)
        chosen = [shown.index(k) for k in wanted[cause.key]]
        seen = beside.screen(again=(cause, part), chosen=chosen)
        others = [effect for effect in best.effects if effect is not cause]
        guesses = _near(seen, cause, ALIKE * scale)
        search.replacements(best, others, [seen.effects[k] for k in guesses], [*guesses.values()])
        alternatives[cause.key] = _as_good(search, best, cause, ALIKE * scale)
    return alternatives


def _as_good(search: Search, best: CandidateFit, cause: Effect, tolerance: float) -> tuple[Alternative, ...]:
    """What was fitted in a cause's place and leaves about as little, the least first."""
    rest, alternatives = best.names - {cause.key}, []
    for names, tried in search.trials.tried.items():
        new = [effect for effect in tried.effects if effect.key not in rest]
        same = (
            len(names) == len(best.names) and rest <= names and len(new) == 1 and names not in search.trials.uncorrected
        )
        if same and new[0].key != cause.key:
            worse = tried.chi2 - best.chi2
            if worse < tolerance:
                alternatives.append(Alternative(new[0], float(worse)))
    return tuple(sorted(alternatives, key=lambda each: each.worse))


def _alike(first: Screen, cause: Effect, other: Effect) -> bool:
    """Whether another effect does to the model without effects about what the cause does."""
    one = [k for k, each in enumerate(first.effects) if each.key == cause.key]
    two = [k for k, each in enumerate(first.effects) if each.key == other.key]
    return any(first.likeness[i, j] > _ALIKE for i in one for j in two)


def _near(seen: Screen, cause: Effect, tolerance: float) -> dict[int, Array]:
    """Absent effects that may do what the cause does, nearly: one variant each, and how large that takes."""
    size = cause.coordinates[: cause.magnitude_count]
    own = seen.R[:, seen.parts[0]] @ size  # what the cause does to the residuals
    power = float(own @ own)
    guesses: dict[int, Array]
    diverges_from_data, guesses = np.full(len(seen.effects), np.inf), {}
    for k in range(1, len(seen.effects)):
        columns = seen.R[:, seen.parts[k]]
        if seen.absorbed[k] or not np.isfinite(columns).all():
            continue
        guess = np.asarray(np.linalg.lstsq(columns, own, rcond=1e-10)[0])
        guesses[k] = guess
        diverges_from_data[k] = power - float(np.sum((columns @ guess) ** 2))
    # A linear guess is the worse the larger the effect.
    close = [k for k in range(1, len(seen.effects)) if diverges_from_data[k] < _NEAR * tolerance + 0.02 * power]
    chosen = one_each(seen.effects, sorted(close, key=lambda k: float(diverges_from_data[k])))[:_MOST]
    return {k: guesses[k] for k in chosen}
