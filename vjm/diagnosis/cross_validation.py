"""Tests that an effect must pass beside its significance: Wald's test of its size, and leave-one-out cross-validation.

In cross-validation (Stone, Journal of the Royal Statistical Society B 36, 1974) each recording, or group of repeats, is
predicted with the parameters fitted to the others: one Gauss-Newton step without the recording's rows. Only its own
initial state is estimated from it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from vjm.diagnosis.candidate_fit import information_of
from vjm.effects import Effect
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.identification.uncertainty import SINGULAR
from vjm.records import Array
from vjm.simulation.least_squares import SquareRootInformation
from vjm.simulation.run import Run


def is_determined(fit: TrajectoryFit, effect: Effect, alpha: float) -> bool:
    """Return True if an effect's magnitudes differ significantly from their null values (Wald's test).

    Their covariance allows for residuals that are correlated or larger than the noise.

    Args:
        fit: the model.
        effect: one of its effects.
        alpha: significance level.
    """
    sizes = fit.sizes_of(effect)
    x, covariance = fit.estimate[sizes], information_of(fit).covariance[np.ix_(sizes, sizes)]
    if not np.isfinite(covariance).all():
        return False
    statistic = float(x @ np.linalg.lstsq(covariance, x, rcond=None)[0])
    return bool(statistic > stats.chi2.isf(alpha, x.size))


def predicts_better(fit: TrajectoryFit, fewer: TrajectoryFit) -> bool:
    """Return True if a model has a smaller cross-validation error than one with an effect less.

    True as well where no recording, or group of repeats, can be predicted, since each has information that the others
    lack.

    Args:
        fit: the model.
        fewer: fitted to the same recordings or segments without one of its effects.
    """
    errors = _prediction_errors(fit)
    judged = np.isfinite(errors)
    # The smaller model cannot predict a recording better than it fits it: if even its fit is worse, no prediction of it
    # is needed.
    fitted = np.array([sum(fewer.point.runs[k].chi2 for k in group) for group in _groups(fewer.point.runs)])
    if not judged.any() or errors[judged].sum() < fitted[judged].sum():
        return True
    reduced_errors = _prediction_errors(fewer)
    judged &= np.isfinite(reduced_errors)
    return bool(not judged.any() or errors[judged].sum() < reduced_errors[judged].sum())


def _prediction_errors(fit: TrajectoryFit) -> Array:
    """Return the chi^2 (G,) with which each recording, or group of repeats, is predicted from the others.

    NaN where leaving the group out more than doubles the standard error of some combination of parameters: the others
    then do not determine what the group shows.
    """
    point = fit.point
    free = np.r_[~point.held, True]  # and the residuals' column
    parts = [part.eliminated(part.columns - point.x.size).R[:, free] for part in point.linearizations]
    prior = np.column_stack(point.problem.prior(point.x))[:, free]
    all_rows = np.vstack([*parts, prior])[:, :-1]
    groups = _groups(point.runs)
    errors = np.full(len(groups), np.nan)
    for index, group in enumerate(groups):
        rows = np.vstack([*(part for k, part in enumerate(parts) if k not in group), prior])
        if (
            _smallest_information_share(rows[:, :-1], all_rows) > 0.5**2
        ):  # a share of the information; errors go as its inverse root
            change = SquareRootInformation.of([(rows[:, :-1], rows[:, -1])], rows.shape[1] - 1).best()
            residuals = [parts[k][:, :-1] @ change - parts[k][:, -1] for k in group]
            errors[index] = sum(float(residual @ residual) for residual in residuals)
            errors[index] += sum(point.runs[k].log_determinant for k in group)  # which is a part of chi^2
    return errors


def _smallest_information_share(rows: Array, all_rows: Array) -> float:
    """Return the smallest share of the Fisher information on any combination of parameters that some rows hold.

    It is the smallest generalised eigenvalue of rows^T rows and whole^T whole.
    """
    scale = np.linalg.norm(all_rows, axis=0)
    shown = scale > 0
    _, sizes, axes = np.linalg.svd(all_rows[:, shown] / scale[shown], full_matrices=False)
    known = sizes > np.sqrt(SINGULAR) * sizes[0]  # singular values are roots of the information's eigenvalues
    parts = rows[:, shown] / scale[shown] @ axes[known].T / sizes[known]
    return float(np.linalg.svd(parts, compute_uv=False)[-1] ** 2) if len(parts) >= known.sum() else 0.0


def _groups(runs: Sequence[Run]) -> list[list[int]]:
    """Return the indices of the runs of each recording, or of recordings that repeat each other."""
    groups: dict[tuple[bool, str], list[int]] = {}
    for k, run in enumerate(runs):
        recording = run.observed.recording
        groups.setdefault((bool(recording.repeat), recording.repeat or recording.file), []).append(k)
    return list(groups.values())
