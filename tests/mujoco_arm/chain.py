"""Flexible links as MuJoCo sees them: fine chains of rigid rods joined by hinges with springs and dampers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Link:
    """A uniform flexible link in the x-y plane, at the distal end of the one before it.

    Attributes:
        name: of the link, and of its active joint.
        length: m.
        mass: kg, uniform along the link.
        bending_stiffness: N m^2.
        kelvin_voigt_time: s; the damping of a hinge is its stiffness times this.
        joint: "revolute" (turned by a torque) or "clamped" (along the end of the link before, the first along x).
        hub_inertia: kg m^2 about the joint axis; the hub turns with this link and has no mass.
        hub_radius: m, from the joint axis to where the link begins.
        payload, payload_offset, payload_inertia: kg, m, kg m^2, of a body with its centre beyond the distal end.
        joint_damping, joint_stiffness: of its active joint, N m s/rad, N m/rad; the spring is at rest at zero.
        joint_friction: dry, of its active joint, N m.
    """

    name: str
    length: float
    mass: float
    bending_stiffness: float
    kelvin_voigt_time: float = 0.0
    joint: Literal["revolute", "clamped"] = "revolute"
    hub_inertia: float = 0.0
    hub_radius: float = 0.0
    payload: float = 0.0
    payload_offset: float = 0.0
    payload_inertia: float = 0.0
    joint_damping: float = 0.0
    joint_stiffness: float = 0.0
    joint_friction: float = 0.0


@dataclass(frozen=True)
class Arm:
    """Links from the base outwards, cut into segments of equal length.

    A hinge bends each segment, so that rods of about a segment's length join the middles of segments, shorter ones at
    the link's ends. With the hinges exactly at the middles, errors are of second order in a segment's length. With
    the outermost hinges moved towards the link's ends by 1/24 of a segment, the end correction of the midpoint rule,
    errors of natural frequencies are of third order.

    Attributes:
        links: from the base outwards.
        segments: of each link.
        end_shift: of the outermost hinges, in segments.
        gravity: m/s^2, (gx, gy) in the base frame.
    """

    links: tuple[Link, ...]
    segments: int = 32
    end_shift: float = 1.0 / 24.0
    gravity: tuple[float, float] = (0.0, 0.0)

    @property
    def active(self) -> list[int]:
        """Indices, among the coordinates, of the active joints."""
        sizes = [self.segments + (link.joint == "revolute") for link in self.links]
        starts = np.concatenate([[0], np.cumsum(sizes)])
        return [int(start) for start, link in zip(starts, self.links, strict=False) if link.joint == "revolute"]

    def rod_lengths(self, link: Link) -> Array:
        """Lengths of a link's rods, m, (segments + 1,)."""
        lengths = np.ones(self.segments + 1)
        lengths[[0, -1]] = 0.5 - self.end_shift
        lengths[[1, -2]] += self.end_shift
        return lengths * link.length / self.segments

    def headings(self, coordinates: Array) -> Array:
        """Directions of all rods, rad, (T, rods), from coordinates (T, n)."""
        columns, taken = [], 0
        for link in self.links:
            if link.joint == "clamped":
                columns.append(np.zeros((len(coordinates), 1)))
            size = self.segments + (link.joint == "revolute")
            columns.append(coordinates[:, taken : taken + size])
            taken += size
        return np.asarray(np.cumsum(np.hstack(columns), axis=1))

    def positions(self, coordinates: Array, link: int, arc_lengths: list[float]) -> Array:
        """Base-frame positions at k arc lengths (m) of a link, m, (T, k, 2), from coordinates (T, n).

        Best at the ends of segments: there, at the middle of a rod, the rod has the direction of the link.
        """
        headings = self.headings(coordinates)
        tangents = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
        counts = [self.rod_lengths(each).size for each in self.links]
        firsts = (np.cumsum(counts) - counts)[: link + 1]
        hubs = np.array([each.hub_radius for each in self.links[: link + 1]]) @ tangents[:, firsts]
        return np.asarray(hubs[:, None] + self._covered(link, np.array(arc_lengths)) @ tangents)

    def _covered(self, link: int, arc_lengths: Array) -> Array:
        """How much of each rod lies before each arc length of a link, m, (k, rods)."""
        reach = arc_lengths + sum(before.length for before in self.links[:link])
        lengths = np.concatenate([self.rod_lengths(each) for each in self.links])
        starts = np.cumsum(lengths) - lengths
        return np.asarray(np.clip(reach[:, None] - starts, 0.0, lengths))

    def straight_mass_matrix(self) -> Array:
        """Mass matrix of the straight arm, kg m^2, (n, n)."""
        model = self.build()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        matrix = np.empty((model.nv, model.nv))
        for column, unit in zip(matrix, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        return matrix

    def natural_frequencies(self, count: int) -> Array:
        """The lowest frequencies of the straight, undamped arm with free joints, Hz, (count,)."""
        stiffness = np.diag(self.build().jnt_stiffness)
        squared = eigh(stiffness, self.straight_mass_matrix(), eigvals_only=True)[len(self.active) :]
        return np.asarray(np.sqrt(squared[:count]) / (2.0 * np.pi))

    def build(self, time_step: float = 1e-4) -> mujoco.MjModel:
        """The model, with MuJoCo's integrator of fourth order (Runge-Kutta)."""
        bodies = ""
        for index in reversed(range(len(self.links))):
            start = float(self.rod_lengths(self.links[index - 1])[-1]) if index else 0.0
            bodies = self._rods(self.links[index], start, bodies)
        motors = "".join(f'<motor joint="{link.name}"/>' for link in self.links if link.joint == "revolute")
        gravity = " ".join(repr(float(component)) for component in (*self.gravity, 0.0))
        return mujoco.MjModel.from_xml_string(
            f"""<mujoco><compiler angle="radian"/>
            <option timestep="{float(time_step)!r}" integrator="RK4" gravity="{gravity}">
                <flag contact="disable" constraint="disable" energy="enable" autoreset="disable"/></option>
            <worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>"""
        )

    def _rods(self, link: Link, start: float, beyond: str) -> str:
        """A link's rods, nested, from `start` (m) along the rod before; `beyond` is what its distal end carries."""
        lengths = self.rod_lengths(link).tolist()
        stiffness = link.bending_stiffness * self.segments / link.length
        spring = f'stiffness="{stiffness!r}" damping="{stiffness * link.kelvin_voigt_time!r}"'
        beyond += _payload(link, lengths[-1])
        for index in reversed(range(len(lengths))):
            mass = link.mass * lengths[index] / link.length
            inertia = mass * lengths[index] ** 2 / 12.0 + (0.0 if index else link.hub_inertia)
            joint = f'<joint axis="0 0 1" {spring}/>' if index else _active_joint(link)
            place = lengths[index - 1] if index else start + link.hub_radius
            beyond = f"""<body pos="{place!r} 0 0">{joint}
                {_inertial(lengths[index] / 2.0, mass, inertia)}{beyond}</body>"""
        return beyond


def _active_joint(link: Link) -> str:
    spring = f'stiffness="{link.joint_stiffness!r}" damping="{link.joint_damping!r}"'
    axis = f'pos="{-link.hub_radius!r} 0 0" axis="0 0 1"'
    return f'<joint name="{link.name}" {axis} {spring}/>' if link.joint == "revolute" else ""


def _payload(link: Link, position: float) -> str:
    if not link.payload:
        return ""
    inertia = max(link.payload_inertia, 1e-12)  # MuJoCo has no point masses
    return f'<body pos="{position!r} 0 0">{_inertial(link.payload_offset, link.payload, inertia)}</body>'


def _inertial(position: float, mass: float, inertia: float) -> str:
    """Mass, kg, at x = position, m; only the inertia about z, kg m^2, matters in the plane."""
    return f'<inertial pos="{position!r} 0 0" mass="{mass!r}" diaginertia="{inertia!r} {inertia!r} {inertia!r}"/>'
