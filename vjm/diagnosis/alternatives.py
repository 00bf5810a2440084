"""Causes with their estimated parameters, and alternatives: other effects that fit the recordings equally well."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from vjm.diagnosis.candidate_fit import SearchOptions, information_of, predicted_increase, starting_effect
from vjm.diagnosis.records import EQUIVALENT, Alternative, Cause
from vjm.diagnosis.screen import Screen
from vjm.diagnosis.segments import fit_segments
from vjm.diagnosis.selection import Fits, Search, SearchResult
from vjm.diagnosis.simulations import open_loop
from vjm.effects import Effect
from vjm.effects.effect import Key, is_nonsmooth
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.records import VISIBLE_SHARE, Array, Estimate
from vjm.text import number, ratio

_MOST_ALTERNATIVES = 6  # refitted for each cause, to bound the time; the most similar ones


def find_alternatives(result: SearchResult, search: Search) -> dict[Key, tuple[Alternative, ...]]:
    """Find, for each cause in the best model, effects with which the model fits equally well in its place.

    Args:
        result: result of the search.
        search: fits the models with alternatives.
    """
    best, causes = result.best, result.best.new_effects
    if not causes:
        return {}
    tolerance = equivalent_increase(best)
    directions = result.last_tests.screen.directions
    # Stick-slip and play are slow to fit: they are tried only where the screen finds them similar to the cause.
    candidates = {
        cause.key: [
            k
            for k, variant in enumerate(directions.effects)
            if not variant.nonsmooth or cause.nonsmooth or _is_similar(result.first_tests.screen, cause, variant)
        ]
        for cause in causes
    }
    alternatives = {}
    for cause in causes:
        screened = directions.screen(present=(cause, best.part_of(cause)), chosen=candidates[cause.key])
        remaining = [effect for effect in best.effects if effect is not cause]
        guesses = _substitute_sizes(screened, cause, tolerance)
        guessed = [starting_effect(screened.effects[k], size, best.point.chain) for k, size in guesses.items()]
        models = [(*remaining, _as_fitted(effect, best.effect_keys - {cause.key}, result)) for effect in guessed]
        search.fit_models(best, models, best.chi2 + tolerance, result.fits)
        alternatives[cause.key] = _equivalent_fits(best, cause, result.fits, tolerance, search.options)
    return alternatives


def find_next_best(result: SearchResult, search: Search) -> TrajectoryFit | None:
    """Return the second best model of as many effects, in whole recordings; None where no other was fitted."""
    best = result.best
    for fits in (result.fits, result.segment_fits):
        candidates = [fit for fit in fits.values() if len(fit.new_effects) == len(best.new_effects) > 0]
        candidates = [fit for fit in candidates if fit.effect_keys != best.effect_keys]
        # Stick-slip and play are slow to fit: only where the best model has such an effect.
        candidates = [fit for fit in candidates if not is_nonsmooth(fit.effects) or is_nonsmooth(best.effects)]
        if candidates and not search.out_of_time:
            search.report("fitting the next best")
            second = min(candidates, key=search.options.criterion)
            try:
                if is_nonsmooth(second.effects) or fits is result.fits:
                    return open_loop(second, search.whole, search.deadline)
                return fit_segments(second, search.whole, np.inf, search.stop())
            except (SimulationDivergedError, InsufficientDataError):
                return None
    return None


def equivalent_increase(fit: TrajectoryFit) -> float:
    """Return how far above a fit's chi^2 that of another model may be that explains the recordings as well.

    Where what a fit leaves is correlated or more than noise, chi^2 of models differs by more (`Information.inflation`).
    """
    return EQUIVALENT * max(1.0, information_of(fit).inflation)


def _as_fitted(effect: Effect, others: frozenset[Key], result: SearchResult) -> Effect:
    """Return an effect as it was fitted to segments beside others, where that was done: no linear guess is as near."""
    fit = result.segment_fits.get(others | {effect.key})
    return effect if fit is None else next(fitted for fitted in fit.effects if fitted.key == effect.key)


def _equivalent_fits(
    best: TrajectoryFit, cause: Effect, fits: Fits, tolerance: float, options: SearchOptions
) -> tuple[Alternative, ...]:
    """Return the effects whose fit in a cause's place has a chi^2 within the tolerance of the best, the best first."""
    shared, alternatives = best.effect_keys - {cause.key}, []
    for keys, fit in fits.items():
        added = [effect for effect in fit.effects if effect.key not in shared]
        if len(keys) == len(best.effect_keys) and shared <= keys and len(added) == 1 and added[0].key != cause.key:
            increase = best.chi2 * (options.criterion(fit) / options.criterion(best) - 1)
            if increase < tolerance:
                alternatives.append(Alternative(added[0], float(increase)))
    return tuple(sorted(alternatives, key=lambda alternative: alternative.chi2_increase))


def _is_similar(screen: Screen, cause: Effect, candidate: Effect) -> bool:
    """Return True if the directions of two effects in residual space are less than 60 degrees apart."""
    causes = [k for k, effect in enumerate(screen.effects) if effect.key == cause.key]
    candidates = [k for k, effect in enumerate(screen.effects) if effect.key == candidate.key]
    return any(screen.cosines[i, j] > 0.5 for i in causes for j in candidates)


def _substitute_sizes(screened: Screen, cause: Effect, tolerance: float) -> dict[int, Array]:
    """Return sizes (s,) of effects, one variant each, that by the linear model nearly replace a cause."""
    size = cause.coordinates[[*cause.size_coordinates]]
    change = screened.R[:, screened.parts[0]] @ size  # change of the residuals by the cause
    power = float(change @ change)
    remaining_chi2, guesses = np.full(len(screened.effects), np.inf), dict[int, Array]()
    for k in range(1, len(screened.effects)):
        columns = screened.R[:, screened.parts[k]]
        if screened.absorbed[k]:
            continue
        guess = np.asarray(np.linalg.lstsq(columns, change, rcond=1e-10)[0])
        guesses[k] = guess
        remaining_chi2[k] = power - float(np.sum((columns @ guess) ** 2))
    # The linear model is off by some times the tolerance, and the more the larger the effect: hence these margins.
    close = [k for k in range(1, len(screened.effects)) if remaining_chi2[k] < 5 * tolerance + 0.02 * power]
    chosen = screened.first_variants(sorted(close, key=lambda k: float(remaining_chi2[k])))[:_MOST_ALTERNATIVES]
    return {k: guesses[k] for k in chosen}


def estimate_causes(
    result: SearchResult,
    search: Search,
    alternatives: Mapping[Key, tuple[Alternative, ...]],
    reference_misfit: float,
) -> tuple[Cause, ...]:
    """Return the best model's new effects as causes.

    Args:
        result: result of the search.
        search: fits the best model without an effect where that was not done on the way.
        alternatives: for each cause, effects that explain the recordings as well in its place.
        reference_misfit: misfit of the reference recordings that counts as noise; at least one.
    """
    best, causes, information = result.best, [], information_of(result.best)
    # By which chi^2 of models differs more, where the best one leaves what is correlated or more than noise.
    inflation = max(1.0, information.inflation)
    estimated = best.point.problem.effects_at(best.estimate)
    for effect, estimate, part in [*zip(best.effects, estimated, best.point.problem.parts, strict=True)][
        best.point.problem.reference_effects :
    ]:
        reduced = _model_without(effect, result, search)
        decrease = (
            predicted_increase(best, effect) if reduced is None else max(_chi2_of(reduced, best) - best.chi2, 0.0)
        )
        p_of_fit = result.first_tests.p_of_fit(effect, decrease / inflation)
        p_value = max(min(result.p_values.get(effect.key, 1.0), p_of_fit), 1e-300)
        if reduced is None:
            reason = ", out of time" if search.out_of_time else ""
            evidence = f"not fitted without it{reason}: chi² would rise by {number(decrease)} in a linear model"
        elif not decrease:
            evidence = "its fit ended before it was better than that without it"
        else:
            unit = "noise" if reference_misfit == 1 else "the residual before the change"
            before, after = ratio(reduced.misfit), ratio(best.misfit)
            evidence = f"training residual falls from {before} to {after} × {unit}, chi² by {number(decrease)}"
        parameters = _with_errors(estimate, information.covariance[part, part])
        causes.append(Cause(effect, parameters, p_value, decrease, alternatives.get(effect.key, ()), evidence))
    return tuple(causes)


def _model_without(effect: Effect, result: SearchResult, search: Search) -> TrajectoryFit | None:
    """Return the best model fitted without one of its effects; None where that was not simulated, or not in time."""
    best = result.best
    keys = best.effect_keys - {effect.key}
    shorter = result.segment_fits.get(keys)
    reduced = result.fits.get(keys) or search.refit_without(best, effect, result.fits) or shorter
    # A refit that ran out of time has not lost yet what it can lose. Shorter segments leave less than longer ones.
    if reduced is not None and not reduced.converged and shorter is not None:
        return min(reduced, shorter, key=lambda fit: _chi2_of(fit, best))
    return reduced


def _chi2_of(fit: TrajectoryFit, best: TrajectoryFit) -> float:
    """Return a model's chi^2 in the recordings of the best one; in proportion where it was fitted to some segments."""
    return fit.chi2 if fit.point.count == best.point.count else fit.misfit**2 * best.point.expected_chi2


def ranked(causes: Sequence[Cause]) -> tuple[Cause, ...]:
    """Return causes with their roles: main ones by the chi^2 that they explain, then minor ones by held-out gain."""
    largest = max((cause.decrease for cause in causes), default=0.0)
    roles = [replace(cause, role="minor" if cause.decrease < VISIBLE_SHARE * largest else "main") for cause in causes]
    main = sorted((cause for cause in roles if cause.role == "main"), key=lambda cause: -cause.decrease)
    minor = sorted((cause for cause in roles if cause.role == "minor"), key=lambda cause: -(cause.holdout_gain or 0.0))
    return (*main, *minor)


def _with_errors(effect: Effect, covariance: Array) -> dict[str, Estimate]:
    """Return an effect's parameters with errors by the delta method, from its coordinates' covariance (p, p).

    A whole number has none. What is a root of its coordinate has no slope at zero: its error is the change over one
    standard error of the coordinate.
    """
    x, values = effect.coordinates, effect.values
    steps = 1e-5 * np.maximum(np.abs(x), 1.0)
    roots = [k for k in effect.root_coordinates if covariance[k, k] > 0]
    steps[roots] = np.sqrt(np.diag(covariance)[roots])
    moved = [effect.at(x + step).values for step in np.diag(steps)]
    parameters = {}
    for parameter in effect.parameters:
        name = parameter.name
        slope = np.array([(point[name] - values[name]) / step for point, step in zip(moved, steps, strict=True)])
        with np.errstate(invalid="ignore"):  # the recordings may not determine a cause among several
            variance = float(slope @ covariance @ slope)
        known = np.isfinite(variance) and not parameter.integer and name not in effect.fixed
        std = float(np.sqrt(max(variance, 0.0))) if known else None
        nonnegative = parameter.lower >= 0
        parameters[name] = Estimate(name, float(values[name]), std, parameter.unit, nonnegative=nonnegative)
    return parameters
