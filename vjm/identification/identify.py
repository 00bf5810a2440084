"""The identification from an experiment to a model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np

from vjm.chain.layout import DEFAULT_LAYOUT, chain_layouts, nominal_chain
from vjm.chain.virtual_links import Chain
from vjm.errors import ChoiceError, ShapeError
from vjm.identification.assess import compare_modes, fit_recordings, objective_of, prepared_for, torque_data
from vjm.identification.parameters import PARAMETRISATIONS, Parametrisation
from vjm.identification.prepare import (
    Data,
    Options,
    read_data,
)
from vjm.identification.records import METHODS, Identification, TrajectorySummary
from vjm.identification.torque_method import by_torque
from vjm.identification.trajectory_method import by_trajectory
from vjm.identification.uncertainty import Information, covariance, estimates, of_torque, of_trajectory, to_physical
from vjm.identification.virtual_joints import JointChoice
from vjm.identification.warn import (
    data_warnings,
    joint_notes,
    mode_warnings,
    repeat_warnings,
    residual_warnings,
    result_warnings,
    scale_notes,
)
from vjm.markers.angles import ANGLE_METHODS, AngleMethod
from vjm.records import Array, Experiment, Progress
from vjm.simulation.least_squares import LOSSES
from vjm.simulation.model import Model

_STOPPED_EARLY = "the search stopped early: ask for fewer parameters, or give recordings that move more"


def identify(
    experiment: Experiment,
    method: str = "trajectory",
    virtual_joints: int | None = None,
    parameters: str = "uniform",
    *,
    layout: str = DEFAULT_LAYOUT,
    family: str = "cantilever",
    angles: str | None = None,
    derivatives: str = "smoothing",
    loss: str = "linear",
    progress: Progress | None = None,
) -> Identification:
    """Identify an arm's virtual-joint model from its training recordings.

    Args:
        experiment: the rig and its recordings.
        method: `trajectory`, the maximum-likelihood fit of whole simulated trajectories to everything measured;
            `torque`, torque errors (eqs. 14-16); `torque+frequency`, with the natural frequencies (section 6.5).
        virtual_joints: n of every link; the experiment file's, or chosen from the data, when None.
        parameters: `uniform`, one bending stiffness and Kelvin-Voigt time a link; `joints`, every joint's K and D;
            `lengths`, those and the virtual links' lengths; `full`, all of alpha (eq. 13).
        layout: where the links are cut: `fourth-order`, `end-corrected`, `half-ends` or `equal`.
        family: of the shape functions.
        angles: `curvature`, `curve` or, as in the paper, `points`; chosen by the parametrisation when None.
        derivatives: `smoothing` or, as in the paper, `interpolating`.
        loss: of the trajectories' residuals: `linear`, `huber`, `soft_l1` or `cauchy`. Single outliers are left out
            whatever the loss.
        progress: told (text, done, total) while it runs.

    Raises:
        ChoiceError: an unknown method or option.
        InsufficientDataError: recordings that cannot determine the model.
        SimulationDivergedError: no start can be simulated.
    """
    _check_choices(method, parameters, angles, virtual_joints, loss)
    options = Options(parameters, virtual_joints, layout, family, cast(AngleMethod | None, angles), derivatives)
    data = read_data(experiment, options)
    if method == "trajectory":
        found = _trajectory(experiment, data, loss, progress)
    else:
        found = _torque(experiment, data, method == "torque+frequency", progress)
    return _result(experiment, method, data, found, progress)


def _check_choices(method: str, parameters: str, angles: str | None, virtual_joints: int | None, loss: str) -> None:
    for what, given, choices in (
        ("method", method, METHODS),
        ("parameters", parameters, PARAMETRISATIONS),
        ("angles", angles, (None, *ANGLE_METHODS)),
        ("loss", loss, LOSSES),
    ):
        if given not in choices:
            raise ChoiceError(what, given, choices)
    if virtual_joints is not None and not 1 <= virtual_joints <= 60:
        raise ShapeError("virtual_joints", virtual_joints, "a number from 1 to 60")


@dataclass(frozen=True)
class _Found:
    """What either method found."""

    parametrisation: Parametrisation
    x: Array
    information: Information
    joints: tuple[JointChoice, ...]
    converged: bool
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    before: Chain | None = None
    states: Mapping[str, Array] | None = None
    trajectory: TrajectorySummary | None = None


def _torque(experiment: Experiment, data: Data, frequencies: bool, progress: Progress | None) -> _Found:
    problem, fit = by_torque(experiment, data, progress, frequencies)
    return _Found(
        problem.parametrisation, fit.x, of_torque(fit), data.plan.joints, fit.converged, warnings=data.problems
    )


def _trajectory(experiment: Experiment, data: Data, loss: str, progress: Progress | None) -> _Found:
    found = by_trajectory(experiment, data, loss, progress)
    point = found.fit.point
    information, whiteness = of_trajectory(found.fit, experiment.rig.marker_noise is not None)
    return _Found(
        point.problem.parametrisation,
        point.x,
        information,
        found.joints,
        found.fit.converged,
        warnings=(*found.problems, *residual_warnings(whiteness)),
        notes=found.notes,
        before=None if found.torque is None else found.torque[0].parametrisation.chain(found.torque[1].x),
        states={run.observed.recording.file: run.state for run in point.runs},
        trajectory=TrajectorySummary(whiteness, found.fit),
    )


def _result(
    experiment: Experiment, method: str, data: Data, found: _Found, progress: Progress | None
) -> Identification:
    orders, noise = data.plan.shape.orders, (data.settings.marker_noise, data.settings.encoder_noise)
    parametrisation, information = found.parametrisation, found.information
    chain = parametrisation.chain(found.x)
    physical = to_physical(parametrisation, found.x, covariance(information))
    parameters = estimates(parametrisation, found.x, information, physical)
    model = Model(chain, experiment.rig, *noise, parameters)
    nominal = Model(nominal_chain(experiment.rig, chain_layouts(chain)), experiment.rig, *noise)
    before = None if found.before is None else Model(found.before, experiment.rig, *noise)
    recordings = fit_recordings(experiment, model, (nominal, before), progress, found.states)
    comparison = compare_modes(model, data.payload, data.prepared, data.seen, max(orders))
    prepared = prepared_for(chain, experiment.rig, data)
    kind = parametrisation.kind
    known = [k for k, estimate in enumerate(parameters) if estimate.std is not None]
    return Identification(
        experiment=experiment,
        model=model,
        nominal=nominal,
        torque_model=before,
        method=method,
        parametrisation=kind,
        parameters=parameters,
        covariance=physical[np.ix_(known, known)],
        modes=comparison,
        objective=objective_of(chain, prepared, chain),
        objective_nominal=objective_of(nominal.chain, prepared, chain),
        trajectory=found.trajectory,
        torque_data=tuple(torque_data(one, nominal.chain, chain) for one in prepared),
        recordings=recordings,
        status="converged" if found.converged else "not converged",
        remedy="" if found.converged else _STOPPED_EARLY,
        warnings=(
            *experiment.warnings,
            *data_warnings(experiment, data.prepared, orders, found.joints, data.seen, kind),
            *repeat_warnings(data.recordings, noise[0]),
            *found.warnings,
            *mode_warnings(comparison if method == "torque" else ()),
            *result_warnings(recordings, parameters),
        ),
        notes=(
            *joint_notes(experiment, orders, found.joints, kind),
            *found.notes,
            *scale_notes(experiment.rig, data.recordings),
        ),
    )
