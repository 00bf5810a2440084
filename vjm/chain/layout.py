"""Layouts of virtual joints on a uniform flexible link: lengths, cells and nominal stiffness.

The bulk of a chain of uniform rods with K = EI / Delta is fourth-order accurate by itself: with displacements
y - kappa Delta^2 / 12 at the joints, its moments there are the beam's. The error sits at the ends. A free end needs no
correction; at an end that carries a moment two links and two joints are changed so that a curvature and its slope come
out exactly (layout `fourth-order`). The layout `end-corrected` has constants fitted to frequencies.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from vjm.chain.virtual_links import Chain, Distal, LinkChain
from vjm.errors import ChoiceError, ShapeError
from vjm.records import Array, Link, Payload, Rig

LayoutName = Literal["fourth-order", "end-corrected", "half-ends", "equal"]
LAYOUTS: tuple[str, ...] = get_args(LayoutName)
DEFAULT_LAYOUT: LayoutName = "fourth-order"

# Lengths of the two virtual links, and compliances of the two joints, next to an end that carries a moment, in units of
# Delta and Delta / EI. Exact curvature and slope of curvature leave one number free, where the second joint is: 1.4
# gives the smallest errors of small chains.
_SECOND_JOINT = 1.4
_FIRST_LINK = _SECOND_JOINT * (2 * _SECOND_JOINT**2 - 1) / (6 * _SECOND_JOINT**2 - 1)
_SECOND_LINK = _SECOND_JOINT - _FIRST_LINK
_FIRST_CELL = (_SECOND_JOINT**2 / 2 - 1 / 12) / _SECOND_LINK
_SECOND_CELL = _SECOND_JOINT + 0.5 - _FIRST_CELL

# `end-corrected`: link length and joint compliance next to an end, found by least squares on frequencies and static
# deflections over n = 6..16.
_MOMENT_END = (0.390, 1 / 1.126)
_FREE_END = (0.957, 1 / 0.934)
# One joint has no bulk: its two constants meet the first natural frequency and the static end-load deflection,
# both exactly. lambda_1 L = 1.8751 is the first root of 1 + cos(z) cosh(z).
_ROOT = 1.8751040687119611
_SINGLE_DISTAL = 9 / _ROOT**4
# Kelvin-Voigt time from which searches start, in links' own units: 0.35 % of critical damping in a clamped first mode,
# within a decade or two of metals and polymers.
_START = 2e-3


@dataclass(frozen=True)
class Layout:
    """Virtual links and joints of one flexible link."""

    lengths: Array  # (n + 1,) virtual links [m]
    cells: Array  # (n,) length of beam each virtual joint stands for [m]; its nominal stiffness is EI / cells
    distal: Distal = "free"  # of moment, or `joined` to a further link or a body


Cuts = Layout | LinkChain  # what says where a link is cut


def layout(length: float, n: int, name: str = DEFAULT_LAYOUT, distal: Distal = "free") -> Layout:
    """Cut a link of `length` [m] at n virtual joints.

    Args:
        length: of the flexible link [m].
        n: number of virtual joints, at least 1.
        name: `fourth-order`, `end-corrected`; `half-ends`: the end links are half as long; `equal`: all are equal.
        distal: whether the distal end is free of moment, or joined to a further link or a body that is no point.

    Raises:
        ChoiceError: unknown name.
        ShapeError: n below 1.
    """
    if n < 1:
        raise ShapeError("virtual joints", n, "at least 1")
    if name not in LAYOUTS:
        raise ChoiceError("layout", name, LAYOUTS)
    if name == "equal":
        lengths, cells = np.ones(n + 1), np.ones(n)
    elif name == "half-ends" or (n == 1 and distal == "joined"):
        lengths, cells = np.r_[0.5, np.ones(n - 1), 0.5], np.ones(n)
    elif n == 1:
        lengths, cells = np.array([1 - _SINGLE_DISTAL, _SINGLE_DISTAL]), np.array([1 / (3 * _SINGLE_DISTAL**2)])
    else:
        lengths, cells = (_fourth_order if name == "fourth-order" else _end_corrected)(n, distal)
    delta = length / lengths.sum()
    return Layout(delta * lengths, delta * cells, distal)


def _fourth_order(n: int, distal: Distal) -> tuple[Array, Array]:
    lengths, cells = np.ones(n + 1), np.ones(n)
    for side in (slice(None), slice(None, None, -1)) if distal == "joined" else (slice(None),):
        # Corrections of both ends add up where a short chain makes them meet.
        lengths[side][:2] += (_FIRST_LINK - 1, _SECOND_LINK - 1)
        cells[side][:2] += (_FIRST_CELL - 1, _SECOND_CELL - 1)
    return lengths, cells


def _end_corrected(n: int, distal: Distal) -> tuple[Array, Array]:
    outer = _FREE_END if distal == "free" else _MOMENT_END
    lengths = np.r_[_MOMENT_END[0], np.ones(n - 1), outer[0]]
    return lengths, np.r_[_MOMENT_END[1], np.ones(n - 2), outer[1]]


def layout_of_lengths(lengths: ArrayLike, distal: Distal = "free") -> Layout:
    """Return the layout with given virtual links (n + 1,) [m]; each joint's cell ends midway to its neighbours.

    Past the last joint before a free end the curvature falls to zero: only half of the last virtual link counts.
    """
    values = np.asarray(lengths, dtype=float)
    cells = (values[:-1] + values[1:]) / 2
    cells[0] += values[0] / 2
    if distal == "joined":
        cells[-1] += values[-1] / 2
    return Layout(values, cells, distal)


def uniform_chain(link: Link, cuts: Cuts, kelvin_voigt: float = 0.0) -> LinkChain:
    """Return the chain of a uniform link: uniform bars, K = EI / cell, D = K times the Kelvin-Voigt time [s]."""
    masses, stiffness = link.mass * cuts.lengths / link.length, link.bending_stiffness / cuts.cells
    return LinkChain(
        name=link.name,
        joint=link.joint,
        lengths=cuts.lengths,
        masses=masses,
        mass_centers=cuts.lengths / 2,
        inertias=masses * (cuts.lengths**2 / 12 + section_inertia(link.thickness)),
        stiffness=stiffness,
        damping=stiffness * kelvin_voigt,
        cells=cuts.cells,
        hub_inertia=link.hub_inertia,
        hub_radius=link.hub_radius,
        payload=link.payload,
        payload_offset=link.payload_offset,
        payload_inertia=link.payload_inertia,
        distal=cuts.distal,
        width=link.width,
        thickness=link.thickness,
    )


def section_inertia(thickness: float | None) -> float:
    """Return a cross section's moment of inertia over its mass, h^2 / 12 [m^2]; zero for an unknown thickness h [m].

    That of a Rayleigh beam (S. P. Timoshenko, Vibration Problems in Engineering, 1937, section 54): thick beams are
    slower than slender ones, by (pi h / l)^2 in the order of magnitude.
    """
    return 0.0 if thickness is None else thickness**2 / 12


def rig_layouts(
    rig: Rig, joints: Sequence[int], name: str = DEFAULT_LAYOUT, payloads: Iterable[Payload] = ()
) -> list[Layout]:
    """Cut each link of a rig at its number of virtual joints.

    Only the last link's distal end is free of moment: if neither the link's payload nor any of these, which recordings
    may have beside it, is more than a point there.
    """
    last = len(rig.links) - 1
    tip: Distal = "joined" if any(map(_bends_tip, (rig.links[-1].payload_body, *payloads))) else "free"
    return [
        layout(link.length, n, name, tip if i == last else "joined")
        for i, (link, n) in enumerate(zip(rig.links, joints, strict=True))
    ]


def _bends_tip(payload: Payload) -> bool:
    return payload.mass > 0 and (payload.offset != 0 or payload.inertia > 0)


def nominal_chain(rig: Rig, cuts: Sequence[Cuts], kelvin_voigt: float = 0.0) -> Chain:
    """Return the chain of the experiment file's nominal values, which have no Kelvin-Voigt time [s] of their own."""
    links = [uniform_chain(link, cut, kelvin_voigt) for link, cut in zip(rig.links, cuts, strict=True)]
    return Chain(rig.name, tuple(links), rig.gravity)


def starting_chain(rig: Rig, cuts: Sequence[Cuts]) -> Chain:
    """Return the nominal chain with a little damping, from which searches start."""
    links = [replace(link, damping=_START * link.time_unit * link.stiffness) for link in nominal_chain(rig, cuts).links]
    return Chain(rig.name, tuple(links), rig.gravity)
