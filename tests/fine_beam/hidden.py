"""What may be hidden in an arm beside the plain beam: sizes of all mechanical effects, each null by default.

A field is named by the effect and its parameter, `tip_payload_mass` for the `mass` of `tip_payload`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import inf, isfinite, pi

import numpy as np
from numpy.typing import NDArray

from tests.fine_beam.beam import Body

Array = NDArray[np.float64]

FLANK_DEPTH = 2e-5  # rad; over the first bit of a contact the damping of a backlash's flanks fades in


@dataclass(frozen=True)
class Physics:
    """Mechanical effects; t is the time since the recording's start.

    Attributes:
        tip_payload_mass, tip_payload_radius_of_gyration, tip_payload_offset: of a body, its centre beyond the tip; kg,
            m, m.
        payload_body_offset, payload_body_radius_of_gyration: of a recording's payload, beyond those that are known, m.
        marker_mass_mass, marker_mass_arcs: of each marker, kg, and where they are on the link, m.
        hub_radius_radius: of the hub, beyond the one that is known, m.
        in_plane_gravity_gx, in_plane_gravity_gy: uniform gravity on top of the beam's own, m/s^2.
        coulomb_friction_torque: dry friction at the joint, with sticking, N m.
        viscous_friction_coefficient: at the joint, N m s/rad.
        joint_spring_stiffness: pulls the joint to angle 0, N m/rad.
        torque_gain_gain: true over recorded torque.
        torque_offset_offset: true less recorded torque, N m.
        gear_elasticity_stiffness, gear_elasticity_motor_share, gear_elasticity_damping: between motor and hub, N m/rad;
            the motor's part of the hub's inertia; of a damper beside the spring, N m s/rad.
        backlash_gap, backlash_motor_share: whole dead zone between motor and hub, rad; as of the gear, which counts
            where there are both.
        backlash_contact_stiffness, backlash_contact_damping_ratio: of the flanks, N m/rad, and of the motor on them.
        clamp_compliance_compliance, clamp_compliance_damping: turn of the link's root over its bending moment at rest,
            rad/(N m); of a damper beside the spring, N m s/rad.
        base_compliance_stiffness, base_compliance_mass, base_compliance_direction, base_compliance_damping_ratio: of a
            table that slides under the base, from where its load holds it; N/m, kg, rad, and of the table by itself.
        linear_drag_coefficient: force per length over normal velocity, N s/m^2.
        quadratic_drag_coefficient: the same over its square, N s^2/m^3.
        structural_damping_loss_factor, structural_damping_dispersion: of Maxwell arms, which lose about the same share
            of the energy at any frequency, and of dampers of the modes; the arms' part of the loss. The bending
            stiffness is that at the first natural frequency.
        structural_damping_memory, structural_damping_spacing: the arms' longest time constant, in radians of the first
            vibration; decades from one to the next, down to 1/4000 of a radian.
        viscoelastic_creep_ratio, viscoelastic_creep_time_constant: a Maxwell arm beside the spring; s.
        hysteresis_ratio, hysteresis_yield_angle: Bouc-Wen share of the stiffness; rad over the whole length.
        cubic_stiffness_coefficient: of the bending moment EI kappa (1 + coefficient kappa^2), m^2.
        stiffness_drift_rate: of the bending stiffness EI (1 + rate t), 1/s.
        rest_curvature_curvature: of the unloaded link, 1/m.
        taper_taper: thickness 1 + taper (1/2 - s/l) of the mean; stiffness goes with its cube, mass with itself.
        stiffness_asymmetry_ratio: of the bending moment EI kappa (1 + ratio sign(kappa)).
        external_tone_amplitude, external_tone_frequency, external_tone_phase: tip force normal to the link; N, Hz, rad.
        actuator_lag_time_constant: of the true torque behind the one that is asked for, s.
        torque_saturation_limit: to which the torque that is asked for is clipped, N m.
        cogging_amplitude, cogging_count, cogging_phase: torque by the motor's angle; N m, waves in a turn, rad.
        stribeck_torque, stribeck_speed: what dry friction at rest exceeds that of fast motion by, and the rate at which
            a part 1/e of it is left; N m, rad/s.
    """

    tip_payload_mass: float = 0.0
    tip_payload_radius_of_gyration: float = 0.0
    tip_payload_offset: float = 0.0
    payload_body_offset: float = 0.0
    payload_body_radius_of_gyration: float = 0.0
    marker_mass_mass: float = 0.0
    marker_mass_arcs: tuple[float, ...] = ()
    hub_radius_radius: float = 0.0
    in_plane_gravity_gx: float = 0.0
    in_plane_gravity_gy: float = 0.0
    coulomb_friction_torque: float = 0.0
    viscous_friction_coefficient: float = 0.0
    joint_spring_stiffness: float = 0.0
    torque_gain_gain: float = 1.0
    torque_offset_offset: float = 0.0
    gear_elasticity_stiffness: float = inf
    gear_elasticity_motor_share: float = 0.5
    gear_elasticity_damping: float = 0.0
    backlash_gap: float = 0.0
    backlash_motor_share: float = 0.5
    backlash_contact_stiffness: float = 2000.0
    backlash_contact_damping_ratio: float = 0.5
    clamp_compliance_compliance: float = 0.0
    clamp_compliance_damping: float = 0.0
    base_compliance_stiffness: float = inf
    base_compliance_mass: float = 5.0
    base_compliance_direction: float = 0.5 * pi
    base_compliance_damping_ratio: float = 0.03
    linear_drag_coefficient: float = 0.0
    quadratic_drag_coefficient: float = 0.0
    structural_damping_loss_factor: float = 0.0
    structural_damping_dispersion: float = 1.0
    structural_damping_memory: float = 100.0
    structural_damping_spacing: float = 0.5
    viscoelastic_creep_ratio: float = 0.0
    viscoelastic_creep_time_constant: float = 0.1
    hysteresis_ratio: float = 0.0
    hysteresis_yield_angle: float = 0.05
    cubic_stiffness_coefficient: float = 0.0
    stiffness_drift_rate: float = 0.0
    rest_curvature_curvature: float = 0.0
    taper_taper: float = 0.0
    stiffness_asymmetry_ratio: float = 0.0
    external_tone_amplitude: float = 0.0
    external_tone_frequency: float = 1.0
    external_tone_phase: float = 0.0
    actuator_lag_time_constant: float = 0.0
    torque_saturation_limit: float = inf
    cogging_amplitude: float = 0.0
    cogging_count: float = 24.0
    cogging_phase: float = 0.0
    stribeck_torque: float = 0.0
    stribeck_speed: float = 0.1

    @property
    def tip_payload(self) -> Body:
        """The unknown body on the tip."""
        mass, radius = self.tip_payload_mass, self.tip_payload_radius_of_gyration
        return Body(mass, self.tip_payload_offset, mass * radius**2)

    def true_payload(self, known: Body) -> Body:
        """A recording's payload as it is."""
        mass, offset, inertia = known
        spread = mass * self.payload_body_radius_of_gyration**2
        return Body(mass, offset + self.payload_body_offset if mass else 0.0, inertia + spread)

    @property
    def has_motor(self) -> bool:
        """Whether motor and hub turn apart."""
        return isfinite(self.gear_elasticity_stiffness) or self.backlash_gap > 0.0

    @property
    def motor_share(self) -> float:
        """The motor's part of the hub's inertia, where they turn apart."""
        elastic = isfinite(self.gear_elasticity_stiffness)
        return self.gear_elasticity_motor_share if elastic else self.backlash_motor_share

    @property
    def has_table(self) -> bool:
        """Whether the base moves."""
        return isfinite(self.base_compliance_stiffness)

    @property
    def step(self) -> float:
        """Longest step that follows what is not smooth, s."""
        if self.backlash_gap > 0.0:
            return 1.25e-4
        abrupt = self.has_dry_friction or isfinite(self.torque_saturation_limit) or self.cogging_amplitude != 0.0
        return 1e-3 if abrupt else 2e-3

    @property
    def has_dry_friction(self) -> bool:
        """Whether the joint may stick."""
        return self.coulomb_friction_torque > 0.0 or self.stribeck_torque > 0.0

    def dry_friction(self, rate: Array) -> Array:
        """Largest dry friction at the joint, N m, (B,), at rates of it, rad/s, (B,)."""
        falling = np.exp(-((rate / self.stribeck_speed) ** 2))
        return np.asarray(self.coulomb_friction_torque + self.stribeck_torque * falling)

    @property
    def nodes(self) -> int:
        """Points along the link that resolve what happens at each of them."""
        return 32 if self.hysteresis_ratio != 0.0 or self.stiffness_asymmetry_ratio != 0.0 else 16


def fields_of(effect: str, parameters: Mapping[str, float]) -> dict[str, float]:
    """Names and values of the fields for an effect with its parameters."""
    return {f"{effect}_{name}": value for name, value in parameters.items()}


def is_mechanical(effect: str) -> bool:
    """Whether the effect is in the arm and not in its sensors."""
    return any(each.name.startswith(f"{effect}_") for each in fields(Physics))


def transmission_torque(physics: Physics, hub_inertia: float, twist: Array, twist_rate: Array) -> Array:
    """Torque of motor on hub, N m, (B,), for motor less hub angle, rad and rad/s, (B,), where it is not linear.

    The flanks push and never pull. With an elastic gear as well, the flanks are as soft as the gear, and its damper is
    beside their own.
    """
    elastic = isfinite(physics.gear_elasticity_stiffness)
    stiffness = physics.gear_elasticity_stiffness if elastic else physics.backlash_contact_stiffness
    ratio = (0.1 if elastic else 1.0) * physics.backlash_contact_damping_ratio
    damping = 2.0 * ratio * np.sqrt(stiffness * physics.motor_share * hub_inertia) + physics.gear_elasticity_damping
    side = np.sign(twist)
    depth = np.maximum(np.abs(twist) - 0.5 * physics.backlash_gap, 0.0)
    push = stiffness * depth + damping * side * twist_rate * np.minimum(depth / FLANK_DEPTH, 1.0)
    return np.asarray(side * np.maximum(push, 0.0))


def slip_rate(curvature_rate: Array, hysteretic: Array, yield_curvature: float) -> Array:
    """Rate of the Bouc-Wen curvature, 1/(m s), from the curvature's rate, 1/(m s), and itself, 1/m."""
    loading = 0.5 * (1.0 + np.sign(curvature_rate * hysteretic))
    return np.asarray(curvature_rate * (1.0 - np.abs(hysteretic) / yield_curvature * loading))
