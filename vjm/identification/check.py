"""What an experiment's recordings can tell, before anything is trusted."""

from __future__ import annotations

from dataclasses import dataclass

from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.errors import InsufficientDataError
from vjm.identification.parameters import PARAMETRISATIONS
from vjm.identification.prepare import Data, Options, read_data
from vjm.identification.torque_method import evaluate, fit_uniform, refined
from vjm.identification.uncertainty import covariance, estimates, of_torque, to_physical
from vjm.identification.warn import data_warnings, marker_warnings
from vjm.model.modes import modes
from vjm.records import Array, Estimate, Experiment, Result

_NOMINAL_JOINTS = 6


@dataclass(frozen=True, repr=False)
class Check(Result):
    """What an experiment can tell.

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
    """Say what is wrong with an experiment, what can be identified from it and what cannot be told apart.

    The standard errors are those that the recordings allow at the uniform link that fits them.

    Args:
        experiment: as loaded.
    """
    rig = experiment.rig
    nominal = nominal_chain(rig, rig_layouts(rig, [link.virtual_joints or _NOMINAL_JOINTS for link in rig.links]))
    expected = modes(nominal).frequencies
    try:
        data = {kind: read_data(experiment, Options(kind)) for kind in PARAMETRISATIONS}
        identifiable = {kind: _identifiable(experiment, one, kind) for kind, one in data.items()}
    except InsufficientDataError as error:
        problem = str(error)
        about_markers = [text for link in rig.links for text in marker_warnings(link, link.virtual_joints)]
        return Check(experiment, (*experiment.warnings, *about_markers, problem), expected, (), {}, problem)
    plain = data["uniform"]
    warnings = data_warnings(
        experiment, plain.prepared, plain.plan.shape.orders, plain.plan.joints, plain.seen, "uniform"
    )
    joints = tuple(choice.joints for choice in plain.plan.joints)
    return Check(experiment, (*experiment.warnings, *warnings), expected, joints, identifiable)


def _identifiable(experiment: Experiment, data: Data, kind: str) -> tuple[Estimate, ...]:
    problem, fit = fit_uniform(experiment, data)
    if kind != "uniform":
        problem = refined(problem, fit, kind)
        fit = evaluate(problem, problem.parametrisation.start)
    information = of_torque(fit)
    physical = to_physical(problem.parametrisation, fit.x, covariance(information))
    return estimates(problem.parametrisation, fit.x, information, physical)
