"""A taper and a stiffness that differs from side to side, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.effects.setups import FORE, LINK, POST, chain_of
from tests.effects.test_forces import driven
from tests.fine_beam.wedge import wedge_pulsations
from vjm.chain.layout import layout_of_lengths, uniform_chain
from vjm.chain.virtual_links import Array, Chain, LinkChain
from vjm.effects import StiffnessAsymmetry, Taper
from vjm.model.modes import modes
from vjm.records import NO_PAYLOAD
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import simulate_trajectories


def frequency_errors(taper: float, n: int) -> Array:
    """Relative errors of the first three natural frequencies of a tapered chain."""
    found = 2 * np.pi * modes(Taper(taper=taper).chain(chain_of(POST, n=n))).frequencies[:3]
    return np.asarray(found / wedge_pulsations(POST.length, POST.mass, POST.bending_stiffness, taper, 3) - 1)


@pytest.mark.parametrize("taper", [0.05, 0.5, 1.0])
def test_a_tapered_chain_has_the_frequencies_of_a_truncated_wedge(taper: float) -> None:
    coarse, fine = frequency_errors(taper, 6), frequency_errors(taper, 24)
    assert np.abs(fine) == pytest.approx(0.0, abs=5e-5)
    # Fourth order in the joints: 256 times less, or a hundred at least; a cell's compliance gives 16 times less.
    assert (np.abs(fine) < np.abs(coarse) / 100).all()


def moments(link: LinkChain, order: int) -> float:
    """Integral of the mass times a power of the arc length, of rods on one line."""
    centers = np.cumsum(link.lengths) - link.lengths + link.mass_centers
    second = link.inertias if order == 2 else 0.0
    return float((link.masses * centers**order + second).sum())


@given(st.floats(-0.99, 0.99), st.integers(1, 9))
def test_mass_goes_with_the_thickness(taper: float, n: int) -> None:
    """To the second moment, link by link of the chain: nothing is integrated approximately."""
    chain = chain_of(LINK, POST, n=n)
    link = Taper(taper=taper, link=0).chain(chain).links[0]
    # Integrals over s of s^k (1 + taper (1/2 - s)) on a link of length one.
    exact = [LINK.mass * ((1 + taper / 2) / (k + 1) - taper / (k + 2)) for k in range(3)]
    assert [moments(link, order) for order in range(3)] == pytest.approx(exact)
    starts = np.cumsum(link.lengths) - link.lengths
    ends = starts + link.lengths
    assert link.masses == pytest.approx(
        LINK.mass * ((1 + taper / 2) * (ends - starts) - taper * (ends**2 - starts**2) / 2)
    )
    assert (link.inertias > 0).all()


@given(st.floats(-0.99, 0.99), st.lists(st.floats(0.05, 1.0), min_size=2, max_size=8))
def test_joints_are_as_stiff_as_the_section_where_they_are(taper: float, lengths: list[float]) -> None:
    """However the link is cut."""
    cuts = layout_of_lengths(np.array(lengths) / sum(lengths))
    link = uniform_chain(POST, cuts, kelvin_voigt=1e-3)
    (tapered,) = Taper(taper=taper).chain(Chain("post", (link,))).links
    section = (1 + taper * (0.5 - link.joint_arcs)) ** 3
    assert tapered.stiffness == pytest.approx(section * link.stiffness)
    assert tapered.damping == pytest.approx(section * link.damping)
    assert tapered.masses.sum() == pytest.approx(POST.mass)
    assert (tapered.inertias > 0).all()


def test_a_taper_of_one_link_leaves_the_others() -> None:
    chain = chain_of(LINK, FORE)
    found = Taper(taper=0.1, link=1).chain(chain)
    assert found.links[0] is chain.links[0]
    assert found.links[1].masses.sum() == pytest.approx(FORE.mass)


def push(ratio: float, q: Array, chain: Chain) -> Array:
    motion = StiffnessAsymmetry(ratio=ratio).force(chain, NO_PAYLOAD)
    assert motion is not None
    return motion(np.zeros(q.shape[:-1]), q, 0 * q, np.zeros((*q.shape[:-1], 0)))


@given(st.floats(-0.9, 0.9), st.integers(0, 99))
def test_each_side_has_a_stiffness_of_its_own(ratio: float, seed: int) -> None:
    chain = chain_of(LINK)
    q = 0.1 * np.random.default_rng(seed).normal(size=(20, chain.size))
    total = push(ratio, q, chain) - chain.stiffness * q
    left = np.where(q > 0, 1 + ratio, 1 - ratio)
    assert total == pytest.approx(-chain.stiffness * left * q)


def test_a_decay_swings_farther_to_the_soft_side_and_keeps_the_sum_of_both_half_periods() -> None:
    """Of one joint: energy gives the ratio of both amplitudes, and each half swing is half a period of its own side."""
    ratio, turn = 0.3, 0.01
    plain = chain_of(POST, n=1, kelvin_voigt=0.0)
    time = np.linspace(0.0, 4.0, 4001)
    recording = replace(driven(np.zeros(time.size), time), tau=np.zeros((time.size, 0)), theta=np.zeros((time.size, 0)))
    arm = Arm.of(plain, (StiffnessAsymmetry(ratio=ratio),))
    (steps,) = simulate_trajectories([arm], [recording], [np.array([turn])], [np.zeros(1)])
    angle = steps.angles(time)[:, 0]
    assert angle.min() / turn == pytest.approx(-np.sqrt((1 + ratio) / (1 - ratio)), rel=1e-3)
    period = 0.5 / modes(plain).frequencies[0] * (1 / np.sqrt(1 + ratio) + 1 / np.sqrt(1 - ratio))
    down = np.flatnonzero((angle[:-1] > 0) & (angle[1:] <= 0))
    crossings = time[down] + 1e-3 * angle[down] / (angle[down] - angle[down + 1])
    assert np.diff(crossings) == pytest.approx(period, rel=1e-3)


def test_default_steps_are_short_enough_for_the_kink() -> None:
    chain, time = chain_of(LINK), np.linspace(0.0, 3.0, 1501)
    recording = driven(0.24 * np.sin(5 * time) + 0.08 * np.sin(17 * time) + 0.05 * np.sin(33 * time), time)
    arm, rest = Arm.of(chain, (StiffnessAsymmetry(ratio=0.05),)), np.zeros(chain.size)
    ways = [simulate_trajectories([arm], [recording], [rest], [rest], step)[0].angles(time) for step in (None, 5e-4)]
    assert np.abs(ways[0] - ways[1]).max() < 2e-5  # rad of a joint; a fifth of an encoder's noise
