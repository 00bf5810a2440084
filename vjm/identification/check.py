"""Check of an experiment before identification: doubtful data, identifiable parameters."""

from __future__ import annotations

from dataclasses import dataclass

from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.errors import InsufficientDataError
from vjm.identification.parameters import PARAMETRISATIONS
from vjm.identification.torque_method import fit_uniform_torque
from vjm.identification.training_data import TrainingData, read_training_data
from vjm.identification.uncertainty import estimates, torque_information
from vjm.identification.warn import data_warnings, marker_warnings
from vjm.model.modes import modes
from vjm.records import Array, Estimate, Experiment, Result


@dataclass(frozen=True, repr=False)
class Check(Result):
    """Doubts about an experiment, and which parameters its recordings determine.

    Attributes:
        experiment: the experiment.
        warnings: what is wrong or doubtful.
        modes: (m,) natural frequencies expected from the nominal values [Hz].
        virtual_joints: n of each link that `identify` would take; empty where nothing can be identified.
        identifiable: for each parametrisation, the parameters and whether the training recordings determine them.
        problem: why nothing can be identified; empty where something can.
    """

    experiment: Experiment
    warnings: tuple[str, ...]
    modes: Array
    virtual_joints: tuple[int, ...]
    identifiable: dict[str, tuple[Estimate, ...]]
    problem: str = ""


def check(experiment: Experiment) -> Check:
    """Say what is wrong with a loaded experiment, what can be identified from it and what cannot be told apart.

    The standard errors are those that the recordings allow at the uniform link that fits them.
    """
    rig = experiment.rig
    joints = [link.virtual_joints or 6 for link in rig.links]  # enough for the slowest few frequencies
    expected = modes(nominal_chain(rig, rig_layouts(rig, joints))).frequencies
    try:
        data = {kind: read_training_data(experiment, kind) for kind in PARAMETRISATIONS}
        identifiable = {kind: _identifiable(each) for kind, each in data.items()}
    except InsufficientDataError as error:
        problem = str(error)
        about_markers = [text for link in rig.links for text in marker_warnings(link, link.virtual_joints)]
        return Check(experiment, (*experiment.warnings, *about_markers, problem), expected, (), {}, problem)
    choices = data["uniform"].joints
    warnings = (*experiment.warnings, *data_warnings(data["uniform"], choices))
    return Check(experiment, warnings, expected, tuple(choice.joints for choice in choices), identifiable)


def _identifiable(data: TrainingData) -> tuple[Estimate, ...]:
    fit = fit_uniform_torque(data)
    if data.parameters != "uniform":
        problem = fit.refined(data.parameters)
        fit = problem.evaluate(problem.parametrisation.start)
    parametrisation, information = fit.problem.parametrisation, torque_information(fit)
    covariance = parametrisation.physical_covariance(fit.x, information.covariance)
    return estimates(parametrisation, fit.x, information, covariance)
