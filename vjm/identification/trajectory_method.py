"""The trajectory method: where it starts, what it leaves out, and how many virtual joints explain the recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vjm.errors import InsufficientDataError
from vjm.experiment.records import Experiment, Recording
from vjm.identification.data import Data
from vjm.identification.outliers import trimmed
from vjm.identification.select import JointChoice, choose_virtual_joints
from vjm.identification.torque_fit import Progress, TorqueFit, TorqueProblem
from vjm.identification.torque_method import driven_hubs, fit_uniform
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.identification.trajectory_search import Search
from vjm.simulate.drive import measured_torque
from vjm.simulate.loss import LOSSES
from vjm.simulate.observation import Observed

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ByTrajectory:
    """What the trajectory method found.

    Attributes:
        fit: the minimum.
        joints: numbers of virtual joints, and what they cost.
        torque: the torque method's fit that it started from; None where there was none.
        problems: why others were not used, a sentence each.
        notes: what was decided on the way.
    """

    fit: TrajectoryFit
    joints: tuple[JointChoice, ...]
    torque: tuple[TorqueProblem, TorqueFit] | None
    problems: tuple[str, ...]
    notes: tuple[str, ...]


def by_trajectory(
    experiment: Experiment, data: Data, loss: str = "linear", progress: Progress | None = None
) -> ByTrajectory:
    """Identify by whole trajectories.

    Args:
        experiment: the rig.
        data: its recordings.
        loss: of the weighted residuals, one of `LOSSES`.
        progress: told (text, done, total) now and then.

    Raises:
        InsufficientDataError: no recording can be simulated.
        SimulationDivergedError: no start can be simulated.
    """
    search, fit, torque, problems = first_fit(experiment, data, loss, progress)
    counts = search.candidates()
    fit, joints, notes = search.enough_joints(counts, fit)
    choices = tuple(
        replace(choose_virtual_joints(link, order, n), asked=len(counts) == 1 and search.asked)
        for link, order, n in zip(experiment.rig.links, data.plan.shape.orders, joints, strict=True)
    )
    return ByTrajectory(fit, choices, torque, problems, notes)


def first_fit(
    experiment: Experiment,
    data: Data,
    loss: str = "linear",
    progress: Progress | None = None,
    rough: bool = False,
) -> tuple[Search, TrajectoryFit, tuple[TorqueProblem, TorqueFit] | None, tuple[str, ...]]:
    """Uniform links with few joints, from far away, to recordings without their outliers.

    Args:
        experiment, data, loss, progress: as of `by_trajectory`.
        rough: whether the minimum is only a start for other searches.

    Returns:
        What further fits start with, the fit, what the torque method found (None where there was nothing for it to
        find), and why recordings were not used, a sentence each.

    Raises:
        InsufficientDataError: no recording can be simulated.
        SimulationDivergedError: no start can be simulated.
    """
    recordings, problems = simulated(data.recordings)
    noise = (data.settings.marker_noise, data.settings.encoder_noise)
    observed = tuple(Observed.of(experiment.rig, each, noise, LOSSES[loss]) for each in recordings)
    torque = fit_uniform(experiment, data, progress) if data.prepared else None
    search = Search(experiment, data, observed, driven_hubs(experiment, recordings), progress, rough)
    joints = search.candidates()[0]
    fit = search.far(joints, torque)
    observed = tuple(trimmed(run) for run in fit.point.runs)
    if any(one is not two for one, two in zip(observed, search.observed, strict=True)):
        search = replace(search, observed=observed)
        fit = search.near(joints, fit)
    return search, fit, torque, problems


def simulated(recordings: Sequence[Recording]) -> tuple[tuple[Recording, ...], tuple[str, ...]]:
    """Recordings whose torques are known, and what is wrong with the others.

    Raises:
        InsufficientDataError: there is none.
    """
    kept, problems = [], []
    for recording in recordings:
        try:
            measured_torque(recording)
            kept.append(recording)
        except InsufficientDataError as error:
            problems.append(str(error))
    if not kept:
        raise InsufficientDataError(
            "method trajectory",
            "no torque was measured at the active joints of any training recording, so none can be simulated",
            "record the column LINK.tau, or use method 'torque'",
        )
    return tuple(kept), tuple(problems)
