"""The identification from an experiment to a model."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np

from vjm.chain.curve import curve_map
from vjm.chain.layout import DEFAULT_LAYOUT, LAYOUTS, LayoutName, nominal_chain
from vjm.chain.virtual_links import Chain
from vjm.errors import is_whole, require, require_choice, require_kind, require_progress
from vjm.experiment.records import require_experiment
from vjm.experiment.spectrum import match, mode_shapes
from vjm.identification.check import (
    data_warnings,
    estimates,
    failure_of,
    fit_warnings,
    identification_notes,
    stopped_remedy,
)
from vjm.identification.comparison import compare_recordings
from vjm.identification.discretization import first_order_bias
from vjm.identification.mistakes import refuse_mistakes
from vjm.identification.parameters import PARAMETRISATIONS, Parameters
from vjm.identification.records import METHODS, Identification, Method, ModeComparison, Whiteness
from vjm.identification.torque_method import MODE_TOLERANCE, TorqueFit, fit_torque
from vjm.identification.training_data import DerivativeMethod, TrainingData
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.identification.trajectory_method import first_fit
from vjm.identification.uncertainty import Information, trajectory_information
from vjm.markers.angles import AngleMethod
from vjm.markers.shape import FAMILIES, FamilyName
from vjm.model.dynamics import objective
from vjm.model.modes import modes
from vjm.records import Array, Complex, Experiment, Progress, Rig, Stages
from vjm.simulation.least_squares import LOSSES, LossName
from vjm.simulation.model import Model
from vjm.threads import on_one_thread


@on_one_thread
def identify(
    experiment: Experiment,
    method: Method = "trajectory",
    virtual_joints: int | None = None,
    parameters: Parameters = "uniform",
    *,
    layout: LayoutName = DEFAULT_LAYOUT,
    family: FamilyName = "cantilever",
    angles: AngleMethod | None = None,
    derivatives: DerivativeMethod = "smoothing",
    loss: LossName = "linear",
    baselines: bool = True,
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
        family: of the shape functions: `cantilever`, `polynomial`, `clamped-polynomial` or `trigonometric`.
        angles: how angles are read off them: `curvature`, `curve` or, as in the paper, `points`; chosen by the
            parametrisation when None.
        derivatives: `smoothing` or, as in the paper, `interpolating`.
        loss: of the trajectories' residuals: `linear`, `huber`, `soft_l1` or `cauchy`. Single outliers are left out
            whatever the loss.
        baselines: simulate every recording with the nominal and the torque method's model as well, to be compared with;
            without, an identification of a short recording takes a third less time.
        progress: called with (text, done, total) while it runs.

    Raises:
        ExperimentError: no experiment.
        ChoiceError: an unknown method or option.
        ShapeError: a number of virtual joints below 1 or above 60, or another argument of the wrong kind.
        MistakeError: recordings that a mistake explains far better than the experiment file does.
        InsufficientDataError: recordings that cannot determine the model.
        SimulationDivergedError: no start can be simulated.
    """
    require_experiment(experiment)
    for option, value, choices in (
        ("method", method, METHODS),
        ("parameters", parameters, PARAMETRISATIONS),
        ("layout", layout, LAYOUTS),
        ("family", family, FAMILIES),
        ("angles", angles, (None, *get_args(AngleMethod))),
        ("derivatives", derivatives, get_args(DerivativeMethod)),
        ("loss", loss, LOSSES),
    ):
        require_choice(option, value, choices)
    valid = virtual_joints is None or (is_whole(virtual_joints, 1) and virtual_joints <= 60)
    require("virtual_joints", virtual_joints, valid, "a whole number from 1 to 60")
    require_kind("baselines", baselines, bool, "True or False")
    require_progress(progress)
    likely = refuse_mistakes(experiment)
    progress = Stages(progress, 0.25).inside  # share of what is left that each of about seven fits takes
    data = TrainingData.of(experiment, parameters, virtual_joints, layout, family, angles, derivatives)
    if method != "trajectory":
        torque = fit_torque(data, data.parameters, method == "torque+frequency", progress)
        result = _result(experiment, method, data, torque, Information.of_torque_errors(torque), baselines, progress)
        return replace(result, warnings=(*likely, *result.warnings))
    search, first = first_fit(data, loss, progress)
    fit, notes = search.select_joints(first)
    information, whiteness = trajectory_information(fit, data.rig.marker_noise is not None)
    uniform = fit.point.problem.parametrisation.kind == "uniform"
    bias = first_order_bias(fit.point, data.rig) if uniform else None
    data = replace(search.data, joints=search.joint_choices(fit))
    parts = notes, whiteness, search.torque, None if bias is None else bias.shift
    result = _result(experiment, method, data, fit, information, baselines, progress, *parts)
    return replace(result, warnings=(*likely, *result.warnings))


def _result(
    experiment: Experiment,
    method: str,
    data: TrainingData,
    fit: TorqueFit | TrajectoryFit,
    information: Information,
    baselines: bool,
    progress: Progress | None,
    notes: tuple[str, ...] = (),
    whiteness: tuple[Whiteness, ...] = (),
    torque: TorqueFit | None = None,
    shift: Array | None = None,
) -> Identification:
    trajectory, point = (None, fit) if isinstance(fit, TorqueFit) else (fit, fit.point)
    rig, parametrisation, chain = data.rig, point.problem.parametrisation, point.chain
    covariance = parametrisation.physical_covariance(point.x, information.covariance)
    parameters = estimates(parametrisation, point.x, information, covariance, shift)
    known = [k for k, estimate in enumerate(parameters) if estimate.std is not None]
    model = Model(chain, rig, *data.noise, parameters)
    nominal = Model(nominal_chain(rig, chain.links), rig, *data.noise)
    torque_model = None if torque is None else Model(torque.chain, rig, *data.noise)
    states = {} if trajectory is None else {run.observed.recording.file: run.state for run in trajectory.point.runs}
    references = (nominal, torque_model) if baselines else (None, None)
    step_multiple = 1.0 if trajectory is None else trajectory.point.problem.step_multiple
    recordings = compare_recordings(experiment, model, references, progress, states, step_multiple)
    compared_modes = _compare_modes(chain, data)
    # The same weights for both models.
    objectives = [
        objective(data.weighted_errors(compared, chain)) if data.prepared else None
        for compared in (chain, nominal.chain)
    ]
    failure = failure_of(experiment, recordings)
    return Identification(
        experiment=experiment,
        model=model,
        nominal=nominal,
        method=method,
        parametrisation=parametrisation.kind,
        parameters=parameters,
        covariance=covariance[np.ix_(known, known)],
        modes=compared_modes,
        shape=data.shape,
        objective=objectives[0],
        objective_nominal=objectives[1],
        trajectory=trajectory,
        whiteness=whiteness,
        torque_data=data.prepared_for(chain),
        recordings=recordings,
        status="failed" if failure else "converged" if fit.converged else "not converged",
        remedy=failure or ("" if fit.converged else stopped_remedy(trajectory)),
        warnings=(
            *experiment.warnings,
            *data_warnings(data),
            *map(str, data.problems),
            *fit_warnings(recordings, parameters, whiteness, compared_modes if method == "torque" else ()),
        ),
        notes=identification_notes(data, notes),
    )


def _compare_modes(chain: Chain, data: TrainingData) -> tuple[ModeComparison, ...]:
    """Compare a chain's modes with the measured ones: up to the last measured one, and all that the markers show."""
    natural_modes = modes(chain, data.payload)
    shapes = _marker_deflections(chain, data.rig, natural_modes.shapes)
    rows = []
    for frequency, ratio, shape in zip(
        natural_modes.frequencies.tolist(), natural_modes.damping_ratios.tolist(), shapes, strict=True
    ):
        value, std, damping = match(frequency, data.modes, MODE_TOLERANCE) or (None, None, None)
        measured = _measured_shape(data, frequency)
        mac = None if measured is None else _modal_assurance(shape, measured)
        rows.append(ModeComparison(frequency, value, std, damping_model=ratio, damping_measured=damping, mac=mac))
    last = max([k + 1 for k, row in enumerate(rows) if row.frequency_measured is not None], default=0)
    return tuple(rows[: max(last, *data.shape.orders)])


def _marker_deflections(chain: Chain, rig: Rig, angles: Array) -> Array:
    """Return lateral deflections (m, k) of the markers in their link frames, for small joint angles (nv, m)."""
    rows = []
    for link, rig_link, part in zip(chain.links, rig.links, chain.passive_slices, strict=True):
        slope = curve_map(link, rig_link.markers).jacobian(np.zeros(link.virtual_joints))
        rows.append(slope[:, 1] @ angles[part])
    return np.concatenate(rows).T


def _modal_assurance(model: Array, measured: Complex) -> float:
    """Return the MAC of two shapes (k,): one where they agree up to a factor, zero where they are orthogonal."""
    power = np.vdot(model, model).real * np.vdot(measured, measured).real
    return float(np.abs(np.vdot(model, measured)) ** 2 / max(power, 1e-300))


def _measured_shape(data: TrainingData, frequency: float) -> Complex | None:
    """Return the deflection (k,) of all markers in the measured mode nearest to a frequency [Hz]; None if none is near.

    It is the shape that explains most of the free and the forced motion of all recordings.
    """
    parts = []
    for prepared, measured_modes in zip(data.freely_moving, data.modes, strict=True):
        deviations = np.abs(measured_modes.frequencies / frequency - 1)
        if np.min(deviations, initial=np.inf) < MODE_TOLERANCE:
            pairs = zip(data.rig.links, prepared.angles.shapes, strict=True)
            lateral = np.hstack([shape.evaluate(link.markers) for link, shape in pairs])
            parts.append(
                mode_shapes(prepared.angles.time, lateral, measured_modes, prepared.driving_torque)[
                    np.argmin(deviations)
                ]
            )
    if not parts:
        return None
    shape: Complex = np.linalg.svd(np.concatenate(parts, axis=1), full_matrices=False)[0][:, 0]
    return shape
