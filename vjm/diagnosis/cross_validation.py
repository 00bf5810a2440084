"""Tests that an effect of a fitted model must pass beside its significance: a size that is determined, and prediction.

Leave-one-out cross-validation (Stone, Journal of the Royal Statistical Society B 36, 1974): each recording, or group
of repeats, is predicted by the parameters that the others give. Only the recording's own initial state is estimated
from it. The parameters are those of one Gauss-Newton step without the recording's rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from vjm.diagnosis.candidate_fit import information_of
from vjm.effects import Effect
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.records import Array
from vjm.simulation.least_squares import SquareRootInformation
from vjm.simulation.run import Run


def is_determined(fit: TrajectoryFit, effect: Effect, alpha: float) -> bool:
    """Return True if an effect's magnitudes differ from their nulls by more than their errors (Wald's test).

    The errors allow for residuals that are correlated or larger than the noise.

    Args:
        fit: the model.
        effect: one of its effects.
        alpha: significance level.
    """
    effects = zip(fit.effects, fit.point.problem.parts, strict=True)
    start = next(part.start for one, part in effects if one is effect)
    sizes = slice(start, start + effect.magnitude_count)
    x, covariance = fit.estimate[sizes], information_of(fit).covariance[sizes, sizes]
    if not np.isfinite(covariance).all():
        return False
    statistic = float(x @ np.linalg.lstsq(covariance, x, rcond=None)[0])
    return statistic > stats.chi2.isf(alpha, x.size)


def prediction_error(fit: TrajectoryFit) -> float:
    """Return chi^2 of all recordings, each predicted from the others; NaN where there is one recording or group only.

    Sizes that the others do not determine stay at their nulls: an effect shows in one recording alone, and gains or
    loses nothing in its prediction.
    """
    point = fit.point
    groups = _groups(point.runs)
    if len(groups) < 2:
        return float("nan")
    parts = [part.eliminated(part.columns - point.x.size).R for part in point.linearizations]
    known = np.column_stack(point.problem.prior(point.x))
    shrunk = _towards_null(fit)
    error = 0.0
    for group in groups:
        others = [part for k, part in enumerate(parts) if k not in group]
        rows = np.vstack([*others, known, shrunk])
        change = SquareRootInformation.of([(rows[:, :-1], rows[:, -1])], point.x.size).best()
        for k in group:
            residual = parts[k][:, :-1] @ change - parts[k][:, -1]
            error += float(residual @ residual)
    return error


def _groups(runs: Sequence[Run]) -> list[list[int]]:
    """Indices of the runs of each recording, or of recordings that repeat each other."""
    groups: dict[tuple[bool, str], list[int]] = {}
    for k, run in enumerate(runs):
        recording = run.observed.recording
        groups.setdefault((bool(recording.repeat), recording.repeat or recording.file), []).append(k)
    return list(groups.values())


def _towards_null(fit: TrajectoryFit) -> Array:
    """Rows (r, p + 1) of a prior of new effects' magnitudes about their nulls, as wide as what was estimated."""
    x = fit.point.x
    rows = []
    for effect, part in zip(fit.effects, fit.point.problem.parts, strict=True):
        for k in range(part.start, part.start + effect.magnitude_count):
            row = np.zeros(x.size + 1)
            if effect in fit.new_effects and x[k] != 0:
                row[k], row[-1] = 1 / abs(x[k]), -np.sign(x[k])
                rows.append(row)
    return np.array(rows).reshape(-1, x.size + 1)
