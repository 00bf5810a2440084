"""Alternatives: effects that explain the recordings as well as a cause when they take its place."""

from __future__ import annotations

import numpy as np

from vjm.diagnosis.candidate_fit import CandidateFit
from vjm.diagnosis.fit_cache import ALIKE, LOST_MISFIT
from vjm.diagnosis.records import Alternative
from vjm.diagnosis.screen import Directions, Screen
from vjm.diagnosis.selection import Search, SearchResult
from vjm.effects import Effect
from vjm.effects.effect import Key
from vjm.records import Array

_MOST = 6  # alternatives refitted for each cause
_ALIKE = 0.5  # cosine from which a nonsmooth effect, slow to fit, is tried
_NEAR = 5.0  # times the tolerance that a linear guess may be off


def find_alternatives(result: SearchResult, search: Search) -> dict[Key, tuple[Alternative, ...]]:
    """Find, for each new effect of the best model, effects that explain the recordings as well in its place.

    Args:
        result: of the search.
        search: fits the models with alternatives.
    """
    best, causes = result.best, result.best.new_effects
    if not causes or best.misfit >= LOST_MISFIT:  # what does not follow the recordings is no model others could equal
        return {}
    tolerance = ALIKE * max(1.0, best.misfit**2)  # where more than noise remains, that is the measure
    variants = [v for v in search.candidate_set.variants if v.key not in best.names]
    # Stick-slip and play are slow to try: only where they may look like the cause.
    wanted = {
        cause.key: [
            k
            for k, v in enumerate(variants)
            if not v.nonsmooth or cause.nonsmooth or _alike(result.first.screen, cause, v)
        ]
        for cause in causes
    }
    shown = sorted({k for several in wanted.values() for k in several})
    beside = Directions.of(best.point, best.effects, [variants[k] for k in shown], search.workers)
    alternatives = {}
    for cause in causes:
        part = next(p for effect, p in zip(best.effects, best.extension.parts, strict=True) if effect is cause)
        chosen = [shown.index(k) for k in wanted[cause.key]]
        screened = beside.screen(present=(cause, part), chosen=chosen)
        others = [effect for effect in best.effects if effect is not cause]
        guesses = _near(screened, cause, tolerance)
        search.replacements(best, others, [screened.effects[k] for k in guesses], [*guesses.values()])
        alternatives[cause.key] = _as_good(search, best, cause, tolerance)
    return alternatives


def _as_good(search: Search, best: CandidateFit, cause: Effect, tolerance: float) -> tuple[Alternative, ...]:
    """Models fitted with another effect in a cause's place that leave about as little, the best first."""
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
    """Another effect does to the model without effects about what the cause does."""
    one = [k for k, each in enumerate(first.effects) if each.key == cause.key]
    two = [k for k, each in enumerate(first.effects) if each.key == other.key]
    return any(first.likeness[i, j] > _ALIKE for i in one for j in two)


def _near(screened: Screen, cause: Effect, tolerance: float) -> dict[int, Array]:
    """Absent effects that may do what the cause does, nearly: one variant each, and how large that takes."""
    size = cause.coordinates[: cause.magnitude_count]
    own = screened.R[:, screened.parts[0]] @ size  # what the cause does to the residuals
    power = float(own @ own)
    guesses: dict[int, Array]
    diverges_from_data, guesses = np.full(len(screened.effects), np.inf), {}
    for k in range(1, len(screened.effects)):
        columns = screened.R[:, screened.parts[k]]
        if screened.absorbed[k] or not np.isfinite(columns).all():
            continue
        guess = np.asarray(np.linalg.lstsq(columns, own, rcond=1e-10)[0])
        guesses[k] = guess
        diverges_from_data[k] = power - float(np.sum((columns @ guess) ** 2))
    # A linear guess is the worse the larger the effect.
    close = [k for k in range(1, len(screened.effects)) if diverges_from_data[k] < _NEAR * tolerance + 0.02 * power]
    chosen = screened.first_of_each(sorted(close, key=lambda k: float(diverges_from_data[k])))[:_MOST]
    return {k: guesses[k] for k in chosen}
