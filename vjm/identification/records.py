"""Records of an identification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from vjm.errors import require_choice
from vjm.identification.training_data import PreparedRecording
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.markers.angles import ShapeSettings, estimate_angles
from vjm.records import Array, ByParameter, Estimate, Experiment, Recording, RecordingComparison, SimulatedResult
from vjm.simulation.model import Model

Method = Literal["torque", "torque+frequency", "trajectory"]
METHODS: tuple[str, ...] = get_args(Method)


@dataclass(frozen=True)
class ModeComparison:
    """One natural mode, of the model and as measured (the paper's Table 2)."""

    frequency_model: float  # [Hz]
    frequency_measured: float | None  # [Hz]; None where the recordings do not show the mode
    frequency_std: float | None  # standard error of the measured frequency [Hz]
    damping_model: float  # fraction of critical
    damping_measured: float | None  # fraction of critical; None where not measured
    # Modal assurance criterion of the two shapes at the markers, one where they agree; None where not measured.
    mac: float | None = None


@dataclass(frozen=True, repr=False)
class Comparison(SimulatedResult):
    """A model beside the recordings of an experiment.

    Attributes:
        experiment: the recordings.
        model: given or identified.
        nominal: of the experiment file's nominal values, with the same virtual links.
        covariance: (p, p) of the parameters that have a standard error; empty where unknown.
        recordings: comparison of every recording, in the experiment's order.
        warnings: what a user should know.
    """

    experiment: Experiment
    model: Model
    nominal: Model
    covariance: Array
    recordings: tuple[RecordingComparison, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, repr=False)
class Identification(Comparison, ByParameter):
    """An identified model beside its recordings, and what is known about it.

    Attributes:
        method: `torque`, `torque+frequency` or `trajectory`.
        parametrisation: `uniform`, `joints`, `lengths` or `full`.
        parameters: every parameter of the parametrisation, estimated or fixed.
        modes: model and measurement side by side, slowest first.
        shape: the shape functions, and how angles are read off them.
        objective: J of eq. (15): the noise-weighted mean square of the torque errors at the identified parameters; None
            where no recording has what torque errors need.
        objective_nominal: J of the nominal model.
        trajectory: the fit of whole trajectories; None for the torque methods.
        whiteness: of the trajectories' residuals, one a fitted recording.
        torque_data: the training recordings as the torque method sees them.
        status: `converged`; `not converged`; or `failed`, if a sensor was left out whole, a held-out recording cannot
            be compared, or residuals are a hundred times the noise.
        remedy: what to do when it has not converged, and why it has failed; empty otherwise.
        notes: what was decided on the way, and why.
    """

    method: str
    parametrisation: str
    parameters: tuple[Estimate, ...]
    modes: tuple[ModeComparison, ...]
    shape: ShapeSettings
    objective: float | None
    objective_nominal: float | None
    trajectory: TrajectoryFit | None
    whiteness: tuple[Whiteness, ...]
    torque_data: tuple[PreparedRecording, ...]
    status: Literal["converged", "not converged", "failed"]
    remedy: str
    notes: tuple[str, ...] = ()

    def phi(self, recording: Recording | str) -> tuple[Array, Array]:
        """Return the angles of all links' virtual joints in a recording, from the base outwards.

        Args:
            recording: one of the experiment's, or its file name.

        Returns:
            (T, n) angles from the markers [rad], NaN where the camera did not show them; and (T, n) those of the
            identified model, open loop [rad], NaN if it cannot be simulated.

        Raises:
            ChoiceError: no recording of that name; the message lists those there are.
        """
        name = recording.file if isinstance(recording, Recording) else recording
        by_name = {comparison.recording.file: comparison for comparison in self.recordings}
        require_choice("recording", name, by_name)
        comparison, chain, rig = by_name[name], self.model.chain, self.model.rig
        angles = estimate_angles(rig, chain.links, comparison.recording, self.shape, *comparison.noise)
        measured, simulated = np.full((2, comparison.recording.time.size, chain.passive.size), np.nan)
        measured[comparison.recording.frames] = angles.q[:, chain.passive]
        if comparison.simulated is not None:
            simulated = comparison.simulated.simulation.q[:, chain.passive]
        return measured, simulated


@dataclass(frozen=True)
class Whiteness:
    """Test of a recording's weighted residuals for white noise."""

    file: str  # the recording's
    mean_square: float  # one where they are noise
    correlation: float  # largest one of a residual with those up to ten samples later, over all sensors
    correlated: bool  # True if they certainly are
    excessive: bool  # True if they are certainly larger than the noise

    @property
    def white(self) -> bool:
        """False if they are certainly no white noise as large as the sensors'."""
        return not (self.correlated or self.excessive)
