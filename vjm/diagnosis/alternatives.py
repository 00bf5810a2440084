"""Causes with their magnitudes, and alternatives: effects that explain the recordings as well in a cause's place."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vjm.diagnosis.candidate_fit import starting_effect
from vjm.diagnosis.records import EQUIVALENT, Alternative, Cause
from vjm.diagnosis.screen import Screen
from vjm.diagnosis.selection import Fits, Search, SearchResult
from vjm.effects import Effect
from vjm.effects.effect import Key
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.records import Array, Estimate
from vjm.text import number, ratio

_MOST_ALTERNATIVES = 6  # refitted for each cause


def find_alternatives(result: SearchResult, search: Search) -> dict[Key, tuple[Alternative, ...]]:
    """Find, for each new effect of the best model, effects that explain the recordings as well in its place.

    Args:
        result: of the search.
        search: fits the models with alternatives.
    """
    best, causes = result.best, result.best.new_effects
    if not causes:
        return {}
    tolerance = EQUIVALENT * max(1.0, best.misfit**2)  # where more than noise remains, that is the measure
    directions = result.last_tests.screen.directions
    # Stick-slip and play are slow to try: only where they may look like the cause.
    wanted = {
        cause.key: [
            k
            for k, v in enumerate(directions.effects)
            if not v.nonsmooth or cause.nonsmooth or _alike(result.first_tests.screen, cause, v)
        ]
        for cause in causes
    }
    alternatives = {}
    for cause in causes:
        part = next(p for effect, p in zip(best.effects, best.point.problem.parts, strict=True) if effect is cause)
        screened = directions.screen(present=(cause, part), chosen=wanted[cause.key])
        others = [effect for effect in best.effects if effect is not cause]
        guesses = _near(screened, cause, tolerance)
        models = [
            (*others, starting_effect(screened.effects[k], size, best.point.chain)) for k, size in guesses.items()
        ]
        search.fit_models(best, models, best.chi2 + tolerance, result.fits)
        alternatives[cause.key] = _as_good(best, cause, result.fits, tolerance)
    return alternatives


def _as_good(best: TrajectoryFit, cause: Effect, fits: Fits, tolerance: float) -> tuple[Alternative, ...]:
    """Return the effects that, fitted in a cause's place, leave about as little, the best first."""
    rest, alternatives = best.effect_keys - {cause.key}, []
    for names, tried in fits.items():
        new = [effect for effect in tried.effects if effect.key not in rest]
        if len(names) == len(best.effect_keys) and rest <= names and len(new) == 1 and new[0].key != cause.key:
            worse = tried.chi2 - best.chi2
            if worse < tolerance:
                alternatives.append(Alternative(new[0], float(worse)))
    return tuple(sorted(alternatives, key=lambda each: each.worse))


def _alike(first: Screen, cause: Effect, other: Effect) -> bool:
    """Return True if another effect moves the model without effects about as the cause does: by a cosine of 0.5."""
    one = [k for k, each in enumerate(first.effects) if each.key == cause.key]
    two = [k for k, each in enumerate(first.effects) if each.key == other.key]
    return any(first.cosines[i, j] > 0.5 for i in one for j in two)


def _near(screened: Screen, cause: Effect, tolerance: float) -> dict[int, Array]:
    """Return the sizes (s,) of absent effects, one variant each, with which they do nearly what the cause does."""
    size = cause.coordinates[: cause.magnitude_count]
    own = screened.R[:, screened.parts[0]] @ size  # what the cause does to the residuals
    power = float(own @ own)
    guesses: dict[int, Array]
    remaining_chi2, guesses = np.full(len(screened.effects), np.inf), {}
    for k in range(1, len(screened.effects)):
        columns = screened.R[:, screened.parts[k]]
        if screened.absorbed[k] or not np.isfinite(columns).all():
            continue
        guess = np.asarray(np.linalg.lstsq(columns, own, rcond=1e-10)[0])
        guesses[k] = guess
        remaining_chi2[k] = power - float(np.sum((columns @ guess) ** 2))
    # A linear guess, which is the worse the larger the effect, may be off by some times the tolerance.
    close = [k for k in range(1, len(screened.effects)) if remaining_chi2[k] < 5 * tolerance + 0.02 * power]
    chosen = screened.first_variants(sorted(close, key=lambda k: float(remaining_chi2[k])))[:_MOST_ALTERNATIVES]
    return {k: guesses[k] for k in chosen}


def estimate_causes(
    result: SearchResult,
    search: Search,
    alternatives: Mapping[Key, tuple[Alternative, ...]],
    reference_misfit: float,
    covariance: Array,
) -> tuple[Cause, ...]:
    """Return the best model's new effects, the one without which most is missed first.

    Args:
        result: of the search.
        search: fits the best model without an effect where that was not done on the way.
        alternatives: effects that explain the recordings as well, by the cause in whose place.
        reference_misfit: of the reference recordings, as far as it counts as noise; at least one.
        covariance: (p, p) of the best model's coordinates.
    """
    best, causes = result.best, []
    estimated = best.point.problem.effects_at(best.estimate)
    for effect, estimate, part in [*zip(best.effects, estimated, best.point.problem.parts, strict=True)][
        best.point.problem.reference_effects :
    ]:
        names = best.effect_keys - {effect.key}
        without = result.fits.get(names) or search.refit_without(best, effect, result.fits) or search.start
        decrease = without.chi2 - best.chi2
        # Where the best model leaves more than noise, what it leaves is the measure.
        p_of_fit = result.first_tests.p_of_fit(effect, decrease / max(1.0, best.misfit**2))
        p_value = max(min(result.p_values.get(effect.key, 1.0), p_of_fit), 1e-300)
        unit = "noise" if reference_misfit == 1 else "the residual before the change"
        before, after = ratio(without.misfit), ratio(best.misfit)
        evidence = f"training residual falls from {before} to {after} × {unit}, chi² by {number(decrease)}"
        parameters = _with_errors(estimate, covariance[part, part])
        causes.append(Cause(effect, parameters, p_value, decrease, alternatives.get(effect.key, ()), evidence))
    return tuple(sorted(causes, key=lambda cause: -cause.decrease))


def _with_errors(effect: Effect, covariance: Array) -> dict[str, Estimate]:
    """Return parameters with standard errors, by the covariance (p, p) of an effect's coordinates (delta method)."""
    x, values = effect.coordinates, effect.values
    steps = 1e-5 * np.maximum(np.abs(x), 1.0)
    moved = [effect.at(x + step).values for step in np.diag(steps)]
    parameters = {}
    for parameter in effect.parameters:
        name = parameter.name
        slope = np.array([(other[name] - values[name]) / step for other, step in zip(moved, steps, strict=True)])
        with np.errstate(invalid="ignore"):  # the recordings may not determine a cause among several
            variance = float(slope @ covariance @ slope)
        std = float(np.sqrt(max(variance, 0.0))) if np.isfinite(variance) and not parameter.integer else None
        parameters[name] = Estimate(name, float(values[name]), std, parameter.unit)
    return parameters
