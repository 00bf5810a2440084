"""The identification from an experiment to a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from vjm.angles.estimate import ANGLE_METHODS, AngleMethod, ShapeSettings
from vjm.chain.layout import Layout
from vjm.chain.records import Chain
from vjm.errors import ChoiceError, InsufficientDataError, ShapeError, SimulationDivergedError
from vjm.experiment.records import Experiment, Recording
from vjm.identify.parametrisation import PARAMETRISATIONS, Parametrisation
from vjm.identify.prepare import Prepared, Settings, choose_orders, fitted_recordings, modes_in, prepare
from vjm.identify.records import METHODS, Identification, ModeComparison, RecordingFit, TorqueData
from vjm.identify.select import JointChoice, choose_virtual_joints, cuts_of, nominal_chain
from vjm.identify.torque_fit import (
    FrequencyTarget,
    Progress,
    TorqueFit,
    TorqueProblem,
    fit_torque,
    noise_factor,
    seen_errors,
    spread_of,
    whiten,
)
from vjm.identify.uncertainty import covariance, estimates, to_physical
from vjm.identify.warn import data_warnings, result_warnings
from vjm.model import Model
from vjm.modes import modes
from vjm.noise import sensor_noise
from vjm.simulate.initial_state import Replay
from vjm.spectrum import MeasuredModes, match
from vjm.torque import torque_errors

Array = NDArray[np.float64]

_MATCH_TOLERANCE = 0.15  # a measured frequency this close to the model's is the same mode
_MODEL_FLOOR = 5e-4  # relative accuracy of a small chain's frequencies, however sharp the measured ones are
_EXTRA_MODES = 2  # peaks looked for beyond the modes that the shapes show
_START_DAMPING = 1e-3  # s, Kelvin-Voigt time the search starts from
_NOT_CONVERGED = "the search stopped early: ask for fewer parameters, or give recordings that move more"


def identify(
    experiment: Experiment,
    method: str = "torque",
    virtual_joints: int | None = None,
    parameters: str = "uniform",
    *,
    layout: str = "end-corrected",
    family: str = "cantilever",
    angles: str = "curvature",
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
        layout: where the links are cut: `end-corrected`, `half-ends` or `equal`.
        family: of the shape functions.
        angles: `curvature` or, as in the paper, `points`.
        derivatives: `smoothing` or, as in the paper, `interpolating`.
        progress: told (text, done, total) while it runs.

    Raises:
        ChoiceError: an unknown method or option.
        InsufficientDataError: recordings that cannot determine the model.
    """
    _check_choices(method, parameters, angles, virtual_joints)
    noise = sensor_noise(experiment.rig, experiment.recordings)
    recordings = fitted_recordings(experiment.recordings)
    plan = _plan(experiment, recordings, parameters, virtual_joints, layout, family, cast(AngleMethod, angles))
    settings = Settings(plan.shape, derivatives, *noise)
    prepared = tuple(prepare(experiment.rig, plan.cuts, recording, settings) for recording in recordings)
    measured = [modes_in(one, noise[0], max(plan.shape.orders) + _EXTRA_MODES) for one in prepared]
    chosen, payload = _commonest_payload(recordings)
    seen = [measured[k] for k in chosen]
    start = nominal_chain(experiment.rig, plan.cuts, _START_DAMPING)
    hubs = _hubs(experiment, prepared)
    problem = TorqueProblem(
        experiment.rig, Parametrisation(start, "uniform", hubs), prepared, settings, payload=payload
    )
    fit = fit_torque(problem, progress)
    problem = replace(problem, spread=spread_of(fit))
    if parameters != "uniform":
        # The uniform link found first is where the search starts, and what it keeps to where the data are silent.
        parametrisation = Parametrisation(problem.parametrisation.chain(fit.x), parameters, hubs)
        problem = replace(problem, parametrisation=parametrisation, preference=parametrisation.preference)
        fit = fit_torque(problem, progress)
    if method == "torque+frequency":
        problem = replace(problem, targets=tuple(_targets(problem.parametrisation.chain(fit.x), payload, seen)))
        fit = fit_torque(problem, progress)
    return _result(experiment, method, plan, problem, fit, seen, noise, progress)


def _check_choices(method: str, parameters: str, angles: str, virtual_joints: int | None) -> None:
    for what, given, choices in (
        ("method", method, METHODS),
        ("parameters", parameters, PARAMETRISATIONS),
        ("angles", angles, ANGLE_METHODS),
    ):
        if given not in choices:
            raise ChoiceError(what, given, choices)
    if virtual_joints is not None and not 1 <= virtual_joints <= 60:
        raise ShapeError("virtual_joints", virtual_joints, "a number from 1 to 60")


@dataclass(frozen=True)
class Plan:
    """What is decided before anything is fitted: shape orders, numbers of joints, cuts."""

    shape: ShapeSettings
    joints: tuple[JointChoice, ...]
    cuts: tuple[Layout, ...]


def _plan(
    experiment: Experiment,
    recordings: Sequence[Recording],
    parameters: str,
    virtual_joints: int | None,
    layout: str,
    family: str,
    angles: AngleMethod,
) -> Plan:
    rig = experiment.rig
    provisional = cuts_of(rig, [3] * len(rig.links), layout)
    orders = choose_orders(rig, provisional, recordings, family)
    joints = tuple(
        choose_virtual_joints(link, order, virtual_joints or link.virtual_joints or _joints_told(order, parameters))
        for link, order in zip(rig.links, orders, strict=True)
    )
    robust = all(len(link.markers) >= order + 2 for link, order in zip(rig.links, orders, strict=True))
    shape = ShapeSettings(family, orders, angles, robust)
    return Plan(shape, joints, tuple(cuts_of(rig, [choice.joints for choice in joints], layout)))


def _joints_told(order: int, parameters: str) -> int | None:
    """Number of joints whose own parameters so many shape functions can tell apart; None: as many as accuracy asks."""
    # Rows along `order` shapes tell order (order + 1) / 2 joints' stiffness apart.
    joints = min(order + 1, order * (order + 1) // 2)
    return {"uniform": None, "joints": joints, "lengths": order, "full": order}[parameters]


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
        found = match(float(frequency), seen, _MATCH_TOLERANCE)
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
    plan: Plan,
    problem: TorqueProblem,
    fit: TorqueFit,
    seen: Sequence[MeasuredModes],
    noise: tuple[float, float],
    progress: Progress | None,
) -> Identification:
    parametrisation = problem.parametrisation
    physical = to_physical(parametrisation, fit.x, covariance(fit))
    parameters = estimates(parametrisation, fit, physical)
    model = Model(parametrisation.chain(fit.x), experiment.rig, *noise, parameters)
    nominal = Model(nominal_chain(experiment.rig, plan.cuts), experiment.rig, *noise)
    recordings = fit_recordings(experiment, model, nominal, progress)
    comparison = compare_modes(model.chain, problem.payload, seen, max(plan.shape.orders))
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
        objective=_objective(fit),
        objective_nominal=_nominal_objective(nominal.chain, fit, model.chain),
        torque_data=tuple(_torque_data(one, nominal.chain, model.chain) for one in fit.prepared),
        recordings=recordings,
        status="converged" if fit.converged else "not converged",
        remedy="" if fit.converged else _NOT_CONVERGED,
        warnings=(
            *experiment.warnings,
            *data_warnings(experiment, fit.prepared, plan.shape.orders, plan.joints, seen, parametrisation.kind),
            *result_warnings(recordings, parameters),
        ),
    )


def _objective(fit: TorqueFit) -> float:
    """J at the minimum: mean weighted square of a row's torque error."""
    return float(np.sum([np.sum(r**2) for r in fit.residuals]) / np.sum([r.size for r in fit.residuals]))


def _nominal_objective(nominal: Chain, fit: TorqueFit, found: Chain) -> float:
    """J of the nominal model under the same weights, those of the found parameters."""
    residuals = [whiten(seen_errors(nominal, one), noise_factor(found, one)) for one in fit.prepared]
    return float(np.sum([np.sum(r**2) for r in residuals]) / np.sum([r.size for r in residuals]))


def _torque_data(prepared: Prepared, nominal: Chain, found: Chain) -> TorqueData:
    recording, d = prepared.recording, prepared.derivatives
    before, after = (
        torque_errors(chain, d.value, d.rate, d.acceleration, prepared.torque, recording.payload, recording.gravity)
        for chain in (nominal, found)
    )
    return TorqueData(recording, prepared.angles, d, prepared.torque, before, after)


def compare_modes(
    chain: Chain, payload: float, seen: Sequence[MeasuredModes], least: int
) -> tuple[ModeComparison, ...]:
    """The model's modes beside the measured ones: all up to the last measured one, and at least `least`."""
    found = modes(chain, payload)
    rows = []
    for frequency, ratio in zip(found.frequencies, found.damping_ratios, strict=True):
        mode = match(float(frequency), seen, _MATCH_TOLERANCE)
        rows.append(
            ModeComparison(
                float(frequency),
                None if mode is None else mode.frequency,
                None if mode is None else mode.frequency_std,
                float(ratio),
                None if mode is None else mode.damping_ratio,
            )
        )
    last = max([k + 1 for k, row in enumerate(rows) if row.frequency_measured is not None], default=0)
    return tuple(rows[: max(last, least)])


def fit_recordings(
    experiment: Experiment, model: Model, nominal: Model | None, progress: Progress | None = None
) -> tuple[RecordingFit, ...]:
    """Open-loop replay of every recording by the model and, for comparison, by the nominal one."""
    fits = []
    total = len(experiment.recordings)
    for k, recording in enumerate(experiment.recordings):
        if progress is not None:
            progress("replaying recordings", k, total)
        replayed, problem = _replay(model, recording)
        compared = _replay(nominal, recording)[0] if nominal is not None and replayed is not None else None
        fits.append(RecordingFit(recording, replayed, compared, model.marker_noise, model.encoder_noise, problem))
    if progress is not None:
        progress("replaying recordings", total, total)
    return tuple(fits)


def _replay(model: Model, recording: Recording) -> tuple[Replay | None, str]:
    try:
        return model.replay(recording), ""
    except (InsufficientDataError, SimulationDivergedError) as error:
        return None, str(error)
