"""Forces of effects where theory says what they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.chain.beams import beam_chain, clamped_frequencies
from tests.effects.setups import FORE, LINK, POST, PRESENT, chain_of, placed_first, recording_of, revolute_arms
from tests.fine_beam import Beam
from tests.fine_beam.extended import Extended
from tests.fine_beam.hidden import Physics
from tests.model.arms import random_motion
from tests.simulation.integrators import trajectories_of
from vjm.chain.virtual_links import Array, Chain
from vjm.effects import (
    CoulombFriction,
    CubicStiffness,
    Effect,
    ExternalTone,
    Hysteresis,
    InPlaneGravity,
    JointSpring,
    LinearDrag,
    MarkerMass,
    PayloadBody,
    QuadraticDrag,
    RestCurvature,
    StateFunction,
    StiffnessDrift,
    Stribeck,
    StructuralDamping,
    TipPayload,
    ViscousFriction,
)
from vjm.model.modes import linearise, modes, modes_of
from vjm.records import NO_PAYLOAD, Payload, Recording, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import simulate_trajectories
from vjm.simulation.stick_slip import under_friction

HUB = chain_of(LINK)
# What has internal states may give back what it took: the contract follows it over a motion.
LOSSES = [effect for effect in PRESENT if effect.dissipative and not effect.nonsmooth]


def force(effect: Effect, chain: Chain, q: Array, v: Array, time: float = 0.0, states: Sequence[float] = ()) -> Array:
    motion = effect.force(chain, NO_PAYLOAD)
    assert motion is not None
    return motion(np.array(time), q, v, np.array(states))


def turning(chain: Chain, rate: float) -> tuple[Array, Array]:
    """A straight arm that turns about its first joint."""
    v = np.zeros(chain.size)
    v[0] = rate
    return np.zeros(chain.size), v


def test_drag_of_a_straight_link_is_that_of_a_turning_rod() -> None:
    rate, length = 1.7, LINK.length
    linear = force(LinearDrag(coefficient=0.3), HUB, *turning(HUB, rate))
    assert linear[0] == pytest.approx(-0.3 * rate * length**3 / 3)
    quadratic = force(QuadraticDrag(coefficient=0.3), HUB, *turning(HUB, rate))
    assert quadratic[0] == pytest.approx(-0.3 * rate**2 * length**4 / 4, rel=1e-4)
    # Beyond a joint at s the moment is that of what lies beyond.
    s = HUB.links[0].joint_arcs
    assert linear[1:] == pytest.approx(-0.3 * rate * ((length**3 - s**3) / 3 - s * (length**2 - s**2) / 2))


def test_drag_on_one_of_two_links_is_the_difference() -> None:
    chain = chain_of(LINK, FORE)
    q, v = turning(chain, 2.0)
    reach, length = LINK.length + FORE.length, LINK.length
    shares = [force(LinearDrag(coefficient=0.3, link=i), chain, q, v)[0] for i in (0, 1)]
    assert shares == pytest.approx([-0.2 * length**3, -0.2 * (reach**3 - length**3)])


@pytest.mark.parametrize("shift", [0.0, 3.7])
def test_drag_takes_nothing_from_a_link_that_does_not_move_or_moves_along_itself(shift: float) -> None:
    chain = chain_of(LINK, FORE)
    q, v = np.zeros((2, chain.size))
    assert force(LinearDrag(coefficient=0.3), chain, q + shift, v) == pytest.approx(0.0)
    # The second link at a right angle to a first one that turns, turning back as fast, moves along itself only.
    elbow = int(chain.active[1])
    q[elbow], v[0], v[elbow] = np.pi / 2, 1.0, -1.0
    assert force(LinearDrag(coefficient=0.3, link=1), chain, q, v) == pytest.approx(0.0, abs=1e-12)


def driven(push: np.ndarray, time: np.ndarray) -> Recording:
    """A recording of nothing but a torque."""
    known = recording_of(Rig("arm", (LINK,)))
    empty = {"theta": np.zeros((time.size, 1)), "markers": np.full((time.size, 1, 2), np.nan)}
    return replace(known, gravity=(0.0, 0.0), time=time, tau=push[:, None], payload=0.0, **empty)


@dataclass(frozen=True)
class GradualFriction(CoulombFriction):
    """Dry friction whose sign changes over a range of rates."""

    steepness: float = field(default=1e4, kw_only=True)

    def dry_friction(self, chain: Chain) -> None:
        return None

    def force(self, chain: Chain, payload: float) -> StateFunction:
        joint = self.active_joint(chain)
        return self.force_on(joint, lambda time, q, v, z: -self.torque * np.tanh(self.steepness * v[..., joint]))


def test_motion_with_dry_friction_depends_smoothly_on_parameters() -> None:
    """Searches need it to: steps do not meet the instants at which it slips, and must not show it to an encoder."""
    time = np.linspace(0.0, 2.0, 1001)
    push = 0.16 * np.sin(2 * np.pi * 1.1 * time) + 0.08 * np.sin(2 * np.pi * 3.7 * time)
    recording = driven(push, time)
    ends = []
    for factor in 1.0 + 2e-5 * np.arange(9):
        links = tuple(replace(link, stiffness=factor * link.stiffness) for link in HUB.links)
        arm = Arm.of(replace(HUB, links=links), (CoulombFriction(torque=0.008).placed(Rig("hub", (LINK,)), 0),))
        (steps,) = simulate_trajectories([arm], [recording], [np.zeros(HUB.size)], [np.zeros(HUB.size)])
        ends.append(steps.angles(time)[:, 0])
    bent = np.diff(np.array(ends), n=2, axis=0)
    assert np.ptp(ends[0]) > 0.1
    assert np.abs(bent).max() < 1e-6


@pytest.mark.parametrize("friction", [CoulombFriction(torque=0.02), Stribeck(torque=0.02, speed=0.1)])
def test_steps_with_dry_friction_are_short_enough(friction: Effect) -> None:
    """Angles (RMS) of a hub that slews and stops, beside those of steps an eighth as long."""
    rng, time, drives = np.random.default_rng(3), np.arange(301) / 200.0, 4
    recordings = []
    for _ in range(drives):
        draws = zip(rng.uniform(0.01, 0.06, 3), rng.uniform(0.2, 5.0, 3), rng.uniform(0.0, 6.0, 3), strict=True)
        torque = sum(size * np.sin(2 * np.pi * frequency * time + phase) for size, frequency, phase in draws)
        recordings.append(driven(np.where(time < 1.2, torque, 0.0), time))
    rest, arms = [np.zeros(HUB.size)] * drives, [Arm.of(HUB, (friction,))] * drives
    step = friction.max_step(HUB)
    coarse, fine = (
        np.stack([path.angles(time) for path in simulate_trajectories(arms, recordings, rest, rest, each)])
        for each in (step, step / 8)
    )
    assert (np.ptp(fine[:, :, 0], axis=1) > 0.01).sum() > 1
    assert np.sqrt(np.mean((coarse - fine) ** 2)) < 2.5e-7


@pytest.mark.slow
def test_dry_friction_beside_internal_states_is_the_limit_of_a_gradual_one() -> None:
    time = np.linspace(0.0, 1.0, 501)
    recording = driven(0.1 * np.sin(2 * np.pi * 1.1 * time) + 0.05 * np.sin(2 * np.pi * 3.7 * time), time)
    hysteresis, rest = Hysteresis(ratio=0.1, yield_angle=0.01), np.zeros(HUB.size)

    def angles(friction: Effect | None, *how: str | float) -> Array:
        found = []
        for effects in ((hysteresis, friction), (friction, hysteresis)):
            arm = Arm.of(HUB, tuple(effect for effect in effects if effect is not None))
            (steps,) = trajectories_of([arm], [recording], [rest], [rest], *how)  # type: ignore[arg-type]
            found.append(steps.angles(time)[:, 0])
        assert found[0] == pytest.approx(found[1], abs=1e-9)
        return found[0]

    dry = angles(CoulombFriction(torque=0.02))
    assert np.abs(angles(None) - dry).max() > 1e-2
    fine = angles(CoulombFriction(torque=0.02), "exponential", 2e-4)
    assert np.sqrt(np.mean((dry - fine) ** 2)) < 1e-6  # as `default_step` promises, where nothing sticks
    far, near = (
        np.abs(angles(GradualFriction(torque=0.02, steepness=steepness), "rk4", step) - dry).max()
        for steepness, step in ((1e3, 1e-4), (1e4, 2e-5))
    )
    assert near < 1e-4
    assert near < far / 5


@pytest.mark.parametrize(("push", "moves"), [((0.028, 0.0095), False), ((0.035, 0.0095), True), ((0.028, 0.015), True)])
def test_two_joints_are_held_each_by_its_own_friction(push: tuple[float, float], moves: bool) -> None:
    chain, rig = chain_of(LINK, FORE, n=2), Rig("arm", (LINK, FORE))
    time, rest = np.linspace(0.0, 0.5, 251), np.zeros(chain.size)
    torque = np.minimum(time, 0.2)[:, None] / 0.2 * np.array(push)
    recording = replace(driven(0.0 * time, time), tau=torque, theta=np.zeros((time.size, 2)))
    effects = [CoulombFriction(each).placed(rig, link) for link, each in ((0, 0.03), (1, 0.01))]
    (steps,) = simulate_trajectories([Arm.of(chain, effects)], [recording], [rest], [rest])
    largest = np.abs(steps.angles(time)[:, chain.active]).max()
    assert largest > 1e-3 if moves else largest < 1e-5


@pytest.mark.slow
def test_dry_friction_at_two_joints_is_the_limit_of_a_gradual_one() -> None:
    chain, rig = chain_of(LINK, FORE, n=2), Rig("arm", (LINK, FORE))
    time = np.linspace(0.0, 1.5, 751)
    push = 0.2 * np.sin(2 * np.pi * 0.9 * time)
    recording = replace(driven(push, time), tau=np.stack([push, 0.3 * push[::-1]], axis=1), theta=np.zeros((751, 2)))
    rest = np.zeros(chain.size)

    def angles(kind: Callable[[float], CoulombFriction], *how: str | float) -> Array:
        effects = [kind(torque).placed(rig, link) for link, torque in ((0, 0.03), (1, 0.01))]
        (steps,) = trajectories_of([Arm.of(chain, effects)], [recording], [rest], [rest], *how)  # type: ignore[arg-type]
        return steps.angles(time)[:, chain.active]

    dry = angles(CoulombFriction)
    assert np.ptp(dry, axis=0).min() > 0.05
    fine = angles(CoulombFriction, "exponential", 2e-4)
    assert np.sqrt(np.mean((dry - fine) ** 2)) < 1e-6  # as `default_step` promises, where nothing sticks
    far, near = (
        np.abs(angles(partial(GradualFriction, steepness=steepness), "rk4", step) - dry).max()
        for steepness, step in ((1e3, 1e-4), (1e4, 2e-5))
    )
    assert near < 3e-4
    assert near < far / 5


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(0.0, 2.0), st.floats(0.1, 2.0))
def test_a_joint_stops_at_once_and_starts_if_pushed_harder(
    rate: float, push: float, braking: float, duration: float
) -> None:
    """Two halves are the whole, and friction takes the work that is missing."""

    def stopped(rate: float, duration: float) -> float:
        with np.errstate(all="ignore"):
            start, pushed, braked, zero = np.array([[rate], [push], [braking], [0.0]])
            return float(under_friction(start, (pushed, zero), (braked, zero), duration)[0].after[0])

    end = stopped(rate, duration)
    assert stopped(stopped(rate, duration / 2), duration / 2) == pytest.approx(end, abs=1e-12)
    mean = (end - rate) / duration - push
    assert abs(mean) <= braking * (1 + 1e-9) + 1e-12
    if abs(push) <= braking and abs(rate) <= (braking - abs(push)) * duration:
        assert end == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("torque", [1e-3, pytest.param(0.008, marks=pytest.mark.slow), 0.05])
def test_dry_friction_sticks_slips_and_sticks_again(torque: float) -> None:
    """A rigid link on a hub, pushed gently, more than friction holds, and no more: by Coulomb's law, in closed form."""
    stiff = replace(HUB, links=tuple(replace(link, stiffness=300 * link.stiffness) for link in HUB.links))
    time = np.linspace(0.0, 3.0, 1501)
    push = np.where(time < 0.5, 1.8 * np.minimum(time, 0.4), np.where(time < 1.0, 3.0, 0.0)) * torque
    recording = driven(push, time)
    friction = CoulombFriction(torque=torque).placed(Rig("hub", (LINK,)), 0)
    arm, rest = Arm.of(stiff, (friction,)), np.zeros(stiff.size)
    (steps,) = simulate_trajectories([arm], [recording], [rest], [rest])
    angle = steps.angles(time)[:, 0]
    rate = torque / (LINK.hub_inertia + LINK.mass * LINK.length**2 / 3)  # of speeding up at 2, of slowing down at 1
    assert np.abs(angle[time < 0.5]).max() < 1e-4
    assert angle[np.searchsorted(time, 1.0)] == pytest.approx(0.5 * 2 * rate * 0.5**2, rel=0.01, abs=1e-4)
    assert angle[-1] == pytest.approx(0.5 * 2 * rate * 0.5**2 + 0.5 * rate * 1.0**2, rel=0.01, abs=1e-4)
    assert np.ptp(angle[time > 2.1]) < 2e-4


def test_joints_get_dampers_and_springs() -> None:
    chain = chain_of(POST, LINK)
    joint = chain.active[0]
    damped = ViscousFriction(coefficient=0.004, link=1).chain(ViscousFriction(coefficient=0.001, link=1).chain(chain))
    sprung = JointSpring(stiffness=0.05, link=1).chain(JointSpring(stiffness=0.02, link=1).chain(chain))
    assert damped.damping - chain.damping == pytest.approx(0.005 * (np.arange(chain.size) == joint))
    assert sprung.stiffness - chain.stiffness == pytest.approx(0.07 * (np.arange(chain.size) == joint))


def test_a_mass_on_the_tip_joins_the_one_that_is_there() -> None:
    chain = chain_of(POST, replace(LINK, payload=0.02))
    loaded = TipPayload(mass=0.01, radius_of_gyration=0.05).chain(TipPayload(0.03, 0.1).chain(chain))
    assert [link.payload for link in loaded.links] == pytest.approx([0.0, 0.06])
    assert [link.payload_inertia for link in loaded.links] == pytest.approx([0.0, 0.01 * 0.05**2 + 0.03 * 0.1**2])
    assert modes(TipPayload(mass=0.03).chain(HUB)).frequencies == pytest.approx(modes(HUB, Payload(0.03)).frequencies)
    beyond = TipPayload(0.01, 0.05, 0.09).chain(TipPayload(0.03, 0.1, -0.03).chain(chain)).links[1]
    assert (beyond.payload, beyond.payload_offset) == pytest.approx((0.06, 0.0))
    assert beyond.payload_inertia == pytest.approx(0.01 * (0.05**2 + 0.09**2) + 0.03 * (0.1**2 + 0.03**2))


def test_a_known_payload_that_is_no_point_is_the_body_that_it_is() -> None:
    rig = Rig("arm", (POST, replace(LINK, payload=0.02, payload_inertia=3e-5)))
    (effect,) = PayloadBody().variants(rig, [])
    effect = replace(effect, offset=-0.03, radius_of_gyration=0.05)
    recording = replace(recording_of(rig), payload=0.1, payload_offset=0.01)
    shown = effect.true_inputs(recording)
    assert shown.payload_body == pytest.approx((0.1, -0.02, 0.1 * 0.05**2))
    assert shown.markers is recording.markers
    bare = replace(recording, payload=0.0, payload_offset=0.0)
    assert effect.true_inputs(bare) is bare
    chain, other = chain_of(*rig.links), TipPayload(mass=0.01, radius_of_gyration=0.1, offset=0.04, link=1)
    body = Payload(0.02, -0.03, 3e-5 + 0.02 * 0.05**2)
    assert effect.chain(chain).links[1].payload_body == pytest.approx(body)
    both = body.with_another(Payload(0.01, 0.04, 0.01 * 0.1**2))
    for last, first in ((effect, other), (other, effect)):  # whichever a search found first
        assert last.chain(first.chain(chain)).links[1].payload_body == pytest.approx(both)


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=6), st.floats(1e-5, 1.0))
def test_markers_that_weigh_something_are_points_on_the_link(fractions: list[float], mass: float) -> None:
    """Mass, and first and second moment about the proximal end, whichever virtual links they are on."""
    chain = chain_of(POST, LINK)
    arcs = [fraction * chain.links[1].length for fraction in fractions]
    heavy = MarkerMass(mass=mass, arcs=tuple(arcs), link=1).chain(chain)
    assert heavy.links[0] is chain.links[0]

    def moments(of: Chain) -> Array:
        link = of.links[1]
        places = np.cumsum(link.lengths) - link.lengths + link.mass_centers
        second = link.inertias.sum() + link.masses @ places**2
        return np.array([link.masses.sum(), link.masses @ places, second])

    added = mass * np.array([[1.0, arc, arc**2] for arc in arcs]).sum(axis=0)
    assert moments(heavy) - moments(chain) == pytest.approx(added, rel=1e-9, abs=1e-12)
    assert (heavy.links[1].inertias >= 0).all()


@pytest.mark.parametrize("arcs", [(0.2, 0.4, 0.6, 0.8, 1.0), (0.13, 0.47, 0.71)])
def test_markers_leave_a_chain_s_frequencies_accurate_to_fourth_order(arcs: tuple[float, ...]) -> None:
    beam = Beam(1.0, 0.44, 1.97)
    continuous = Extended(beam, Physics(marker_mass_mass=0.005, marker_mass_arcs=arcs), size=14, nodes=28)
    expected = continuous.modes()[0][:2] / (2 * np.pi)
    errors = []
    for n in (8, 16):
        chain = chain_of(replace(LINK, joint="clamped", hub_inertia=0.0, mass=0.44, bending_stiffness=1.97), n=n)
        heavy = MarkerMass(mass=0.005, arcs=arcs).chain(chain)
        errors.append(modes(heavy).frequencies[:2] / expected - 1)
    assert np.abs(errors[0]).max() < 1.1e-4
    assert (np.abs(errors[1]) < np.abs(errors[0]) / 8).all()


def test_a_marker_on_the_tip_is_a_payload() -> None:
    marker = MarkerMass(mass=0.03, arcs=(LINK.length,)).chain(HUB)
    assert modes(marker).frequencies == pytest.approx(modes(TipPayload(mass=0.03).chain(HUB)).frequencies)


def test_an_arm_carries_its_payload_as_effects_say() -> None:
    arm = Arm.of(HUB, (PayloadBody(offset=0.02, radius_of_gyration=0.03), InPlaneGravity(gx=0.5)))
    payload, gravity = arm.loads(Payload(0.1))
    assert payload == pytest.approx((0.1, 0.02, 0.1 * 0.03**2))
    assert gravity == pytest.approx((HUB.gravity[0] + 0.5, HUB.gravity[1]))
    assert arm.loads()[0] == Payload()


def test_a_body_on_the_tip_makes_the_frequencies_of_the_characteristic_equation() -> None:
    beam, extended = beam_chain(32, distal="joined"), Beam(1.0, 1.0, 1.0)  # an end that carries a moment
    for mass, radius in ((0.02, 0.0), (0.02, 0.2), (0.3, 0.05), (0.3, 0.25)):
        exact = clamped_frequencies(3, mass, mass * radius**2)
        chain = TipPayload(mass, radius).chain(beam)
        assert modes(chain).frequencies[:3] == pytest.approx(exact, rel=2e-4)
        physics = Physics(tip_payload_mass=mass, tip_payload_radius_of_gyration=radius)
        pulsations = Extended(extended, physics).modes()[0][:3]
        assert pulsations / (2 * np.pi) == pytest.approx(exact, rel=1e-6)


def test_a_body_beyond_the_tip_makes_the_frequencies_of_two_other_simulators() -> None:
    pytest.importorskip("mujoco")
    from tests.mujoco_arm.chain import Arm, Link

    for mass, radius, offset in ((0.02, 0.0, 0.05), (0.3, 0.05, 0.1), (0.1, 0.1, -0.2)):
        body = {"payload": mass, "payload_offset": offset, "payload_inertia": mass * radius**2}
        rods = Arm((Link("beam", 1.0, 1.0, 1.0, joint="clamped", **body),), segments=60).natural_frequencies(3)
        chain = TipPayload(mass, radius, offset).chain(beam_chain(32, distal="joined"))
        physics = Physics(tip_payload_mass=mass, tip_payload_radius_of_gyration=radius, tip_payload_offset=offset)
        fine = Extended(Beam(1.0, 1.0, 1.0), physics).modes()[0][:3] / (2 * np.pi)
        assert modes(chain).frequencies[:3] == pytest.approx(fine, rel=1e-3)
        assert rods == pytest.approx(fine, rel=1e-3)
        centred = TipPayload(mass, radius).chain(beam_chain(32, distal="joined"))
        assert modes(centred).frequencies[0] != pytest.approx(fine[0], rel=2e-3)


def test_gravity_adds_up() -> None:
    recording = recording_of(Rig("arm", (LINK,)))
    tilted = InPlaneGravity(gx=0.2, gy=-0.3).true_inputs(recording)
    assert tilted.gravity == pytest.approx((recording.gravity[0] + 0.2, recording.gravity[1] - 0.3))
    assert tilted.markers is recording.markers


def test_curvature_at_rest_adds_up() -> None:
    once = RestCurvature(curvature=0.02, link=0).chain(HUB)
    twice = RestCurvature(curvature=-0.05, link=0).chain(once)
    assert [chain.links[0].rest_curvature for chain in (once, twice)] == pytest.approx([0.02, -0.03])


@pytest.mark.parametrize("links", [(LINK,), (POST,), (LINK, FORE)])
def test_structural_damping_gives_every_mode_half_the_loss_factor(links: Sequence) -> None:  # type: ignore[type-arg]
    chain = chain_of(*links, n=3, kelvin_voigt=0.0)
    effects = [StructuralDamping(loss_factor=0.02, link=i) for i in range(len(links))]
    M, _, K, _ = linearise(chain, Payload(0.05))
    C = sum(effect.modal_damping(chain, Payload(0.05)) for effect in effects)
    assert modes_of(M, C, K).damping_ratios == pytest.approx(0.01)
    # No loss without bending: a rigid turn, or a link with none of the strain energy.
    if links == (LINK,):
        v = np.eye(chain.size)[0]
        motion = effects[0].force(chain, Payload(0.05))
        assert motion is not None
        drift = v - modes_of(M, C, K).shapes @ (modes_of(M, C, K).shapes.T @ M @ v)
        still = effects[0].initial_states(chain, v)
        assert motion(np.array(0.0), v, drift, still) == pytest.approx(0.0, abs=1e-9)


def complex_stiffness(effect: Effect, chain: Chain, pulsation: float) -> Array:
    """What the effect adds to the stiffness (nv, nv) [N m/rad] in harmonic motion [rad/s], its states following it."""
    n = chain.size
    count = effect.initial_states(chain, np.zeros(n)).size
    units, still = np.eye(n), np.zeros((n, n))
    force, rates = effect.force(chain, NO_PAYLOAD), effect.state_rates(chain)
    assert force is not None
    assert rates is not None
    time, no_states = np.zeros(n), np.zeros((n, count))
    by_angle, by_rate = force(time, units, still, no_states), force(time, still, units, no_states)
    zeros = np.zeros((count, n))
    by_state = force(np.zeros(count), zeros, zeros, np.eye(count))
    driven = rates(time, still, units, no_states)
    relaxing = rates(np.zeros(count), zeros, zeros, np.eye(count))
    states = 1j * pulsation * driven @ np.linalg.inv(1j * pulsation * np.eye(count) - relaxing)
    return np.asarray(-(by_angle + 1j * pulsation * by_rate + states @ by_state).T)


@pytest.mark.parametrize("links", [(LINK,), (POST,), (LINK, FORE)])
@pytest.mark.parametrize("dispersion", [1.0, 0.4])
def test_structural_damping_loses_the_same_at_all_frequencies_and_stiffens_as_causality_asks(
    links: Sequence,  # type: ignore[type-arg]
    dispersion: float,
) -> None:
    chain, loss = chain_of(*links, n=6, kelvin_voigt=0.0), 0.02
    effect = StructuralDamping(loss_factor=loss, dispersion=dispersion, link=len(links) - 1)
    M, D, K, _ = linearise(chain)
    first = 2 * np.pi * modes_of(M, D, K).frequencies[0]
    part = effect.virtual_joints(chain)
    omega = 2 * np.pi * modes_of(M[part, part], D[part, part], K[part, part]).frequencies
    shapes = modes_of(M[part, part], D[part, part], K[part, part]).shapes
    relaxing = replace(effect, loss_factor=loss * dispersion, dispersion=1.0)
    # The slowest shape at all frequencies; the others where they swing.
    cases = [(0, f) for f in np.geomspace(omega[0] / 2, omega[2], 9)] + [*enumerate(omega[:5])][1:]
    for shape, pulsation in cases:
        a = shapes[:, shape] / omega[shape]
        found = a @ complex_stiffness(relaxing, chain, pulsation)[part, part] @ a
        assert found.imag == pytest.approx(loss * dispersion, rel=0.04)
        stiffening = 2 / np.pi * loss * dispersion * np.log(pulsation / first)
        # Elements that are dampers, each 10^(2/3) times as fast as the one before, stiffen in proportion to the square.
        spacing, fastest = np.log(10.0) / 1.5, 28.0 / 10 ** (5 / 1.5) * effect.units(chain)[2]
        omitted = 2 / np.pi * loss * dispersion * spacing * (pulsation * fastest) ** 2 / np.expm1(2 * spacing)
        assert found.real == pytest.approx(stiffening, abs=omitted * (shape < 3) + 0.015 * loss * dispersion)
    # The rest is a damper in each mode.
    rest = complex_stiffness(effect, chain, omega[0]) - complex_stiffness(relaxing, chain, omega[0])
    assert rest.real == pytest.approx(0.0, abs=1e-9)
    assert rest.imag == pytest.approx((1 - dispersion) * omega[0] * effect.modal_damping(chain, NO_PAYLOAD), abs=1e-9)


@pytest.mark.parametrize("longest", [2.0, 10.0, 50.0])
def test_structural_damping_ends_at_its_longest_time_constant(longest: float) -> None:
    """An even spectrum of time constants up to T loses 2 eta / pi arctan(omega T) of the strain energy."""
    chain, loss = chain_of(LINK, n=6, kelvin_voigt=0.0), 0.02
    plain = StructuralDamping(loss_factor=loss, link=0)
    end = longest * plain.units(chain)[2]
    effect, part = replace(plain, dispersion=1.0, longest_time_constant=end), plain.virtual_joints(chain)
    M, D, K, _ = linearise(chain)
    modes = modes_of(M[part, part], D[part, part], K[part, part])
    a = modes.shapes[:, 0] / (2 * np.pi * modes.frequencies[0])
    for pulsation in np.geomspace(0.1, 10.0, 7) / end:
        found = (a @ complex_stiffness(effect, chain, pulsation)[part, part] @ a).imag
        assert found == pytest.approx(2 / np.pi * loss * np.arctan(pulsation * end), abs=0.03 * loss)


def test_structural_damping_has_no_kink_along_its_longest_time_constant() -> None:
    """A fit would stay at one, where slopes on either side promise what no step keeps."""
    chain = chain_of(LINK, n=6, kelvin_voigt=0.0)
    plain = StructuralDamping(loss_factor=0.02, dispersion=1.0, link=0)
    ends = np.linspace(np.log(1.0), np.log(280.0), 1001)
    effects = (replace(plain, longest_time_constant=float(np.exp(end)) * plain.units(chain)[2]) for end in ends)
    slopes = np.diff([effect.relaxation(chain).moments for effect in effects], axis=0)
    # Intervals are 0.4 % of the elements' spacing, over which a slope changes by as much of the largest.
    assert np.abs(np.diff(slopes, axis=0)).max() < 0.01 * np.abs(slopes).max()


def test_structural_damping_of_one_link_follows_its_share_of_the_energy() -> None:
    stiff = chain_of(replace(LINK, bending_stiffness=1e5), replace(FORE, bending_stiffness=0.5), n=3, kelvin_voigt=0.0)
    M, _, K, _ = linearise(stiff)
    ratios = [
        modes_of(M, StructuralDamping(loss_factor=0.02, link=i).modal_damping(stiff, NO_PAYLOAD), K).damping_ratios[0]
        for i in (0, 1)
    ]
    assert ratios[0] < 1e-6
    assert ratios[1] == pytest.approx(0.01, rel=1e-3)


def test_cubic_stiffness_is_a_moment_of_the_curvature() -> None:
    link, rng = HUB.links[0], np.random.default_rng(1)
    q = 0.1 * rng.normal(size=HUB.size)
    found = force(CubicStiffness(coefficient=-0.3), HUB, q, q)
    curvature = q[1:] / link.cells
    assert found == pytest.approx(np.r_[0.0, 0.3 * LINK.bending_stiffness * curvature**3])


def test_drift_is_stiffness_in_proportion_to_time() -> None:
    q = 0.1 * np.random.default_rng(1).normal(size=HUB.size)
    found = force(StiffnessDrift(rate=0.002), HUB, q, q, time=3.0)
    assert found == pytest.approx(-0.006 * HUB.stiffness * q)


def test_a_tone_pushes_the_tip_sideways() -> None:
    effect = ExternalTone(amplitude=0.5, frequency=2.0, phase=0.3)
    still = np.zeros(HUB.size)
    arms = LINK.length - np.r_[0.0, HUB.links[0].joint_arcs]
    for time in (0.0, 0.1, 0.37):
        push = 0.5 * np.sin(4 * np.pi * time + 0.3)
        assert force(effect, HUB, still, still, time) == pytest.approx(push * arms)
    folded = still.copy()
    folded[-1] = np.pi / 2  # the last virtual link stands upright: the force is along the others
    assert force(effect, HUB, folded, still)[0] == pytest.approx(0.5 * np.sin(0.3) * HUB.links[0].lengths[-1])


def test_a_tone_is_searched_in_cosine_and_sine() -> None:
    effect = ExternalTone(amplitude=0.02, frequency=3.0, phase=-2.5, link=0)
    assert effect.coordinates == pytest.approx([4 * np.cos(2.5), -4 * np.sin(2.5), np.log(3 / 2.5)])
    again = effect.at(effect.coordinates)
    assert again.values == pytest.approx(effect.values)
    assert effect.at(-effect.coordinates).amplitude == pytest.approx(0.02)
    assert effect.at(np.array([0.0, 0.0, 0.5])).is_null
    assert effect.magnitude_count == 2


@settings(max_examples=25)
@given(revolute_arms(), st.integers(0, 99), st.sampled_from(LOSSES))
def test_dissipative_effects_never_do_positive_work(chain: Chain, seed: int, effect: Effect) -> None:
    q, v, _ = random_motion(chain, 30, seed)
    v *= np.logspace(-6, 1, 30)[:, None]
    present = placed_first(effect)
    extended = present.chain(chain)
    total = -v * v * (extended.damping - chain.damping)
    motion = present.force(extended, NO_PAYLOAD)
    if motion is not None:
        total = total + v * motion(np.zeros(30), q, v, np.zeros((30, 0)))
    power = total.sum(axis=-1)
    assert (power <= 1e-12 * np.abs(total).sum(axis=-1)).all()
    assert (power < 0).any()
