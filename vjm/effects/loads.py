"""Loads: bodies and a force on the tip, gravity, and air drag, with the planar kinematics of rigid rods.

Rod b has heading psi_b and turns at w_b. With e_b = exp(i psi_b), the component of a point's velocity along the normal
i e_b at distance x from the rod's proximal end is Re(conj(e_b) sum_{a<b} l_a w_a e_a) + x w_b.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from scipy.interpolate import BarycentricInterpolator

from vjm.chain.virtual_links import Chain, LinkChain
from vjm.effects.effect import Effect, LinkEffect, StateFunction, WaveEffect, magnitude, shape_parameter
from vjm.records import NO_PAYLOAD, Array, Complex, Payload, Recording, Rig


@dataclass(frozen=True)
class _TipEffect(LinkEffect):
    """Acts at the distal end of the last link."""

    @property
    def link_index(self) -> int:
        return -1

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        return (len(rig.links) - 1,)

    def with_payload(self, chain: Chain, body: Payload) -> Chain:
        """Return the chain with another payload."""
        mass, offset, inertia = body
        return self.with_link(chain, payload=mass, payload_offset=offset, payload_inertia=inertia)


@dataclass(frozen=True)
class TipPayload(_TipEffect):
    """A mass on the last link, its radius of gyration, and how far beyond the distal end its centre is."""

    mass: float = magnitude("kg", 0.02, lower=0.0, in_rig_units=True)
    # Typical: of a body a sixth as long as the link. At most that of a rod as long as the link, held by its middle.
    radius_of_gyration: float = shape_parameter("m", 0.05, upper=12**-0.5, power=2, in_rig_units=True)
    # Of such a body where the link ends in its middle; at most that of a rod as long as the link where it ends.
    offset: float = shape_parameter("m", 0.05, lower=-0.5, upper=0.5, power=1, in_rig_units=True)

    description = "unknown mass on the tip"
    clause = (
        "unknown mass of {mass}[, radius of gyration {radius_of_gyration},] on the tip of '{link}'"
        "[, its centre {offset} beyond it]"
    )
    assumptions = "a centre of mass on the last link's centre line or its extension; rigidly fastened"
    reference = "L. Meirovitch, Fundamentals of Vibrations, McGraw-Hill, 2001"
    distinguishing_experiment = "a recording with a known tip mass, static sag, or driven recordings"
    common = True
    in_urdf = True

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with a larger payload."""
        added = Payload(self.mass, self.offset, self.mass * self.radius_of_gyration**2)
        return self.with_payload(chain, self.link_of(chain).payload_body.with_another(added))


@dataclass(frozen=True)
class PayloadBody(_TipEffect):
    """A payload of known mass that is no point at the distal end, where it was taken for one.

    Attributes:
        carried: what the rig has there in every recording.
    """

    # Typical, and the bounds: as of an unknown mass.
    offset: float = magnitude("m", 0.05, lower=-0.5, upper=0.5, in_rig_units=True)
    radius_of_gyration: float = magnitude("m", 0.05, lower=0.0, upper=12**-0.5, power=2, in_rig_units=True)
    carried: Payload = field(default=NO_PAYLOAD, kw_only=True)

    description = "known payload that is no point at the tip"
    clause = (
        "the known payload on '{link}' is no point at its tip:[ radius of gyration {radius_of_gyration},]"
        " centre {offset} beyond it"
    )
    assumptions = "one radius of gyration and one centre of all known payloads, on the centre line; rigidly fastened"
    reference = "C. G. Atkeson, C. H. An and J. M. Hollerbach, Int. J. Robotics Research 5(3), 1986"
    distinguishing_experiment = "the same drive without the payload; two payloads of different size"
    in_urdf = True

    def placed(self, rig: Rig, link: int | None) -> Self:
        """Return the effect on the last link of a rig, with what the rig has there."""
        return replace(super().placed(rig, link), carried=rig.links[-1].payload_body)

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Return the reason if there is no known payload."""
        known = rig.links[-1].payload or any(recording.payload for recording in recordings)
        return "" if known else "no payload is known to be on the tip"

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with the rig's payload as it is; another mass there stays."""
        if not self.carried.mass or self.is_null:
            return chain
        mass, offset, inertia = self.carried
        others = self.link_of(chain).payload_body.with_another(Payload(-mass, offset, -inertia))
        return self.with_payload(chain, others.with_another(self._true(self.carried)))

    def true_inputs(self, recording: Recording) -> Recording:
        """Return the recording with its payload as it is."""
        if not recording.payload:
            return recording
        true = self._true(recording.payload_body)
        return replace(recording, payload_offset=true.offset, payload_inertia=true.inertia)

    def _true(self, known: Payload) -> Payload:
        return known._replace(
            offset=known.offset + self.offset, inertia=known.inertia + known.mass * self.radius_of_gyration**2
        )


@dataclass(frozen=True)
class MarkerMass(LinkEffect):
    """Markers that weigh something: equal point masses at all of a link's markers.

    Attributes:
        arcs: where the markers are on the link [m].
    """

    # Typical: a hundredth of the link's mass; at most a tenth. Where nothing but frequencies is known, as of a clamped
    # link, larger masses are the same with a larger stiffness.
    mass: float = magnitude("kg", 0.01, lower=0.0, upper=0.1, in_rig_units=True)
    arcs: tuple[float, ...] = field(default=(), kw_only=True)

    description = "markers that weigh something"
    clause = "each marker of '{link}' weighs {mass}"
    assumptions = "equal masses of all of a link's markers, points on its centre line"
    reference = "L. Meirovitch, Fundamentals of Vibrations, McGraw-Hill, 2001"
    distinguishing_experiment = "weigh a marker, or a decay of a clamped link with all of its markers but one taken off"
    in_urdf = True

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Return the links with markers."""
        return tuple(i for i, link in enumerate(rig.links) if link.markers)

    def placed(self, rig: Rig, link: int | None) -> Self:
        """Return the effect on a link of a rig, with the link's markers."""
        return replace(super().placed(rig, link), arcs=rig.links[link or 0].markers)

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with heavier virtual links."""
        if self.is_null:
            return chain
        link = self.link_of(chain)
        points = [_equivalent_points(link, arc) for arc in self.arcs]
        masses, centers, inertias = self._loaded(link, *np.concatenate([np.zeros((2, 0)), *points], axis=1))
        if min(masses.min(), centers.min(), inertias.min()) < 0:  # too heavy for shares of which some are negative
            masses, centers, inertias = self._loaded(link, np.array(self.arcs), np.ones(len(self.arcs)))
        return self.with_link(chain, masses=masses, mass_centers=centers, inertias=inertias)

    def _loaded(self, link: LinkChain, arcs: Array, shares: Array) -> tuple[Array, Array, Array]:
        """Return masses, mass centers and inertias (n + 1,) of virtual links with shares (k,) of it at arcs (k,)."""
        starts, count = np.cumsum(link.lengths) - link.lengths, link.lengths.size
        rods = np.searchsorted(starts, arcs, side="right") - 1
        # Mass, and first and second moment about each virtual link's proximal end.
        moments = (link.masses, link.masses * link.mass_centers, link.inertias + link.masses * link.mass_centers**2)
        mass, first, second = (
            moment + self.mass * np.bincount(rods, shares * (arcs - starts[rods]) ** power, count)
            for power, moment in enumerate(moments)
        )
        centers = np.divide(first, mass, out=np.zeros(count), where=mass > 0)
        return mass, centers, second - mass * centers**2


def _equivalent_points(link: LinkChain, arc: float) -> Array:
    """Return arc lengths (k,) [m] of points on virtual links that stand for one on the curve, and their shares (k,).

    Virtual links cross the curve at a distance of length / 12^(1/2) from their middles. Four such points around the
    place have the same mass, first, second and third moments about it, where a point of the virtual link there would
    have an error of second order in the number of joints, and a bad one: it goes to and fro with that number. Beyond
    the outermost ones the link is straight.
    """
    middles = np.cumsum(link.lengths) - link.lengths / 2
    crossings = np.sort(np.concatenate([middles - link.lengths / 12**0.5, middles + link.lengths / 12**0.5]))
    if not crossings[0] <= arc <= crossings[-1]:
        return np.array([[arc], [1.0]])
    nearest = crossings[np.argsort(np.abs(crossings - arc), kind="stable")[:4]]
    return np.stack([nearest, BarycentricInterpolator(nearest, np.eye(nearest.size))(arc)])


@dataclass(frozen=True)
class InPlaneGravity(Effect):
    """Uniform gravity in the plane, beside what is known, in the base frame: the base is tilted."""

    # Gravity is the world's, not the rig's: a tilt of 1.5 degrees is typical, three times the earth's is impossible.
    gx: float = magnitude("m/s^2", 0.25, lower=-30.0, upper=30.0)
    gy: float = magnitude("m/s^2", 0.25, lower=-30.0, upper=30.0)

    title = "In-plane gravity"
    description = "tilted base: gravity in the plane of motion"
    clause = "the base is tilted: in-plane gravity {gx} along x, {gy} along y"
    assumptions = "the same uniform gravity in every recording and throughout it"
    reference = "B. Siciliano et al., Robotics: Modelling, Planning and Control, Springer, 2009, chapter 7"
    distinguishing_experiment = "recordings at several hub angles"
    in_simulators = True

    def true_inputs(self, recording: Recording) -> Recording:
        """Return the recording with more gravity."""
        x, y = recording.gravity
        return replace(recording, gravity=(x + self.gx, y + self.gy))


@dataclass(frozen=True)
class ExternalTone(WaveEffect, _TipEffect):
    """A lateral force on the tip, amplitude sin(2 pi frequency t + phase), normal to the last virtual link.

    Time is that since the start of each recording. A force whose period is longer than the recordings is none.
    """

    amplitude: float = magnitude("N", 0.005, lower=0.0, in_rig_units=True)
    frequency: float = shape_parameter("Hz", 2.5, lower=5e-3, upper=5e3, from_spectrum="time", in_rig_units=True)
    phase: float = shape_parameter("rad", 0.0, lower=-np.pi, upper=np.pi)

    title = "Sinusoidal disturbance"
    description = "sinusoidal disturbance force on the tip"
    clause = "sinusoidal disturbance force of {amplitude} at {frequency} on the tip of '{link}'"
    assumptions = (
        "one constant amplitude, frequency and phase in every recording; a force normal to the link at its end"
    )
    reference = "J. P. Den Hartog, Mechanical Vibrations, 4th edition, McGraw-Hill, 1956"
    distinguishing_experiment = "a quiet recording, in which nothing drives the arm"
    abscissa = "frequency"

    def force(self, chain: Chain, payload: Payload) -> StateFunction | None:
        """Return the force on the end of the last virtual link."""
        rods = Rods(chain)
        last = np.zeros(rods.lengths.size)
        last[-1] = 1.0
        lever, angular_frequency = rods.lengths[-1], 2 * np.pi * self.frequency

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            wave = self.amplitude * np.sin(angular_frequency * np.asarray(time) + self.phase)
            push = wave[..., None] * last
            return rods.torques(rods.directions(q), push, lever * push)

        return force


class Rods:
    """The virtual links of all links of a chain, and the hubs before them that have a radius, from the base outwards.

    Products are by `dot`: of few motions at once, as an integrator has, it takes half the time of `@`.

    Attributes:
        lengths: (B,) [m].
        owners: (B,) index of each rod's link; -1 for a hub.
    """

    def __init__(self, chain: Chain) -> None:
        hubs = [np.array([link.hub_radius] if link.hub_radius else []) for link in chain.links]
        rods = [np.r_[hub, link.lengths] for hub, link in zip(hubs, chain.links, strict=True)]
        counts = np.array([part.size for part in rods])
        self.lengths = np.concatenate(rods)
        self.owners = np.repeat(range(counts.size), counts)
        self.owners[(np.cumsum(counts) - counts)[[hub.size > 0 for hub in hubs]]] = -1
        # Derivatives (nv, B) of the rods' headings by the joints' angles, and bends (B,) between rods at zero [rad].
        self._turns, bends = np.zeros((chain.size, self.lengths.size)), np.zeros(self.lengths.size)
        rod = 0
        for hub, link, part in zip(hubs, chain.links, chain.passive_slices, strict=True):
            self._turns[part.stop - link.coordinates : part.start, rod:] = 1.0
            if hub.size and link.root_stiffness is not None and link.radii[0]:
                self._turns[part.start - 1, rod] = 0.0  # the root joint is beyond the hub
            rod += hub.size
            for j, coordinate in enumerate(range(part.start, part.stop), start=1):
                self._turns[coordinate, rod + j :] = 1.0
                bends[rod + j] = link.rest_curvature * float(link.cells[j - 1])
            rod += link.lengths.size
        self._slides = chain.base_size  # coordinates, none or one, that move all rods in this direction
        self._slide = complex(*chain.base.axis) if chain.base is not None else 0j
        self._rest = np.exp(1j * np.cumsum(bends))
        # [a, b]: what rod a adds to the place of rod b's proximal end. Complex, as what it is multiplied by.
        self._reach = np.triu(np.repeat(self.lengths[:, None], self.lengths.size, axis=1), 1).astype(complex)

    def directions(self, q: Array) -> Complex:
        """Return the rods' directions (..., B), exp(i psi), at angles (..., nv) [rad]."""
        return np.asarray(self._rest * np.exp(1j * q.dot(self._turns)))

    def motion(self, direction: Complex, v: Array) -> tuple[Array, Array]:
        """Return how the rods move that have directions (..., B) exp(i psi), at rates (..., nv) [rad/s].

        Returns:
            (..., B) their rates [rad/s], and velocities of their proximal ends along the normals [m/s].
        """
        rate, back = v.dot(self._turns), direction.conj()
        normal = ((direction * rate).dot(self._reach) * back).real
        if self._slides:
            normal = normal + v[..., :1] * (self._slide * back).imag
        return rate, normal

    def torques(self, direction: Complex, force: Array, moment: Array) -> Array:
        """Return the generalised forces (..., nv) [N m], on a moving base [N], of forces on the rods.

        Args:
            direction: (..., B) exp(i psi).
            force: (..., B) along each rod's normal [N].
            moment: (..., B) of these forces about the rod's proximal end [N m].
        """
        back = direction.conj()
        lever = (direction * force).dot(self._reach.T)
        result: Array = (moment + (lever * back).real).dot(self._turns.T)
        if self._slides:
            result[..., 0] = (force * (self._slide * back).imag).sum(axis=-1)
        return result


# In the link's own units l / T: 1/1000 of the speed of a tip that swings by l / 7 in the first mode (3.5 rad / T).
_SLOW = 5e-4


@dataclass(frozen=True)
class _Drag(LinkEffect):
    """Air's resistance to the normal velocity of a link."""

    reference = "W. E. Baker et al., Air and internal damping of thin cantilever beams, Int. J. Mech. Sci. 9(11), 1967"
    abscissa = "amplitude"
    dissipative = True

    def density(self, normal: Array, slow: float) -> Array:
        """Return the force per length [N/m] at normal velocities [m/s]; its sign may be smoothed below a slow one."""
        raise NotImplementedError

    def force(self, chain: Chain, payload: Payload) -> StateFunction | None:
        rods = Rods(chain)
        # Three nodes a virtual link; two are exact except where the velocity changes its sign.
        abscissae, gauss = np.polynomial.legendre.leggauss(3)
        indices = np.flatnonzero(rods.owners == self.link_index)
        places = rods.lengths[indices, None] * (1 + abscissae) / 2  # (b, nodes)
        weights = (rods.lengths[indices, None] * gauss / 2).ravel()
        # From rods to nodes: the velocity at each is its rod's, and its rate times the distance.
        at_nodes = np.repeat(np.eye(rods.lengths.size)[:, indices], abscissae.size, axis=1)
        along = at_nodes * places.ravel()
        forces, moments = weights[:, None] * at_nodes.T, weights[:, None] * along.T
        length, _, time = self.units(chain)
        slow = _SLOW * length / time

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            direction = rods.directions(q)
            rates, normals = rods.motion(direction, v)
            densities = self.density(normals.dot(at_nodes) + rates.dot(along), slow)
            return rods.torques(direction, densities.dot(forces), densities.dot(moments))

        return force


@dataclass(frozen=True)
class LinearDrag(_Drag):
    """A force per length against the normal velocity, in proportion to it."""

    coefficient: float = magnitude("N s/m^2", 0.05, lower=0.0, in_rig_units=True)

    description = "air drag proportional to velocity"
    clause = "linear air drag on '{link}', {coefficient}"
    assumptions = "still air; force across the link only; one coefficient along its length; no added mass of air"
    distinguishing_experiment = "two or more modes in free decay: drag damps slow modes most"

    def density(self, normal: Array, slow: float) -> Array:
        """Return the force per length [N/m] at normal velocities [m/s]."""
        return -self.coefficient * normal


@dataclass(frozen=True)
class QuadraticDrag(_Drag):
    """A force per length against the normal velocity, in proportion to its square."""

    coefficient: float = magnitude("N s^2/m^3", 0.2, lower=0.0, in_rig_units=True)

    description = "air drag proportional to velocity squared"
    clause = "quadratic air drag on '{link}', {coefficient}"
    assumptions = "still air; force across the link only; one coefficient along its length; no added mass of air"
    distinguishing_experiment = "recordings at two amplitudes: its damping grows with amplitude"

    def density(self, normal: Array, slow: float) -> Array:
        """Return the force per length [N/m] at normal velocities [m/s]; its sign is smoothed below a slow one."""
        return -self.coefficient * normal * np.sqrt(normal * normal + slow * slow)
