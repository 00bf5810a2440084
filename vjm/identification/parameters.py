"""From an optimiser's numbers to a chain: the choices of alpha (eq. 13), with (17)-(20) holding by construction.

Every chain built here has positive lengths and masses (17), centres of mass inside their virtual links (18), moments of
inertia that some mass distribution along the link has, positive stiffness and no negative damping (19), and the link's
known total length and mass (20).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vjm.chain.layout import Layout, layout_of_lengths
from vjm.chain.virtual_links import Chain, LinkChain
from vjm.errors import ChoiceError
from vjm.records import Array, Recording
from vjm.simulation.arm import Arm

PARAMETRISATIONS = ("uniform", "joints", "lengths", "full")


@dataclass(frozen=True)
class Coordinate:
    """One number the optimiser turns.

    Attributes:
        name: of the physical parameter.
        unit: of the physical parameter.
        link: index of its flexible link.
        group: `stiffness`, `damping`, `hub`, `length`, `mass`, `center` or `inertia`.
        index: of the virtual joint or link; -1 for one shared by the whole link.
    """

    name: str
    unit: str
    link: int
    group: str
    index: int


@dataclass(frozen=True)
class Parametrisation:
    """The free numbers of a chain.

    Stiffness, damping and hub inertia are multiples of the template's scale, in which the torque errors are linear.
    Lengths and masses are logarithms of ratios to the last one, so that they stay positive and keep their total;
    centres and inertias are logits of their fractions of the possible range.

    Attributes:
        template: the chain at the starting values.
        kind: `uniform`, `joints`, `lengths` or `full`.
        hubs: indices of the links whose hub inertia is identified.
    """

    template: Chain
    kind: str
    hubs: tuple[int, ...]

    def __post_init__(self) -> None:
        if self.kind not in PARAMETRISATIONS:
            raise ChoiceError("parametrisation", self.kind, PARAMETRISATIONS)

    @cached_property
    def coordinates(self) -> tuple[Coordinate, ...]:
        """The free numbers, in the optimiser's order."""
        result: list[Coordinate] = []
        for i, link in enumerate(self.template.links):
            if self.kind == "uniform":
                result.append(Coordinate(f"{link.name}.bending_stiffness", "N m^2", i, "stiffness", -1))
                result.append(Coordinate(f"{link.name}.kelvin_voigt_time", "s", i, "damping", -1))
            else:
                joints = range(link.virtual_joints)
                result += [Coordinate(f"{link.name}.stiffness_{j + 1}", "N m/rad", i, "stiffness", j) for j in joints]
                result += [Coordinate(f"{link.name}.damping_{j + 1}", "N m s/rad", i, "damping", j) for j in joints]
            if i in self.hubs:
                result.append(Coordinate(f"{link.name}.hub_inertia", "kg m^2", i, "hub", -1))
            if self.kind in ("lengths", "full"):
                names = range(link.virtual_joints)  # the last one follows from the total
                result += [Coordinate(f"{link.name}.length_{j}", "m", i, "length", j) for j in names]
            if self.kind == "full":
                result += self._masses(i, link)
        return tuple(result)

    def _masses(self, i: int, link: LinkChain) -> list[Coordinate]:
        moving = range(self._first_moving(i), link.virtual_joints + 1)
        masses = [Coordinate(f"{link.name}.mass_{j}", "kg", i, "mass", j) for j in moving[:-1]]
        centers = [Coordinate(f"{link.name}.mass_center_{j}", "m", i, "center", j) for j in moving]
        # Behind an active joint, virtual link 0 only turns: its inertia is the hub's.
        turning = [j for j in moving if j > 0]
        inertias = [Coordinate(f"{link.name}.inertia_{j}", "kg m^2", i, "inertia", j) for j in turning]
        return masses + centers + inertias

    def _first_moving(self, i: int) -> int:
        """First virtual link of flexible link i whose mass the motion can show."""
        return 1 if i == 0 else 0

    @property
    def linear(self) -> NDArray[np.bool_]:
        """(p,) whether the torque errors are linear in the coordinate at given lengths and masses."""
        return np.array([c.group in ("stiffness", "damping", "hub") for c in self.coordinates])

    @property
    def start(self) -> Array:
        """(p,) coordinates of the template."""
        values = []
        for coordinate in self.coordinates:
            link = self.template.links[coordinate.link]
            values.append(_read(coordinate, link, self))
        return np.array(values)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (p,), (p,) of the coordinates."""
        lower = np.array(
            [{"stiffness": 1e-6, "damping": 0.0, "hub": 0.0}.get(c.group, -12.0) for c in self.coordinates]
        )
        upper = np.where(self.linear, np.inf, 12.0)
        return lower, upper

    @property
    def reach(self) -> Array:
        """(p,) by how much a step of a search may change each coordinate: the step's own damping is enough."""
        return np.full(len(self.coordinates), np.inf)

    @property
    def preference(self) -> tuple[Array, Array]:
        """Centre and width (p,) of a weak preference for the template where the data are silent.

        Wide against what recordings usually tell, narrow enough that what they do not tell stays near the template.
        """
        centre = self.start
        width = np.array([_WIDTHS[c.group] for c in self.coordinates])
        relative = self.linear
        return centre, np.where(relative, width * np.maximum(np.abs(centre), _LEAST_SIZE), width)

    def scale(self, coordinate: Coordinate) -> float:
        """Physical size of one unit of a linear coordinate."""
        link = self.template.links[coordinate.link]
        if coordinate.group == "hub":
            return link.hub_inertia or float(link.masses.sum() * link.length**2) / 3
        stiffness = link.bending_stiffness / (1.0 if coordinate.index < 0 else float(link.cells[coordinate.index]))
        return stiffness if coordinate.group == "stiffness" else DAMPING_SCALE * stiffness

    def chain(self, x: Array) -> Chain:
        """The chain at coordinates x (p,)."""
        links = []
        for i, link in enumerate(self.template.links):
            links.append(self._link(i, link, x))
        return replace(self.template, links=tuple(links))

    def arms(self, x: Array, recordings: Sequence[Recording]) -> tuple[Arm, ...]:
        """What moves in each of the recordings, at coordinates x (p,)."""
        return (Arm(self.chain(x)),) * len(recordings)

    def _values(self, i: int, group: str, x: Array) -> tuple[list[int], Array]:
        rows = [k for k, c in enumerate(self.coordinates) if c.link == i and c.group == group]
        return [self.coordinates[k].index for k in rows], x[rows]

    def _link(self, i: int, link: LinkChain, x: Array) -> LinkChain:
        changes: dict[str, Array | float] = {}
        cells = link.cells
        if self.kind in ("lengths", "full"):
            cuts = self._cuts(i, link, x)
            cells = cuts.cells
            masses = link.masses.sum() * cuts.lengths / link.length
            changes = {"lengths": cuts.lengths, "cells": cells, "masses": masses, "mass_centers": cuts.lengths / 2}
            changes["inertias"] = masses * cuts.lengths**2 / 12
        if self.kind == "full":
            changes |= self._inertial(i, link, np.asarray(changes["lengths"]), x)
        stiffness_scale, damping_scale = self._scales(i)
        stiffness, damping = self._values(i, "stiffness", x)[1], self._values(i, "damping", x)[1]
        if self.kind == "uniform":
            changes["stiffness"] = stiffness[0] * stiffness_scale[0] / cells
            changes["damping"] = damping[0] * damping_scale[0] / cells
        else:
            changes["stiffness"], changes["damping"] = stiffness * stiffness_scale, damping * damping_scale
        hub = self._values(i, "hub", x)[1]
        if hub.size:
            changes["hub_inertia"] = float(hub[0]) * self.scale(self._one(i, "hub"))
        return replace(link, **changes)  # type: ignore[arg-type]

    def _one(self, i: int, group: str) -> Coordinate:
        return next(c for c in self.coordinates if c.link == i and c.group == group)

    def _scales(self, i: int) -> tuple[Array, Array]:
        """Physical sizes of the link's stiffness and damping coordinates."""
        mine = [c for c in self.coordinates if c.link == i]
        return (
            np.array([self.scale(c) for c in mine if c.group == "stiffness"]),
            np.array([self.scale(c) for c in mine if c.group == "damping"]),
        )

    def _cuts(self, i: int, link: LinkChain, x: Array) -> Layout:
        ratios = np.exp(np.r_[self._values(i, "length", x)[1], 0.0])
        return layout_of_lengths(link.length * ratios / ratios.sum(), link.distal)

    def _inertial(self, i: int, link: LinkChain, lengths: Array, x: Array) -> dict[str, Array]:
        first = self._first_moving(i)
        masses = link.masses.sum() * lengths / link.length  # what does not move keeps its uniform share
        ratios = np.exp(np.r_[self._values(i, "mass", x)[1], 0.0])
        masses[first:] = masses[first:].sum() * ratios / ratios.sum()
        centers = lengths / 2
        indices, values = self._values(i, "center", x)
        centers[indices] = lengths[indices] * _logistic(values)
        spread = np.full(lengths.size, 1 / 3)  # a uniform rod has a third of the largest inertia its centre allows
        indices, values = self._values(i, "inertia", x)
        spread[indices] = _logistic(values)
        return {"masses": masses, "mass_centers": centers, "inertias": spread * masses * centers * (lengths - centers)}

    def physical(self, x: Array) -> Array:
        """(p,) the parameters in their units."""
        chain = self.chain(x)
        result = []
        for k, coordinate in enumerate(self.coordinates):
            link = chain.links[coordinate.link]
            if coordinate.group == "damping" and coordinate.index < 0:
                result.append(float(link.damping[0] / link.stiffness[0]))
            elif self.linear[k]:
                result.append(x[k] * self.scale(coordinate))
            else:
                result.append(float(getattr(link, _FIELDS[coordinate.group])[coordinate.index]))
        return np.array(result)

    def jacobian(self, x: Array) -> Array:
        """(p, p) derivative of the physical parameters by the coordinates."""
        base = self.physical(x)
        steps = 1e-6 * np.maximum(np.abs(x), 1e-3)
        moved = [
            (self.physical(x + step * unit) - base) / step for step, unit in zip(steps, np.eye(x.size), strict=True)
        ]
        return np.stack(moved, axis=1)


# Widths of the preference: relative for stiffness, damping and hub, in logarithms and logits for the others.
_WIDTHS = {"stiffness": 0.5, "damping": 1.0, "hub": 1.0, "length": 0.5, "mass": 0.5, "center": 1.0, "inertia": 1.0}
_LEAST_SIZE = 1e-2
DAMPING_SCALE = 1e-2  # s; a Kelvin-Voigt time of ten milliseconds is one unit
_FIELDS = {"length": "lengths", "mass": "masses", "center": "mass_centers", "inertia": "inertias"}


def _read(coordinate: Coordinate, link: LinkChain, parametrisation: Parametrisation) -> float:
    """The template's value of one coordinate."""
    j = coordinate.index
    if coordinate.group == "stiffness":
        physical = link.bending_stiffness if j < 0 else float(link.stiffness[j])
        return physical / parametrisation.scale(coordinate)
    if coordinate.group == "damping":
        physical = float(np.mean(link.damping * link.cells)) if j < 0 else float(link.damping[j])
        return physical / parametrisation.scale(coordinate)
    if coordinate.group == "hub":
        return link.hub_inertia / parametrisation.scale(coordinate)
    if coordinate.group in ("length", "mass"):
        values = link.lengths if coordinate.group == "length" else link.masses
        return float(np.log(values[j] / values[-1]))
    length, center = float(link.lengths[j]), float(link.mass_centers[j])
    if coordinate.group == "center":
        return _logit(center / length)
    largest = float(link.masses[j]) * center * (length - center)
    return _logit(float(link.inertias[j]) / largest)


def _logit(fraction: float) -> float:
    kept = min(max(fraction, 1e-5), 1 - 1e-5)
    return float(np.log(kept / (1 - kept)))


def _logistic(values: Array) -> Array:
    result: Array = 1 / (1 + np.exp(-values))
    return result
