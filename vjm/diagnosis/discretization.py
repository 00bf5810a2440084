"""Correction of a model's discretization error, beside which effects are looked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from time import monotonic

import numpy as np

from vjm.effects.effect import is_nonsmooth
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.discretization import DiscretizationBias, FirstOrderBias, first_order_bias, with_offset
from vjm.identification.trajectory_fit import Point, TrajectoryFit, fit_trajectory
from vjm.records import Array, Rig

CLOSE_MISFIT = 2.0  # misfit up to which the discretization error is comparable with what else is missing


@lru_cache(maxsize=4)
def bias_of(fit: TrajectoryFit, rig: Rig) -> FirstOrderBias | None:
    """Return a model's discretization error to first order, as of `first_order_bias`; the last ones are remembered."""
    return first_order_bias(fit.point, rig)


def corrected_for_discretization(
    fit: TrajectoryFit, rig: Rig, negligible: float = 0.0, deadline: float = np.inf
) -> TrajectoryFit | None:
    """Fit a model again with its chain's discretization error corrected, measured beside its own effects.

    Args:
        fit: the model. Where its misfit exceeds `CLOSE_MISFIT`, more is missing than that error, and it is returned. A
            correction that it has, measured beside other effects, is replaced.
        rig: the arm.
        negligible: decrease of chi^2 up to which only the estimates of a model with stick-slip or play are corrected.
        deadline: reading of `time.monotonic` after which nothing more is fitted [s].

    Returns:
        The model; None where the error cannot be measured, or not in time.
    """
    if fit.misfit > CLOSE_MISFIT:
        return fit
    if monotonic() > deadline:
        return None
    point = with_offset(fit.point, None)
    if point is not fit.point:
        try:
            fit = fit_trajectory(point.problem, point.x, None, point.states, stop=lambda *_: monotonic() > deadline)
        except (SimulationDivergedError, InsufficientDataError):
            return None
        if fit.misfit > CLOSE_MISFIT:
            return None
    if is_nonsmooth(fit.effects):
        return _corrected_beside_kinks(fit, rig, negligible, deadline)
    bias = DiscretizationBias.of(fit.point, rig, CLOSE_MISFIT, deadline)
    return None if bias is None else bias.corrected(fit, CLOSE_MISFIT, deadline)


def _corrected_beside_kinks(fit: TrajectoryFit, rig: Rig, negligible: float, deadline: float) -> TrajectoryFit | None:
    """Correct a model with stick-slip or play, as often as corrections settle; where a joint only just sticks, once.

    If the first one would lower chi^2 by no more than `negligible`, only the parameters are corrected, as a fit takes
    several times as long. None where the corrected model leaves more than noise and more than the chain.
    """
    bias = None if monotonic() > deadline else bias_of(fit, rig)
    if bias is None:
        return None
    if bias.decrease <= negligible:
        nothing = [np.zeros_like(difference) for difference in bias.offset]
        return replace(fit, point=with_offset(fit.point, nothing), shift=bias.shift)
    corrected, used, last = None, bias, np.zeros(fit.point.x.size)
    while True:
        trial = _fitted_beside(corrected or fit.point, bias.offset, deadline)
        if trial is None or trial.chi2 > max(fit.chi2, trial.noise_limit):
            break
        corrected, used = trial, bias
        further = None if monotonic() > deadline else first_order_bias(corrected, rig)
        # Unless each correction is half as large as the one before, they need not settle.
        if further is None or further.chi2 > used.chi2 / 4:
            break
        if further.chi2 < 1.0:  # within a standard error a linear model will do
            last = further.shift
            break
        bias = further
    if corrected is None:
        return None
    runs = zip(corrected.runs, fit.point.runs, used.offset, strict=True)
    offset = [after.predicted - before.predicted + difference for after, before, difference in runs]
    return replace(fit, point=with_offset(fit.point, offset), shift=corrected.x + last - fit.point.x)


def _fitted_beside(point: Point, offset: Sequence[Array], deadline: float) -> Point | None:
    """Fit again beside offsets of the predictions; None where that cannot be simulated."""
    beside = with_offset(point, offset)
    states = [run.state for run in beside.runs]
    try:
        return fit_trajectory(beside.problem, beside.x, None, states, stop=lambda *_: monotonic() > deadline).point
    except (SimulationDivergedError, InsufficientDataError):
        return None
