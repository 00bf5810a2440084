"""The package's integrator and the reference that it is compared with, and simulations by either."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from unittest.mock import patch

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp

from vjm.chain.virtual_links import Chain
from vjm.effects.contact import Contact
from vjm.model.dynamics import mechanism_of
from vjm.records import Recording, Rig, Simulation
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import simulate_trajectories
from vjm.simulation.measurement import MarkerArcs, sensor_readings
from vjm.simulation.system import Drive, System, Trajectory

Array = NDArray[np.float64]
INTEGRATORS = ("exponential", "rk4")


def trajectories_of(
    arms: Sequence[Arm],
    recordings: Sequence[Recording],
    q: Sequence[Array],
    v: Sequence[Array],
    integrator: str = "exponential",
    step: float | None = None,
) -> list[Trajectory]:
    """As `simulate_trajectories`, by either integrator; steps of Runge-Kutta are 100 us unless told otherwise."""
    if integrator == "exponential":
        return simulate_trajectories(arms, recordings, q, v, step)
    with patch("vjm.simulation.integrate._integrate", runge_kutta):
        return simulate_trajectories(arms, recordings, q, v, 1e-4 if step is None else step)


def simulate(
    arm: Chain | Arm,
    rig: Rig,
    recording: Recording,
    q: ArrayLike,
    v: ArrayLike,
    integrator: str = "exponential",
    step: float | None = None,
) -> Simulation:
    """What the sensors of an arm show that starts at angles and rates q, v (nv,)."""
    arm = arm if isinstance(arm, Arm) else Arm(arm)
    (trajectory,) = trajectories_of([arm], [recording], [np.asarray(q)], [np.asarray(v)], integrator, step)
    return sensor_readings(arm, MarkerArcs.of(rig), recording, trajectory)


def flank_torque(contact: Contact, twist: Array, rate: Array) -> Array:
    """The torque of a gap's flanks on its joint; they push and never pull."""
    inside = np.abs(twist) > contact.gap / 2
    push = contact.stiffness * (np.abs(twist) - contact.gap / 2) + contact.damping * np.sign(twist) * rate
    return -np.sign(twist) * np.where(inside, np.maximum(push, 0.0), 0.0)


def runge_kutta(system: System, q: Array, v: Array, z: Array, drive: Drive) -> tuple[Trajectory, None]:
    """Classical fourth-order Runge-Kutta steps, the reference (section 6.4 of the paper takes 100 us)."""
    if system.has_dry_friction:
        raise ValueError("the reference has no dry friction: give it a gradual one")
    contacts, copies = system.contacts, np.arange(len(q))[:, None]
    step, count = drive.step, len(drive.start)
    time, half, accelerations = step * np.arange(count + 1.0), step / 2, system.accelerations
    path = Trajectory(time, *(np.empty((count + 1, *like.shape)) for like in (q, q, q, z)))
    active = np.stack([drive.start, drive.middle, drive.end])
    torques = np.zeros((*active.shape[:2], *q.shape))
    torques[..., system.active] = active

    def slopes(time: float, q: Array, v: Array, z: Array, torque: Array) -> tuple[Array, Array]:
        force = torque - system.stiffness * q - system.damping * v
        joints = copies, contacts.joint
        force[joints] += flank_torque(contacts, q[joints], v[joints])
        if not system.has_further_forces:
            return accelerations(q, v, force), z
        further, rates = system.further_forces(np.full(len(q), time), q, v, z)
        return accelerations(q, v, force + further), rates

    for k, (start, middle, end) in enumerate(np.moveaxis(torques, 0, 1)):
        a1, z1 = slopes(time[k], q, v, z, start)
        path.q[k], path.v[k], path.a[k], path.z[k] = q, v, a1, z
        q2, v2 = q + half * v, v + half * a1
        a2, z2 = slopes(time[k] + half, q2, v2, z + half * z1, middle)
        q3, v3 = q + half * v2, v + half * a2
        a3, z3 = slopes(time[k] + half, q3, v3, z + half * z2, middle)
        q4, v4 = q + step * v3, v + step * a3
        a4, z4 = slopes(time[k + 1], q4, v4, z + step * z3, end)
        moved = q + step / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v = v + step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        z = z + step / 6 * (z1 + 2 * z2 + 2 * z3 + z4)
        q = moved
    last = np.zeros(q.shape)
    last[:, system.active] = drive.ends[-1]
    path.q[-1], path.v[-1], path.a[-1], path.z[-1] = q, v, slopes(time[-1], q, v, z, last)[0], z
    return path, None


def followed_events(arm: Arm, recording: Recording) -> Array:
    """Angles (T, nv) at the recording's instants from rest, by DOP853 from one contact's begin or end to the next."""
    chain, contacts, driven = arm.chain, arm.contacts, arm.inputs(recording)
    n, (stiffness, damping) = chain.size, arm.springs
    mechanism = mechanism_of(chain, recording.payload_body, recording.gravity)

    def rates(t: float, state: Array, sides: Array) -> Array:
        q, v = state[None, :n], state[None, n:]
        torque = -stiffness * q - damping * v
        torque[:, chain.active] += [np.interp(t, driven.time, column) for column in driven.tau.T]
        for contact, side in zip(contacts, sides, strict=True):
            if side:
                joint = contact.joint
                torque[:, joint] -= side * contact.resistance(q[:, joint], v[:, joint])
        return np.r_[state[n:], mechanism.forward_dynamics(q, v, torque)[0]]

    def change_of(place: int, touches: bool) -> Callable[[float, Array, Array], float]:
        contact = contacts[place]

        def change(t: float, state: Array, sides: Array) -> float:
            return float(contact.event_function(state[contact.joint], state[n + contact.joint]))

        change.terminal, change.direction = True, -1.0 if touches else 1.0  # type: ignore[attr-defined]
        return change

    time, found, t, state = recording.time, [np.zeros((1, n))], 0.0, np.zeros(2 * n)
    sides = np.zeros(len(contacts))
    while t < time[-1]:
        changes = [change_of(place, side != 0.0) for place, side in enumerate(sides)]
        span = (t, float(time[-1]))
        # Small steps at first, as a joint may leave a flank for less than a millisecond.
        steps = {"rtol": 1e-10, "atol": 1e-12, "max_step": 1e-3, "first_step": min(1e-5, span[1] - t)}
        part = solve_ivp(rates, span, state, "DOP853", time[time > t], events=changes, args=(sides,), **steps)
        found += [part.y.T[:, :n]] if len(part.t) else []
        if part.status != 1:
            break
        place = next(place for place, instants in enumerate(part.t_events) if len(instants))
        t, state = float(part.t_events[place][0]), part.y_events[place][0]
        sides[place] = 0.0 if sides[place] else np.sign(state[contacts[place].joint])
    return np.concatenate(found)
