"""Effects on bending, beyond a linear spring and damper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vjm.chain.virtual_links import Chain, LinkChain
from vjm.effects.effect import Effect, LinkEffect, StateFunction, magnitude, shape_parameter
from vjm.model.modes import linearise, modes_of
from vjm.records import NO_PAYLOAD, Array, Payload, Recording, Rig

# Modes above are damped no faster than one of this angular frequency, in the link's own units 1 / T (a cantilever's
# seventh has 417, its eighth 555): no camera shows them, and steps need not follow them.
_FASTEST = 500.0
# Time constants of relaxation, in the link's own unit T: from 16 periods of a cantilever, longer ones being followed as
# this one, to the time in which its third mode turns by 0.8 rad. With three in two decades the loss is the same at all
# frequencies to 2 / cosh(pi^2 / spacing) = 0.65 %.
_SPACING = np.log(10.0) / 1.5
_RELAXATION_TIMES: Array = 28.0 * np.exp(-_SPACING * np.arange(6))
# Bending shapes that relax; those beyond have less than 1e-3 of a static deflection, as (3.5 / 120)^2 says.
_RELAXING_SHAPES = 3


class _Loss(NamedTuple):
    """Moments of a link's n virtual joints, in proportion to angles and rates, and of m shapes with r elements each."""

    stiffness: Array  # (n, n) [N m/rad]
    damping: Array  # (n, n) [N m s/rad]
    moments: Array  # (n, r m) by the elements' states [N m/rad]
    shapes: Array  # (n, r m) rates of the states by those of the joints
    rates: Array  # (r m,) at which states relax [1/s]


@dataclass(frozen=True)
class StructuralDamping(LinkEffect):
    """A loss in bending that does not depend on the rate: every mode gets the same damping ratio, half the loss factor.

    The loss factor eta is the energy lost in a radian over the strain energy. A material that loses the same at all
    frequencies is stiffer at higher ones, by 2 eta / pi of its stiffness for every factor e, and remembers its bends:
    it is a row of Maxwell elements whose time constants are evenly spaced on a logarithmic scale. The dispersion is the
    share of the loss that comes about so; the rest is a damper for each mode, as simulators have it. The longest time
    constant is that at which the elements end. The link's bending stiffness is that at the arm's first natural
    frequency without a known payload.

    With several links, a mode gets each link's loss by the share of its strain energy there.
    """

    loss_factor: float = magnitude("", 0.01, lower=0.0, upper=0.3)
    dispersion: float = shape_parameter("", 1.0, upper=1.0, power=1, grid=(1.0,))
    # Up to a decade beyond the slowest element, which stands for all longer ones.
    longest_time_constant: float = shape_parameter(
        "s", 60.0, lower=1.0, upper=10.0 * float(_RELAXATION_TIMES[0]), in_rig_units=True
    )

    description = "structural damping: rate-independent bending loss"
    clause = "structural damping in '{link}', loss factor {loss_factor}"
    assumptions = (
        "the same loss factor at all frequencies, along the link, at any bend; modes of joints with play in contact; "
        "full relaxation where a recording begins, in at most about 16 periods of the clamped link"
    )
    reference = (
        "H.-P. Liu, D. L. Anderson and H. Kanamori, Velocity dispersion due to anelasticity, Geophys. J. Royal "
        "Astronomical Society 47(1), 1976; S. H. Crandall, The role of damping in vibration theory, J. Sound and "
        "Vibration 11(1), 1970"
    )
    distinguishing_experiment = "two or more modes in free decay"
    abscissa = "amplitude"

    def initial_states(self, chain: Chain, q: Array) -> Array:
        """Return the relaxing elements' deflections, in each shape: none."""
        return np.zeros((*q.shape[:-1], _RELAXATION_TIMES.size * min(self.link_of(chain).cells.size, _RELAXING_SHAPES)))

    def force(self, chain: Chain, payload: Payload) -> StateFunction | None:
        """Return the moments of the modes' dampers and of the relaxing elements."""
        part, loss, damping = self.virtual_joints(chain), self.relaxation(chain), self.modal_damping(chain, payload)
        damping = (1 - self.dispersion) * damping
        damping[part, part] += loss.damping

        def moments(time: Array, q: Array, v: Array, z: Array) -> Array:
            total = -(v @ damping)
            total[..., part] -= q[..., part] @ loss.stiffness + z @ loss.moments.T
            return total

        return moments

    def state_rates(self, chain: Chain) -> StateFunction | None:
        """Return how the elements follow the shapes and relax: z' = a' - z / tau."""
        part, loss = self.virtual_joints(chain), self.relaxation(chain)
        return lambda time, q, v, z: v[..., part] @ loss.shapes - loss.rates * z

    def modal_damping(self, chain: Chain, payload: Payload) -> Array:
        """Return (nv, nv) C = M Phi diag(loss_factor omega) Phi^T M of the chain's modes at rest [N m s/rad]."""
        M, D, K, _ = linearise(chain, payload, (0.0, 0.0))
        modes = modes_of(M, D, K)
        energies = np.diag(K)[:, None] * modes.shapes**2
        shares = energies[self.virtual_joints(chain)].sum(axis=0) / energies.sum(axis=0)
        momenta, fastest = M @ modes.shapes, _FASTEST / self.units(chain)[2]
        rates = self.loss_factor * shares * np.minimum(2 * np.pi * modes.frequencies, fastest)
        result: Array = (momenta * rates) @ momenta.T
        return (result + result.T) / 2

    def relaxation(self, chain: Chain) -> _Loss:
        """Return the part of the loss that relaxes, in the shapes in which the clamped link swings.

        Elements that relax faster than the fastest of those followed are dampers. Shapes beyond the relaxing ones have
        a damper, and the stiffness, of the frequency at which they swing.
        """
        M, D, K, _ = linearise(chain, NO_PAYLOAD, (0.0, 0.0))
        first = 2 * np.pi * modes_of(M, D, K).frequencies[0]
        part = self.virtual_joints(chain)
        springs, times = K[part, part], _RELAXATION_TIMES * self.units(chain)[2]
        modes = modes_of(M[part, part], D[part, part], springs)
        omega = 2 * np.pi * modes.frequencies
        loss = self.loss_factor * self.dispersion
        ratio, relaxing = 2 / np.pi * loss * _SPACING, np.arange(omega.size) < _RELAXING_SHAPES
        omega_shown = np.minimum(omega, _FASTEST / self.units(chain)[2])
        # Two elements share the time constants between theirs, linearly in the logarithm; the slowest has all longer
        # ones. What an element gets up to the longest is the integral of that, which has no kink.
        beyond = np.log(self.longest_time_constant / times) / _SPACING
        rising, falling = 0.5 * (1 + np.clip(beyond, -1.0, 0.0)) ** 2, 0.5 * (1 - np.clip(beyond, 0.0, 1.0)) ** 2
        shares = rising + 0.5 - falling
        shares[0] = rising[0] + max(beyond[0], 0.0)
        phases = (first * times) ** 2
        added = -ratio * np.sum(shares * phases / (1 + phases))
        stiffness = np.where(relaxing, added, 2 / np.pi * loss * np.log(omega_shown / first))
        damping = np.where(relaxing, ratio * times[-1] / np.expm1(_SPACING), loss / omega_shown)
        moments = springs @ modes.shapes / omega  # K psi, with psi^T K psi = 1
        scale = np.sqrt(np.trace(springs) / len(springs))  # makes states angles [rad]
        slow = moments[:, relaxing]
        return _Loss(
            (moments * stiffness) @ moments.T,
            (moments * damping) @ moments.T,
            np.kron(ratio * scale * shares, slow),
            np.tile(slow / scale, times.size),
            np.repeat(1 / times, slow.shape[1]),
        )

    def max_step(self, chain: Chain) -> float:
        """Return the time step [s] that keeps the tip within a millionth of the arm's length.

        An explicit one of fourth order is stable up to 2.8 time constants.
        """
        fastest = 1 / max(self.loss_factor * _FASTEST, 1e-300)  # time constant of the fastest shape by its damper
        return min(1.5 * float(_RELAXATION_TIMES[-1]), fastest) * self.units(chain)[2]


@dataclass(frozen=True)
class CubicStiffness(LinkEffect):
    """A bending moment EI kappa (1 + coefficient kappa^2); a positive coefficient hardens, a negative one softens."""

    coefficient: float = magnitude("m^2", 0.05, in_rig_units=True)

    description = "cubic stiffness: bending stiffness that changes with curvature"
    clause = "the bending stiffness of '{link}' changes with curvature, coefficient {coefficient}"
    assumptions = "a moment odd in the curvature; one coefficient along the link; linear loss"
    reference = "A. H. Nayfeh and P. F. Pai, Linear and Nonlinear Structural Mechanics, Wiley, 2004"
    distinguishing_experiment = "recordings at two amplitudes"
    abscissa = "amplitude"

    def force(self, chain: Chain, payload: Payload) -> StateFunction | None:
        """Return moments proportional to the angles' cubes."""
        link, part = self.link_of(chain), self.virtual_joints(chain)
        factor = -self.coefficient * link.stiffness / link.cells**2
        return self.force_on(part, lambda time, q, v, z: factor * q[..., part] * q[..., part] * q[..., part])


@dataclass(frozen=True)
class StiffnessDrift(LinkEffect):
    """A bending stiffness (1 + rate t) times that at the start of each recording."""

    rate: float = magnitude("1/s", 0.001, in_rig_units=True)

    description = "bending stiffness that drifts during each recording"
    clause = "the bending stiffness of '{link}' drifts by {rate} during each recording"
    assumptions = "a drift linear in time, the same in every recording and along the link; constant loss"
    reference = "H. Sohn, Effects of environmental and operational variability, Phil. Trans. Royal Society A 365, 2007"
    distinguishing_experiment = "recordings at two amplitudes, or a restart after the link has warmed up"

    def force(self, chain: Chain, payload: Payload) -> StateFunction | None:
        """Return moments proportional to time and angles."""
        part, factor = self.virtual_joints(chain), -self.rate * self.link_of(chain).stiffness
        return self.force_on(part, lambda time, q, v, z: np.asarray(time)[..., None] * q[..., part] * factor)


@dataclass(frozen=True)
class RestCurvature(LinkEffect):
    """An unloaded link that is an arc."""

    curvature: float = magnitude("1/m", 0.02, in_rig_units=True)

    description = "rest curvature: a link that is bent when unloaded"
    clause = "link '{link}' is curved at rest, {curvature}"
    assumptions = "an arc of constant curvature; the same shape in every recording"
    reference = "S. P. Timoshenko and J. M. Gere, Theory of Elastic Stability, 2nd edition, McGraw-Hill, 1961"
    distinguishing_experiment = "a fixed fiducial beside the base in the camera's view"
    abscissa = "marker"
    in_simulators = True

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with an arc for the link."""
        return self.with_link(chain, rest_curvature=self.link_of(chain).rest_curvature + self.curvature)


@dataclass(frozen=True)
class Taper(LinkEffect):
    """A link whose thickness is 1 + taper (1/2 - s/l) times the mean at the arc length s.

    Mass per length is in proportion to the thickness, bending stiffness to its cube; both are given for a link of mean
    thickness, so that the mass stays. A virtual joint has the stiffness of the section where it is, since its angle
    stands for the curvature there, as the curve to the markers takes it to: that is fourth-order accurate in the number
    of joints, a compliance integrated over the joint's cell of second order only.
    """

    taper: float = magnitude("", 0.05, lower=-1.0, upper=1.0)

    description = "taper: thickness that changes along the link"
    clause = "link '{link}' is tapered: thickness falls by {taper} of its mean from root to tip"
    assumptions = "thickness linear in the arc length; constant width and material"
    reference = (
        "H. H. Mabie and C. B. Rogers, Transverse vibrations of tapered cantilever beams with end loads, "
        "J. Acoustical Society of America 36(3), 1964"
    )
    distinguishing_experiment = "three or more modes; or measure the thickness at both ends"
    abscissa = "frequency"
    in_urdf = True

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with other masses, inertias, springs and dampers of the link."""
        if self.is_null:
            return chain
        link = self.link_of(chain)
        rods = np.cumsum(link.lengths) - link.lengths + link.mass_centers
        cubes, slope = self._thickness(link, link.joint_arcs) ** 3, -self.taper / link.length
        # Integrals of a rod's mass, which is symmetric about its centre, times a linear function.
        masses, thickness = link.masses * self._thickness(link, rods), self._thickness(link, rods)
        shifts = slope * link.inertias / np.maximum(masses, 1e-300)
        return self.with_link(
            chain,
            masses=masses,
            mass_centers=link.mass_centers + shifts,
            inertias=link.inertias * thickness - masses * shifts**2,
            stiffness=link.stiffness * cubes,
            damping=link.damping * cubes,
        )

    def _thickness(self, link: LinkChain, arcs: Array) -> Array:
        """Return the thickness at arc lengths [m] over the mean."""
        return 1 + self.taper * (0.5 - arcs / link.length)


@dataclass(frozen=True)
class StiffnessAsymmetry(LinkEffect):
    """A bending moment EI kappa (1 + ratio sign(kappa)), as of a section with a crack that closes when bent one way.

    A link with a positive ratio is stiffer when it is bent to the left, its tip towards +y of its own frame; bends are
    from the unloaded shape, at which the moment is continuous.
    """

    ratio: float = magnitude("", 0.03, lower=-0.9, upper=0.9)

    description = "bilinear stiffness: a link that is stiffer bent one way than the other"
    clause = "link '{link}' is stiffer by {ratio} bent to the left, softer by as much to the right"
    assumptions = "a kink at the unloaded shape, the same along the link; the same loss both ways"
    reference = "T. G. Chondros et al., Vibration of a beam with a breathing crack, J. Sound Vibration 239(1), 2001"
    distinguishing_experiment = "static deflections to both sides, or decays released from either side"
    abscissa = "position"

    def force(self, chain: Chain, payload: Payload) -> StateFunction | None:
        """Return moments proportional to the angles' sizes."""
        part, factor = self.virtual_joints(chain), -self.ratio * self.link_of(chain).stiffness
        return self.force_on(part, lambda time, q, v, z: factor * np.abs(q[..., part]))


@dataclass(frozen=True)
class UnmodelledMode(Effect):
    """Too few virtual joints for what the recordings show: a reason to refit, no physics."""

    description = "a bending mode beyond those of the virtual joints"
    assumptions = "none"
    reference = "M. J. Balas, Feedback control of flexible systems, IEEE Transactions on Automatic Control 23(4), 1978"
    distinguishing_experiment = "the same fit with two more virtual joints"

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Return why it is not looked for."""
        return "the discretization error is measured and corrected; it is not a cause"


@dataclass(frozen=True)
class ViscoelasticCreep(LinkEffect):
    """Standard linear solid: beside each spring K another, ratio K, in series with a damper.

    The deflections of these springs are internal states.
    """

    ratio: float = magnitude("", 0.03, lower=0.0, upper=1.0)
    time_constant: float = shape_parameter(
        "s", 0.2, 2e-3, upper=2e3, grid=(0.02, 0.064, 0.2, 0.64, 2.0), in_rig_units=True
    )

    description = "viscoelastic creep: part of the bending stiffness relaxes"
    clause = "link '{link}' creeps: a fraction {ratio} of its bending stiffness relaxes, time constant {time_constant}"
    assumptions = "a single relaxation time, the same along the link; full relaxation where a recording begins"
    reference = "C. Zener, Elasticity and Anelasticity of Metals, University of Chicago Press, 1948"
    distinguishing_experiment = "two or more modes in free decay, and a held static deflection"
    abscissa = "amplitude"

    def initial_states(self, chain: Chain, q: Array) -> Array:
        """Return the angles of the relaxing springs, one at each virtual joint: none."""
        return np.zeros_like(q[..., self.virtual_joints(chain)])

    def force(self, chain: Chain, payload: Payload) -> StateFunction | None:
        """Return the moments of the relaxing springs."""
        factor = -self.ratio * self.link_of(chain).stiffness
        return self.force_on(self.virtual_joints(chain), lambda time, q, v, z: factor * z)

    def state_rates(self, chain: Chain) -> StateFunction | None:
        """Return how the springs follow phi and relax: z' = phi' - z / time_constant."""
        part, relaxation = self.virtual_joints(chain), 1 / self.time_constant
        return lambda time, q, v, z: v[..., part] - relaxation * z

    def max_step(self, chain: Chain) -> float:
        """Return the time step [s] that is stable; an explicit one of fourth order is up to 2.8 time constants."""
        return 1.5 * self.time_constant


@dataclass(frozen=True)
class Hysteresis(LinkEffect):
    """Bouc-Wen: a part of each spring slips above a yield angle, moment K ((1 - ratio) phi + ratio z), z being a state.

    The yield angle is of the bending of the whole link, of which each joint has a part.
    """

    ratio: float = magnitude("", 0.05, lower=0.0, upper=1.0)
    yield_angle: float = shape_parameter("rad", 0.05, lower=1e-3, upper=3.0, grid=(0.01, 0.031, 0.097, 0.3))

    description = "hysteresis: part of the bending stiffness yields beyond an angle"
    clause = "hysteresis in '{link}': a fraction {ratio} of its bending stiffness yields beyond {yield_angle}"
    assumptions = (
        "slip spread evenly along the link; Bouc and Wen's loop with exponent 1; no reversal before a recording begins"
    )
    reference = "Y.-K. Wen, Method for random vibration of hysteretic systems, J. Eng. Mechanics ASCE 102(2), 1976"
    distinguishing_experiment = "recordings at two amplitudes, and a slow motion"
    abscissa = "amplitude"

    def initial_states(self, chain: Chain, q: Array) -> Array:
        """Return z = y (1 - exp(-|phi| / y)) sign(phi): the joints were bent from zero to their angles phi, never back.

        This virgin loading curve is the solution of the equation of `state_rates` from phi = z = 0 on.
        """
        yields, phi = self.yields(chain), q[..., self.virtual_joints(chain)]
        return np.copysign(yields * np.expm1(-np.abs(phi) / yields), phi)

    def force(self, chain: Chain, payload: Payload) -> StateFunction | None:
        """Return the moments beside the springs' own -K phi."""
        part, factor = self.virtual_joints(chain), self.ratio * self.link_of(chain).stiffness
        return self.force_on(part, lambda time, q, v, z: factor * (q[..., part] - z))

    def state_rates(self, chain: Chain) -> StateFunction | None:
        """Return how the springs slip: z' = phi' (1 - |z| / y (1 + sign(phi' z)) / 2)."""
        part, scale = self.virtual_joints(chain), 0.5 / self.yields(chain)
        slow = 5e-5 / self.units(chain)[2]  # rad/s; the sign of a slower rate is rounded off
        # Faster than a step resolves, as joints are for an instant after an unlikely initial state: explicit steps of
        # fourth order are stable up to 2.78 time constants y / |phi'|.
        fast = 2.7 * self.yields(chain) / self.max_step(chain)

        def rates(time: Array, q: Array, v: Array, z: Array) -> Array:
            rate = np.minimum(np.maximum(v[..., part], -fast), fast)  # a fifth of the time of `np.clip`
            # |z| sign(phi' z) = z sign(phi')
            return np.asarray(rate * (1 - scale * (np.abs(z) + z * np.tanh(rate / slow))))

        return rates

    def yields(self, chain: Chain) -> Array:
        """Return (n,) each joint's part of the yield angle [rad]."""
        link = self.link_of(chain)
        return self.yield_angle * link.cells / link.length

    def max_step(self, chain: Chain) -> float:
        """Return the time step [s] that is stable in fast motion: 1.5 times that of a bend by one yield angle."""
        fast = 2.4  # rad / T, the link's own unit: the rate of a bend by 0.7 rad in the first mode (3.5 rad / T)
        return 1.5 * self.yield_angle / fast * self.units(chain)[2]
