"""The identification from an experiment to a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from vjm.angles.estimate import ANGLE_METHODS, AngleMethod
from vjm.chain.layout import DEFAULT_LAYOUT
from vjm.chain.records import Chain
from vjm.errors import ChoiceError, InsufficientDataError, ShapeError
from vjm.experiment.records import Experiment, Recording
from vjm.identification.assess import (
    MATCH_TOLERANCE,
    compare_modes,
    fit_recordings,
    objective,
    objective_of,
    torque_data,
)
from vjm.identification.parametrisation import PARAMETRISATIONS, Parametrisation
from vjm.identification.plan import Plan, make_plan
from vjm.identification.prepare import Prepared, Settings, fitted_recordings, modes_in, prepare
from vjm.identification.records import METHODS, Identification
from vjm.identification.select import nominal_chain
from vjm.identification.torque_fit import FrequencyTarget, Progress, TorqueFit, TorqueProblem, fit_torque, spread_of
from vjm.identification.uncertainty import covariance, estimates, to_physical
from vjm.identification.warn import data_warnings, joint_notes, mode_warnings, result_warnings
from vjm.model import Model
from vjm.modes import modes
from vjm.noise import sensor_noise
from vjm.spectrum import MeasuredModes, match

Array = NDArray[np.float64]

_MODEL_FLOOR = 5e-4  # relative accuracy of a small chain's frequencies, however sharp the measured ones are
_EXTRA_MODES = 2  # peaks looked for beyond the modes that the shapes show
_START_DAMPING = 1e-3  # s, Kelvin-Voigt time the search starts from
_MOST_PASSES = 5  # with a weight of the preference that follows from the pass before
_NOT_CONVERGED = "the search stopped early: ask for fewer parameters, or give recordings that move more"


def identify(
    experiment: Experiment,
    method: str = "torque",
    virtual_joints: int | None = None,
    parameters: str = "uniform",
    *,
    layout: str = DEFAULT_LAYOUT,
    family: str = "cantilever",
    angles: str | None = None,
    derivatives: str = "smoothing",
    progress: Progress | None = None,
) -> Identification:
    """Identify an arm's virtual-joint model from its training recordings.

    Args:
        experiment: the rig and its recordings.
        method: `torque`, torque errors (eqs. 14-16); `torque+frequency`, with the natural frequencies (section 6.5).
        virtual_joints: n of every link; the experiment file's, or chosen from the data, when None.
        parameters: `uniform`, one bending stiffness and Kelvin-Voigt time a link; `joints`, every joint's K and D;
            `lengths`, those and the virtual links' lengths; `full`, all of alpha (eq. 13).
        layout: where the links are cut: `fourth-order`, `end-corrected`, `half-ends` or `equal`.
        family: of the shape functions.
        angles: `curvature`, `curve` or, as in the paper, `points`; chosen by the parametrisation when None.
        derivatives: `smoothing` or, as in the paper, `interpolating`.
        progress: told (text, done, total) while it runs.

    Raises:
        ChoiceError: an unknown method or option.
        InsufficientDataError: recordings that cannot determine the model.
    """
    _check_choices(method, parameters, angles, virtual_joints)
    data = read_data(
        experiment, parameters, virtual_joints, layout, family, cast(AngleMethod | None, angles), derivatives
    )
    problem, fit = fit_uniform(experiment, data, progress)
    if parameters != "uniform":
        # The uniform link found first is where the search starts, and what it keeps to where the data are silent.
        problem, fit = fit_refined(refined(problem, fit, parameters), progress)
    if method == "torque+frequency":
        chain = problem.parametrisation.chain(fit.x)
        problem = replace(problem, targets=tuple(_targets(chain, data.payload, data.seen)))
        fit = fit_torque(problem, progress, fit.x)
    return _result(experiment, method, data, problem, fit, progress)


@dataclass(frozen=True)
class Data:
    """The fitted recordings as every torque fit sees them.

    Attributes:
        plan: shape functions, numbers of joints, cuts.
        settings: how the recordings were prepared.
        prepared: the recordings.
        seen: modes of those with the commonest payload.
        payload: that payload [kg].
    """

    plan: Plan
    settings: Settings
    prepared: tuple[Prepared, ...]
    seen: tuple[MeasuredModes, ...]
    payload: float


def read_data(
    experiment: Experiment,
    parameters: str,
    virtual_joints: int | None = None,
    layout: str = DEFAULT_LAYOUT,
    family: str = "cantilever",
    angles: AngleMethod | None = None,
    derivatives: str = "smoothing",
) -> Data:
    """Everything before the first fit; arguments and errors are those of `identify`."""
    noise = sensor_noise(experiment.rig, experiment.recordings)
    recordings = fitted_recordings(experiment.recordings)
    plan = make_plan(experiment, recordings, parameters, virtual_joints, layout, family, angles)
    settings = Settings(plan.shape, derivatives, *noise)
    prepared = tuple(prepare(experiment.rig, plan.cuts, recording, settings) for recording in recordings)
    chosen, payload = _commonest_payload(recordings)
    most = max(plan.shape.orders) + _EXTRA_MODES
    seen = tuple(modes_in(prepared[k], noise[0], most) for k in chosen)
    return Data(plan, settings, prepared, seen, payload)


def fit_uniform(
    experiment: Experiment, data: Data, progress: Progress | None = None
) -> tuple[TorqueProblem, TorqueFit]:
    """Fit uniform links, from the nominal ones."""
    start = nominal_chain(experiment.rig, data.plan.cuts, _START_DAMPING)
    parametrisation = Parametrisation(start, "uniform", _hubs(experiment, data.prepared))
    problem = TorqueProblem(experiment.rig, parametrisation, data.prepared, data.settings, payload=data.payload)
    fit = fit_torque(problem, progress)
    return replace(problem, spread=spread_of(fit)), fit


def refined(problem: TorqueProblem, fit: TorqueFit, parameters: str) -> TorqueProblem:
    """The problem with more parameters, starting from a fit with fewer."""
    template = problem.parametrisation.chain(fit.x)
    parametrisation = Parametrisation(template, parameters, problem.parametrisation.hubs)
    return replace(problem, parametrisation=parametrisation, preference=parametrisation.preference)


def fit_refined(problem: TorqueProblem, progress: Progress | None = None) -> tuple[TorqueProblem, TorqueFit]:
    """Fit with a preference, whose weight beside the data follows from what this model itself leaves unexplained."""
    fit = fit_torque(problem, progress)
    for _ in range(_MOST_PASSES):
        before = problem.spread
        problem = replace(problem, spread=spread_of(fit))
        fit = fit_torque(problem, progress, fit.x)
        if abs(problem.spread - before) < 0.1 * before:
            break
    return problem, fit


def _check_choices(method: str, parameters: str, angles: str | None, virtual_joints: int | None) -> None:
    for what, given, choices in (
        ("method", method, METHODS),
        ("parameters", parameters, PARAMETRISATIONS),
        ("angles", angles, (None, *ANGLE_METHODS)),
    ):
        if given not in choices:
            raise ChoiceError(what, given, choices)
    if virtual_joints is not None and not 1 <= virtual_joints <= 60:
        raise ShapeError("virtual_joints", virtual_joints, "a number from 1 to 60")


def _hubs(experiment: Experiment, prepared: Sequence[Prepared]) -> tuple[int, ...]:
    """Links whose hub inertia shows: their active joint's torque was measured."""
    shown = np.any([np.isfinite(one.torque).any(axis=0) for one in prepared], axis=0)
    return tuple(i for k, i in enumerate(experiment.rig.active_links) if shown[k])


def _commonest_payload(recordings: Sequence[Recording]) -> tuple[list[int], float]:
    """Recordings with the payload that most of them have: frequencies are compared among equals only."""
    payloads = [recording.payload for recording in recordings]
    best = max(sorted(set(payloads)), key=payloads.count)
    return [k for k, payload in enumerate(payloads) if payload == best], best


def _targets(chain: Chain, payload: float, seen: Sequence[MeasuredModes]) -> list[FrequencyTarget]:
    """Measured frequencies that belong to modes of the chain.

    Raises:
        InsufficientDataError: none does.
    """
    targets = []
    for mode, frequency in enumerate(modes(chain, payload).frequencies):
        found = match(float(frequency), seen, MATCH_TOLERANCE)
        if found is not None:
            std = float(np.hypot(found.frequency_std, _MODEL_FLOOR * found.frequency))
            targets.append(FrequencyTarget(mode, found.frequency, std))
    if not targets:
        raise InsufficientDataError(
            "torque+frequency", "no peak of the recordings' spectra is near a mode of the model", "use method 'torque'"
        )
    return targets


def _result(
    experiment: Experiment,
    method: str,
    data: Data,
    problem: TorqueProblem,
    fit: TorqueFit,
    progress: Progress | None,
) -> Identification:
    plan, noise = data.plan, (data.settings.marker_noise, data.settings.encoder_noise)
    parametrisation = problem.parametrisation
    physical = to_physical(parametrisation, fit.x, covariance(fit))
    parameters = estimates(parametrisation, fit, physical)
    model = Model(parametrisation.chain(fit.x), experiment.rig, *noise, parameters)
    nominal = Model(nominal_chain(experiment.rig, plan.cuts), experiment.rig, *noise)
    recordings = fit_recordings(experiment, model, nominal, progress)
    comparison = compare_modes(model.chain, data.payload, data.seen, max(plan.shape.orders))
    known = [k for k, estimate in enumerate(parameters) if estimate.std is not None]
    return Identification(
        experiment=experiment,
        model=model,
        nominal=nominal,
        method=method,
        parametrisation=parametrisation.kind,
        parameters=parameters,
        covariance=physical[np.ix_(known, known)],
        modes=comparison,
        objective=objective(fit),
        objective_nominal=objective_of(nominal.chain, fit, model.chain),
        torque_data=tuple(torque_data(one, nominal.chain, model.chain) for one in fit.prepared),
        recordings=recordings,
        status="converged" if fit.converged else "not converged",
        remedy="" if fit.converged else _NOT_CONVERGED,
        warnings=(
            *experiment.warnings,
            *data_warnings(experiment, fit.prepared, plan.shape.orders, plan.joints, data.seen, parametrisation.kind),
            *mode_warnings(comparison if method == "torque" else ()),
            *result_warnings(recordings, parameters),
        ),
        notes=tuple(joint_notes(experiment, plan.shape.orders, plan.joints, parametrisation.kind)),
    )
