"""Equations of motion of the beam with hidden physics, for a batch of recordings at once.

The same heading psi(s, t) = sum_m q_m(t) H_m(s) as in `mechanics`, written with the kernel
G(s, s') = integral of the mass beyond both s and s', which makes a whole batch a few array operations:
M = H^T (G cos(psi - psi')) H. Coordinates: motor, hub, root of the link (each only where it moves), bending functions,
and last, where it moves, the table's displacement u: a point's velocity is u' d more than that relative to the base.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from tests.fine_beam.basis import Basis, make_basis
from tests.fine_beam.beam import NO_BODY, Beam, Body
from tests.fine_beam.hidden import Physics, slip_rate, transmission_torque

Array = NDArray[np.float64]

_TWIST: Array = np.array([[1.0, -1.0], [-1.0, 1.0]])  # of motor and hub against each other


class Fields(NamedTuple):
    """Along the beams of a batch, at N nodes: cosine and sine of the heading, its rate (rad/s); (B, N) each."""

    cosine: Array
    sine: Array
    rate: Array


class Parts(NamedTuple):
    """Where in a state y (B, d) the coordinates, rates, Maxwell arms' coordinates, slips and a late torque are."""

    coordinates: slice
    rates: slice
    maxwell: slice
    slip: slice
    torque: slice


class Extended:
    """A beam with hidden physics and B payloads, on top of its own."""

    def __init__(
        self, beam: Beam, physics: Physics, payloads: Sequence[Body] = (NO_BODY,), size: int = 8, nodes: int = 16
    ) -> None:
        true = np.array([physics.true_payload(payload) for payload in payloads])
        distinct, group = np.unique(true, axis=0, return_inverse=True)
        self.group: NDArray[np.intp] = group.ravel()
        # On the tip with each distinct payload.
        self.bodies = [(Body(beam.payload), physics.tip_payload, Body(*map(float, payload))) for payload in distinct]
        on_tip = [body for bodies in self.bodies for body in bodies]
        tip_moment = any(body.offset or body.inertia for body in on_tip)
        size += int(tip_moment)  # up to the same degree
        basis: Basis = make_basis(beam.length, size, nodes, tip_moment)
        basis = basis.with_tip_node() if any(body.offset for body in on_tip) else basis
        self.revolute = beam.joint == "revolute"
        hub = (beam.hub_radius + physics.hub_radius_radius) * self.revolute
        basis = basis.with_hub(hub) if hub else basis
        nodes = len(basis.nodes)
        self.beam, self.physics, self.basis = beam, physics, basis
        self.motor = self.revolute and physics.has_motor
        self.root = physics.clamp_compliance_compliance > 0.0
        turning = int(self.revolute) + int(self.root)
        still, table = np.zeros((nodes, int(self.motor))), np.zeros((nodes, int(physics.has_table)))
        self.heading: Array = np.hstack([still, np.ones((nodes, turning)), basis.heading, table])
        self.curvature: Array = np.hstack([still, np.zeros((nodes, turning)), basis.curvature, table])
        self.bending = slice(turning + int(self.motor), turning + int(self.motor) + size)
        if hub and self.root:
            self.heading[0, self.bending.start - 1] = 0.0  # the hub stays as the root turns in its clamp
        direction = physics.base_compliance_direction
        self.slide: Array = np.array([np.cos(direction), np.sin(direction)])
        self.size: int = self.heading.shape[1]
        self.arc: Array = physics.rest_curvature_curvature * basis.nodes
        # Mass per length, kg/m, and bending stiffness, N m^2, at the nodes.
        thickness = 1.0 + physics.taper_taper * (0.5 - basis.nodes / beam.length)
        self.line: Array = beam.mass / beam.length * thickness
        self.line[: int(hub != 0.0)] = 0.0  # a hub's own mass is in its inertia
        self.section: Array = beam.bending_stiffness * thickness**3
        self.tip_heading: Array = self._tip_heading()
        self.gravity: Array = np.add(beam.gravity, (physics.in_plane_gravity_gx, physics.in_plane_gravity_gy))
        self._set_masses()
        self.stiffness, self.bending_stiffness = self._stiffness()
        self.damping: Array = np.stack([self._damping(k) for k in range(len(self.bodies))])
        self.ratios, self.time_constants = self._maxwell_arms()
        self.parts = self._parts(size, nodes)
        self.dimension: int = self.parts.torque.stop
        # Of coordinates and rates side by side.
        springs = np.stack([np.vstack([self.stiffness, damping]) for damping in self.damping])
        self._springs: Array = springs[self.group] if len(springs) > 1 else springs

    def _tip_heading(self) -> Array:
        """Heading of each coordinate at the tip, (n,)."""
        values = np.ones(self.size)
        values[: int(self.motor)] = 0.0
        values[self.bending.stop :] = 0.0
        values[self.bending] = self.basis.weights @ self.basis.curvature
        return values

    def _parts(self, size: int, nodes: int) -> Parts:
        n = self.size
        maxwell = 2 * n + size * len(self.ratios)
        slip = maxwell + (nodes if self.physics.hysteresis_ratio != 0.0 else 0)
        torque = slip + (1 if self.revolute and self.physics.actuator_lag_time_constant > 0.0 else 0)
        return Parts(slice(0, n), slice(n, 2 * n), slice(2 * n, maxwell), slice(maxwell, slip), slice(slip, torque))

    def _set_masses(self) -> None:
        """Kernels (N, N) and masses beyond each node (N,) of the distinct payloads; one for each member."""
        basis = self.basis
        carried = self.line * basis.weights
        count, nodes = len(self.bodies), len(basis.nodes)
        # Of what bends with the link: its own mass, and the markers'.
        markers = self.physics.marker_mass_mass * np.ones(len(self.physics.marker_mass_arcs))
        reaches = np.vstack([basis.cumulative, basis.integrals_to(np.array(self.physics.marker_mass_arcs))])
        carried = np.append(carried, markers)
        kernels = np.tile((reaches.T * carried) @ reaches, (count, 1, 1))
        beyond = np.tile(carried @ reaches, (count, 1))
        turning = np.zeros((count, self.size, self.size))
        if self.revolute:
            motor = self.physics.motor_share
            for k, share in enumerate((motor, 1.0 - motor) if self.motor else (1.0,)):
                turning[:, k, k] = share * self.beam.hub_inertia
        for k, bodies in enumerate(self.bodies):
            for mass, offset, inertia in bodies:
                # On the tip, and beyond it: by the distance times the heading at the last node.
                reach = basis.weights + offset * np.eye(nodes)[-1]
                kernels[k] += mass * np.outer(reach, reach)
                beyond[k] += mass * reach
                turning[k] += inertia * np.outer(self.tip_heading, self.tip_heading)
        self.mass: Array = self.heading.T @ kernels @ self.heading + turning
        if self.physics.has_table:
            masses = np.array([sum(body.mass for body in bodies) for bodies in self.bodies])
            self._moved: Array = self.physics.base_compliance_mass + self.beam.mass + markers.sum() + masses
            self.mass[:, -1, -1] = self._moved
            straight = self.slide[1] * beyond @ self.heading[:, :-1]
            self.mass[:, -1, :-1], self.mass[:, :-1, -1] = straight, straight
        single = count == 1
        self._turning: Array = turning if single else turning[self.group]
        self._kernel: Array = kernels if single else kernels[self.group]
        self._beyond: Array = beyond if single else beyond[self.group]

    def _stiffness(self) -> tuple[Array, Array]:
        """Linear stiffness, all of it and that of bending alone, (n, n) each."""
        bending = (self.curvature.T * (self.section * self.basis.weights)) @ self.curvature
        whole = bending.copy()
        if self.root:
            root = self.bending.start - 1
            whole[root, root] += 1.0 / self.physics.clamp_compliance_compliance
        if self.motor and self.physics.backlash_gap == 0.0:
            whole[:2, :2] += self.physics.gear_elasticity_stiffness * _TWIST
        if self.physics.has_table:
            whole[-1, -1] = self.physics.base_compliance_stiffness
        return whole, bending

    def _damping(self, k: int) -> Array:
        """Dampers, of bending and of joints, and those of the modes with distinct payload k, (n, n)."""
        viscous = self.beam.kelvin_voigt_time * self.bending_stiffness
        if self.root:
            root = self.bending.start - 1
            viscous[root, root] += self.physics.clamp_compliance_damping
        if self.motor and self.physics.backlash_gap == 0.0:
            viscous[:2, :2] += self.physics.gear_elasticity_damping * _TWIST
        if self.physics.has_table:
            critical = 2.0 * np.sqrt(self.physics.base_compliance_stiffness * self.physics.base_compliance_mass)
            viscous[-1, -1] = self.physics.base_compliance_damping_ratio * critical
        loss = (1.0 - self.physics.structural_damping_dispersion) * self.physics.structural_damping_loss_factor
        if loss == 0.0:
            return np.asarray(viscous)
        pulsations, shapes = self._modes_in_contact(k)
        carried = self.mass[k] @ shapes
        return np.asarray(viscous + loss * (carried * pulsations) @ carried.T)

    def _maxwell_arms(self) -> tuple[Array, Array]:
        """Ratios to the bending stiffness and time constants, s, of the arms beside it, (A,) each.

        The stiffness is lowered by what those of structural damping add at the first natural frequency
        without a known payload.
        """
        ratios, constants = np.zeros(0), np.zeros(0)
        if self.physics.viscoelastic_creep_ratio != 0.0:
            ratios = np.array([self.physics.viscoelastic_creep_ratio])
            constants = np.array([self.physics.viscoelastic_creep_time_constant])
        loss = self.physics.structural_damping_dispersion * self.physics.structural_damping_loss_factor
        spacing = self.physics.structural_damping_spacing
        if loss == 0.0:
            return ratios, constants
        alone = Extended(self.beam, replace(self.physics, structural_damping_loss_factor=0.0))
        first = alone._modes_in_contact()[0][0]
        # Of the time constants in the first vibration.
        phases = 10.0 ** np.arange(np.log10(self.physics.structural_damping_memory), np.log10(1 / 4000), -spacing)
        ratio = 2.0 / np.pi * loss * spacing * np.log(10.0)
        self.stiffness -= ratio * np.sum(phases**2 / (1.0 + phases**2)) * self.bending_stiffness
        return np.append(ratios, np.full(len(phases), ratio)), np.append(constants, phases / first)

    def modes(self, k: int = 0) -> tuple[Array, Array]:
        """Pulsations, rad/s, (m,) and mass-normalised shapes (n, m) of the vibrations with distinct payload k."""
        squared, shapes = eigh(self.stiffness, self.mass[k])
        return np.sqrt(squared[self._free :]), shapes[:, self._free :]

    def _modes_in_contact(self, k: int = 0) -> tuple[Array, Array]:
        """`modes` of a hub with play that stays on a flank, where it nearly always is."""
        if not (self.motor and self.physics.backlash_gap > 0.0):
            return self.modes(k)
        elastic = isfinite(self.physics.gear_elasticity_stiffness)
        touching = self.stiffness.copy()
        stiffness = self.physics.gear_elasticity_stiffness if elastic else self.physics.backlash_contact_stiffness
        touching[:2, :2] += stiffness * _TWIST
        squared, shapes = eigh(touching, self.mass[k])
        return np.sqrt(squared[int(self.revolute) :]), shapes[:, int(self.revolute) :]

    @property
    def _free(self) -> int:
        """Number of motions that nothing holds."""
        return int(self.revolute) + int(self.motor and self.physics.backlash_gap > 0.0)

    def modes_on_ground(self, k: int = 0) -> Array:
        """Shapes (n, m) of the vibrations on a table that is held, with distinct payload k."""
        arm = slice(0, self.bending.stop)
        _, shapes = eigh(self.stiffness[arm, arm], self.mass[k][arm, arm])
        still = np.zeros((self.size - self.bending.stop, shapes.shape[1]))
        return np.vstack([shapes, still])[:, self._free :]

    def linear(self, k: int) -> Array:
        """The linear first-order system's matrix, (d, d), with distinct payload k."""
        n, parts = self.size, self.parts
        matrix = np.zeros((self.dimension, self.dimension))
        matrix[parts.coordinates, parts.rates] = np.eye(n)
        matrix[parts.rates, parts.coordinates] = -np.linalg.solve(self.mass[k], self.stiffness)
        matrix[parts.rates, parts.rates] = -np.linalg.solve(self.mass[k], self.damping[k])
        if parts.maxwell.stop > parts.maxwell.start:
            size = parts.maxwell.stop - parts.maxwell.start
            arms = np.hstack([ratio * self.bending_stiffness[:, self.bending] for ratio in self.ratios])
            matrix[parts.rates, parts.maxwell] = -np.linalg.solve(self.mass[k], arms)
            stretched = np.tile(np.eye(size // len(self.ratios)), (len(self.ratios), 1))
            matrix[parts.maxwell, parts.rates][:, self.bending] = stretched
            relaxing = np.repeat(1.0 / self.time_constants, size // len(self.ratios))
            matrix[parts.maxwell, parts.maxwell] = -np.diag(relaxing)
        if parts.torque.stop > parts.torque.start:
            matrix[parts.rates, parts.torque] = np.linalg.solve(self.mass[k], np.eye(n)[:, :1])
            matrix[parts.torque, parts.torque] = -1.0 / self.physics.actuator_lag_time_constant
        return matrix

    def fields(self, state: Array) -> Fields:
        """Heading and its rate along the beams for states (B, d)."""
        both = state[:, : 2 * self.size].reshape(len(state), 2, self.size) @ self.heading.T
        angle = both[:, 0] + self.arc
        return Fields(np.cos(angle), np.sin(angle), both[:, 1])

    def accelerations(self, state: Array, time: float, torque: Array) -> Array:
        """Second derivatives (B, n) of the coordinates for torques (B,) at the joint, N m."""
        along = self.fields(state)
        kernel = self._kernel * (
            along.cosine[:, :, None] * along.cosine[:, None, :] + along.sine[:, :, None] * along.sine[:, None, :]
        )
        mass = self.heading.T @ (kernel @ self.heading) + self._turning
        if self.physics.has_table:
            across = self.slide[1] * along.cosine - self.slide[0] * along.sine
            pulled = (self._beyond * across) @ self.heading[:, :-1]
            mass[:, -1, :-1], mass[:, :-1, -1], mass[:, -1, -1] = pulled, pulled, self._moved[self.group]
        force = self.forces(state, time, torque, along)
        return np.asarray(np.linalg.solve(mass, force[..., None])[..., 0])

    def forces(self, state: Array, time: float, torque: Array, along: Fields) -> Array:
        """All generalised forces (B, n) but the inertia of accelerating."""
        coordinates, rates = state[:, self.parts.coordinates], state[:, self.parts.rates]
        along_links = self._centrifugal(along)
        for load in self._loads(along, coordinates, time):
            along_links += load
        force = along_links @ self.heading - times(self._springs, state[:, : 2 * self.size])
        if self.parts.maxwell.stop > self.parts.maxwell.start:
            arms = state[:, self.parts.maxwell].reshape(len(state), len(self.ratios), -1)
            force -= (self.ratios @ arms) @ self.bending_stiffness[self.bending]
        if self.physics.has_table:
            ahead = self.slide[0] * along.cosine + self.slide[1] * along.sine
            force[:, -1] += np.sum(self._beyond * ahead * along.rate**2, axis=1)
        moment = self._moment(state, time)
        if moment is not None:
            force -= (self.basis.weights * moment) @ self.curvature
        if self.revolute:
            self._add_joint(force, coordinates, rates, torque)
        return np.asarray(force)

    def _centrifugal(self, along: Fields) -> Array:
        """Force on the heading at each node, N m, (B, N)."""
        squared = along.rate**2
        if len(self._kernel) == 1:
            lifted = (squared * along.sine) @ self._kernel[0], (squared * along.cosine) @ self._kernel[0]
        else:
            lifted = _rows(self._kernel, squared * along.sine), _rows(self._kernel, squared * along.cosine)
        return np.asarray(along.cosine * lifted[0] - along.sine * lifted[1])

    def _loads(self, along: Fields, coordinates: Array, time: float) -> Iterator[Array]:
        """What gravity, the air and the tone do to the heading at each node, N m, (B, N), where they are at all."""
        physics = self.physics
        if self.gravity.any():
            yield self._beyond * (self.gravity[1] * along.cosine - self.gravity[0] * along.sine)
        linear, quadratic = physics.linear_drag_coefficient, physics.quadratic_drag_coefficient
        if linear or quadratic:
            yield self._drag(along, linear, quadratic)
        if physics.external_tone_amplitude:
            phase = 2.0 * np.pi * physics.external_tone_frequency * time + physics.external_tone_phase
            tip = coordinates @ self.tip_heading + physics.rest_curvature_curvature * self.beam.length
            turned = along.cosine * np.cos(tip)[:, None] + along.sine * np.sin(tip)[:, None]
            yield physics.external_tone_amplitude * np.sin(phase) * self.basis.weights * turned

    def _drag(self, along: Fields, linear: float, quadratic: float) -> Array:
        """The air's resistance to the normal velocity."""
        integrals, cosine, sine = self.basis.cumulative, along.cosine, along.sine
        normal = cosine * ((cosine * along.rate) @ integrals.T) + sine * ((sine * along.rate) @ integrals.T)
        pushed = -self.basis.weights * (linear + quadratic * np.abs(normal)) * normal
        return np.asarray(cosine * ((pushed * cosine) @ integrals) + sine * ((pushed * sine) @ integrals))

    def _moment(self, state: Array, time: float) -> Array | None:
        """Bending moment beyond the linear one at each node, N m, (B, N); None where there is none."""
        physics, share = self.physics, self.physics.hysteresis_ratio
        cubic, drift = physics.cubic_stiffness_coefficient, physics.stiffness_drift_rate * time
        lopsided = physics.stiffness_asymmetry_ratio
        if not (share or cubic or lopsided or physics.stiffness_drift_rate):
            return None
        bend = state[:, self.parts.coordinates] @ self.curvature.T
        extra = cubic * bend**3 + lopsided * np.abs(bend)
        if share:
            extra += share * (state[:, self.parts.slip] - bend)
        if drift:
            speed = state[:, self.parts.rates] @ self.curvature.T
            extra += drift * (bend + extra + self.beam.kelvin_voigt_time * speed)
        return np.asarray(self.section * extra)

    def _add_joint(self, force: Array, coordinates: Array, rates: Array, torque: Array) -> None:
        """Torque, spring, viscous friction and cogging at the joint, and the play behind it."""
        physics = self.physics
        force[:, 0] += torque - physics.joint_spring_stiffness * coordinates[:, 0]
        force[:, 0] -= physics.viscous_friction_coefficient * rates[:, 0]
        if physics.cogging_amplitude:
            turn = physics.cogging_count * coordinates[:, 0] + physics.cogging_phase
            force[:, 0] += physics.cogging_amplitude * np.sin(turn)
        if self.motor and physics.backlash_gap > 0.0:
            twist, twist_rate = coordinates[:, 0] - coordinates[:, 1], rates[:, 0] - rates[:, 1]
            passed = transmission_torque(physics, self.beam.hub_inertia, twist, twist_rate)
            force[:, 0] -= passed
            force[:, 1] += passed

    def slip_rates(self, state: Array) -> Array:
        """Rates of the Bouc-Wen curvatures, 1/(m s), (B, N)."""
        speed = state[:, self.parts.rates] @ self.curvature.T
        yields = self.physics.hysteresis_yield_angle / self.beam.length
        return slip_rate(speed, state[:, self.parts.slip], yields)


def _rows(matrices: Array, vectors: Array) -> Array:
    """Each symmetric matrix (B, n, n) times its vector (B, n)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def times(matrices: Array, rows: Array) -> Array:
    """Rows (B, d) times the matrix, or each times its own; matrices (1 or B, d, e)."""
    if len(matrices) == 1:
        return np.asarray(rows @ matrices[0])
    return np.asarray((rows[:, None, :] @ matrices)[:, 0])
