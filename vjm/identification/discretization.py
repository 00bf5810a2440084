"""Discretization error of a chain: what more virtual joints would change of its predictions and parameters.

The predictions of a chain with n joints differ from those of a beam by terms of orders 1/n^2 and 1/n^4, in recordings
of large bends far above the noise of many samples, and its best parameters are biased. A finer chain is therefore
compared with it, with the derivatives of the coarse one (deferred correction: Pereyra, Numerische Mathematik 10, 1967);
Richardson's extrapolation of the differences gives the offset of the predictions and the shift of the parameters to
those of a beam.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import monotonic
from typing import NamedTuple, Self

import numpy as np

from vjm.chain.layout import LayoutName, rig_layouts, starting_chain
from vjm.effects.effect import is_nonsmooth
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.parameters import Parametrisation
from vjm.identification.trajectory_fit import Point, TrajectoryFit, TrajectoryProblem, fit_trajectory, stays_above
from vjm.records import Array, Payload, Rig
from vjm.simulation.run import Run, simulate_runs

# Of the chain that stands for a beam, whatever the layout of the fitted one: three times the joints hardly bring
# `end-corrected` nearer to a beam, as its constants have three digits, and leave `equal` a third of its error.
_FINER_LAYOUT: LayoutName = "fourth-order"


class FirstOrderBias(NamedTuple):
    """Difference between a beam and a fitted chain, by one Gauss-Newton step beside that of their predictions."""

    offset: tuple[Array, ...]  # (N,) for each recording, the beam's predictions less the chain's [m, rad]
    shift: Array  # (p,) the beam's coordinates less the chain's
    decrease: float  # of chi^2, by what the chain's predictions lack
    chi2: float  # the shift's square in standard errors of the coordinates


def first_order_bias(point: Point, rig: Rig) -> FirstOrderBias | None:
    """Compare a fitted uniform chain with a finer one, to first order; None where that cannot be simulated.

    With stick-slip or play, beside which steps have larger errors, these are shorter by the factor of the joints.

    Args:
        point: where the chain fits best, beside offsets of its predictions if it has any.
        rig: the arm.
    """
    coarse = with_offset(point, None)
    try:
        predicted = _predictions(_finer(coarse, rig, _refinement(point)), coarse)
        factor = _extrapolation(coarse, rig, predicted)
        offset = tuple(factor * (fine - run.predicted) for fine, run in zip(predicted, coarse.runs, strict=True))
        free, change = ~point.held, np.zeros(point.x.size)
        before, beside = (each.reduced()[0].of_unknowns(free) for each in (point, with_offset(coarse, offset)))
        change[free] = beside.best() - before.best()
    except (SimulationDivergedError, InsufficientDataError):
        return None
    chi2 = float(np.sum((beside.R[:, :-1] @ change[free]) ** 2))
    return FirstOrderBias(offset, change, before.least - beside.least, chi2)


@dataclass(frozen=True)
class DiscretizationBias:
    """Difference between a beam and a fitted chain with few joints, each fitted as well as it can be."""

    offset: tuple[Array, ...]  # (N,) for each recording, the beam's predictions less the chain's [m, rad]
    shift: Array  # (p,) the beam's coordinates less the chain's

    @classmethod
    def of(cls, point: Point, rig: Rig, max_misfit: float = np.inf, deadline: float = np.inf) -> Self | None:
        """Compare a fitted chain with a finer one.

        Corrections of first order need not settle: over the many swings of an elbow a small error at the start grows.

        Args:
            point: where the chain fits best.
            rig: the arm.
            max_misfit: misfit of the finer chain, after all corrections, above which they have not settled.
            deadline: reading of `time.monotonic` after which nothing more is fitted [s].

        Returns:
            The bias; None where the finer chain cannot be simulated, or corrections will not settle, or not in time, or
            the bias is so large that what the extrapolation leaves of it may show in the residuals.
        """
        start = with_offset(point, None)
        finer = _finer(start, rig, _refinement(point))
        current, best, chi2, fall, factor = start, None, np.inf, np.inf, np.nan
        try:
            for remaining in reversed(range(4)):  # corrections; each reduces the rest of the error by the error itself
                predicted = _predictions(finer, current)
                factor = _extrapolation(start, rig, predicted) if current is start else factor
                previous, chi2 = chi2, sum(map(_chi2, current.runs, predicted))
                previous_fall, fall = fall, previous - chi2
                # What is left falls by about the same factor each time, and so do the falls.
                if chi2 * min(chi2 / previous, 1.0) ** remaining > max_misfit**2 * point.expected_chi2:
                    return None
                negligible = 1e-4 * chi2  # below a tenth of a typical noise of chi^2
                if not fall > negligible:
                    break
                best = predicted, current.x
                if np.isfinite(previous_fall) and fall**2 / previous_fall < negligible:
                    break
                if remaining:
                    offset = [fine - run.predicted for fine, run in zip(predicted, current.runs, strict=True)]
                    shifted = with_offset(current, offset)
                    states = [run.state for run in shifted.runs]
                    # To the minimum: a loose tolerance leaves up to ten standard errors, which do not settle.
                    fit = fit_trajectory(
                        shifted.problem, shifted.x, None, states, stop=lambda *_: monotonic() > deadline
                    )
                    if monotonic() > deadline:
                        return None
                    current = with_offset(fit.point, None)
        except (SimulationDivergedError, InsufficientDataError):
            return None
        if best is None:
            return None
        predicted, x = best
        changes = [fine - run.predicted for fine, run in zip(predicted, start.runs, strict=True)]
        # What the extrapolation adds is a bound of its own error.
        added = [
            run.observed.whitened(run.observed.weights * (factor - 1) * change)
            for run, change in zip(start.runs, changes, strict=True)
        ]
        if sum(float(part @ part) for part in added) > point.noise_limit - point.expected_chi2:
            return None
        return cls(tuple(factor * change for change in changes), factor * (x - point.x))

    def corrected(self, candidate: TrajectoryFit, max_misfit: float, deadline: float = np.inf) -> TrajectoryFit | None:
        """Fit a model again beside the bias; None where its misfit comes out larger than `max_misfit`.

        After the deadline, a reading of `time.monotonic` [s], the fit ends where it stands.
        """
        point = with_offset(candidate.point, self.offset)
        states = [run.state for run in point.runs]
        max_chi2 = max_misfit**2 * point.expected_chi2
        fit = fit_trajectory(
            point.problem,
            point.x,
            None,
            states,
            stop=lambda trial, predicted: stays_above(trial, predicted, max_chi2) or monotonic() > deadline,
        )
        return None if fit.misfit > max_misfit else replace(fit, shift=self.shift)


def with_offset(point: Point, offset: Sequence[Array] | None) -> Point:
    """Return the same simulations with offsets (N,) of their predictions, one for each recording; None: without."""
    if offset is None and all(run.observed.discretization_offset is None for run in point.runs):
        return point  # with what is known of its linearization
    runs = tuple(
        replace(run, observed=replace(run.observed, discretization_offset=run_offset))
        for run, run_offset in zip(point.runs, [None] * len(point.runs) if offset is None else offset, strict=True)
    )
    return replace(point, problem=replace(point.problem, observed=tuple(run.observed for run in runs)), runs=runs)


def _refinement(point: Point) -> int:
    """Return how many times as many joints to compare with: three leave a ninth of the error, two a quarter.

    With an elbow more joints take shorter steps as well, and three times as many ten times as long.
    """
    return 2 if point.chain.elbows.size else 3


def _extrapolation(point: Point, rig: Rig, fine: Sequence[Array]) -> float:
    """Return the factor of Richardson's extrapolation, by which a beam differs more from a chain than a finer one does.

    Errors are of order 1/n^2 where the link bends much, and of 1/n^4 elsewhere: how much of them is of either follows
    from the predictions of a third chain, with twice the joints. Beside an elbow, where that is the finer one, they are
    taken to be of order 1/n^2. The factor is one where the fitted chain has another layout: its error, which is many
    times larger, says nothing of what the finer chain leaves.

    Args:
        point: the fitted chain, without offsets.
        rig: the arm.
        fine: (N,) for each recording, the finer chain's predictions [m, rad].
    """
    links, refinement = point.chain.links, _refinement(point)
    cuts = rig_layouts(rig, [link.virtual_joints for link in links], _FINER_LAYOUT, _payloads(point))
    if not all(np.allclose(link.lengths, cut.lengths) for link, cut in zip(links, cuts, strict=True)):
        return 1.0
    second, fourth = ((1 / (1 - refinement**-order)) for order in (2, 4))
    if refinement == 2:
        return second
    product, square = 0.0, 0.0
    for run, twice, finer in zip(point.runs, _predictions(_finer(point, rig, 2), point), fine, strict=True):
        less, more = (run.observed.whitened(run.observed.weights * (other - run.predicted)) for other in (twice, finer))
        product, square = product + float(less @ more), square + float(more @ more)
    # Differences from chains with two and three times the joints are a (1 - 1/4) and a (1 - 1/9) of an error a / n^2,
    # b (1 - 1/16) and b (1 - 1/81) of one b / n^4.
    return float(np.clip(81 / 40 - 16 / 15 * product / max(square, 1e-300), fourth, second))


def _finer(point: Point, rig: Rig, factor: int) -> TrajectoryProblem:
    """Return the problem of a chain with so many times the joints."""
    coarse = point.problem.parametrisation
    joints = [factor * link.virtual_joints for link in coarse.template.links]
    template = starting_chain(rig, rig_layouts(rig, joints, _FINER_LAYOUT, _payloads(point)))
    finer = Parametrisation(template, coarse.kind, coarse.hubs)
    return replace(point.problem, parametrisation=finer)


def _payloads(point: Point) -> list[Payload]:
    """Return what is on the tip, as the effects say: where it is no point, it bends the end of a chain made free."""
    inputs = [run.arm.inputs(run.observed.recording) for run in point.runs]
    return [*(run.chain.links[-1].payload_body for run in point.runs), *(driven.payload_body for driven in inputs)]


def _predictions(finer: TrajectoryProblem, point: Point) -> list[Array]:
    """Return the finer chain's predictions for each recording [m, rad]."""
    observed, multiple = [run.observed for run in point.runs], point.problem.step_multiple
    if is_nonsmooth(point.problem.effects):
        multiple = min(multiple, 1.0) * point.chain.size / finer.parametrisation.template.size
    arms = finer.arms(point.x, [run.observed.recording for run in point.runs])
    states = _transferred_states(finer, point)
    return [run.predicted for run in simulate_runs(arms, observed, None, states, multiple)]


def _transferred_states(finer: TrajectoryProblem, point: Point) -> list[Array]:
    """Return the initial states (2 nv,) of the finer chain that a fitted chain's stand for."""
    arms = finer.arms(point.x, [run.observed.recording for run in point.runs])
    return [run.transferred_state(arm) for run, arm in zip(point.runs, arms, strict=True)]


def _chi2(run: Run, predicted: Array) -> float:
    residual = run.observed.whitened(run.observed.weights * (run.observed.values - predicted))
    return float(residual @ residual)
