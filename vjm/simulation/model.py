"""An identified arm: its chain and effects, to simulate, analyse and export."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect
from vjm.errors import ShapeError
from vjm.files import write_text
from vjm.model.dynamics import Mechanism
from vjm.model.modes import Modes, modes
from vjm.records import REFERENCE, Array, Estimate, Record, Recording, Rig, SimulatedRecording, Simulation
from vjm.simulation.arm import Arm
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.measurement import Observations

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

    @cached_property
    def arm(self) -> Arm:
        """The chain with its effects."""
        return Arm.of(self.chain, self.effects)

    @cached_property
    def _reference(self) -> Arm:
        return Arm.of(self.chain, self.effects[: self.reference_effects])

    def arm_in(self, recording: Recording) -> Arm:
        """Return the arm of a recording; in a `reference` recording it has the reference effects only."""
        return (self._reference if recording.condition == REFERENCE else self.arm).in_recording(recording)

    def simulate(self, recording: Recording) -> Simulation:
        """Simulate a recording open loop, from the initial state most likely given the whole of it.

        Raises:
            InsufficientDataError: no torque measured at an active joint.
            SimulationDivergedError: the simulation left the finite numbers.
        """
        return self.replay(recording).simulation

    def replay(self, recording: Recording) -> SimulatedRecording:
        """Simulate a recording as `simulate` does, and keep it with its residuals."""
        observed = Observations.of(self.rig, recording, (self.marker_noise, self.encoder_noise))
        ((run, converged),) = fit_initial_states([self.arm_in(recording)], [observed])
        return run.simulated_recording(converged)

    def modes(self, payload: float = 0.0) -> Modes:
        """Return natural frequencies, damping ratios and shapes, with an extra point mass [kg] on the tip."""
        return modes(self.arm.chain, payload)

    def pinocchio(self) -> PinocchioModel:
        """Return the chain as a `pin.Model`, with its stiffness and damping beside it."""
        chain = self.arm.chain
        return PinocchioModel(Mechanism(chain).model, chain.stiffness, chain.damping)

    def to_urdf(self, path: Path | str) -> Path:
        """Write the chain with its effects, as far as URDF can carry them, whole or not at all, and return the path.

        Raises:
            FolderError: the file cannot be written.
        """
        file = Path(path)
        write_text(file, self.arm.urdf())
        return file
