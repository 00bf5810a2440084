"""A table that moves under the base: rigid bodies from first principles, a beam on a spring, and a continuous beam."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from tests.diagnosis import rigs
from tests.effects.setups import FORE, LINK, POST, chain_of
from tests.effects.test_forces import driven
from tests.effects.test_rods import drawn
from tests.fine_beam import Beam, Physics, Run, simulate_runs
from tests.model.arms import arms, random_motion
from vjm.chain.curve import transfer_state
from vjm.chain.virtual_links import Array, Chain
from vjm.effects import BaseCompliance, ExternalTone, GearElasticity, LinearDrag
from vjm.effects.loads import Rods
from vjm.identification.parameters import Parametrisation
from vjm.identification.trajectory_fit import TrajectoryProblem
from vjm.model.dynamics import Mechanism, torque_errors
from vjm.model.modes import linearise, modes
from vjm.records import NO_PAYLOAD, Payload, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import simulate_trajectories
from vjm.simulation.measurement import MarkerArcs
from vjm.simulation.variational_equations import PerturbedArm

TABLE = BaseCompliance(stiffness=2000.0, mass=3.0, direction=0.7, damping_ratio=0.02)
STEP = 1e-6


def moving(chain: Chain, direction: float = 0.7) -> Chain:
    return replace(TABLE, direction=direction).chain(chain)


def test_the_chain_gets_one_joint_more_the_first() -> None:
    plain, chain = chain_of(POST, LINK), moving(chain_of(POST, LINK))
    assert chain.joint_names == ("base_slide", *plain.joint_names)
    assert [part.start for part in chain.passive_slices] == [part.start + 1 for part in plain.passive_slices]
    assert chain.active.tolist() == (plain.active + 1).tolist()
    assert chain.passive.tolist() == [0, *(plain.passive + 1).tolist()]
    assert (chain.stiffness[0], chain.damping[0]) == pytest.approx((2000.0, 2 * 0.02 * np.sqrt(2000.0 * 3.0)))
    assert chain.elbows.tolist() == (plain.elbows + 1).tolist() == chain.active.tolist()
    assert moving(chain_of(LINK)).elbows.size == 0
    assert chain.stiffness[1:].tolist() == plain.stiffness.tolist()


@settings(max_examples=25)
@given(arms(), st.floats(-4, 4), st.integers(0, 99))
def test_kinetic_energy_is_that_of_the_bodies(arm: Chain, direction: float, seed: int) -> None:
    """Of all of them, placed as on the ground and moved along with the table: what Lagrange's equations follow from."""
    chain = moving(arm, direction)
    q, v, _ = random_motion(chain, 1, seed)
    centers, rods = np.concatenate([link.mass_centers for link in arm.links]), Rods(arm)
    of_links = rods.owners >= 0

    def places(angles: Array, distances: Array) -> Array:
        along = np.zeros(of_links.size)
        along[of_links] = distances
        return drawn(arm, angles, along)[0][of_links]

    centers_of_payloads = np.concatenate([link.lengths for link in arm.links])
    tips = np.cumsum([link.lengths.size for link in arm.links]) - 1
    centers_of_payloads[tips] += [link.payload_offset for link in arm.links]

    def rates(distances: Array) -> Array:
        ahead, behind = (places(q[0, 1:] + sign * STEP * v[0, 1:], distances) for sign in (1, -1))
        return (ahead - behind) / (2 * STEP) + v[0, 0] * np.array([np.cos(direction), np.sin(direction)])

    turning = rods.motion(rods.directions(q[0, 1:]), v[0, 1:])[0][of_links]
    energy = 0.5 * TABLE.mass * v[0, 0] ** 2
    masses, inertias = (np.concatenate([getattr(link, name) for link in arm.links]) for name in ("masses", "inertias"))
    energy += 0.5 * (masses @ (rates(centers) ** 2).sum(axis=1) + inertias @ turning**2)
    carried = np.array([link.payload for link in arm.links])
    energy += 0.5 * carried @ (rates(centers_of_payloads)[tips] ** 2).sum(axis=1)
    energy += 0.5 * np.array([link.payload_inertia for link in arm.links]) @ turning[tips] ** 2
    firsts = tips + 1 - [link.lengths.size for link in arm.links]  # hubs turn with them
    energy += 0.5 * np.array([link.hub_inertia for link in arm.links]) @ turning[firsts] ** 2
    mass = Mechanism(chain).mass_matrix(q)[0]
    assert 0.5 * v[0] @ mass @ v[0] == pytest.approx(energy, rel=1e-6)


@settings(max_examples=25)
@given(arms(), st.floats(-4, 4), st.integers(0, 99))
def test_forces_on_rods_move_the_table_as_virtual_work_says(arm: Chain, direction: float, seed: int) -> None:
    chain = moving(arm, direction)
    q, v, _ = random_motion(chain, 1, seed)
    rods, plain = Rods(chain), Rods(arm)
    turned = rods.directions(q[0])
    _, normal = rods.motion(turned, v[0])
    slide = np.cos(direction - np.angle(turned * 1j))  # of each normal
    assert normal == pytest.approx(plain.motion(turned, v[0, 1:])[1] + v[0, 0] * slide)
    force = np.random.default_rng(seed).normal(size=turned.size)
    found = rods.torques(turned, force, 0 * force)
    assert found[0] == pytest.approx(force @ slide)
    assert found[1:] == pytest.approx(plain.torques(turned, force, 0 * force))
    assert found @ v[0] == pytest.approx(force @ normal)


def test_weight_moves_nothing_but_the_arm() -> None:
    """The table stands where its load holds it; what it carries hangs as on the ground."""
    plain, gravity = chain_of(POST), (3.0, -9.81)
    chain = moving(plain)
    rest = linearise(chain, Payload(0.05), gravity)[3]
    assert rest[0] == pytest.approx(0.0, abs=1e-12)
    assert rest[1:] == pytest.approx(linearise(plain, Payload(0.05), gravity)[3], abs=1e-12)
    mechanism, still = Mechanism(chain, Payload(0.05), gravity), np.zeros((1, chain.size))
    a = mechanism.forward_dynamics(rest[None], still, -chain.stiffness * rest[None])
    assert a == pytest.approx(still, abs=1e-6)
    assert mechanism.inverse_dynamics(rest[None], still, a)[0] == pytest.approx(-chain.stiffness * rest, abs=1e-9)


def test_it_falls_with_a_payload_only_where_that_was_not_there() -> None:
    chain = moving(chain_of(LINK))
    errors = torque_errors(
        chain, *np.zeros((3, 4, chain.size)), np.zeros((4, 1)), payload=Payload(0.1), gravity=(0.0, 0.0)
    )
    assert not errors.any()


def sprung(pulsation: float, stiffness: float, mass: float) -> float:
    """Zero at the natural frequencies of a beam whose root slides across it on a spring and carries a mass there."""
    z = np.sqrt(pulsation) * (LINK.mass / LINK.length / LINK.bending_stiffness) ** 0.25
    cos, sin, cosh, sinh = np.cos(z), np.sin(z), np.cosh(z), np.sinh(z)
    held = stiffness - mass * pulsation**2  # times the root's displacement: the shear force there, EI w'''
    bent = LINK.bending_stiffness * z**3
    rows = [[0, 1, 0, 1], [held, -bent, held, bent], [-cos, -sin, cosh, sinh], [sin, -cos, sinh, cosh]]
    scale = np.array([[1.0], [stiffness], [cosh], [cosh]])
    return float(np.linalg.det(np.array(rows) / scale))


def test_frequencies_are_those_of_a_beam_on_a_sliding_root() -> None:
    chain = moving(chain_of(POST, n=16), np.pi / 2)
    for found in 2 * np.pi * modes(chain).frequencies[:4]:
        exact = brentq(sprung, 0.99 * found, 1.01 * found, args=(2000.0, 3.0), xtol=1e-12)
        assert found == pytest.approx(exact, rel=3e-4)
    along = modes(moving(chain_of(POST, n=8), 0.0)).frequencies
    assert np.abs(2 * np.pi * along - np.sqrt(2000.0 / 3.44)).min() < 1e-6  # as one rigid body


def shaken(direction: float, n: int) -> tuple[Array, Array]:
    """What a table adds to markers (T, k, 2) and encoder (T,) of a driven arm, in a chain and in a continuous beam."""
    time = np.linspace(0.0, 1.5, 751)
    torque = 0.2 * np.sin(5 * time) + 0.08 * np.sin(17 * time)
    chain, rig = chain_of(LINK, n=n), Rig("hub", (LINK,))
    beam = Beam(LINK.length, LINK.mass, LINK.bending_stiffness, 1e-3, "revolute", LINK.hub_inertia)
    table = replace(TABLE, direction=direction)
    values = {f"base_compliance_{name}": value for name, value in table.values.items()}
    shown: list[tuple[Array, Array]] = []
    for effects, physics in (((), Physics()), ((table,), Physics(**values))):
        arm = Arm.of(chain, effects)
        rest = np.zeros(arm.chain.size)
        (steps,) = simulate_trajectories([arm], [driven(torque, time)], [rest], [rest])
        (motion,) = simulate_runs(beam, physics, time, [Run(torque)])
        q = steps.angles(time)
        markers, angles = MarkerArcs.of(rig).positions(arm.chain, q), q[:, arm.chain.active]
        other = motion.positions(LINK.markers)
        one, two = (each.reshape(time.size, -1) for each in (markers, other))
        shown.append((np.hstack([one, angles]), np.hstack([two, motion.theta[:, None]])))
    return shown[1][0] - shown[0][0], shown[1][1] - shown[0][1]


@pytest.mark.parametrize("direction", [0.7, *(pytest.param(each, marks=pytest.mark.slow) for each in (0.0, 1.9))])
def test_it_shakes_a_chain_as_it_does_a_continuous_beam(direction: float) -> None:
    chain, beam = shaken(direction, 16)
    assert np.abs(beam).max() > 1e-4
    assert np.sqrt(np.mean((chain - beam) ** 2)) < 0.01 * np.sqrt(np.mean(beam**2))


def test_steps_follow_a_light_table_too() -> None:
    chain, time = chain_of(LINK), np.linspace(0.0, 3.0, 1501)
    recording = driven(0.24 * np.sin(5 * time) + 0.08 * np.sin(17 * time) + 0.05 * np.sin(33 * time), time)
    for table in (TABLE, replace(TABLE, mass=0.3, stiffness=4e4, direction=1.7)):
        arm = Arm.of(chain, (table,))
        rest = np.zeros(arm.chain.size)
        coarse, fine = (simulate_trajectories([arm], [recording], [rest], [rest], step)[0] for step in (None, 5e-4))
        assert np.abs(coarse.angles(time) - fine.angles(time)).max() < 2e-5


def test_a_state_is_taken_to_a_table_and_back() -> None:
    plain, chain = chain_of(LINK), moving(chain_of(LINK))
    state = np.random.default_rng(1).normal(size=2 * plain.size)
    there = transfer_state(plain, chain, state)
    assert there.reshape(2, -1)[:, 0].tolist() == [0.0, 0.0]
    assert transfer_state(chain, plain, there) == pytest.approx(state)
    assert transfer_state(chain, chain, there + 1) == pytest.approx(there + 1)


def test_a_camera_on_the_ground_sees_it_move_and_one_on_a_turning_link_does_not() -> None:
    q = np.zeros(1 + chain_of(POST, FORE).size)
    q[0] = 0.02
    for frame, moved in (("base", [1.0, 1.0]), ("link", [1.0, 0.0])):
        rig = Rig("arm", (replace(POST, markers_frame=frame), replace(FORE, markers_frame=frame, markers=(0.7,))))
        plain = MarkerArcs.of(rig).positions(chain_of(POST, FORE), q[1:])
        seen = MarkerArcs.of(rig).positions(moving(chain_of(POST, FORE)), q)
        expected = 0.02 * np.outer(moved, [np.cos(0.7), np.sin(0.7)])
        assert seen - plain == pytest.approx(expected)


def test_it_goes_with_other_effects_in_any_order() -> None:
    others = GearElasticity(stiffness=60.0), LinearDrag(coefficient=0.1), ExternalTone(amplitude=0.1)
    one, two = (Arm.of(chain_of(LINK), effects) for effects in ((TABLE, *others), (*others, TABLE)))
    assert one.chain.joint_names == two.chain.joint_names
    q, v = np.random.default_rng(2).normal(size=(2, one.chain.size))
    forces = [arm.forces(NO_PAYLOAD) for arm in (one, two)]
    found = [force(np.array(0.3), q, v, np.zeros(0)) for force in forces if force is not None]
    assert found[0] == pytest.approx(found[1])
    assert found[0][0] != 0.0


def test_a_search_keeps_the_frequency_and_takes_any_direction() -> None:
    """At a given frequency the motion is linear in the compliance; at the null the mass says the frequency."""
    absent = BaseCompliance().placed(Rig("hub", (LINK,)), None)
    present, softer = (absent.at(np.array([size, 0.3, 0.5, 0.0])) for size in (0.02, 0.04))
    assert softer.stiffness / softer.mass == pytest.approx(present.stiffness / present.mass)
    assert softer.stiffness == pytest.approx(present.stiffness / 2)
    assert absent.at(np.array([0.0, 0.3, 0.5, 0.0])).coordinates == pytest.approx([0.0, 0.3, 0.5, 0.0])
    turned = absent.at(np.array([0.03, 0.3, 0.5, 0.03]))
    assert turned.direction - absent.direction == pytest.approx(np.pi / 8)
    assert turned.stiffness == pytest.approx(present.stiffness * 0.02 / np.hypot(0.03, 0.03))
    assert turned.at(turned.coordinates).values == pytest.approx(turned.values)
    along_x = replace(absent, direction=0.0)
    around = [along_x.at(np.array([0.03, 0.3, 0.5, across])).direction for across in (-1e-6, 1e-6)]
    assert np.ptp(around) < 1e-3  # standard errors are differences
    again = present.with_softer_joint(4.0)
    assert (again.stiffness, again.mass) == (present.stiffness, 4 * present.mass)


def test_a_step_of_a_search_is_limited_in_shape_and_not_in_size() -> None:
    parametrisation = Parametrisation(rigs.chain_of(2), "uniform", rigs.RIG.active_links)
    problem = TrajectoryProblem(parametrisation, (), effects=(TABLE.placed(rigs.RIG, None), LinearDrag(link=0)))
    table, drag = problem.parts
    assert problem.max_step[table].tolist() == [np.inf, 1.0, 1.0, np.inf]
    assert np.isinf(problem.max_step[: table.start]).all()
    assert np.isinf(problem.max_step[drag]).all()


def test_compliances_along_several_directions_add_up() -> None:
    """What three variants do together is what one table does along the direction that they make up."""
    variants = [each for each in BaseCompliance().variants(Rig("hub", (LINK,)), []) if each.mass > 10]
    assert len(variants) == 3
    assert all(one.superposes(other) for one in variants for other in variants)
    assert not variants[0].superposes(replace(variants[0], mass=1.0))
    assert not variants[0].superposes(LinearDrag())
    tensor = 0.4 * np.outer(*2 * [[np.cos(2.9), np.sin(2.9)]])
    axes = [np.array([np.cos(each.direction), np.sin(each.direction)]) for each in variants]
    parts = np.array([np.outer(axis, axis)[np.triu_indices(2)] for axis in axes]).T
    sizes = np.linalg.solve(parts, tensor[np.triu_indices(2)])
    found, size = variants[0].superposition(variants, sizes)
    assert found.direction == pytest.approx(2.9)
    assert size == pytest.approx([0.4])
    assert found.is_null


@pytest.mark.parametrize(
    "changed", [{"stiffness": 2001.0}, {"mass": 3.01}, {"direction": 0.701}, {"damping_ratio": 0.021}]
)
def test_derivatives_by_what_a_table_is_are_those_of_whole_simulations(changed: dict[str, float]) -> None:
    chain = rigs.chain_of(2)
    arm, other = (Arm.of(chain, (table,)) for table in (TABLE, replace(TABLE, **changed)))
    point = rigs.point_of(chain, (TABLE,), rigs.recorded(arm, 1, duration=1.0))
    moved = rigs.point_of(chain, other.effects, [run.observed.recording for run in point.runs])
    ((name, value),) = changed.items()
    step = value - TABLE.values[name]
    for run, again in zip(point.runs, moved.runs, strict=True):
        parts = list(run.jacobian(run.linearization([PerturbedArm(other, step)])))
        measured, slopes = np.concatenate([rows for rows, _ in parts]), np.vstack([part for _, part in parts])
        expected = (run.residual - again.residual)[measured] / step
        assert np.linalg.norm(slopes[:, -1] - expected) < 0.02 * np.linalg.norm(expected)
