"""What a chain shows otherwise than a beam, because its joints are few: measured against a finer chain, and corrected.

A chain with n joints follows recordings best with parameters that are a little off, and even then not quite: its error
is of the order 1/n^2 of a large bend, far above the noise of many samples, and looks like effects that are not there.
Simulating more joints is simple, searching with them slow. So a finer chain is fitted once, with the derivatives of the
coarse one (deferred correction): where both follow the recordings as well as they can, what the finer one shows beyond
the coarse one is known from then on, and its parameters are those of the beam.

Source: V. Pereyra, Iterated deferred corrections for nonlinear operator equations, Numerische Mathematik 10, 1967.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vjm.chain.layout import DEFAULT_LAYOUT, nominal_chain, rig_layouts
from vjm.diagnosis.candidate_fit import Extension
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.parameters import Parametrisation
from vjm.identification.torque_method import START_DAMPING
from vjm.identification.trajectory_fit import Coordinates, Point, TrajectoryFit, fit_trajectory
from vjm.model import dynamics
from vjm.records import Array, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.run import Run, Start, run_all, transferred

CLOSE = 2.0  # misfit from which coarseness is the smallest worry
_FINER = 3  # times as many joints
_ENDLESS = _FINER**2 / (_FINER**2 - 1)  # Richardson's extrapolation of an error of order 1/n^2
_PASSES = 4
_SETTLED = 1e-4  # relative fall of chi^2 from one pass to the next


@dataclass(frozen=True)
class DiscretizationBias:
    """How a chain with endless joints would differ, each fitted as well as it can be.

    Attributes:
        discretization_offset: (N,) for each recording, what it would show beyond the chain [m, rad].
        shift: (p,) of the coordinates, from the chain's to its own.
    """

    discretization_offset: tuple[Array, ...]
    shift: Array


def discretization_bias(point: Point, rig: Rig, rough: bool = False) -> DiscretizationBias | None:
    """Compare a fitted chain with a finer one.

    Args:
        point: where the chain fits best.
        rig: the arm.
        rough: whether to tell the difference with the same parameters, which is most of it, and no shift.

    Returns:
        The difference; None where the finer chain cannot be simulated.
    """
    bare = with_offset(point, [None] * len(point.runs))
    finer = _finer(bare, rig)
    best, found, here = np.inf, None, bare
    try:
        for left in reversed(range(1 if rough else _PASSES)):
            shown, own = _shown(finer, here), [_predicted(here, k) for k in range(len(here.runs))]
            chi2 = sum(_chi2(here, k, each) for k, each in enumerate(shown))
            if not chi2 < best * (1 - _SETTLED):
                break
            best, found = chi2, (shown, here.x)
            if left:
                discretization_offset = [one - two for one, two in zip(shown, own, strict=True)]
                fit = _fitted(with_offset(here, discretization_offset), rough=True)
                here = with_offset(fit.point, [None] * len(shown))
    except (SimulationDivergedError, InsufficientDataError):
        return None
    if found is None:
        return None
    shown, x = found
    discretization_offset = [_ENDLESS * (each - _predicted(bare, k)) for k, each in enumerate(shown)]
    return DiscretizationBias(tuple(discretization_offset), _ENDLESS * (x - point.x))


def corrected(fit: TrajectoryFit, found: DiscretizationBias | None, rough: bool = False) -> TrajectoryFit:
    """The fit once its chain's coarseness is known; a rough one is only a start for others."""
    if found is None:
        return fit
    return _fitted(with_offset(fit.point, found.discretization_offset), rough)


def with_offset(point: Point, discretization_offset: Sequence[Array | None]) -> Point:
    """The same simulations, beside what is known to be shown beyond them."""
    runs = tuple(
        replace(run, observed=replace(run.observed, discretization_offset=each))
        for run, each in zip(point.runs, discretization_offset, strict=True)
    )
    return replace(point, problem=replace(point.problem, observed=tuple(run.observed for run in runs)), runs=runs)


def _fitted(point: Point, rough: bool = False) -> TrajectoryFit:
    return fit_trajectory(point.problem, point.x, None, [run.state for run in point.runs], rough=rough)


def _finer(point: Point, rig: Rig) -> Coordinates:
    """The same coordinates of a chain with more joints."""
    step_multiple = point.problem.parametrisation
    joints = [_FINER * link.virtual_joints for link in step_multiple.template.links]
    template = nominal_chain(rig, rig_layouts(rig, joints, DEFAULT_LAYOUT), START_DAMPING)
    fine = Parametrisation(template, step_multiple.kind, step_multiple.hubs)
    extension = point.problem.extension
    return replace(extension, base=fine) if isinstance(extension, Extension) else fine


def _shown(finer: Coordinates, point: Point) -> list[Array]:
    """What the finer chain would have shown [m, rad]."""
    observed = [run.observed for run in point.runs]
    arms = finer.arms(point.x, [each.recording for each in observed])
    starts = [Start.of(arm, each.recording) for arm, each in zip(arms, observed, strict=True)]
    states = [_carried_over(run, arm) for run, arm in zip(point.runs, arms, strict=True)]
    runs = run_all(arms, observed, starts, states, point.problem.step_multiple)
    return [run.observed.predicted(run.arm, run.steps) for run in runs]


def _carried_over(run: Run, arm: Arm) -> Array:
    """(2 nv,) a run's initial state in a finer chain, with the same momentum of its active joints.

    The rates with which fast modes begin are told differently by different chains; a joint that is free must not drift
    away with the difference.
    """
    state = transferred(run.chain, arm.chain, run.state)
    active = arm.chain.active
    if not active.size:
        return state
    recording = run.observed.recording
    (q, v), (fine_q, fine_v) = np.split(run.state, 2), np.split(state, 2)
    step_multiple = dynamics.mass_matrix(dynamics.build(run.chain, run.arm.inputs(recording).payload), q[None])[0]
    fine = dynamics.mass_matrix(dynamics.build(arm.chain, arm.inputs(recording).payload), fine_q[None])[0]
    missing = (step_multiple @ v)[run.chain.active] - (fine @ fine_v)[active]
    fine_v[active] += np.linalg.solve(fine[np.ix_(active, active)], missing)
    return np.concatenate([fine_q, fine_v])


def _predicted(point: Point, k: int) -> Array:
    run = point.runs[k]
    return run.observed.predicted(run.arm, run.steps)


def _chi2(point: Point, k: int, shown: Array) -> float:
    """Of what would have been shown."""
    seen = point.runs[k].observed
    left = seen.whitened(seen.weights * (seen.values - shown))
    return float(left @ left)
