"""Chains of virtual links and virtual joints as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, GetPydanticSchema

from vjm.errors import ShapeError
from vjm.records import Array, Indices, Payload, Record

Distal = Literal["free", "joined"]
_Values = Annotated[Array, GetPydanticSchema(lambda _, handler: handler(list[float]))]  # as model.json holds them
_NotNegative = Annotated[float, Field(ge=0)]
_LARGEST = 1e100  # in SI units: a product of three, as of a mass and the square of a width, is finite as well
_Positive = Annotated[float, Field(gt=0, le=_LARGEST)]


@dataclass(frozen=True, repr=False)
class LinkChain(Record):
    """A flexible link as n + 1 rigid virtual links joined by n virtual joints.

    Virtual link 0 starts at the proximal end, along the x axis of the link frame Sigma_i; virtual joint j
    (from 1) sits between virtual links j - 1 and j.

    Raises:
        ShapeError: arrays whose sizes do not fit, or values out of range.
    """

    name: str  # the flexible link's
    joint: Literal["revolute", "clamped"]  # an active joint at the proximal end, or none
    lengths: _Values  # (n + 1,) length l of each virtual link [m]
    masses: _Values  # (n + 1,) mass m of each virtual link [kg]
    mass_centers: _Values  # (n + 1,) distance of the centre of mass from the virtual link's proximal end [m]
    inertias: _Values  # (n + 1,) moment of inertia about the centre of mass [kg m^2]
    stiffness: _Values  # (n,) K of each virtual joint [N m/rad]
    damping: _Values  # (n,) D of each virtual joint [N m s/rad]
    cells: _Values  # (n,) length of beam whose bending each virtual joint stands for [m]: phi_j = cells_j kappa(s_j)
    hub_inertia: _NotNegative = 0.0  # about the active joint's axis [kg m^2]
    hub_radius: float = 0.0  # distance of the proximal end from the active joint's axis [m]
    payload: _NotNegative = 0.0  # mass on the last virtual link [kg]
    payload_offset: float = 0.0  # distance of that mass's centre beyond the distal end, along that virtual link [m]
    payload_inertia: _NotNegative = 0.0  # of that mass about its centre [kg m^2]
    distal: Distal = "free"  # the distal end carries no moment, or `joined`: it may, for a link or a body is there
    joint_stiffness: _NotNegative = 0.0  # of the active joint, back to zero [N m/rad]
    joint_damping: _NotNegative = 0.0  # of the active joint, viscous [N m s/rad]
    # Of a passive joint between the hub, or the ground, and virtual link 0 [N m/rad]; None: there is no such joint. It
    # is at the proximal end, or where a part of the hub turns with virtual link 0 at the active joint, as in a gear.
    root_stiffness: _NotNegative | None = None
    root_damping: _NotNegative = 0.0  # of that joint [N m s/rad]
    root_inertia: _NotNegative = 0.0  # of what turns with virtual link 0 beyond that joint, about its axis [kg m^2]
    # Of the unloaded link, an arc [1/m]; the virtual joints' angles are measured from there.
    rest_curvature: float = 0.0
    width: _Positive | None = None  # parallel to the joint axes [m], for pictures; None where unknown
    thickness: _Positive | None = None  # in the bending plane [m]; None where unknown

    def __post_init__(self) -> None:
        n = np.size(self.stiffness)
        if n < 1:
            raise ShapeError("stiffness", "no virtual joint", "at least one")
        for field, size in _SIZES.items():
            values = np.array(getattr(self, field), dtype=float)
            values.setflags(write=False)
            if values.shape != (n + size,):
                raise ShapeError(f"{self.name}.{field}", f"shape {values.shape}", f"shape ({n + size},)")
            if not ((values >= 0) & (values <= _LARGEST)).all():
                raise ShapeError(f"{self.name}.{field}", values.tolist(), f"values from 0 to {_LARGEST:g}")
            object.__setattr__(self, field, values)
        for field in _NOT_NEGATIVE:
            value = getattr(self, field)
            if value is not None and not 0 <= value < np.inf:
                raise ShapeError(f"{self.name}.{field}", value, "zero or a positive number")
        if self.joint == "clamped" and self.hub_radius:
            raise ShapeError(f"{self.name}.hub_radius", self.hub_radius, "zero, of a clamped link")
        for field in ("payload_offset", "payload_inertia"):
            if getattr(self, field) and not self.payload:
                raise ShapeError(f"{self.name}.{field}", getattr(self, field), "zero, without a payload")
        for field in ("lengths", "cells"):
            if (getattr(self, field) <= 0).any():
                raise ShapeError(f"{self.name}.{field}", getattr(self, field).tolist(), "positive lengths")

    @property
    def virtual_joints(self) -> int:
        """Number n of virtual joints."""
        return int(self.stiffness.size)

    @property
    def payload_body(self) -> Payload:
        """The payload as a body."""
        return Payload(self.payload, self.payload_offset, self.payload_inertia)

    @property
    def joint_kinds(self) -> tuple[str, ...]:
        """Kind of each joint, from the proximal end: `joint` if active, `root`, then `virtual`."""
        active, root = self.joint == "revolute", self.root_stiffness is not None
        return ("joint",) * active + ("root",) * root + ("virtual",) * self.virtual_joints

    @property
    def coordinates(self) -> int:
        """Number of joints: active, root and virtual."""
        return len(self.joint_kinds)

    @property
    def length(self) -> float:
        """Total length [m]."""
        return float(self.lengths.sum())

    @property
    def carried_inertia(self) -> float:
        """Inertia of what turns with virtual link 0 [kg m^2]: the root's, and the hub's where no joint is between."""
        return self.root_inertia + (self.hub_inertia if self.root_stiffness is None else 0.0)

    @property
    def radii(self) -> tuple[float, float]:
        """Parts of the hub's radius before and after the root joint [m]."""
        geared = self.root_stiffness is not None and self.root_inertia > 0
        return (0.0, self.hub_radius) if geared else (self.hub_radius, 0.0)

    @property
    def bending_stiffness(self) -> float:
        """Mean over the virtual joints of the bending stiffness EI = K times cell [N m^2]."""
        return float(np.mean(self.stiffness * self.cells))

    @property
    def kelvin_voigt_time(self) -> float:
        """Mean over the virtual joints of D / K, the ratio of viscous to elastic bending moment [s]."""
        return float(np.mean(self.damping / np.maximum(self.stiffness, 1e-300)))

    @property
    def time_unit(self) -> float:
        """Its own unit of time, the root of m l^3 / EI [s]: a clamped link's first mode turns by 3.5 rad in it."""
        return float(np.sqrt(self.masses.sum() * self.length**3 / self.bending_stiffness))

    @property
    def joint_arcs(self) -> Array:
        """(n,) arc length s_j of each virtual joint from the proximal end [m]."""
        return np.cumsum(self.lengths)[:-1]


@dataclass(frozen=True)
class MovingBase:
    """A base that slides in one direction of the plane, without turning, on a spring and a damper.

    Its displacement is from where it stands under the weight of all that it carries.

    Raises:
        ShapeError: values out of range.
    """

    mass: _NotNegative  # of the base itself [kg]
    stiffness: _NotNegative  # [N/m]
    damping: _NotNegative  # [N s/m]
    direction: float  # from the x axis of the base frame [rad]

    def __post_init__(self) -> None:
        for field in ("mass", "stiffness", "damping"):
            value = getattr(self, field)
            if not 0 <= value <= _LARGEST:
                raise ShapeError(f"base.{field}", value, f"a number from 0 to {_LARGEST:g}")

    @property
    def axis(self) -> Array:
        """(2,) unit vector of the direction."""
        return np.array([np.cos(self.direction), np.sin(self.direction)])


_NOT_NEGATIVE = (
    *("joint_stiffness", "joint_damping", "payload_inertia"),
    *("root_stiffness", "root_damping", "root_inertia"),
)
_SIZES = {"lengths": 1, "masses": 1, "mass_centers": 1, "inertias": 1, "stiffness": 0, "damping": 0, "cells": 0}


@dataclass(frozen=True, repr=False, eq=False)
class Chain(Record):
    """An arm of flexible links as virtual-joint chains.

    Coordinates q run from the base outwards: the base's displacement [m] where it moves, then for each link its active
    angle theta (revolute links only), the angle of its root joint (where there is one), its virtual joints' angles phi.
    """

    name: str  # of the arm
    links: Annotated[tuple[LinkChain, ...], Field(min_length=1)]  # from the base outwards
    gravity: tuple[float, float] = (0.0, 0.0)  # in the plane, (x, y) of the base frame [m/s^2]
    # Apparent inertia of each active joint's drive, against the turn of that joint itself [kg m^2].
    armature: float = 0.0
    base: MovingBase | None = None  # on which the arm stands; None: the ground

    @property
    def size(self) -> int:
        """Number of coordinates nv."""
        return self.base_size + sum(link.coordinates for link in self.links)

    @property
    def base_size(self) -> int:
        """Number of coordinates of the base: one, the first, where it moves."""
        return int(self.base is not None)

    @property
    def passive_slices(self) -> tuple[slice, ...]:
        """For each link, the coordinates that are its virtual joints' angles."""
        stops = (self.base_size + np.cumsum([link.coordinates for link in self.links])).tolist()
        return tuple(slice(stop - link.virtual_joints, stop) for stop, link in zip(stops, self.links, strict=True))

    @property
    def active(self) -> Indices:
        """Coordinates that are active joint angles."""
        return self._of_kind("joint")

    @property
    def elbows(self) -> Indices:
        """Coordinates of active joints beyond a flexible link, whose angles change the arm's shape altogether."""
        return self.active[self.active > self.base_size]

    @property
    def roots(self) -> Indices:
        """Coordinates that are root joints' angles."""
        return self._of_kind("root")

    @property
    def passive(self) -> Indices:
        """Coordinates that no motor drives."""
        return self._of_kind("base", "root", "virtual")

    def _of_kind(self, *kinds: str) -> Indices:
        coordinate_kinds = ["base"] * self.base_size + [kind for link in self.links for kind in link.joint_kinds]
        return np.array([k for k, kind in enumerate(coordinate_kinds) if kind in kinds], dtype=np.intp)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Name of each coordinate's joint: `base_slide`, `LINK_joint` if active, `LINK_root`, `LINK_virtual_J`."""
        names = ["base_slide"] * self.base_size
        for link in self.links:
            names += [f"{link.name}_{kind}" for kind in link.joint_kinds if kind != "virtual"]
            names += [f"{link.name}_virtual_{j}" for j in range(1, link.virtual_joints + 1)]
        return tuple(names)

    @property
    def stiffness(self) -> Array:
        """(nv,) joint stiffness [N m/rad], the base's [N/m]."""
        return self._of_joints("stiffness")

    @property
    def damping(self) -> Array:
        """(nv,) joint damping [N m s/rad], the base's [N s/m]."""
        return self._of_joints("damping")

    def _of_joints(self, field: str) -> Array:
        """Return stiffness or damping (nv,) of all joints in the order of the coordinates."""
        values: list[Array] = [] if self.base is None else [getattr(self.base, field)]
        for link in self.links:
            values += [getattr(link, f"{kind}_{field}") for kind in link.joint_kinds if kind != "virtual"]
            values.append(getattr(link, field))
        return np.hstack(values)


@lru_cache(maxsize=1024)  # asked again for every recording and segment
def have_equal_links(chain: Chain, other: Chain, fields: Sequence[str]) -> bool:
    """Return True if two chains have the same base, and links that are equal in some fields."""
    if chain.base != other.base:
        return False
    links = list(zip(chain.links, other.links, strict=True))
    return all(np.array_equal(getattr(left, field), getattr(right, field)) for left, right in links for field in fields)
