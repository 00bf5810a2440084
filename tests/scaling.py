"""An experiment in other units of length, mass and time: the same mathematics on a toy or on a boom."""

from __future__ import annotations

from dataclasses import replace

from vjm import Experiment, Link, Recording, Rig


def scaled(experiment: Experiment, length: float, mass: float, time: float) -> Experiment:
    """The experiment with all lengths, masses and times multiplied, and everything else as its unit says."""
    torque, acceleration = mass * length**2 / time**2, length / time**2

    def link(one: Link) -> Link:
        return replace(
            one,
            length=length * one.length,
            mass=mass * one.mass,
            bending_stiffness=torque * length * one.bending_stiffness,
            markers=tuple(length * marker for marker in one.markers),
            hub_inertia=mass * length**2 * one.hub_inertia,
            hub_radius=length * one.hub_radius,
            payload=mass * one.payload,
            payload_offset=length * one.payload_offset,
            payload_inertia=mass * length**2 * one.payload_inertia,
            width=None,
            thickness=None,
            youngs_modulus=None,
        )

    def recording(one: Recording) -> Recording:
        return replace(
            one,
            time=time * one.time,
            markers=length * one.markers,
            tau=torque * one.tau,
            payload=mass * one.payload,
            payload_offset=length * one.payload_offset,
            payload_inertia=mass * length**2 * one.payload_inertia,
            gravity=tuple(acceleration * value for value in one.gravity),
        )

    rig = experiment.rig
    rig = Rig(
        rig.name,
        tuple(link(one) for one in rig.links),
        tuple(acceleration * value for value in rig.gravity),
        length * rig.marker_noise if rig.marker_noise else None,
        rig.encoder_noise,
    )
    return Experiment(rig, tuple(recording(one) for one in experiment.recordings))
