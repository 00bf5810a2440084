"""The independent beam against MuJoCo: chains of rigid rods, hinges, springs and dampers, in the limit of many rods."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.fine_beam import Beam, Physics, Run, modal_state, simulate, simulate_runs

pytest.importorskip("mujoco")

from tests.mujoco_arm.chain import Arm, Link
from tests.mujoco_arm.simulate import simulate_with_mujoco

Array = NDArray[np.float64]

MARKERS = [0.25, 0.5, 0.75, 1.0]  # ends of segments, whether there are 8, 16 or 32
TIME = np.arange(751) / 500.0
CLAMPED = Beam(length=1.0, mass=0.44, bending_stiffness=1.97, kelvin_voigt_time=3e-4)
HUB = replace(CLAMPED, joint="revolute", hub_inertia=0.02)


class Case(NamedTuple):
    """A motion from standstill: hub torque (T,) in N m, and initial tip displacement in the first clamped mode, m."""

    name: str
    beam: Beam
    torque: Array | None = None
    tip: float = 0.0


CASES = [
    Case("driven", HUB, torque=0.35 * np.sin(3.5 * TIME) + 0.05 * np.sin(14.0 * TIME)),
    Case("on a hub", replace(HUB, hub_radius=0.1), torque=0.35 * np.sin(3.5 * TIME) + 0.05 * np.sin(14.0 * TIME)),
    Case("decay", CLAMPED, tip=0.1),
    Case("loaded", replace(CLAMPED, payload=0.05, gravity=(5.0, -3.0))),
]


def first_mode_heading(arc_lengths: Array) -> Array:
    """Slope of the first mode of a clamped-free beam of length 1 m per metre at the tip, rad/m: closed form."""
    root = 1.8751040687119611
    z = root * np.append(arc_lengths, 1.0)
    ratio = (np.cosh(root) + np.cos(root)) / (np.sinh(root) + np.sin(root))
    shape = np.cosh(z) - np.cos(z) - ratio * (np.sinh(z) - np.sin(z))
    slope = np.sinh(z) + np.sin(z) - ratio * (np.cosh(z) - np.cos(z))
    return np.asarray(root * slope[:-1] / shape[-1])


def start(case: Case, segments: int) -> Array | None:
    """Angles of the hinges, rad, for a beam bent as in its first clamped mode; None: straight."""
    if not case.tip:
        return None
    return np.asarray(case.tip * np.diff(first_mode_heading(np.arange(segments + 1) / segments)))


def mujoco_markers(case: Case, segments: int, max_step: float) -> Array:
    """Marker paths, m, (T, k, 2), of a chain bent at the middles of its segments: its errors are of second order."""
    beam = case.beam
    properties = {field.name: getattr(beam, field.name) for field in fields(beam) if field.name != "gravity"}
    link = Link("beam", **properties)
    arm = Arm((link,), segments, end_shift=0.0, gravity=beam.gravity)
    torque = None if case.torque is None else case.torque[:, None]
    return simulate_with_mujoco(arm, TIME, torque, start(case, segments), max_step).positions(0, MARKERS)


@pytest.mark.parametrize(
    "case",
    [*CASES[:2], *(pytest.param(case, marks=pytest.mark.slow) for case in CASES[2:])],
    ids=lambda case: case.name,
)
def test_beam_is_the_limit_of_mujoco_chains(case: Case) -> None:
    # About the longest stable steps: the fastest damping rate grows with the fourth power of the number of segments.
    coarse, middle, fine = (mujoco_markers(case, *chain) for chain in ((8, 2e-4), (16, 1e-4), (32, 2.5e-5)))
    assert np.linalg.norm(middle - coarse) / np.linalg.norm(fine - middle) == pytest.approx(4.0, rel=0.1)
    # Richardson's extrapolation, twice: the error has even powers of a segment's length only.
    from_coarse, from_middle = middle + (middle - coarse) / 3.0, fine + (fine - middle) / 3.0
    limit = from_middle + (from_middle - from_coarse) / 15.0
    state = modal_state(case.beam, [case.tip]) if case.tip else None
    if case.beam.hub_radius:
        (motion,) = simulate_runs(case.beam, Physics(), TIME, [Run(case.torque)], step=5e-4)
        positions = motion.positions(MARKERS)
    else:
        positions = simulate(case.beam, TIME, case.torque, state).positions(MARKERS)
    # Measured: 1.5e-7 m driven (a turn of 1.1 rad, bending of 0.13 m from side to side), 8e-8 m in the decay from
    # 0.1 m, 8e-7 m loaded (tip moving by 0.18 m). The chain of 32 by itself is off by 8e-6, 2.4e-4 and 1.9e-4 m.
    np.testing.assert_allclose(positions, limit, atol=2e-6)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_mujoco_steps_are_short_enough(case: Case) -> None:
    short, long = (mujoco_markers(case, 16, max_step) for max_step in (1e-4, 2e-4))
    np.testing.assert_allclose(short, long, atol=5e-8)  # measured: 1.2e-8 m driven, 2e-11 m otherwise
