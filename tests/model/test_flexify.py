"""Robots with a link or a joint made flexible: rigid, they are the original; elastic, they are its beam."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

import vjm
from tests.model.robots import LINKS, UR5, Array, box_beam, inertia_of, mass_matrix, robot
from vjm.chain.body_inertia import BodyInertia, split_inertia
from vjm.cli import main
from vjm.errors import ChoiceError, InputError, ModelFileError, ShapeError
from vjm.files import GENERATED
from vjm.model.modes import modes_of
from vjm.model.urdf_document import UrdfDocument, springs_of

ANYMAL = "anymal_b_simple_description/robots/anymal.urdf"
STIFF = {"joints": 3, "bending_stiffness": 400.0, "torsion": 300.0}


def total_inertia(bodies: Sequence[BodyInertia]) -> BodyInertia:
    """Several bodies that move as one, by the parallel axis theorem."""
    mass = sum(body.mass for body in bodies)
    center = sum((body.mass * body.center for body in bodies), np.zeros(3)) / mass
    offsets = [body.center - center for body in bodies]
    parts = [
        body.tensor + body.mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        for body, offset in zip(bodies, offsets, strict=True)
    ]
    return BodyInertia(mass, center, np.sum(parts, axis=0))


@st.composite
def bodies(draw: st.DrawFn) -> BodyInertia:
    """A cloud of point masses, anywhere."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    masses, points = rng.uniform(0.1, 1.0, 5), rng.uniform(-1.0, 1.0, (5, 3)) * rng.uniform(0.01, 1.0, 3)
    points += rng.uniform(-1.0, 1.0, 3)
    zero = np.zeros((3, 3))
    return total_inertia([BodyInertia(m, p, zero) for m, p in zip(masses, points, strict=True)])


def direction_of(rng: np.random.Generator) -> Array:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


@given(bodies(), st.integers(0, 2**32 - 1))
def test_any_body_is_cut_into_pieces_that_can_exist_and_add_up_to_it(body: BodyInertia, seed: int) -> None:
    rng = np.random.default_rng(seed)
    lengths = rng.uniform(0.05, 0.5, rng.integers(2, 7))
    pieces = split_inertia(body, rng.uniform(-0.5, 0.5, 3), direction_of(rng), lengths)
    total = total_inertia(pieces)
    assert total.mass == pytest.approx(body.mass, rel=1e-12)
    assert total.center == pytest.approx(body.center, abs=1e-12)
    size = np.trace(body.tensor) + body.mass * (1 + body.center @ body.center)
    assert total.tensor == pytest.approx(body.tensor, abs=1e-12 * size)
    for piece in pieces:
        assert piece.mass > 0
        assert np.linalg.eigvalsh(piece.second_moments)[0] > -1e-12 * size


@pytest.mark.parametrize("density", [None, 0.2, 1.0])
def test_a_uniform_bar_is_cut_into_uniform_bars(density: float | None) -> None:
    length, mass = 0.8, 1.7
    body = BodyInertia(mass, np.array([length / 2, 0, 0]), mass / 12 * np.diag([0.02, length**2, length**2 + 0.02]))
    lengths = length * np.array([0.2, 0.5, 0.3])
    pieces = split_inertia(
        body, np.zeros(3), np.array([1.0, 0, 0]), lengths, None if density is None else density * mass
    )
    if density == 0.2:  # what remains of a bar that is less heavy is lumped, symmetrically
        assert total_inertia(pieces).tensor == pytest.approx(body.tensor, rel=1e-12)
        return
    expected = mass * lengths / length
    assert [piece.mass for piece in pieces] == pytest.approx(expected.tolist(), rel=1e-7)
    assert [piece.center[0] for piece in pieces] == pytest.approx([0.08, 0.36, 0.68], rel=1e-7)
    along = [piece.second_moments[0, 0] for piece in pieces]
    assert along == pytest.approx((expected * lengths**2 / 12 - expected * 0).tolist(), rel=1e-6)


def test_heavy_ends_stay_at_the_ends() -> None:
    """A bar with two point masses at its ends: exactly that is found."""
    bar = BodyInertia(0.6, np.array([0, 0, 0.5]), 0.6 / 12 * np.diag([1.0, 1.0, 1e-4]))
    ends = [BodyInertia(0.3, np.array([0, 0, z]), np.diag([0, 0, 1e-5])) for z in (0.0, 1.0)]
    pieces = split_inertia(total_inertia([bar, *ends]), np.zeros(3), np.array([0, 0, 1.0]), np.full(4, 0.25), 0.6)
    assert [piece.mass for piece in pieces] == pytest.approx([0.45, 0.15, 0.15, 0.45], rel=1e-9)


@pytest.mark.parametrize(
    ("tensor", "expected"),
    [
        (np.diag([0.1, 0.1, 0.3]), "can exist"),  # against the triangle inequality
        (np.diag([-0.1, 0.1, 0.1]), "can exist"),
        (np.zeros((3, 3)), "can exist"),
        (np.diag([0.0, 0.1, 0.1]), None),
        (np.diag([0.1, 0.1, 0.0]), "across its axis"),  # a rod along z has no extent along x
    ],
)
def test_impossible_bodies_are_refused(tensor: Array, expected: str | None) -> None:
    body = BodyInertia(1.0, np.array([0.2, 0, 0]), tensor)
    arguments = body, np.zeros(3), np.array([1.0, 0, 0]), np.array([0.2, 0.3])
    if expected is None:
        assert len(split_inertia(*arguments)) == 2
        return
    with pytest.raises(ShapeError, match=expected):
        split_inertia(*arguments)


@pytest.mark.parametrize("case", LINKS)
def test_rigid_limit_is_the_original(case: str) -> None:
    """With all springs at rest: M, gravity torques, every frame; the link's mass, centre and inertia."""
    path, options = LINKS[case]
    file = robot(path)
    text = vjm.flexify(file, **{**STIFF, **options})  # type: ignore[arg-type]
    rigid, flexible = pin.buildModelFromUrdf(str(file)), pin.buildModelFromXML(text)
    springs = {spring.joint for spring in springs_of(UrdfDocument.read(text))}
    assert flexible.nq == rigid.nq + len(springs) == rigid.nq + 9
    columns = [flexible.joints[flexible.getJointId(name)].idx_v for name in rigid.names[1:]]
    rng = np.random.default_rng(1)
    for _ in range(3):
        q, whole = pin.randomConfiguration(rigid), pin.neutral(flexible)
        for name in rigid.names[1:]:
            one, other = rigid.joints[rigid.getJointId(name)], flexible.joints[flexible.getJointId(name)]
            whole[other.idx_q : other.idx_q + other.nq] = q[one.idx_q : one.idx_q + one.nq]
        v, v_whole = rng.normal(size=rigid.nv), np.zeros(flexible.nv)
        v_whole[columns] = v
        here, there = rigid.createData(), flexible.createData()
        assert mass_matrix(flexible, whole)[np.ix_(columns, columns)] == pytest.approx(mass_matrix(rigid, q), abs=1e-8)
        still = np.zeros(rigid.nv), np.zeros(flexible.nv)
        bias = pin.rnea(rigid, here, q, v, still[0])
        assert pin.rnea(flexible, there, whole, v_whole, still[1])[columns] == pytest.approx(bias, abs=1e-8)
        pin.framesForwardKinematics(rigid, here, q)
        pin.framesForwardKinematics(flexible, there, whole)
        for frame in rigid.frames:
            pose = there.oMf[flexible.getFrameId(frame.name)]
            assert pose.homogeneous == pytest.approx(here.oMf[rigid.getFrameId(frame.name)].homogeneous, abs=1e-8)


@pytest.mark.parametrize("case", LINKS)
def test_mass_and_inertia_are_kept(case: str) -> None:
    path, options = LINKS[case]
    name, file = str(options["link"]), robot(path)
    text = vjm.flexify(file, **{**STIFF, **options})  # type: ignore[arg-type]
    document = UrdfDocument.read(text)
    joints = [joint for joint in document.robot.all("joint") if f"{name}_virtual_" in joint.attributes["name"]]
    origin, parts = np.zeros(3), [inertia_of(text, name)]
    for joint in joints:
        origin = origin + document.pose(joint)[0]
        child = joint.first("child")
        assert child is not None
        part = inertia_of(text, child.attributes["link"])
        assert np.linalg.eigvalsh(part.second_moments)[0] > 0
        parts.append(BodyInertia(part.mass, part.center + origin, part.tensor))
    whole, total = inertia_of(file.read_text(), name), total_inertia(parts)
    assert total.mass == pytest.approx(whole.mass, rel=1e-12)
    assert total.center == pytest.approx(whole.center, abs=1e-12)
    assert total.tensor == pytest.approx(whole.tensor, abs=1e-12)


@pytest.mark.parametrize("case", LINKS)
def test_every_other_byte_stays(case: str) -> None:
    """Undo the edits of the link, its child joints and the two insertions: the original is back, byte for byte."""
    path, options = LINKS[case]
    file = robot(path)
    text = vjm.flexify(file, **{**STIFF, **options})  # type: ignore[arg-type]
    name = str(options["link"])

    def others(source: str) -> list[bytes]:
        """Bytes between the elements that are about the link."""
        document = UrdfDocument.read(source)
        touched = []
        for element in document.robot.children:
            parent = element.first("parent")
            ours = element.attributes.get("name", "").startswith(f"{name}_virtual") or element.tag == "vjm:model"
            carried = parent is not None and parent.attributes.get("link", "").startswith(name)
            if ours or carried or element.attributes.get("name") == name:
                touched.append(element)
        places = [0, *(place for element in touched for place in (element.start, element.stop)), len(document.data)]
        parts = [document.data[a:b] for a, b in list(pairwise(places))[::2]]
        return b"".join(parts).split()

    start, stop = text.index("<!-- What URDF has"), text.index("-->", text.index("<!-- What URDF has")) + 3
    assert others(text[:start] + text[stop:]) == others(file.read_text())


def test_shapes_joints_comments_and_line_ends_survive(tmp_path: Path) -> None:
    robot_text = """\ufeff<?xml version='1.0' encoding="utf-8" ?>
<!-- a robot -->
<robot  name='r' xmlns:xacro="http://ros.org/wiki/xacro">
  <material name='blue'><color rgba='0 0 1 1' /></material>
  <link name = "base" />
  <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="arm"> <!-- kept -->
    <inertial>  <!-- measured -->
      <mass value = '2' /><inertia ixx="0.02" ixy='0' ixz="0" iyy="0.02" iyz="0" izz="0.002" /></inertial>
    <visual><geometry><mesh filename="package://robot/arm.dae"/></geometry><material name='blue'/></visual>
    <visual name="far">
      <origin xyz="0 0 -0.9" rpy="0.1 0.2 0.3"/><geometry><sphere radius="0.1"/></geometry> <!-- a ball -->
    </visual>
    <collision><geometry><box size="1 1 1"/></geometry><origin rpy='0 0 1' xyz='0 0 -0.5'/></collision>
  </link>
  <joint name="tip" type="continuous" ><origin   xyz="0.0 0 -1.0" rpy='0 0 0.5'/>
    <parent link='arm'/><child link="tool"/><mimic joint="j" multiplier="2"/></joint>
  <joint name="camera" type="fixed"><parent link="arm"/><child link="eye"/></joint>
  <link name="tool"/><link name="eye"/>
  <transmission name="t&amp;t"><joint name="j"/></transmission><gazebo reference="arm"/>
</robot>
"""
    file = tmp_path / "r.urdf"
    file.write_bytes(robot_text.replace("\n", "\r\n").encode())
    text = vjm.flexify(file, link="arm", joints=2, bending_stiffness=1.0, bending="y")
    assert text.count("\r\n") == text.count("\n")
    lines = [line.replace("\r", "") for line in text.splitlines()]
    kept = [
        "<!-- a robot -->", "package://robot/arm.dae", "<!-- kept -->", "<!-- measured -->", "<mass value = '",
        '<visual name="far">', '<geometry><sphere radius="0.1"/></geometry> <!-- a ball -->', "t&amp;t",
        '<mimic joint="j" multiplier="2"/>', '<gazebo reference="arm"/>', '<link name = "base" />', "rpy='0 0 0.5'",
        "\ufeff<?xml version='1.0' encoding=\"utf-8\" ?>",
    ]  # fmt: skip
    for words in kept:
        assert sum(words in line for line in lines) == 1, words
    document = UrdfDocument.read(text)
    holder = {
        shape.attributes.get("name", shape.tag): (link.attributes["name"], document.pose(shape)[0][2])
        for link in document.robot.all("link")
        for shape in (*link.all("visual"), *link.all("collision"))
    }
    end = document.pose(next(j for j in document.robot.all("joint") if j.attributes["name"] == "tip"))[0][2]
    assert holder["visual"] == ("arm", 0.0)
    assert holder["far"] == ("arm_virtual_2_link", pytest.approx(end + 0.1))
    assert holder["collision"][0] == "arm_virtual_1_link"
    parents = {j.attributes["name"]: j.first("parent").attributes["link"] for j in document.robot.all("joint")}  # type: ignore[union-attr]
    assert parents["tip"] == "arm_virtual_2_link"
    assert parents["camera"] == "arm"
    assert vjm.flexify(text, joint="j", stiffness=1.0, rotor_inertia=1.0).count("<vjm:model") == 1


def test_other_encodings_become_utf_8(tmp_path: Path) -> None:
    text = box_beam(1.0, 1.0, 0.1, 0.1).replace(
        "<robot", '<?xml version="1.0" encoding="iso-8859-1"?>\n<!-- Träger -->\n<robot'
    )
    (tmp_path / "r.urdf").write_bytes(text.encode("iso-8859-1"))
    flexible = vjm.flexify(tmp_path / "r.urdf", link="bar", joints=1, bending_stiffness=1.0)
    head = f'<?xml version="1.0" encoding="utf-8"?>\n<!-- {GENERATED} -->\n<!-- Träger -->\n<robot'
    assert flexible.startswith(head)
    (tmp_path / "again.urdf").write_text("\ufeff" + flexible, encoding="utf-8")
    again = vjm.flexify(tmp_path / "again.urdf", joint="bar_virtual_1_z", stiffness=1.0, rotor_inertia=1.0)
    assert again.startswith("\ufeff" + head)


def test_a_text_without_declaration_begins_with_the_line_that_vjm_wrote_it() -> None:
    text = "\ufeff" + box_beam(1.0, 1.0, 0.1, 0.1).replace("\n", "\r\n")
    flexible = vjm.flexify(text, link="bar", joints=1, bending_stiffness=1.0)
    assert flexible.startswith(f"\ufeff<!-- {GENERATED} -->\r\n<robot")


def clamped_modes(text: str) -> dict[str, list[float]]:
    """Frequencies [Hz] of the virtual joints about each axis, everything else held."""
    model, springs = pin.buildModelFromXML(text), springs_of(UrdfDocument.read(text))
    M, found = mass_matrix(model, pin.neutral(model)), {}
    for suffix in ("y", "z", "torsion" if "_torsion" in text else "y"):
        chosen = [spring for spring in springs if spring.joint.endswith(f"_{suffix}")]
        rows = [model.joints[model.getJointId(spring.joint)].idx_v for spring in chosen]
        K = np.diag([spring.stiffness for spring in chosen])
        found[suffix] = modes_of(M[np.ix_(rows, rows)], 0 * K, K).frequencies.tolist()
    return found


LENGTH, WIDTH, HEIGHT, DENSITY, E, G = 1.2, 0.03, 0.012, 2700.0, 7e10, 2.6e10
MASS = DENSITY * LENGTH * WIDTH * HEIGHT
SECTION = {"section": f"box:{WIDTH},{HEIGHT}", "youngs_modulus": E, "shear_modulus": G}
TORSION_CONSTANT = 0.2491 * WIDTH * HEIGHT**3  # Timoshenko and Goodier, table of section 109, width / height = 2.5


@pytest.mark.parametrize("joints", [4, 8])
def test_natural_frequencies_are_those_of_the_beam(joints: int) -> None:
    """Bending in both planes is of fourth order; a rod of lumps h long twists slower by (k h)^2 / 24, k = pi / 2 l."""
    text = vjm.flexify(box_beam(LENGTH, MASS, WIDTH, HEIGHT), link="bar", joints=joints, **SECTION)  # type: ignore[arg-type]
    found = clamped_modes(text)
    for suffix, size, across in (("y", HEIGHT, WIDTH), ("z", WIDTH, HEIGHT)):
        EI = E * across * size**3 / 12
        root = 1.8751040687119611
        exact = root**2 / (2 * np.pi) * np.sqrt(EI / (MASS * LENGTH**3))
        rotary = (np.pi * size / LENGTH) ** 2 / 12  # neglected by Euler and Bernoulli
        assert found[suffix][0] == pytest.approx(exact, rel=0.02 / joints**4 + rotary)
    polar = MASS * (WIDTH**2 + HEIGHT**2) / 12
    exact = np.sqrt(G * TORSION_CONSTANT / LENGTH / polar) / 4
    assert found["torsion"][0] == pytest.approx(exact, rel=(np.pi / 2 / joints) ** 2 / 24 + 2e-4)


def test_a_tip_mass_lowers_the_frequency_as_the_beam_formula_says() -> None:
    tip, EI = 0.7, E * WIDTH * HEIGHT**3 / 12
    text = vjm.flexify(box_beam(LENGTH, MASS, WIDTH, HEIGHT, tip), link="bar", joints=5, bending_stiffness=EI)
    equation = lambda z: (  # noqa: E731
        1 + np.cos(z) * np.cosh(z) + tip / MASS * z * (np.cos(z) * np.sinh(z) - np.sin(z) * np.cosh(z))
    )
    root = brentq(equation, 0.1, 1.875)
    exact = root**2 / (2 * np.pi) * np.sqrt(EI / (MASS * LENGTH**3))
    found = clamped_modes(text)
    assert found["y"][0] == pytest.approx(exact, rel=2e-4)
    assert found["z"][0] == pytest.approx(exact, rel=2e-3)  # rotary inertia


@pytest.mark.parametrize("joints", [1, 2, 3, 6])
def test_tip_compliance_is_the_beams(joints: int) -> None:
    """Deflection, slope and twist of forces and moments at a tip that carries a mass: F L^3 / 3 EI and so on."""
    EI, GJ = (70.0, 30.0), 20.0
    text = vjm.flexify(
        box_beam(LENGTH, MASS, WIDTH, HEIGHT, 0.3), link="bar", joints=joints, bending_stiffness=EI, torsion=GJ
    )
    model = pin.buildModelFromXML(text)
    data, q, frame = model.createData(), pin.neutral(model), model.getFrameId("tool")
    J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
    compliance = np.zeros(model.nv)
    for spring in springs_of(UrdfDocument.read(text)):
        compliance[model.joints[model.getJointId(spring.joint)].idx_v] = 1 / spring.stiffness
    flexibility = J @ np.diag(compliance) @ J.T
    error = {1: 0.3, 2: 1e-3}.get(joints, 1e-9)  # exact where the corrections of both ends do not meet
    assert flexibility[2, 2] == pytest.approx(LENGTH**3 / 3 / EI[0], rel=error)
    assert flexibility[1, 1] == pytest.approx(LENGTH**3 / 3 / EI[1], rel=error)
    assert flexibility[4, 2] == pytest.approx(-(LENGTH**2) / 2 / EI[0], rel=error)
    assert flexibility[4, 4] == pytest.approx(LENGTH / EI[0], rel=1e-9)
    assert flexibility[5, 5] == pytest.approx(LENGTH / EI[1], rel=1e-9)
    assert flexibility[3, 3] == pytest.approx(LENGTH / GJ, rel=1e-9)


def test_sections() -> None:
    beam = box_beam(1.0, 1.0, 0.1, 0.1)

    def stiffness(section: str) -> list[float]:
        text = vjm.flexify(beam, link="bar", joints=1, section=section, youngs_modulus=2.0, shear_modulus=3.0)
        return [spring.stiffness * (spring.cell or 0.0) for spring in springs_of(UrdfDocument.read(text))]

    solid, bore = np.pi * 0.1**4 / 64, np.pi * 0.06**4 / 64
    assert stiffness("rod:0.1") == pytest.approx([2 * solid, 2 * solid, 6 * solid])
    assert stiffness("tube:0.1,0.02") == pytest.approx([2 * (solid - bore), 2 * (solid - bore), 6 * (solid - bore)])
    square = 0.1406 * 0.1**4  # Timoshenko and Goodier, section 109
    assert stiffness("box:0.1,0.1") == pytest.approx([2 * 0.1**4 / 12, 2 * 0.1**4 / 12, 3 * square], rel=3e-4)
    wide = [2 * 0.2 * 0.1**3 / 12, 2 * 0.1 * 0.2**3 / 12, 3 * 0.229 * 0.2 * 0.1**3]
    assert stiffness("box:0.2,0.1") == pytest.approx(wide, rel=2e-3)


def test_oblique_axes_are_square_to_the_link() -> None:
    text = vjm.flexify(box_beam(1.0, 1.0, 0.1, 0.1), link="bar", joints=1, bending_stiffness=(1.0, 2.0), bending="z,y",
                       ends=((0, 0, 0), (1.0, 0.5, 0.2)))  # fmt: skip
    document = UrdfDocument.read(text)
    along = np.array([1.0, 0.5, 0.2]) / np.linalg.norm([1.0, 0.5, 0.2])
    axes = [
        document.numbers(axis.attributes["xyz"], "xyz", 3)
        for joint in document.robot.all("joint")
        if "virtual" in joint.attributes["name"] and (axis := joint.first("axis")) is not None
    ]
    frame = np.array([along, *axes])
    assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-15)
    assert axes[0][2] > 0.9
    assert axes[1][1] > 0.8
    assert [spring.joint for spring in springs_of(document)] == ["bar_virtual_1_z", "bar_virtual_1_y"]


def test_flexible_joint_has_a_motor_and_a_spring() -> None:
    """Rigid, M is the original's on both sides of the spring; mass and inertia are kept; the motor keeps its name."""
    file = robot(UR5)
    text = vjm.flexify(file, joint="elbow_joint", stiffness=1e4, rotor_inertia=0.3, kelvin_voigt=1e-3)
    rigid, model = pin.buildModelFromUrdf(str(file)), pin.buildModelFromXML(text)
    assert list(model.names)[1:5] == ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "elbow_joint_spring"]
    q = pin.randomConfiguration(rigid)
    whole = np.insert(q, 3, 0.0)
    M, doubled = mass_matrix(rigid, q), mass_matrix(model, whole)
    place = [0, 1, 2, 2, 3, 4, 5]
    expected = M[np.ix_(place, place)]
    assert doubled == pytest.approx(expected, abs=1e-5 * M[2, 2])  # the motor's own small share of the forearm
    kept = [0, 1, 2, 4, 5, 6]
    assert doubled[np.ix_(kept, kept)] == pytest.approx(M, abs=1e-12)
    assert springs_of(UrdfDocument.read(text)) == [("elbow_joint_spring", 1e4, 10.0, None, False)]
    assert 'rotor_inertia="0.3"' in text


def test_a_prismatic_joint_gets_a_spring_that_slides() -> None:
    text = vjm.flexify(
        robot("panda_description/urdf/panda.urdf"), joint="panda_finger_joint1", stiffness=5e3, rotor_inertia=0.1
    )
    model = pin.buildModelFromXML(text)
    assert model.joints[model.getJointId("panda_finger_joint1_spring")].shortname() in ("JointModelPY", "JointModelPX")


def test_mujoco_reads_it_and_finds_the_same_mass_matrix() -> None:
    """A program that takes no moving body without mass: those between joints at one place have some."""
    mujoco = pytest.importorskip("mujoco")
    options = {"bending_stiffness": 5.0, "torsion": 3.0, "joint": "motor", "stiffness": 5.0, "rotor_inertia": 0.1}
    text = vjm.flexify(box_beam(1.0, 1.0, 0.03, 0.02, 0.3), link="bar", joints=2, **options)  # type: ignore[arg-type]
    model, reference = mujoco.MjModel.from_xml_string(text), pin.buildModelFromXML(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = np.zeros((model.nv, model.nv))
    for row, unit in zip(found, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    names = [model.joint(k).name for k in range(model.njnt)]
    order = [reference.joints[reference.getJointId(name)].idx_v for name in names]
    M = mass_matrix(reference, pin.neutral(reference))
    assert found == pytest.approx(M[np.ix_(order, order)], abs=1e-12)
    assert model.body_mass.sum() == pytest.approx(1.3)


def test_two_links_one_after_the_other() -> None:
    text = vjm.flexify(robot(ANYMAL), link="LF_THIGH", axis="z", joints=1, bending_stiffness=10.0)
    text = vjm.flexify(text, link="RF_THIGH", axis="z", joints=2, bending_stiffness=10.0)
    assert len(springs_of(UrdfDocument.read(text))) == 6
    assert text.count("What URDF has no element for") == 1
    with pytest.raises(ShapeError, match="not flexible yet"):
        vjm.flexify(text, link="RF_THIGH", axis="z", joints=2, bending_stiffness=10.0)


BEAM = box_beam(1.0, 1.0, 0.1, 0.1)
GOOD = {"link": "bar", "joints": 2, "bending_stiffness": 3.0}


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"link": "bra"}, ChoiceError, "unknown link 'bra'; choose one of: base, bar, tool"),
        ({"link": "base"}, ShapeError, "link base: got no mass; expected a link with mass, one of: bar"),
        ({"link": None}, ShapeError, "expected the name of a link or of a joint"),
        ({"link": None, "joint": "motor"}, ShapeError, "link: got None; .* the name of the link that joints is of"),
        ({"stiffness": 1.0}, ShapeError, "joint: got None; expected the name of the joint that stiffness is of"),
        ({"joints": 0}, ShapeError, "joints: got 0; expected at least 1"),
        ({"joints": None}, ShapeError, "joints: got None; expected at least 1"),
        ({"joints": 1.5}, ShapeError, "joints: got 1.5"),
        ({"bending_stiffness": 0.0}, ShapeError, "bending_stiffness: got 0.0; expected a positive"),
        ({"bending_stiffness": (1.0, -2.0)}, ShapeError, "bending_stiffness: got -2.0; expected a positive"),
        ({"bending_stiffness": (1.0, 2.0, 3.0)}, ShapeError, "3 values; expected one, or one for each of 2 axes"),
        ({"bending_stiffness": None}, ShapeError, "EI .* or section and youngs_modulus"),
        ({"bending_stiffness": float("nan")}, ShapeError, "a positive number"),
        ({"torsion": -1.0}, ShapeError, "torsion: got -1.0"),
        ({"bending": "w"}, ChoiceError, "unknown bending axis 'w'; choose one of: x, y, z"),
        ({"bending": "x"}, ShapeError, "axes across the link, which lies along x: y, z"),
        ({"bending": "y,y"}, ShapeError, "one axis of the link's frame, or two"),
        ({"axis": "w"}, ChoiceError, "choose one of: x, y, z"),
        ({"axis": "y"}, ShapeError, r"child joint flange is away \(x 1 m, y 0 m, z 0 m\)"),
        ({"axis": (0, 0, 0)}, ShapeError, "not zero"),
        ({"child": "motor"}, ChoiceError, "unknown child joint of bar 'motor'; choose one of: flange"),
        ({"link": "tool"}, ShapeError, "no mass"),
        ({"ends": ((0, 0, 0), (0, 0, 0))}, ShapeError, "two points"),
        ({"kelvin_voigt": -1.0}, ShapeError, "kelvin_voigt: got -1.0"),
        ({"density": 1.0}, ShapeError, "a section beside density: tube:DIAMETER,WALL"),
        ({"section": "tube:0.1,0.01"}, ShapeError, "no stiffness beside it"),
        ({"section": "tube:0.1", "bending_stiffness": None}, ChoiceError, "tube:DIAMETER,WALL, rod:DIAMETER, box"),
        ({"section": "tube:0.1,0.06", "bending_stiffness": None}, ShapeError, "at most half the diameter"),
        ({"section": "rod:-1", "bending_stiffness": None}, ShapeError, "a positive number"),
        ({"section": "rod:0.1", "bending_stiffness": None}, ShapeError, "youngs_modulus: got nothing"),
        (
            {"section": "rod:0.1", "bending_stiffness": None, "youngs_modulus": 1.0, "density": -1.0},
            ShapeError,
            "density: got -1.0",
        ),
        (
            {"section": "rod:0.1", "bending_stiffness": None, "youngs_modulus": 1.0, "density": 200.0},
            ShapeError,
            "mass of the section: got 1.5708 kg; expected above zero and at most 1 kg",
        ),
    ],
)  # fmt: skip
def test_bad_input_is_refused(changes: dict[str, object], error: type[InputError], message: str) -> None:
    with pytest.raises(error, match=message):
        vjm.flexify(BEAM, **{**GOOD, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joint": "elbow"}, "unknown joint 'elbow'; choose one of: motor, flange"),
        ({"joint": "flange"}, "type 'fixed'; expected one that turns or slides: motor"),
        ({"joint": "motor", "stiffness": 0.0}, "stiffness: got 0.0"),
        ({"joint": "motor", "rotor_inertia": None}, "rotor_inertia: got nothing; expected a positive"),
    ],
)
def test_bad_joints_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        vjm.flexify(BEAM, **{"stiffness": 1.0, "rotor_inertia": 1.0, **options})  # type: ignore[arg-type]


def test_branching_and_impossible_links_of_real_robots_are_refused() -> None:
    file, options = robot(ANYMAL), {"joints": 2, "bending_stiffness": 3.0}
    with pytest.raises(ShapeError, match="child, one of: LF_HAA, RF_HAA, LH_HAA, RH_HAA"):
        vjm.flexify(file, link="base", **options)  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="a body that can exist"):  # 1 mg with the inertia of a barn
        vjm.flexify(file, link="base", child="LF_HAA", **options)  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="no child joint; expected ends"):
        vjm.flexify(file, link="LF_FOOT", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "no usable XML"),
        ("<model/>", "root element is 'model'"),
        ('<robot xmlns:xacro="x"><xacro:include filename="a"/></robot>', "run xacro first"),
        (BEAM.replace('value="1.0"', 'value="much"'), "value='much'; expected 1 finite number"),
    ],
)
def test_what_is_no_urdf_is_refused(text: str, message: str) -> None:
    with pytest.raises(ModelFileError, match=message):
        vjm.flexify(text, **GOOD)  # type: ignore[arg-type]


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = tmp_path / "robot.urdf", tmp_path / "flexible.urdf"
    file.write_text(BEAM)
    options = ["--link", "bar", "--joints", "2", "--bending-stiffness", "3,4", "--bending", "y,z", "--torsion", "5"]
    options += ["--axis", "x", "--joint", "motor", "--stiffness", "6", "--rotor-inertia", "7"]
    assert main(["flexify", str(file), *options, "-o", str(out)]) == 0
    assert capsys.readouterr().out == f"{out}: 7 joints with a spring\n"
    expected = vjm.flexify(file, link="bar", joints=2, bending_stiffness=(3, 4), bending="y,z", torsion=5, axis="x",
                           joint="motor", stiffness=6, rotor_inertia=7)  # fmt: skip
    assert out.read_text() == expected
    assert main(["flexify", str(file), *options, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["command"], result["experiment"], result["urdf"]) == ("flexify", "beam", expected)
    assert result["springs"][-1] == {
        "joint": "motor_spring",
        "stiffness": 6.0,
        "damping": 0.0,
        "cell": None,
        "driven": False,
    }
    assert main(["flexify", str(file), *options[2:]]) == 2
    assert "the name of the link that joints is of" in capsys.readouterr().err
    assert main(["flexify", str(tmp_path / "none.urdf"), *options]) == 2
    assert "No such file" in capsys.readouterr().err
