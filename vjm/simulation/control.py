"""Simulation under a torque of one's own: given over time, or by a control law from the joints' angles and rates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect, StateFunction
from vjm.errors import ShapeError, SimulationDivergedError, is_number, shown
from vjm.experiment.arrays import number_array
from vjm.model.modes import linearise
from vjm.records import NO_PAYLOAD, Array, Payload, Recording, Rig, Simulation
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import default_step, simulate_trajectories
from vjm.simulation.measurement import MarkerArcs, sensor_readings

ControlLaw: TypeAlias = Callable[[float, Array, Array], ArrayLike]
_HALVINGS = 7  # of the step; a law that needs steps 128 times shorter than the arm's motion jumps, or is unstable


@dataclass(frozen=True)
class _Feedback(Effect):
    """Torque of active joints by a control law, through the actuators as effects change it."""

    law: ControlLaw
    effects: tuple[Effect, ...] = ()

    def force(self, chain: Chain, payload: Payload) -> StateFunction:
        """Return the function that gives the law's torque as a force on the joints."""
        return lambda time, q, v, z: np.stack([self._forces(chain, *state) for state in zip(time, q, v, strict=True)])

    def _forces(self, chain: Chain, time: float, q: Array, v: Array) -> Array:
        """Return forces (nv,) at a time [s], angles (nv,) and rates (nv,)."""
        forces, active = np.zeros(chain.size), chain.active
        commanded = _shaped(
            "torque", self.law(float(time), q[active], v[active]), (active.size,), "N m, of active joints"
        )
        forces[active] = _through_actuators(
            self.effects, np.array([time, time + 1.0]), np.stack([commanded, commanded])
        )[0]
        return forces


def _shaped(name: str, values: ArrayLike, shape: tuple[int, ...], unit: str) -> Array:
    """Return values as an array of a shape; a single joint's may be one number."""
    try:
        array = number_array(name, values).reshape(shape)
    except ValueError:
        raise ShapeError(name, shown(values), f"{shape}, finite [{unit}]") from None
    if not np.isfinite(array).all():
        raise ShapeError(name, "a value that is not finite", f"{shape}, finite [{unit}]")
    return array


def _through_actuators(effects: tuple[Effect, ...], time: Array, torque: Array) -> Array:
    """Return the torques (T, n_a) that act where torques (T, n_a) are asked for at instants (T,)."""
    if all(type(effect).true_inputs is Effect.true_inputs for effect in effects):
        return torque
    recording = _recording(time, torque, (0.0, 0.0), NO_PAYLOAD, 0)
    for effect in effects:
        recording = effect.true_inputs(recording)
    return recording.tau


def _recording(time: Array, torque: Array, gravity: tuple[float, float], payload: Payload, markers: int) -> Recording:
    return Recording(
        time,
        np.full((time.size, markers, 2), np.nan),
        tau=torque,
        kind="driven",
        gravity=gravity,
        payload=payload.mass,
        payload_offset=payload.offset,
        payload_inertia=payload.inertia,
    )


def simulate_motion(
    arm: Arm,
    rig: Rig,
    noise: float,
    torque: ArrayLike | ControlLaw | None,
    duration: float | None,
    initial: ArrayLike | None,
    payload: Payload,
) -> Simulation:
    """Simulate an arm as `Model.simulate` does under a torque of one's own.

    Args:
        arm: with its effects.
        rig: says where the markers are.
        noise: of a marker coordinate [m]; a control law's steps are halved until no marker moves by a tenth of it.
        torque, duration, initial, payload: as of `Model.simulate`.

    Raises:
        ShapeError: an argument that does not fit the arm.
        SimulationDivergedError: the motion left the finite numbers, or depends on the step however short.
    """
    if not (is_number(duration) and duration > 0):
        raise ShapeError("duration", shown(duration), "a positive number of seconds")
    chain, count = arm.chain, arm.chain.active.size
    step = min(default_step(chain, payload), duration / 20)
    if torque is None or callable(torque):
        time = np.linspace(0.0, duration, 1 + int(np.ceil(duration / step)))
        torques = np.zeros((time.size, count))
    else:
        samples = number_array("torque", torque)
        if samples.ndim == 0 or samples.shape[0] < 2:
            raise ShapeError("torque", samples.shape, f"(T, {count}) at T >= 2 instants [N m]")
        time = np.linspace(0.0, duration, samples.shape[0])
        torques = _shaped("torque", samples, (time.size, count), "N m")
    recording = _recording(time, torques, rig.gravity, payload, sum(len(link.markers) for link in rig.links))
    q, v = _initial_state(arm, recording, initial)

    def simulated(arm: Arm, step: float | None) -> Simulation:
        (trajectory,) = simulate_trajectories([arm], [recording], [q], [v], step)
        return sensor_readings(arm, MarkerArcs.of(rig), recording, trajectory)

    if not callable(torque):
        return simulated(arm, None)
    _check_memory(arm.effects, count)
    arm = Arm(chain, (*arm.effects, _Feedback(torque, arm.effects)))
    previous, step = None, min(step, arm.longest_step)  # beyond which half a step would be no shorter
    for _ in range(1 + _HALVINGS):
        try:
            motion = simulated(arm, step)
        except SimulationDivergedError:  # the law may be stiff
            motion = None
        if motion and previous and np.abs(motion.markers - previous.markers).max(initial=0.0) < 0.1 * noise:
            return motion
        previous, step = motion, step / 2
    problem = f"the motion under the control law depends on the step, down to one of {2 * step:.3g} s"
    remedy = "the law is unstable, jumps, or does not depend on its arguments alone"
    raise SimulationDivergedError(0.0, 2 * step, remedy, problem)


def _initial_state(arm: Arm, recording: Recording, initial: ArrayLike | None) -> tuple[Array, Array]:
    """Return angles and rates (nv,), (nv,) from those of all joints, or of active ones with passive ones at rest."""
    chain = arm.chain
    n, count = chain.size, chain.active.size
    state = np.zeros((2, count)) if initial is None else number_array("initial", initial)
    if state.shape == (2, n) and np.isfinite(state).all():
        return state[0], state[1]
    if state.shape != (2, count) or not np.isfinite(state).all():
        expected = f"(2, {n}) angles and rates of all joints, or (2, {count}) of active ones [rad, rad/s]"
        raise ShapeError("initial", state.shape if np.isfinite(state).all() else "a value that is not finite", expected)
    inputs, v = arm.inputs(recording), np.zeros(n)
    _, _, _, q = linearise(chain, inputs.payload_body, inputs.gravity, state[0])
    v[chain.active] = state[1]
    return q, v


def _check_memory(effects: tuple[Effect, ...], count: int) -> None:
    """Refuse effects whose torque depends on earlier torques: a control law's are not known before it is simulated."""
    time = np.linspace(0.0, 1.0, 9)
    ramp = 1e-6 * time[:, None] * np.ones(count)
    for effect in effects:
        one_by_one = [
            _through_actuators((effect,), np.array([0.0, 1.0]), np.stack([value, value]))[0] for value in ramp
        ]
        if not np.allclose(_through_actuators((effect,), time, ramp), one_by_one, rtol=1e-9, atol=1e-15):
            expected = "effects without memory of earlier torques, or an array of torques instead of a control law"
            raise ShapeError("torque", f"a control law beside the effect {effect.id!r}", expected)
