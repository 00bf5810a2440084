"""A chain's URDF, seen through other people's parsers."""

from __future__ import annotations

import logging
from dataclasses import replace

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import yourdfpy
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.model.chains import HOSTILE, Plane, chains, extended_chain, plain_chain, plain_link
from tests.model.robots import mujoco_mass_matrix
from tests.model.urdf_contents import NAMESPACE, extension_from, robot_from, springs_from
from vjm.chain.virtual_links import Array, Chain, MovingBase
from vjm.errors import ShapeError
from vjm.model.dynamics import Mechanism
from vjm.model.urdf import chain_to_urdf

SEEDS = st.integers(0, 2**32 - 1)


def posture(chain: Chain, seed: int) -> Array:
    return np.random.default_rng(seed).uniform(-1.2, 1.2, chain.size)


def pinocchio_at(chain: Chain, q: Array) -> tuple[pin.Model, pin.Data, Array]:
    model = pin.buildModelFromXML(chain_to_urdf(chain))
    configuration = pin.integrate(model, pin.neutral(model), q)
    data = model.createData()
    pin.framesForwardKinematics(model, data, configuration)
    return model, data, configuration


def robot_of(chain: Chain) -> yourdfpy.URDF:
    return robot_from(chain_to_urdf(chain))


def inertia_of(chain: Chain, body: str) -> Array:
    """(3,) principal moments of inertia about x, y and z."""
    tensor = robot_of(chain).link_map[body].inertial.inertia
    assert np.array_equal(tensor, np.diag(np.diag(tensor)))
    return np.diag(tensor)


def assert_pose(rotation: Array, translation: Array, place: tuple[Array, float]) -> None:
    point, angle = place
    assert translation == pytest.approx([*point, 0.0], abs=1e-12)
    assert rotation[:2, 0] == pytest.approx([np.cos(angle), np.sin(angle)], abs=1e-12)
    assert rotation[2] == pytest.approx([0, 0, 1])


@settings(deadline=None)
@given(chains(), SEEDS)
def test_pinocchio_finds_the_mass_matrix_of_first_principles(chain: Chain, seed: int) -> None:
    q = posture(chain, seed)
    model, data, configuration = pinocchio_at(chain, q)
    expected = Plane(chain, q).mass_matrix()
    upper = np.triu(pin.crba(model, data, configuration))
    np.testing.assert_allclose(upper, np.triu(expected), rtol=1e-10, atol=1e-12 * expected.max())


@settings(deadline=None)
@given(chains(), SEEDS)
def test_pinocchio_finds_joints_frames_damping_and_mass(chain: Chain, seed: int) -> None:
    q = posture(chain, seed)
    model, data, _ = pinocchio_at(chain, q)
    assert model.name == chain.name
    assert tuple(model.names)[1:] == chain.joint_names
    assert model.damping == pytest.approx(chain.damping, rel=1e-15)
    for name, place in Plane(chain, q).places.items():
        pose = data.oMf[model.getFrameId(name)]
        assert_pose(pose.rotation, pose.translation, place)
    still = chain.links[0].joint == "clamped" and chain.links[0].root_stiffness is None
    clamped = chain.links[0].masses[0] if still else 0.0
    moving = sum(link.masses.sum() + link.payload for link in chain.links) - clamped
    assert pin.computeTotalMass(model) == pytest.approx(moving)


@settings(deadline=None)
@given(chains(), SEEDS)
def test_pinocchio_makes_of_it_what_dynamics_makes_of_the_chain(chain: Chain, seed: int) -> None:
    q = posture(chain, seed)
    model, data, configuration = pinocchio_at(chain, q)
    mechanism = Mechanism(chain)
    assert tuple(model.names) == tuple(mechanism.model.names)
    expected = mechanism.mass_matrix(q[None])[0]
    upper = np.triu(pin.crba(model, data, configuration))
    np.testing.assert_allclose(upper, np.triu(expected), rtol=1e-9, atol=1e-12 * expected.max())


@settings(max_examples=30, deadline=None)
@given(chains(), SEEDS)
def test_yourdfpy_finds_joints_frames_and_masses(chain: Chain, seed: int) -> None:
    q = posture(chain, seed)
    robot = robot_of(chain)
    assert robot.validate(), robot.errors
    assert robot.robot.name == chain.name
    assert robot.base_link == "base"
    assert tuple(robot.actuated_joint_names) == chain.joint_names
    robot.update_cfg(q)
    for name, place in Plane(chain, q).places.items():
        pose = robot.get_transform(name, "base")
        assert_pose(pose[:3, :3], pose[:3, 3], place)
    for name, damping in zip(chain.joint_names, chain.damping, strict=True):
        dynamics = robot.joint_map[name].dynamics
        assert (float(dynamics.damping) if dynamics else 0.0) == damping
    for link in chain.links:
        bodies = [robot.link_map[f"{link.name}_virtual_{j}_link"].inertial for j in range(link.masses.size)]
        ends = [robot.joint_map[f"{link.name}_virtual_{j}"] for j in range(1, link.masses.size)]
        ends.append(robot.joint_map[f"{link.name}_tip_mount"])
        assert [body.mass for body in bodies] == link.masses.tolist()
        at_rim = link.root_stiffness is not None and link.root_inertia == 0.0
        first = np.r_[0.0 if at_rim else link.hub_radius, np.zeros(link.virtual_joints)]
        assert [body.origin[0, 3] for body in bodies] == (first + link.mass_centers).tolist()
        assert [body.inertia[2, 2] for body in bodies[1:]] == link.inertias[1:].tolist()
        assert [joint.origin[0, 3] for joint in ends] == (first + link.lengths).tolist()
        assert (f"{link.name}_payload" in robot.link_map) == bool(link.payload)
        if link.payload:
            carried = robot.link_map[f"{link.name}_payload"].inertial
            assert (carried.mass, carried.origin[0, 3]) == (link.payload, link.payload_offset)


@settings(deadline=None)
@given(chains())
def test_extension_holds_the_rest_to_the_last_bit(chain: Chain) -> None:
    text = chain_to_urdf(chain)
    model = extension_from(text)
    assert tuple(map(float, model.attrib["gravity"].split())) == chain.gravity
    springs = springs_from(text)
    for link, element in zip(chain.links, model, strict=True):
        joints = [f"{link.name}_virtual_{j}" for j in range(1, link.virtual_joints + 1)]
        assert [springs.pop(joint) for joint in joints] == link.stiffness.tolist()
        assert springs.pop(f"{link.name}_root", None) == link.root_stiffness
        cells = [float(joint.attrib["cell"]) for joint in element.iter(f"{NAMESPACE}virtual_joint")]
        assert cells == link.cells.tolist()
        assert element.attrib["distal"] == link.distal
        numbers = {key: float(value) for key, value in element.attrib.items() if key not in ("name", "distal")}
        assert numbers.pop("first_inertia") == link.inertias[0]
        assert numbers.pop("hub_inertia") == link.hub_inertia
        for field in ("joint_stiffness", "hub_radius", "root_inertia", "rest_curvature"):
            assert numbers.pop(field, 0.0) == getattr(link, field)
        for field in ("width", "thickness"):
            assert numbers.pop(field, None) == getattr(link, field)
        assert numbers == {}
    assert springs == {}


@settings(deadline=None)
@given(chains())
def test_inertia_is_that_of_a_body_with_three_dimensions(chain: Chain) -> None:
    links = robot_of(chain).link_map
    for link in chain.links:
        for j in range(link.masses.size):
            axes = np.sort(np.diag(links[f"{link.name}_virtual_{j}_link"].inertial.inertia))
            assert axes[0] > 0
            assert axes[0] + axes[1] >= axes[2]


def test_inertia_of_a_uniform_rod_is_that_of_a_box() -> None:
    length, mass, width, thickness = 0.5, 0.4, 0.035, 0.002
    turning = mass * (length**2 + thickness**2) / 12
    link = plain_link(inertias=np.full(3, turning), masses=np.full(3, mass), width=width, thickness=thickness)
    ixx, iyy, izz = inertia_of(Chain("arm", (link,)), "beam_virtual_1_link")
    assert ixx == pytest.approx(mass * (width**2 + thickness**2) / 12)
    assert iyy == pytest.approx(mass * (length**2 + width**2) / 12)
    assert izz == turning


def test_unknown_section_is_two_per_cent_of_the_length() -> None:
    unknown = plain_link(width=None, thickness=None)
    side = 0.02 * unknown.length
    known = plain_link(width=side, thickness=side)
    one, other = (inertia_of(Chain("arm", (link,)), "beam_virtual_1_link") for link in (unknown, known))
    assert one == pytest.approx(other, rel=1e-12)


def test_hub_turns_with_the_active_joint_only() -> None:
    chain = Chain("arm", (plain_link(hub_inertia=0.0),))
    with_hub = replace(chain, links=(replace(chain.links[0], hub_inertia=0.5),))
    q = posture(chain, 3)
    model, data, configuration = pinocchio_at(chain, q)
    before = pin.crba(model, data, configuration)
    model, data, configuration = pinocchio_at(with_hub, q)
    added = np.triu(pin.crba(model, data, configuration) - before)
    assert added[0, 0] == pytest.approx(0.5)
    assert np.abs(added).sum() == pytest.approx(0.5)


def test_hub_before_a_root_joint_is_a_body_of_its_own() -> None:
    chain = extended_chain()
    links = robot_of(chain).link_map
    assert links["beam_hub"].inertial.inertia[2, 2] == 0.02
    assert links["beam_virtual_0_link"].inertial.inertia[2, 2] == pytest.approx(1e-3 + 0.004)
    assert [shape.material.name for shape in links["beam_hub"].visuals] == ["vjm_hub"]
    assert [shape.material.name for shape in links["beam_virtual_0_link"].visuals] == ["vjm_even"]
    assert links["fore_hub"].inertial.mass == 0.0  # nothing turns there; without an element PyBullet would give it 1 kg
    joints = robot_of(chain).joint_map
    assert (joints["beam_root"].parent, joints["beam_root"].child) == ("beam_hub", "beam_virtual_0_link")
    assert (joints["fore_joint"].type, joints["fore_joint"].parent) == ("fixed", "beam_tip")


def test_mujoco_takes_it_and_finds_the_same_mass_matrix() -> None:
    chain = extended_chain()
    q = posture(chain, 5)
    model = mujoco.MjModel.from_xml_string(chain_to_urdf(chain, {"beam": 0.008}))
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(mujoco_mass_matrix(model, data), Mechanism(chain).mass_matrix(q[None])[0], rtol=1e-9)
    assert tuple(model.joint(i).name for i in range(model.njnt)) == chain.joint_names
    assert model.dof_damping == pytest.approx(chain.damping)
    assert model.dof_frictionloss == pytest.approx([0.008, *[0.0] * (model.nv - 1)])


def on_a_table(chain: Chain) -> Chain:
    return replace(chain, base=MovingBase(3.0, 2000.0, 4.0, 0.7))


@settings(max_examples=25, deadline=None)
@given(chains(), SEEDS)
def test_a_moving_base_is_a_sliding_joint(chain: Chain, seed: int) -> None:
    moving = on_a_table(chain)
    q = posture(moving, seed)
    model, data, configuration = pinocchio_at(moving, q)
    assert tuple(model.names)[1:] == moving.joint_names
    assert model.damping == pytest.approx(moving.damping, rel=1e-15)
    expected = Mechanism(moving).mass_matrix(q[None])[0]
    upper = np.triu(pin.crba(model, data, configuration))
    np.testing.assert_allclose(upper, np.triu(expected), rtol=1e-9, atol=1e-12 * expected.max())
    (slide,) = extension_from(chain_to_urdf(moving)).iter(f"{NAMESPACE}base_slide")
    assert float(slide.attrib["stiffness"]) == 2000.0


def test_mujoco_takes_a_moving_base_too() -> None:
    chain = on_a_table(extended_chain())
    model = mujoco.MjModel.from_xml_string(chain_to_urdf(chain))
    assert tuple(model.joint(i).name for i in range(model.njnt)) == chain.joint_names
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_SLIDE
    assert model.jnt_axis[0] == pytest.approx([np.cos(0.7), np.sin(0.7), 0.0])


@pytest.mark.parametrize("field", ["mass", "stiffness", "damping"])
def test_a_base_has_no_negative_values(field: str) -> None:
    with pytest.raises(ShapeError, match=f"base.{field}"):
        replace(MovingBase(3.0, 2000.0, 4.0, 0.7), **{field: -1.0})


def test_friction_and_damping_are_where_other_programs_look_for_them() -> None:
    chain = extended_chain()
    model = pin.buildModelFromXML(chain_to_urdf(chain, {"beam": 0.008}))
    assert model.damping == pytest.approx(chain.damping)
    assert model.damping[:2] == pytest.approx([0.006, 0.07])
    friction = model.lowerDryFrictionLimit if hasattr(model, "lowerDryFrictionLimit") else -model.friction
    assert np.abs(friction) == pytest.approx([0.008, *[0.0] * (model.nv - 1)])


@pytest.mark.parametrize("friction", [{"boom": 0.1}, {"fore": 0.1}, {"beam": -0.1}, {"beam": np.inf}])
def test_friction_is_at_active_joints_and_not_negative(friction: dict[str, float]) -> None:
    with pytest.raises(ShapeError, match="friction"):
        chain_to_urdf(extended_chain(), friction)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"joint": "clamped", "joint_damping": 0.1}, "beam.joint"),
        ({"joint": "clamped", "joint_stiffness": 0.1}, "beam.joint"),
        ({"root_damping": 0.1}, "beam.root_damping"),
        ({"rest_curvature": np.nan}, "beam.rest_curvature"),
        ({"payload_offset": np.inf}, "beam.payload_offset"),
    ],
)
def test_what_is_at_no_joint_is_refused(changes: dict[str, object], fault: str) -> None:
    with pytest.raises(ShapeError, match=fault):
        chain_to_urdf(Chain("arm", (plain_link(**changes),)))


def test_plain_chains_are_written_as_ever() -> None:
    text = chain_to_urdf(plain_chain())
    for word in ("vjm:root_joint", "_root", 'joint_stiffness="', 'root_inertia="', 'rest_curvature="', "_hub<"):
        assert word not in text
    assert text.count("<dynamics") == plain_chain().passive.size


def test_extension_is_passed_over_in_silence(
    caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    with caplog.at_level(logging.INFO):
        robot_of(plain_chain()).validate()
    pin.buildModelFromXML(chain_to_urdf(plain_chain()))
    assert caplog.text == ""
    assert capfd.readouterr() == ("", "")


def test_hostile_names_survive_every_parser() -> None:
    chain = Chain(HOSTILE, (plain_link(HOSTILE), plain_link("{{ 7 * 7 }}{% raw %}")))
    assert robot_of(chain).robot.name == HOSTILE
    model = pin.buildModelFromXML(chain_to_urdf(chain))
    assert model.name == HOSTILE
    assert tuple(model.names)[1:] == chain.joint_names


@pytest.mark.parametrize("name", ["", "a\nb", "a\tb", "\x00", "\x85", "\ud800", "\uffff"])
def test_names_that_xml_cannot_hold_are_refused(name: str) -> None:
    for chain in (Chain(name, (plain_link(),)), Chain("arm", (plain_link(name),))):
        with pytest.raises(ShapeError, match="control characters"):
            chain_to_urdf(chain)


@pytest.mark.parametrize("field", ["hub_inertia", "payload"])
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_values_no_reader_takes_are_refused(field: str, value: float) -> None:
    with pytest.raises(ShapeError, match=rf"beam\.{field}"):
        chain_to_urdf(Chain("arm", (plain_link(**{field: value}),)))


def test_links_need_names_of_their_own() -> None:
    with pytest.raises(ShapeError, match="names that differ"):
        chain_to_urdf(Chain("arm", (plain_link(), plain_link())))
    with pytest.raises(ShapeError, match="at least one"):
        chain_to_urdf(Chain("arm", ()))


def test_names_made_for_one_link_never_meet_those_of_another() -> None:
    names = ("x", "x_tip", "x_hub", "x_root", "x_virtual", "x_virtual_1", "x_payload", "x_tip_mount", "base")
    chain = Chain("arm", tuple(plain_link(name, root_stiffness=9.0) for name in names))
    robot = robot_of(chain).robot
    for made in ([joint.name for joint in robot.joints], [link.name for link in robot.links]):
        assert len(set(made)) == len(made)


def test_shapes_follow_the_section_and_the_payload() -> None:
    links = robot_of(Chain("arm", (plain_link(payload=0.05),))).link_map
    rod, pin_shape = links["beam_virtual_1_link"].visuals
    assert rod.geometry.box.size == pytest.approx([0.35, 0.0015, 0.035])
    assert rod.origin[:3, 3] == pytest.approx([0.175, 0, 0])
    assert pin_shape.geometry.cylinder.length > 0.035
    colours = [links[f"beam_virtual_{j}_link"].visuals[0].material.name for j in range(3)]
    assert colours == ["vjm_even", "vjm_odd", "vjm_even"]
    radius = links["beam_payload"].visuals[0].geometry.sphere.radius
    assert 7850 * 4 / 3 * np.pi * radius**3 == pytest.approx(0.05)
    large = robot_of(Chain("arm", (plain_link(payload=0.05, payload_inertia=3e-4),))).link_map["beam_payload"]
    assert 2 / 5 * 0.05 * large.visuals[0].geometry.sphere.radius ** 2 == pytest.approx(3e-4)
    assert large.inertial.inertia == pytest.approx(np.diag([3e-4] * 3))


def test_what_is_not_there_has_no_inertia() -> None:
    with pytest.raises(ShapeError, match=r"beam\.payload_inertia.*without a payload"):
        plain_link(payload=0.0, payload_offset=0.0, payload_inertia=1e-3)
    with pytest.raises(ShapeError, match=r"beam\.payload_offset.*without a payload"):
        plain_link(payload=0.0, payload_offset=0.01)
