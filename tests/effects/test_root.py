"""What is soft or loose at a link's root."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.effects.setups import LINK, POST, chain_of
from tests.effects.test_forces import driven
from tests.fine_beam import Beam, Physics, Run, simulate_runs
from vjm.chain.virtual_links import Array
from vjm.effects import Backlash, ClampCompliance, Effect, GearElasticity, HubRadius, MarkerMass
from vjm.effects.contact import Contact
from vjm.model.modes import modes
from vjm.records import NO_PAYLOAD, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import simulate_trajectories
from vjm.simulation.measurement import MarkerArcs

HUB, CLAMPED = chain_of(LINK), chain_of(POST)
GAP = 0.01
# Of the flanks on this link: 1000 EI / l and 2.2 EI T / l with T^2 = m l^3 / EI.
STIFFNESS = 1000 * LINK.bending_stiffness / LINK.length
DAMPING = 2.2 * np.sqrt(LINK.bending_stiffness * LINK.mass * LINK.length)


def test_a_clamp_that_gives_way_is_a_spring_at_the_root() -> None:
    link = ClampCompliance(compliance=0.005).chain(CLAMPED).links[0]
    assert (link.root_stiffness, link.root_damping, link.root_inertia) == (200.0, 0.0, 0.0)


def test_frequencies_of_a_beam_on_a_spring_are_those_of_the_textbook() -> None:
    """Roots of 1 + cos z cosh z = c z (sin z cosh z - cos z sinh z), with c = EI compliance / L."""
    compliance = 0.2 / LINK.bending_stiffness
    found = modes(ClampCompliance(compliance=compliance).chain(chain_of(POST, n=10))).frequencies[:2]
    z = np.sqrt(2 * np.pi * found * LINK.length**2 * np.sqrt(LINK.mass / LINK.length / LINK.bending_stiffness))
    left = 1 + np.cos(z) * np.cosh(z)
    right = 0.2 * z * (np.sin(z) * np.cosh(z) - np.cos(z) * np.sinh(z))
    assert left == pytest.approx(right, rel=0.01)


@given(st.floats(0.01, 0.99), st.floats(1.0, 1e4), st.sampled_from([-1.0, 1.0]))
def test_a_joint_falls_across_its_gap(reverses: float, jerk: float, side: float) -> None:
    """Under an acceleration that passes zero at a constant rate, by the cube of time."""
    time = np.linspace(0.0, 2.0, 801)
    contact, elapsed = Contact(0, 0.01, 1.0, 0.0), np.maximum(time - reverses, 0.0)
    angle, rate, acceleration = contact.fall(time, side * jerk * (reverses - time))
    lands = (6 * 0.01 / jerk) ** (1 / 3)
    falls = (elapsed > 0) & (elapsed < lands * (1 - 1e-9))
    assert angle == pytest.approx(side * np.where(elapsed < lands, 0.005 - jerk * elapsed**3 / 6, -0.005), abs=1e-9)
    assert rate == pytest.approx(-side * np.where(falls, jerk * elapsed**2 / 2, 0.0), abs=1e-6)
    assert acceleration == pytest.approx(-side * np.where(falls, jerk * elapsed, 0.0), abs=1e-6)


@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=40), st.floats(1e-6, 0.1))
def test_a_joint_that_falls_stays_between_its_flanks(values: list[float], gap: float) -> None:
    """Whatever pulls it, and the same to either side."""
    time = np.arange(len(values)) / 100.0
    contact, acceleration = Contact(0, gap, 1.0, 0.0), np.array(values)
    motion = contact.fall(time, acceleration)
    assert np.isfinite(motion).all()
    assert np.abs(motion[0]).max() <= gap / 2 * (1 + 1e-9)
    assert contact.fall(time, -acceleration) == pytest.approx(-motion)


def test_a_gear_splits_the_hub() -> None:
    link = GearElasticity(stiffness=60.0).chain(HUB).links[0]
    assert link.root_stiffness == 60.0
    assert (link.hub_inertia, link.root_inertia) == pytest.approx((0.01, 0.01))
    stiff = modes(GearElasticity(stiffness=1e6).chain(HUB)).frequencies[:3]
    assert stiff == pytest.approx(modes(HUB).frequencies[:3], rel=1e-4)


def test_a_damper_is_beside_the_spring() -> None:
    clamp = ClampCompliance(compliance=0.005, damping=0.7).chain(CLAMPED).links[0]
    gear = GearElasticity(stiffness=60.0, damping=0.3).chain(HUB).links[0]
    assert (clamp.root_damping, gear.root_damping) == (0.7, 0.3)
    for absent in (ClampCompliance(damping=0.7), GearElasticity(damping=0.3)):
        assert absent.chain(HUB) is HUB


def test_a_motor_and_a_hub_lose_what_two_inertias_lose() -> None:
    """The link is so stiff and light that nothing else moves: ratio d (1/a + 1/b) / (2 omega) of critical damping."""
    rod = replace(LINK, bending_stiffness=2e5, mass=1e-4)
    chain = chain_of(rod, kelvin_voigt=0.0)
    mobility = 1 / 0.006 + 1 / (0.014 + rod.mass / 3)
    found = modes(GearElasticity(stiffness=60.0, motor_share=0.3, damping=0.05).chain(chain))
    pulsation = np.sqrt(60.0 * mobility)
    assert 2 * np.pi * found.frequencies[0] == pytest.approx(pulsation, rel=1e-4)
    assert found.damping_ratios[0] == pytest.approx(0.05 * mobility / (2 * pulsation), rel=1e-4)


DAMPED = GearElasticity(stiffness=60.0, motor_share=0.35, damping=0.3), ClampCompliance(compliance=0.01, damping=4.0)


def changes_by_effects(
    with_effects: tuple[Physics, list[Effect]], without: tuple[Physics, list[Effect]], n: int = 16
) -> tuple[Array, Array]:
    """By how much effects change the markers of a driven link, (T, 2 k) in m: of n virtual joints, and continuous."""
    time = np.linspace(0.0, 1.5, 751)
    torque = 0.2 * np.sin(5 * time) + 0.08 * np.sin(17 * time) + 0.2 * np.sin(60 * time)
    beam = Beam(LINK.length, LINK.mass, LINK.bending_stiffness, 1e-3, "revolute", LINK.hub_inertia)
    shown: list[tuple[Array, Array]] = []
    for physics, effects in (with_effects, without):
        (motion,) = simulate_runs(beam, physics, time, [Run(torque)])
        arm = Arm.of(chain_of(LINK, n=n), effects)
        rest = np.zeros(arm.chain.size)
        (steps,) = simulate_trajectories([arm], [driven(torque, time)], [rest], [rest])
        markers = MarkerArcs.of(Rig("hub", (LINK,))).positions(arm.chain, steps.angles(time))
        shown.append((markers.reshape(time.size, -1), motion.positions(LINK.markers).reshape(time.size, -1)))
    chain, other = (present - absent for present, absent in zip(*shown, strict=True))
    return chain, other


def physics_of(*effects: Effect | None) -> Physics:
    """Effects of the continuous beam."""
    present = [effect for effect in effects if effect is not None]
    return Physics(**{f"{each.id}_{name}": value for each in present for name, value in each.values.items()})


@pytest.mark.parametrize("effect", DAMPED, ids=lambda effect: effect.id)
def test_a_damper_acts_on_a_chain_as_on_a_continuous_beam(effect: GearElasticity | ClampCompliance) -> None:
    undamped = replace(effect, damping=0.0)
    chain, other = changes_by_effects((physics_of(effect), [effect]), (physics_of(undamped), [undamped]))
    assert np.abs(other).max() > 1e-4
    assert np.sqrt(np.mean((chain - other) ** 2)) < 0.02 * np.sqrt(np.mean(other**2))


ROOTS = None, GearElasticity(stiffness=20.0, motor_share=0.35), ClampCompliance(compliance=0.05)


@pytest.mark.parametrize("root", ROOTS, ids=["rigid", "gear", "clamp"])
def test_a_hub_s_radius_acts_on_a_chain_as_on_a_continuous_beam(root: Effect | None) -> None:
    """A gear is at the axis, a compliant clamp on the rim."""
    hub, roots = HubRadius(radius=0.15), [] if root is None else [root]
    chain, other = changes_by_effects((physics_of(hub, root), [hub, *roots]), (physics_of(root), roots))
    assert np.sqrt(np.mean((chain - other) ** 2)) < 1e-4 < 0.05 * np.sqrt(np.mean(other**2))


def test_heavy_markers_act_on_a_chain_as_on_a_continuous_beam() -> None:
    arcs = (0.13, 0.5, 0.77, 1.0)
    heavy, light = Physics(marker_mass_mass=0.02, marker_mass_arcs=arcs), Physics()
    chain, other = changes_by_effects((heavy, [MarkerMass(mass=0.02, arcs=arcs)]), (light, []), n=32)
    assert np.sqrt(np.mean((chain - other) ** 2)) < 2e-6 < 1e-4 * np.sqrt(np.mean(other**2))


def test_springs_at_one_root_are_in_series_in_any_order() -> None:
    effects = [
        GearElasticity(stiffness=60.0, damping=0.3),
        ClampCompliance(compliance=0.02, damping=0.7),
        Backlash(gap=GAP, flank_stiffness=STIFFNESS, flank_damping=DAMPING),
    ]
    chains = []
    for order in ([0, 1, 2], [2, 1, 0], [1, 2, 0]):
        chain = HUB
        for k in order:
            chain = effects[k].chain(chain)
        chains.append(chain.links[0])
    for link in chains:
        assert link.root_stiffness == pytest.approx(1 / (1 / 60 + 0.02 + 1 / STIFFNESS))
        # Each damper takes its share of the turn, squared.
        shares = np.array([1 / 60, 0.02, 1 / STIFFNESS]) * link.root_stiffness
        assert link.root_damping == pytest.approx(shares**2 @ [0.3, 0.7, DAMPING])
        assert (link.hub_inertia, link.root_inertia) == pytest.approx((0.01, 0.01))


def flank_torque(twist: Array, rate: float = 0.0, gap: float = GAP) -> Array:
    """Torque of motor on hub."""
    arm = Arm.of(HUB, [Backlash(link=0, gap=gap, flank_stiffness=STIFFNESS, flank_damping=DAMPING)])
    (contact,), root, (stiffness, damping) = arm.contacts, arm.chain.roots[0], arm.springs
    assert arm.forces(NO_PAYLOAD) is None
    assert contact.joint == root
    # Apart from its flanks the joint turns freely, and they change nothing else.
    assert (stiffness[root], damping[root]) == (0.0, 0.0)
    assert np.delete(stiffness, root).tolist() == np.delete(arm.chain.stiffness, root).tolist()
    rates = np.full(twist.shape, rate)
    pushes = contact.event_function(twist, rates) > 0.0
    return np.where(pushes, -np.sign(twist) * contact.resistance(twist, rates), 0.0)


def test_nothing_is_passed_on_inside_the_gap() -> None:
    inside = np.linspace(-0.49, 0.49, 31) * GAP
    assert flank_torque(inside, rate=0.3) == pytest.approx(0.0, abs=1e-4)


def test_flanks_push_and_never_pull() -> None:
    apart = np.array([0.501, 0.55, 0.75]) * GAP
    leaving = flank_torque(apart, rate=-100.0)
    assert leaving == pytest.approx(0.0, abs=1e-12)
    assert (flank_torque(apart, rate=0.1) < flank_torque(apart)).all()


def test_flanks_are_stiff_and_damped_beyond_the_gap() -> None:
    beyond = np.array([0.75, 1.0, 3.0]) * GAP
    for side in (1, -1):
        found = flank_torque(side * beyond)
        assert found == pytest.approx(-side * STIFFNESS * (beyond - GAP / 2), rel=1e-3)
        assert flank_torque(side * beyond, rate=0.3) - found == pytest.approx(-0.3 * DAMPING, rel=1e-3)


def test_the_torque_is_odd_and_falls_with_the_twist() -> None:
    twist = np.linspace(-GAP, GAP, 4001)
    found = flank_torque(twist)
    assert found == pytest.approx(-found[::-1], abs=1e-9)
    assert (np.diff(found) <= 1e-9).all()


def test_other_states_have_the_same_hub_on_either_flank_and_between_them() -> None:
    effect = Backlash(gap=GAP)
    chain = effect.chain(HUB)
    motor, root, n = chain.active[0], chain.roots[0], chain.size
    state = np.random.default_rng(1).standard_normal(2 * n)
    others = effect.other_states(chain, state)
    assert others[:, root] == pytest.approx([-GAP / 2, 0.0, GAP / 2])
    assert not others[:, n + root].any()
    for start in (0, n):  # angles, rates
        hub = others[:, start + motor] + others[:, start + root]
        assert hub == pytest.approx(state[start + motor] + state[start + root])
    rest = np.setdiff1d(np.arange(2 * n), [motor, root, n + motor, n + root])
    assert (others[:, rest] == state[rest]).all()


def test_a_huge_twist_does_not_overflow() -> None:
    with np.errstate(over="raise", invalid="raise"):
        assert np.isfinite(flank_torque(np.array([-50.0, 50.0]), gap=1e-6)).all()
