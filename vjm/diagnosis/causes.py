"""What each cause is: its size, how sure it is, and what the model misses without it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.records import Cause, Rival, Size
from vjm.diagnosis.search import Found, Search
from vjm.effects import Effect
from vjm.effects.effect import Key

Array = NDArray[np.float64]

_SLOPE_STEP = 1e-5


def found_causes(
    search: Search, found: Found, rivals: Mapping[Key, tuple[Rival, ...]], spread: Array
) -> tuple[Cause, ...]:
    """The best explanation's new effects as causes, the one without which most is missed first.

    Args:
        search: can fit more.
        found: where it ended.
        rivals: what explains the recordings as well, by the cause in whose place.
        spread: (p, p) covariance of the best explanation's coordinates.
    """
    best, family, causes = found.best, found.first, []
    scale = max(1.0, best.point.misfit**2)
    estimated = best.extension.present(best.estimate)
    for effect, beam, part in [*zip(best.effects, estimated, best.extension.parts, strict=True)][best.everywhere :]:
        fewer = search.trials.tried.get(best.names - {effect.key}) or search.trials.without(best, effect, np.inf)
        without = fewer or search.start
        drop = without.chi2 - best.chi2
        before, after = without.point.misfit, best.point.misfit
        unit = "the noise" if search.begun.lacking == 1 else "what was missing before the change"
        evidence = (
            f"without it the model misses the training recordings by {before:.3g} times {unit}, with it by "
            f"{after:.3g}; chi^2 falls by {drop:.3g}"
        )
        causes.append(
            Cause(
                effect,
                _sizes(beam, spread[part, part]),
                max(min(found.p_values.get(effect.key, 1.0), family.p_of_fit(effect, drop / scale)), 1e-300),
                drop,
                rivals.get(effect.key, ()),
                evidence,
            )
        )
    return tuple(sorted(causes, key=lambda cause: -cause.gain))


def _sizes(effect: Effect, spread: Array) -> dict[str, Size]:
    """Parameters with standard errors, from the covariance (p, p) of the effect's coordinates."""
    at, values = effect.coordinates, effect.values
    slopes = {name: np.zeros(at.size) for name in values}
    for k in range(at.size):
        step = _SLOPE_STEP * max(abs(at[k]), 1.0)
        moved = effect.at(at + step * np.eye(at.size)[k]).values
        for name, value in values.items():
            slopes[name][k] = (moved[name] - value) / step
    found = {}
    for each in effect.parameters():
        slope = slopes[each.name]
        with np.errstate(invalid="ignore"):  # of an explanation that the recordings do not determine
            variance = float(slope @ spread @ slope)
        std = float(np.sqrt(max(variance, 0.0))) if np.isfinite(variance) and not each.whole else None
        found[each.name] = Size(float(values[each.name]), std, each.unit)
    return found
