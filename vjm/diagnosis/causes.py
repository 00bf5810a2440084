"""Causes: the new effects of the best model, their parameters and standard errors, and what is missed without each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vjm.diagnosis.records import Alternative, Cause
from vjm.diagnosis.selection import Search, SearchResult
from vjm.effects import Effect
from vjm.effects.effect import Key
from vjm.records import Array, Estimate


def estimate_causes(
    result: SearchResult, search: Search, alternatives: Mapping[Key, tuple[Alternative, ...]]
) -> tuple[Cause, ...]:
    """Return the best model's new effects, the one without which most is missed first.

    Args:
        result: of the search.
        search: fits the best model without an effect where that was not done on the way.
        alternatives: effects that explain the recordings as well, by the cause in whose place.
    """
    best, causes = result.best, []
    spread = best.information.covariance
    estimated = best.extension.present(best.estimate)
    for effect, estimate, part in [*zip(best.effects, estimated, best.extension.parts, strict=True)][
        best.reference_effects :
    ]:
        without = (
            search.trials.tried.get(best.names - {effect.key})
            or search.trials.without(best, effect, np.inf)
            or search.start
        )
        decrease = without.chi2 - best.chi2
        # Where the best model leaves more than noise, what it leaves is the measure.
        p_of_fit = result.first.p_of_fit(effect, decrease / max(1.0, best.misfit**2))
        p_value = max(min(result.p_values.get(effect.key, 1.0), p_of_fit), 1e-300)
        unit = "the noise" if search.search_start.reference_misfit == 1 else "what was missing before the change"
        evidence = (
            f"without it the model misses the training recordings by {without.misfit:.3g} times {unit}, with it by "
            f"{best.misfit:.3g}; chi^2 falls by {decrease:.3g}"
        )
        parameters = _with_errors(estimate, spread[part, part])
        causes.append(Cause(effect, parameters, p_value, decrease, alternatives.get(effect.key, ()), evidence))
    return tuple(sorted(causes, key=lambda cause: -cause.gain))


def _with_errors(effect: Effect, spread: Array) -> dict[str, Estimate]:
    """Parameters with standard errors, from the covariance (p, p) of the effect's coordinates (delta method)."""
    x, values = effect.coordinates, effect.values
    steps = 1e-5 * np.maximum(np.abs(x), 1.0)
    moved = [effect.at(x + step).values for step in np.diag(steps)]
    parameters = {}
    for parameter in effect.parameters():
        name = parameter.name
        slope = np.array([(other[name] - values[name]) / step for other, step in zip(moved, steps, strict=True)])
        with np.errstate(invalid="ignore"):  # the recordings may not determine a cause among several
            variance = float(slope @ spread @ slope)
        std = float(np.sqrt(max(variance, 0.0))) if np.isfinite(variance) and not parameter.integer else None
        parameters[name] = Estimate(name, float(values[name]), std, parameter.unit)
    return parameters
