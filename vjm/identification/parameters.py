"""From an optimiser's numbers to a chain: the choices of alpha (eq. 13), with (17)-(20) holding by construction.

Every chain built here has positive lengths and masses (17), centres of mass inside their virtual links (18), moments of
inertia that some mass distribution along the link has, positive stiffness and no negative damping (19), and the link's
known total length and mass (20).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from scipy.optimize import approx_fprime
from scipy.special import expit, logit, softmax

from vjm.chain.layout import layout_of_lengths, section_inertia
from vjm.chain.virtual_links import Chain, LinkChain
from vjm.records import Array, Mask

Parameters = Literal["uniform", "joints", "lengths", "full"]
PARAMETRISATIONS: tuple[str, ...] = get_args(Parameters)

NEAREST_TO_BOUND = 1e-6  # distance of coordinates from their bounds with which searches start

_LINEAR = ("stiffness", "damping", "hub")  # groups in which the torque errors are linear
_MAX_LOGARITHM = 12.0  # e^12 = 1.6e5: no ratio of lengths or masses of one link is larger, no fraction nearer to 0 or 1
# Widths of the preference for the template: relative for stiffness, damping and hub, in logarithms and logits for the
# others. Recordings usually tell these to a few per cent; what they do not tell stays within a factor of two or so.
_WIDTHS = {"stiffness": 0.5, "damping": 1.0, "hub": 1.0, "length": 0.5, "mass": 0.5, "center": 1.0, "inertia": 1.0}
_FIELDS = {"length": "lengths", "mass": "masses", "center": "mass_centers", "inertia": "inertias"}


def at_bounds(x: Array, bounds: tuple[Array, Array]) -> Mask:
    """Return (p,) true where coordinates x (p,) are no further from lower or upper bounds (p,) than at a start."""
    nearest = np.minimum(x - bounds[0], bounds[1] - x)
    return nearest < 1.001 * NEAREST_TO_BOUND  # rounding of a sum must not take a start for further away


@dataclass(frozen=True)
class _Coordinate:
    """One number that the optimiser varies, for a physical parameter of a name and unit."""

    name: str
    unit: str
    link: int  # index of its flexible link
    group: str  # `stiffness`, `damping`, `hub`, `length`, `mass`, `center` or `inertia`
    index: int  # of the virtual joint or link; -1 for one shared by the whole link


@dataclass(frozen=True)
class Parametrisation:
    """The free parameters of a chain, as an optimiser's coordinates.

    Stiffness, damping and hub inertia are multiples of the template's scale, in which the torque errors are linear.
    Lengths and masses are logarithms of ratios to the last one, so that they stay positive and keep their total;
    centres and inertias are logits of their fractions of the possible range.
    """

    template: Chain  # at the starting values
    kind: str  # `uniform`, `joints`, `lengths` or `full`
    hubs: tuple[int, ...]  # indices of the links whose hub inertia is identified

    @cached_property
    def coordinates(self) -> tuple[_Coordinate, ...]:
        """The coordinates, in the optimiser's order."""
        result: list[_Coordinate] = []
        for i, link in enumerate(self.template.links):
            joints = range(link.virtual_joints)
            if self.kind == "uniform":
                result.append(_Coordinate(f"{link.name}.bending_stiffness", "N m^2", i, "stiffness", -1))
                result.append(_Coordinate(f"{link.name}.kelvin_voigt_time", "s", i, "damping", -1))
            else:
                result += [_Coordinate(f"{link.name}.stiffness_{j + 1}", "N m/rad", i, "stiffness", j) for j in joints]
                result += [_Coordinate(f"{link.name}.damping_{j + 1}", "N m s/rad", i, "damping", j) for j in joints]
            if i in self.hubs:
                result.append(_Coordinate(f"{link.name}.hub_inertia", "kg m^2", i, "hub", -1))
            if self.kind in ("lengths", "full"):  # the last length follows from the total
                result += [_Coordinate(f"{link.name}.length_{j}", "m", i, "length", j) for j in joints]
            if self.kind == "full":
                moving = range(
                    1 if i == 0 else 0, link.virtual_joints + 1
                )  # the first one's mass shows in nothing but its weight
                result += [_Coordinate(f"{link.name}.mass_{j}", "kg", i, "mass", j) for j in moving[:-1]]
                result += [_Coordinate(f"{link.name}.mass_center_{j}", "m", i, "center", j) for j in moving]
                # Behind an active joint, virtual link 0 only turns: its inertia is the hub's.
                result += [_Coordinate(f"{link.name}.inertia_{j}", "kg m^2", i, "inertia", j) for j in moving if j > 0]
        return tuple(result)

    @property
    def linear(self) -> Mask:
        """(p,) True where the torque errors are linear in the coordinate at given lengths and masses."""
        return np.array([coordinate.group in _LINEAR for coordinate in self.coordinates])

    @property
    def start(self) -> Array:
        """(p,) coordinates of the template."""
        return np.array([self._template_value(coordinate) for coordinate in self.coordinates])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (p,), (p,) of the coordinates."""
        lowest = {"stiffness": 1e-6, "damping": 0.0, "hub": 0.0}  # K stays positive (eq. 19)
        lower = np.array([lowest.get(coordinate.group, -_MAX_LOGARITHM) for coordinate in self.coordinates])
        return lower, np.where(self.linear, np.inf, _MAX_LOGARITHM)

    @property
    def preference(self) -> tuple[Array, Array]:
        """Centre and width (p,) of a weak preference for the template where the data are silent."""
        centre = self.start
        width = np.array([_WIDTHS[coordinate.group] for coordinate in self.coordinates])
        # A hundredth of the unit keeps the width away from zero at zero damping.
        return centre, np.where(self.linear, width * np.maximum(np.abs(centre), 1e-2), width)

    def scale(self, coordinate: _Coordinate) -> float:
        """Return the physical size of one unit of a linear coordinate."""
        link = self.template.links[coordinate.link]
        if coordinate.group == "hub":  # a hub without inertia: in units of the rigid link's own
            return link.hub_inertia or float(link.masses.sum() * link.length**2) / 3
        stiffness = link.bending_stiffness / (float(link.cells[coordinate.index]) if coordinate.index >= 0 else 1.0)
        # Coordinates are of order one for damping ratios of metal to polymer (3.5 %).
        return stiffness if coordinate.group == "stiffness" else 0.02 * link.time_unit * stiffness

    def chain(self, x: Array) -> Chain:
        """Build the chain at coordinates x (p,)."""
        values = x * [self.scale(coordinate) if coordinate.group in _LINEAR else 1.0 for coordinate in self.coordinates]
        links = (self._link(i, link, values) for i, link in enumerate(self.template.links))
        return replace(self.template, links=tuple(links))

    def physical(self, x: Array) -> Array:
        """Return the parameters (p,) at coordinates x (p,), in their units."""
        links = self.chain(x).links
        return np.array([_value(links[coordinate.link], coordinate) for coordinate in self.coordinates])

    def jacobian(self, x: Array) -> Array:
        """Return the derivative (p, p) of the physical parameters by the coordinates."""
        steps = 1e-6 * np.maximum(np.abs(x), 1e-3)  # 1e-8 is the root of the rounding error
        return np.reshape(approx_fprime(x, self.physical, steps), (x.size, x.size))

    def physical_covariance(self, x: Array, covariance: Array) -> Array:
        """Return the covariance (p, p) of the physical parameters at x (p,), from that of the coordinates."""
        slope = self.jacobian(x)
        result: Array = slope @ covariance @ slope.T
        return result

    def _template_value(self, coordinate: _Coordinate) -> float:
        link, group, j = self.template.links[coordinate.link], coordinate.group, coordinate.index
        value = _value(link, coordinate)
        if group in _LINEAR:
            shared_time = group == "damping" and j < 0
            return value * (link.bending_stiffness if shared_time else 1.0) / self.scale(coordinate)
        if group in ("length", "mass"):
            return float(np.log(value / getattr(link, _FIELDS[group])[-1]))
        length, center = float(link.lengths[j]), float(link.mass_centers[j])
        largest = length
        if group == "inertia":
            value = value / float(link.masses[j]) - section_inertia(link.thickness)
            largest = center * (length - center)
        return float(logit(np.clip(value / largest, 1e-5, 1 - 1e-5)))

    def _of_group(self, i: int, group: str, values: Array) -> tuple[list[int], Array]:
        """Return the indices within link i, and values, of one group."""
        rows = [
            k for k, coordinate in enumerate(self.coordinates) if coordinate.link == i and coordinate.group == group
        ]
        return [self.coordinates[k].index for k in rows], values[rows]

    def _link(self, i: int, link: LinkChain, values: Array) -> LinkChain:
        """Return link i at values (p,): linear coordinates in physical units, the others as the optimiser has them."""
        if self.kind in ("lengths", "full"):
            ratios = softmax(np.r_[self._of_group(i, "length", values)[1], 0.0])
            cuts = layout_of_lengths(link.length * ratios, link.distal)
            masses = link.masses.sum() * cuts.lengths / link.length
            link = replace(
                link,
                lengths=cuts.lengths,
                cells=cuts.cells,
                masses=masses,
                mass_centers=cuts.lengths / 2,
                inertias=masses * (cuts.lengths**2 / 12 + section_inertia(link.thickness)),
            )
        if self.kind == "full":
            link = self._with_inertial(i, link, values)
        stiffness, damping, hub = (self._of_group(i, group, values)[1] for group in _LINEAR)
        if self.kind == "uniform":
            stiffness, damping = stiffness[0] / link.cells, damping[0] / link.cells
        hub_inertia = float(hub[0]) if hub.size else link.hub_inertia
        return replace(link, stiffness=stiffness, damping=damping, hub_inertia=hub_inertia)

    def _with_inertial(self, i: int, link: LinkChain, values: Array) -> LinkChain:
        """Return the link with masses, centres and inertias of its own; what does not move keeps its uniform share."""
        masses, centers = link.masses.copy(), link.lengths / 2
        indices, logits = self._of_group(i, "center", values)
        masses[indices] = masses[indices].sum() * softmax(np.r_[self._of_group(i, "mass", values)[1], 0.0])
        centers[indices] = link.lengths[indices] * expit(logits)
        fraction = np.full(link.lengths.size, 1 / 3)  # of the largest inertia that the centre allows: a uniform rod's
        indices, logits = self._of_group(i, "inertia", values)
        fraction[indices] = expit(logits)
        inertias = masses * (fraction * centers * (link.lengths - centers) + section_inertia(link.thickness))
        return replace(link, masses=masses, mass_centers=centers, inertias=inertias)


def _value(link: LinkChain, coordinate: _Coordinate) -> float:
    """Return the physical parameter of a link that a coordinate stands for, in its unit."""
    if coordinate.group == "hub":
        return link.hub_inertia
    if coordinate.index < 0:
        return link.bending_stiffness if coordinate.group == "stiffness" else link.damping[0] / link.stiffness[0]
    return float(getattr(link, _FIELDS.get(coordinate.group, coordinate.group))[coordinate.index])
