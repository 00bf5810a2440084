"""An identified arm: its chain and effects, to simulate, analyse and export."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect
from vjm.errors import ShapeError, is_number, is_whole, require
from vjm.experiment.arrays import number_array
from vjm.experiment.checks import DEFAULT_NOISE
from vjm.experiment.payload import as_payload
from vjm.experiment.records import as_rig, for_rig, require_recording
from vjm.files import check_model_file, write_models
from vjm.model.dynamics import Mechanism
from vjm.model.flexible import FlexibleModel
from vjm.model.modes import Modes, modes
from vjm.model.urdf import simulator_path
from vjm.records import (
    REFERENCE,
    Array,
    Estimate,
    Link,
    Record,
    Recording,
    Rig,
    SimulatedRecording,
    Simulation,
)
from vjm.simulation.arm import Arm
from vjm.simulation.control import ControlLaw, simulate_motion
from vjm.simulation.initial_state import FEW_TRIALS, fit_initial_states
from vjm.simulation.measurement import MarkerArcs, Observations
from vjm.threads import on_one_thread

if TYPE_CHECKING:
    import pinocchio as pin


class PinocchioModel(NamedTuple):
    """A `pin.Model` with the springs and dampers that it has no place for.

    Attributes:
        model: the `pin.Model`, joints in the chain's order.
        stiffness: (nv,) K, zero at active joints [N m/rad].
        damping: (nv,) D, zero at active joints [N m s/rad].
    """

    model: pin.Model
    stiffness: Array
    damping: Array


@dataclass(frozen=True, repr=False)
class Model(Record):
    """A virtual-joint model of a rig.

    Attributes:
        chain: virtual links and joints.
        rig: the arm it models; says where the markers are.
        marker_noise: 1-sigma noise of a marker coordinate [m].
        encoder_noise: 1-sigma noise of an encoder [rad].
        estimates: the parameters it was identified with; empty for a nominal model.
        effects: on the chain and its sensors.
        reference_effects: number of them, the first ones, that act in recordings of condition `reference` too.

    Raises:
        ShapeError: a chain whose links are not the rig's.
    """

    chain: Chain
    rig: Rig
    marker_noise: float
    encoder_noise: float
    estimates: tuple[Estimate, ...] = ()
    effects: tuple[Effect, ...] = ()
    reference_effects: int = 0

    def __post_init__(self) -> None:
        chain_links = [(link.name, link.joint) for link in self.chain.links]
        rig_links = [(link.name, link.joint) for link in self.rig.links]
        if chain_links != rig_links:
            raise ShapeError("model", f"links {chain_links}", f"the experiment's links {rig_links}")

    @classmethod
    def nominal(cls, rig: Rig | Link, virtual_joints: int = 8, kelvin_voigt: float = 0.0) -> Model:
        """Return the model of an arm as described, without any recording of it.

        Args:
            rig: the arm, with its nominal values; a bare link is fine too.
            virtual_joints: number n of every link's, where the rig does not say.
            kelvin_voigt: damping over stiffness of the links [s]; 0: undamped.

        Raises:
            ShapeError: a number of joints below one, or a time below zero.
        """
        rig = as_rig(rig)
        require("virtual_joints", virtual_joints, is_whole(virtual_joints, 1), "a whole number from 1")
        valid = is_number(kelvin_voigt) and kelvin_voigt >= 0
        require("kelvin_voigt", kelvin_voigt, valid, "a time, zero or positive [s]")
        cuts = rig_layouts(rig, [link.virtual_joints or virtual_joints for link in rig.links])
        markers = rig.marker_noise or DEFAULT_NOISE * max(link.length for link in rig.links)
        return cls(nominal_chain(rig, cuts, kelvin_voigt), rig, markers, rig.encoder_noise or DEFAULT_NOISE)

    @cached_property
    def arm(self) -> Arm:
        """The chain with its effects."""
        return Arm.of(self.chain, self.effects)

    @cached_property
    def _reference(self) -> Arm:
        return Arm.of(self.chain, self.effects[: self.reference_effects])

    def arm_in(self, recording: Recording) -> Arm:
        """Return the arm of a recording; in a `reference` recording it has the reference effects only."""
        require_recording(recording)
        return (self._reference if recording.condition == REFERENCE else self.arm).in_recording(recording)

    @on_one_thread
    def simulate(
        self,
        recording: Recording | None = None,
        *,
        torque: ArrayLike | ControlLaw | None = None,
        duration: float | None = None,
        initial: ArrayLike | None = None,
        payload: float | tuple[float, float, float] = 0.0,
    ) -> Simulation:
        """Simulate a recording open loop, or a motion under a torque of one's own.

        A recording is simulated from the initial state most likely given the whole of it. Without one:

        Args:
            recording: whose torque drives the arm; the other arguments are of no use beside it.
            torque: of the n_a active joints [N m]: (T, n_a), or (T,) of a single one, at T evenly spaced instants from
                zero to the duration and linear between; or a control law, a function of the time [s] and the active
                joints' angles (n_a,) [rad] and rates (n_a,) [rad/s], and of nothing else, that returns them (n_a,). It
                acts without delay, and steps are halved until no marker moves by a tenth of its noise. None: none.
            duration: of the motion [s].
            initial: (2, nv) angles [rad] and rates [rad/s] of all joints in the chain's order, or (2, n_a) of active
                ones, the passive ones at rest under gravity; None: at rest at zero.
            payload: known extra mass on the tip, a point [kg]; or a body's mass [kg], distance of its centre beyond the
                tip [m], and inertia about that [kg m^2].

        Returns:
            The motion, at the torque's instants or, without any, at those of the integrator's default steps.

        Raises:
            InsufficientDataError: no torque measured at an active joint of the recording.
            RecordingError: a recording that does not fit the rig.
            ShapeError: neither a recording nor a duration, both, or an argument that does not fit the arm.
            SimulationDivergedError: the simulation left the finite numbers, or depends on its step however short.
        """
        if recording is None:
            arm, noise, body = self.arm, self.marker_noise, as_payload(payload)
            return simulate_motion(arm, self.rig, noise, torque, duration, initial, body)
        if torque is not None or duration is not None or initial is not None or as_payload(payload).mass:
            raise ShapeError("simulate", "a recording and a torque of one's own", "one of them")
        return self.replay(recording).simulation

    @on_one_thread
    def replay(self, recording: Recording, near: Array | None = None) -> SimulatedRecording:
        """Simulate a recording as `simulate` does, and keep it with its residuals.

        From an initial state (2 nv,) near the most likely, such as a similar model's, a few steps are taken.

        Raises:
            InsufficientDataError, RecordingError, ShapeError, SimulationDivergedError: as of `simulate`.
        """
        recording = for_rig(self.rig, recording)
        observed = Observations.of(self.rig, recording, (self.marker_noise, self.encoder_noise))
        arm = self.arm_in(recording)
        if near is not None:
            near, size = number_array("near", near), 2 * arm.chain.size
            require("near", near, near.shape == (size,) and bool(np.isfinite(near).all()), f"({size},) finite numbers")
        if near is None:
            ((run, converged),) = fit_initial_states([arm], [observed])
        else:
            ((run, converged),) = fit_initial_states([arm], [observed], [near], max_trials=FEW_TRIALS)
        return run.simulated_recording(converged)

    def modes(self, payload: float | tuple[float, float, float] = 0.0) -> Modes:
        """Return natural frequencies, damping ratios and shapes, with an extra mass on the tip as of `simulate`.

        They are of the chain as effects change it, at rest under the rig's gravity and what effects add to that. Forces
        of effects are not in them: drag, structural damping, creep, hysteresis and dry friction add nothing to the
        damping ratios, and those that stiffen or soften nothing to the frequencies.

        Raises:
            InsufficientDataError: no position of rest was found.
            ShapeError: no mass.
        """
        return modes(self.arm.chain, *self.arm.loads(as_payload(payload)))

    def pinocchio(self) -> PinocchioModel:
        """Return the chain as a `pin.Model` under the gravity that acts, with its stiffness and damping beside it."""
        chain = self.arm.chain
        return PinocchioModel(Mechanism(chain, gravity=self.arm.gravity).model, chain.stiffness, chain.damping)

    def flexible_model(self) -> FlexibleModel:
        """Return the chain for static equilibria, linearisation and control; its virtual joints are passive."""
        chain = self.arm.chain
        mechanism = Mechanism(chain, gravity=self.arm.gravity)
        cells = {
            f"{link.name}_virtual_{j}": float(cell) for link in chain.links for j, cell in enumerate(link.cells, 1)
        }
        return FlexibleModel(
            mechanism.model,
            chain.stiffness,
            chain.damping,
            passive=[chain.joint_names[k] for k in chain.passive],
            preload=[-mechanism.base_weight] + [0.0] * (chain.size - 1),
            cells=cells,
        )

    def marker_slopes(self, q: ArrayLike) -> dict[str, Array]:
        """Return the derivatives by q (nv,) [m/rad] of each marker's coordinates, `LINK.mK.x` and `.y`, at q (nv,).

        They are of the curves through the joints, as the camera sees them: outputs of `FlexibleModel.state_space`.

        Raises:
            ShapeError: q of another size.
        """
        angles, size = number_array("q", q), self.arm.chain.size
        if angles.shape != (size,):
            raise ShapeError("q", f"shape {angles.shape}", f"shape ({size},)")
        slopes = MarkerArcs.of(self.rig).jacobian(self.arm, angles[None], np.zeros(1), np.eye(size))[0]
        return dict(zip((column for link in self.rig.links for column in link.marker_columns), slopes, strict=True))

    def to_urdf(self, path: Path | str) -> Path:
        """Write the chain with its effects, as far as URDF can carry them, whole or not at all, and return the path.

        Raises:
            FolderError: the file cannot be written, or there is one that vjm did not write.
        """
        file = check_model_file(path)
        write_models({file: self.arm.urdf()})
        return file

    def export(self, path: Path | str, simulator: str) -> tuple[Path, Path]:
        """Write the URDF and, beside it, what a simulator reads with springs, and return both paths.

        The file beside has the URDF's name and the suffix .xml (MJCF, `mujoco`), .sdf (`gazebo`) or .py (a script, of
        `pinocchio`, `drake`, `pybullet`). Of the effects `arm.not_in_simulators` are in neither.

        Raises:
            ChoiceError: another simulator.
            FolderError: a file cannot be written, or there is one that vjm did not write.
            ShapeError: as of `simulator_path` and `chain_to_urdf`; a base under load without a spring; drives whose
                inertia the simulator has no place for.
        """
        simulator_file = simulator_path(path, simulator)
        file = Path(path)
        markers = [link.markers for link in self.rig.links]
        beside = self.arm.simulator_file(simulator, file.name, markers)
        write_models({file: self.arm.urdf(), simulator_file: beside})
        return file, simulator_file
