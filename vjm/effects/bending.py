"""How a link's bending differs from a linear spring and damper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect, LinkEffect, Motion, changed_link, magnitude, shape_parameter
from vjm.model.modes import linearise, modes_of
from vjm.records import Array, Recording, Rig

# Modes above are damped no faster than one here [rad/s]: no camera shows them, and steps need not follow them.
_FASTEST = 1000.0
_LIGHT = 0.03  # loss factor up to which an explicit step is stable however long
_STEP_FOR_HEAVY = 1.5 / _FASTEST  # s


@dataclass(frozen=True)
class StructuralDamping(LinkEffect):
    """A rate-independent loss in bending: every mode gets the same damping ratio, half the loss factor.

    With several links, a mode gets each link's loss by the share of its strain energy there.

    Attributes:
        loss_factor: energy lost in a radian over the strain energy.
    """

    loss_factor: float = magnitude("", 0.01, lower=0.0, upper=0.3)

    id = "structural_damping"
    description = "structural damping: a loss in bending that does not depend on the rate"
    clause = "structural damping in {link}, with a loss factor of {loss_factor}"
    reference = "S. H. Crandall, The role of damping in vibration theory, Journal of Sound and Vibration 11(1), 1970"
    distinguishing_experiment = "two or more modes in free decay"
    abscissa = "amplitude"
    dissipative = True

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Proportional to the rates."""
        if self.is_null:
            return None
        matrix = self.matrix(chain, payload)

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            result: Array = -v @ matrix
            return result

        return force

    def matrix(self, chain: Chain, payload: float) -> Array:
        """(nv, nv) C = M Phi diag(loss_factor omega) Phi^T M of the chain's modes at rest [N m s/rad]."""
        M, D, K, rest = linearise(chain, payload, (0.0, 0.0))
        found = modes_of(M, D, K, rest)
        pulsations, part = 2 * np.pi * found.frequencies, chain.passive_slices[self.index]
        energies = np.diag(K)[:, None] * found.shapes**2
        shares = energies[part].sum(axis=0) / energies.sum(axis=0)
        carried = M @ found.shapes
        result: Array = (carried * (self.loss_factor * shares * np.minimum(pulsations, _FASTEST))) @ carried.T
        return (result + result.T) / 2

    @property
    def max_step(self) -> float:
        """At which the damping of fast modes is stable."""
        return np.inf if self.loss_factor <= _LIGHT else _STEP_FOR_HEAVY


@dataclass(frozen=True)
class CubicStiffness(LinkEffect):
    """The bending moment is EI kappa (1 + coefficient kappa^2).

    Attributes:
        coefficient: positive: hardening, negative: softening [m^2].
    """

    coefficient: float = magnitude("m^2", 0.05)

    id = "cubic_stiffness"
    description = "a bending stiffness that changes with the curvature"
    clause = "a bending stiffness of {link} that changes with the curvature, by {coefficient}"
    reference = "A. H. Nayfeh and P. F. Pai, Linear and Nonlinear Structural Mechanics, Wiley, 2004"
    distinguishing_experiment = "recordings at two amplitudes"
    abscissa = "amplitude"

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Proportional to the angles' cubes."""
        if self.is_null:
            return None
        link, part = chain.links[self.index], chain.passive_slices[self.index]
        factor = -self.coefficient * link.stiffness / link.cells**2

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            phi, found = q[..., part], np.zeros(q.shape)
            found[..., part] = factor * phi * phi * phi
            return found

        return force


@dataclass(frozen=True)
class StiffnessDrift(LinkEffect):
    """The bending stiffness is (1 + rate t) times what it is at the start of each recording.

    Attributes:
        rate: [1/s].
    """

    rate: float = magnitude("1/s", 0.002)

    id = "stiffness_drift"
    description = "a bending stiffness that drifts during each recording"
    clause = "a bending stiffness of {link} that drifts by {rate} during each recording"
    reference = (
        "H. Sohn, Effects of environmental and operational variability on structural health monitoring, Philosophical "
        "Transactions of the Royal Society A 365, 2007"
    )
    distinguishing_experiment = "recordings at two amplitudes, or one that starts again when the link has warmed up"

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Proportional to time and angles."""
        if self.is_null:
            return None
        part = chain.passive_slices[self.index]
        factor = -self.rate * chain.links[self.index].stiffness

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            found = np.zeros(q.shape)
            found[..., part] = np.asarray(time)[..., None] * q[..., part] * factor
            return found

        return force


@dataclass(frozen=True)
class RestCurvature(LinkEffect):
    """The unloaded link is an arc.

    Attributes:
        curvature: [1/m].
    """

    curvature: float = magnitude("1/m", 0.02)

    id = "rest_curvature"
    description = "a link that is bent at rest"
    clause = "a curvature of {curvature} of {link} at rest"
    reference = "S. P. Timoshenko and J. M. Gere, Theory of Elastic Stability, 2nd edition, McGraw-Hill, 1961"
    distinguishing_experiment = "a fixed fiducial beside the base in the camera's view"
    abscissa = "marker"

    def chain(self, chain: Chain) -> Chain:
        """With an arc for the link."""
        if self.is_null:
            return chain
        curvature = chain.links[self.index].rest_curvature + self.curvature
        return changed_link(chain, self.index, rest_curvature=curvature)


@dataclass(frozen=True)
class UnmodelledMode(Effect):
    """The chain has too few virtual joints for what the recordings show: a reason to refit, no physics."""

    id = "unmodelled_mode"
    description = "a bending mode for which the model has too few virtual joints"
    reference = "M. J. Balas, Feedback control of flexible systems, IEEE Transactions on Automatic Control 23(4), 1978"
    distinguishing_experiment = "the same fit with two virtual joints more"

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Return why it is not looked for."""
        return "the error of so few virtual joints is measured and corrected; it is not a cause"


_CREEP_STEPS = 1.5  # longest step, in time constants; an explicit one of fourth order is stable up to 2.8
_SLIP_RATE = 5.0  # rad/s of a whole link's bending, which is fast; the slip follows it over one yield angle
_SLIP_STEPS = 1.5
_SLOW = 1e-4  # rad/s of one joint; the sign of a smaller rate is rounded off


@dataclass(frozen=True)
class MemoryEffect(LinkEffect):
    """A spring beside each of the link's own, whose angle z is an internal state.

    Attributes:
        ratio: its stiffness over that of the link's own spring.
    """

    ratio: float = magnitude("", 0.03, lower=0.0, upper=1.0)

    def state_count(self, chain: Chain) -> int:
        """One for each virtual joint of the link."""
        return 0 if self.is_null else chain.links[self.index].virtual_joints


@dataclass(frozen=True)
class ViscoelasticCreep(MemoryEffect):
    """Standard linear solid: beside each spring K another, ratio K, in series with a damper.

    Attributes:
        time_constant: of the series [s].
    """

    time_constant: float = shape_parameter("s", 0.1, lower=1e-3, upper=1e3, grid=(0.01, 0.032, 0.1, 0.32, 1.0))

    id = "viscoelastic_creep"
    description = "creep: a part of the bending stiffness that relaxes"
    clause = "creep in {link}: a part {ratio} of its bending stiffness relaxes within {time_constant}"
    reference = "C. Zener, Elasticity and Anelasticity of Metals, University of Chicago Press, 1948"
    distinguishing_experiment = "two or more modes in free decay, and a static bend that is held"
    abscissa = "amplitude"

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Of the relaxing springs."""
        if self.is_null:
            return None
        part, factor = chain.passive_slices[self.index], -self.ratio * chain.links[self.index].stiffness

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            found = np.zeros(v.shape)
            found[..., part] = factor * z
            return found

        return force

    def state_rates(self, chain: Chain) -> Motion | None:
        """The springs follow phi and relax: z' = phi' - z / time_constant."""
        if self.is_null:
            return None
        part, slow = chain.passive_slices[self.index], 1 / self.time_constant
        return lambda time, q, v, z: v[..., part] - slow * z

    @property
    def max_step(self) -> float:
        """At which the relaxation is stable."""
        return np.inf if self.is_null else _CREEP_STEPS * self.time_constant


@dataclass(frozen=True)
class Hysteresis(MemoryEffect):
    """Bouc-Wen: a part of each spring slips above a yield angle, moment K ((1 - ratio) phi + ratio z).

    Attributes:
        ratio: the part of the stiffness that slips.
        yield_angle: of the bending of the whole link, of which each joint has a part [rad].
    """

    ratio: float = magnitude("", 0.05, lower=0.0, upper=1.0)
    yield_angle: float = shape_parameter("rad", 0.05, lower=1e-3, upper=3.0, grid=(0.01, 0.031, 0.097, 0.3))

    id = "hysteresis"
    description = "hysteresis: stiffness that is lost where the link bends farther than it slips"
    clause = "hysteresis in {link}: a part {ratio} of its bending stiffness slips beyond {yield_angle}"
    reference = (
        "Y.-K. Wen, Method for random vibration of hysteretic systems, Journal of the Engineering Mechanics Division, "
        "ASCE 102(2), 1976"
    )
    distinguishing_experiment = "recordings at two amplitudes, and a slow one"
    abscissa = "amplitude"

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """On top of the springs' own -K phi."""
        if self.is_null:
            return None
        part, factor = chain.passive_slices[self.index], self.ratio * chain.links[self.index].stiffness

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            found = np.zeros(q.shape)
            found[..., part] = factor * (q[..., part] - z)
            return found

        return force

    def state_rates(self, chain: Chain) -> Motion | None:
        """Slipping: z' = phi' (1 - |z| / y (1 + sign(phi' z)) / 2), with |z| sign(phi' z) = z sign(phi')."""
        if self.is_null:
            return None
        part, scale = chain.passive_slices[self.index], 0.5 / self.yields(chain)

        def rates(time: Array, q: Array, v: Array, z: Array) -> Array:
            rate = v[..., part]
            return rate * (1 - scale * (np.abs(z) + z * np.tanh(rate / _SLOW)))

        return rates

    def initial_states(self, chain: Chain, q: Array) -> Array:
        """The joints' angles, as far as they do not slip."""
        if self.is_null:
            return super().initial_states(chain, q)
        yields = self.yields(chain)
        result: Array = yields * np.tanh(q[..., chain.passive_slices[self.index]] / yields)
        return result

    def yields(self, chain: Chain) -> Array:
        """(n,) each joint's part of the yield angle [rad]."""
        link = chain.links[self.index]
        result: Array = self.yield_angle * link.cells / link.length
        return result

    @property
    def max_step(self) -> float:
        """At which slipping is stable in fast motion."""
        return np.inf if self.is_null else _SLIP_STEPS * self.yield_angle / _SLIP_RATE
