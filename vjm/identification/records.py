"""What an identification returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.identification.uncertainty import Whiteness
from vjm.markers.angles import Angles
from vjm.markers.smoothing import Derivatives
from vjm.records import Array, Estimate, Experiment, Record, Recording, RecordingComparison, SimulatedResult
from vjm.simulation.model import Model

Method = Literal["torque", "torque+frequency", "trajectory"]
METHODS: tuple[str, ...] = get_args(Method)


@dataclass(frozen=True)
class ModeComparison:
    """One natural mode, of the model and as measured (the paper's Table 2).

    Attributes:
        frequency_model: [Hz].
        frequency_measured: [Hz]; None where the recordings do not show the mode.
        frequency_std: standard error of the measured frequency [Hz].
        damping_model: fraction of critical.
        damping_measured: fraction of critical; None where not measured.
        mac: modal assurance criterion of the two shapes at the markers, one where they agree; None where not measured.
    """

    frequency_model: float
    frequency_measured: float | None
    frequency_std: float | None
    damping_model: float
    damping_measured: float | None
    mac: float | None = None


@dataclass(frozen=True, repr=False)
class TorqueData(Record):
    """One training recording as the torque method sees it.

    Attributes:
        recording: its source.
        angles: as read off the markers, at the camera's frames.
        derivatives: (S, nv) angles, rates and accelerations.
        torque: (S, n_a) active joint torques, through the same filter [N m]; NaN where none was measured.
        errors_before: (S, nv) torque errors (eq. 14) of the nominal model [N m]; NaN on rows without measured torque.
        errors_after: the same of the identified model.
    """

    recording: Recording
    angles: Angles
    derivatives: Derivatives
    torque: Array
    errors_before: Array
    errors_after: Array


@dataclass(frozen=True, repr=False)
class TrajectorySummary(Record):
    """How well whole trajectories fit.

    Attributes:
        whiteness: of each recording's residuals.
        fit: the minimum.
    """

    whiteness: tuple[Whiteness, ...]
    fit: TrajectoryFit

    @property
    def chi2_per_sample(self) -> float:
        """Mean square of the weighted residuals of all training recordings."""
        return self.fit.point.misfit**2


@dataclass(frozen=True, repr=False)
class Identification(SimulatedResult):
    """An identified model and what is known about it.

    Attributes:
        experiment: what it was identified from.
        model: the identified chain, ready to simulate and to write as URDF.
        nominal: the chain that the experiment file's nominal values give.
        torque_model: what the torque method found, where the trajectory method started from it; else None.
        method: `torque`, `torque+frequency` or `trajectory`.
        parametrisation: `uniform`, `joints`, `lengths` or `full`.
        parameters: every parameter of the parametrisation, estimated or fixed.
        covariance: (p, p) of the estimated parameters, in the order of those in `parameters` with a standard error.
        modes: model and measurement side by side, slowest first.
        objective: J of eq. (15): the noise-weighted mean square of the torque errors at the found parameters; None
            where no recording has what torque errors need.
        objective_nominal: J of the nominal model.
        trajectory: how well whole trajectories fit; None for the torque methods.
        torque_data: the training recordings as the method saw them.
        recordings: fit of every recording, in the experiment's order.
        status: `converged` or `not converged`.
        remedy: what to do when it has not converged; empty otherwise.
        warnings: what a user should know before trusting the result.
        notes: what was decided on the way, and why.
    """

    experiment: Experiment
    model: Model
    nominal: Model
    torque_model: Model | None
    method: str
    parametrisation: str
    parameters: tuple[Estimate, ...]
    covariance: Array
    modes: tuple[ModeComparison, ...]
    objective: float | None
    objective_nominal: float | None
    trajectory: TrajectorySummary | None
    torque_data: tuple[TorqueData, ...]
    recordings: tuple[RecordingComparison, ...]
    status: Literal["converged", "not converged"]
    remedy: str
    warnings: tuple[str, ...]
    notes: tuple[str, ...] = ()
