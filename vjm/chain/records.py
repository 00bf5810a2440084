"""The virtual-joint chain as plain data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vjm.errors import ShapeError

Array = NDArray[np.float64]
Distal = Literal["free", "joined"]


@dataclass(frozen=True)
class LinkChain:
    """One flexible link cut into n + 1 rigid virtual links joined by n virtual joints.

    Virtual link 0 starts at the proximal end, along the x axis of the link frame Sigma_i; virtual joint j
    (from 1) sits between virtual links j - 1 and j.

    Attributes:
        name: the flexible link's name.
        joint: `revolute`, an active joint at the proximal end, or `clamped`.
        lengths: (n + 1,) length l of each virtual link [m].
        masses: (n + 1,) mass m of each virtual link [kg].
        mass_centers: (n + 1,) distance of the centre of mass from the virtual link's proximal end [m].
        inertias: (n + 1,) moment of inertia about the centre of mass [kg m^2].
        stiffness: (n,) K of each virtual joint [N m/rad].
        damping: (n,) D of each virtual joint [N m s/rad].
        cells: (n,) length of beam whose bending each virtual joint stands for [m]: phi_j = cells_j kappa(s_j).
        hub_inertia: about the active joint's axis [kg m^2].
        payload: point mass at the distal end [kg].
        distal: `free`, the distal end carries no moment, or `joined`, another link is driven from there.
        width: parallel to the joint axes [m], for pictures; None where unknown.
        thickness: in the bending plane [m], for pictures; None where unknown.

    Raises:
        ShapeError: arrays whose sizes do not fit, or values out of range.
    """

    name: str
    joint: Literal["revolute", "clamped"]
    lengths: Array
    masses: Array
    mass_centers: Array
    inertias: Array
    stiffness: Array
    damping: Array
    cells: Array
    hub_inertia: float = 0.0
    payload: float = 0.0
    distal: Distal = "free"
    width: float | None = None
    thickness: float | None = None

    def __post_init__(self) -> None:
        n = np.size(self.stiffness)
        if n < 1:
            raise ShapeError("stiffness", "no virtual joint", "at least one")
        for field, size in _SIZES.items():
            values = frozen(getattr(self, field))
            if values.shape != (n + size,):
                raise ShapeError(f"{self.name}.{field}", f"shape {values.shape}", f"shape ({n + size},)")
            if not np.isfinite(values).all() or (values < 0).any():
                raise ShapeError(f"{self.name}.{field}", values.tolist(), "finite values, none negative")
            object.__setattr__(self, field, values)
        for field in ("lengths", "cells"):
            if (getattr(self, field) <= 0).any():
                raise ShapeError(f"{self.name}.{field}", getattr(self, field).tolist(), "positive lengths")

    @property
    def virtual_joints(self) -> int:
        """Number n of virtual joints."""
        return int(self.stiffness.size)

    @property
    def length(self) -> float:
        """Total length [m]."""
        return float(self.lengths.sum())

    @property
    def joint_arcs(self) -> Array:
        """(n,) arc length s_j of each virtual joint from the proximal end [m]."""
        return np.cumsum(self.lengths)[:-1]


_SIZES = {"lengths": 1, "masses": 1, "mass_centers": 1, "inertias": 1, "stiffness": 0, "damping": 0, "cells": 0}


@dataclass(frozen=True)
class Chain:
    """A whole arm of flexible links as virtual-joint chains.

    Coordinates q run from the base outwards: for each link its active angle theta (revolute links only),
    then its virtual joints' angles phi.

    Attributes:
        name: of the arm.
        links: from the base outwards.
        gravity: in the plane, (x, y) of the base frame [m/s^2].
    """

    name: str
    links: tuple[LinkChain, ...]
    gravity: tuple[float, float] = (0.0, 0.0)

    @property
    def size(self) -> int:
        """Number of coordinates nv."""
        return sum(link.virtual_joints + (link.joint == "revolute") for link in self.links)

    @property
    def passive_slices(self) -> tuple[slice, ...]:
        """For each link, the coordinates that are its virtual joints' angles."""
        slices, start = [], 0
        for link in self.links:
            start += link.joint == "revolute"
            slices.append(slice(start, start + link.virtual_joints))
            start += link.virtual_joints
        return tuple(slices)

    @property
    def active(self) -> NDArray[np.intp]:
        """Coordinates that are active joint angles."""
        passive = self.passive_slices
        return np.array(
            [part.start - 1 for part, link in zip(passive, self.links, strict=True) if link.joint == "revolute"],
            dtype=np.intp,
        )

    @property
    def passive(self) -> NDArray[np.intp]:
        """Coordinates that are virtual joints' angles."""
        return np.setdiff1d(np.arange(self.size), self.active)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Name of each coordinate's joint: `LINK_joint` if active, `LINK_virtual_J` (J from 1) if virtual."""
        names: list[str] = []
        for link in self.links:
            if link.joint == "revolute":
                names.append(f"{link.name}_joint")
            names.extend(f"{link.name}_virtual_{j}" for j in range(1, link.virtual_joints + 1))
        return tuple(names)

    @property
    def stiffness(self) -> Array:
        """(nv,) joint stiffness, zero at active joints [N m/rad]."""
        return self._spread("stiffness")

    @property
    def damping(self) -> Array:
        """(nv,) joint damping, zero at active joints [N m s/rad]."""
        return self._spread("damping")

    def _spread(self, field: str) -> Array:
        values = np.zeros(self.size)
        for part, link in zip(self.passive_slices, self.links, strict=True):
            values[part] = getattr(link, field)
        return values


def frozen(values: ArrayLike) -> Array:
    """A read-only float copy of `values`."""
    array = np.array(values, dtype=float)
    array.setflags(write=False)
    return array
