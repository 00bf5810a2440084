"""The URDF and what goes beside it in the simulators themselves: masses, frames, M(q), and motions with springs."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray

import vjm
from tests.model.chains import HOSTILE, Plane, extended_chain, model_of, plain_chain, plain_link
from tests.model.robots import mujoco_mass_matrix
from tests.simulation.setups import arm_of, rig_of, steel_link
from vjm.chain.virtual_links import Chain, MovingBase
from vjm.effects import CoulombFriction, CubicStiffness, InPlaneGravity, JointSpring, TipPayload
from vjm.errors import ChoiceError, ShapeError
from vjm.model.dynamics import Mechanism
from vjm.model.urdf import SIMULATORS, chain_to_urdf, simulator_file
from vjm.simulation.model import Model

Array = NDArray[np.float64]
DEMO = Path(vjm.__file__).parent / "demo" / "experiment.toml"


def on_a_table() -> Chain:
    return replace(extended_chain(), base=MovingBase(3.0, 2000.0, 4.0, 0.7))


def package(name: str) -> Any:
    return pytest.importorskip(name, reason=f"{name} has no wheel for this Python, or is not installed")


def in_pinocchio(file: Path, q: Array, frame: str) -> tuple[float, Array, Array]:
    pin = package("pinocchio")
    model = pin.buildModelFromUrdf(str(file))
    data, configuration = model.createData(), pin.integrate(model, pin.neutral(model), q)
    pin.framesForwardKinematics(model, data, configuration)
    M = np.triu(pin.crba(model, data, configuration))
    place = data.oMf[model.getFrameId(frame)].translation[:2]
    return pin.computeTotalMass(model), place, M + np.triu(M, 1).T


def in_mujoco(file: Path, q: Array, frame: str) -> tuple[float, Array, Array]:
    mujoco = package("mujoco")
    # MuJoCo fuses fixed links into those that carry them unless it is told not to.
    spec = mujoco.MjSpec.from_file(str(file))
    spec.compiler.fusestatic = False
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    return float(model.body_mass.sum()), data.body(frame).xpos[:2], mujoco_mass_matrix(model, data)


def in_pybullet(file: Path, q: Array, frame: str) -> tuple[float, Array, Array]:
    pybullet = package("pybullet")
    client = pybullet.connect(pybullet.DIRECT)
    arm = pybullet.loadURDF(str(file), flags=pybullet.URDF_USE_INERTIA_FROM_FILE)
    joints = [pybullet.getJointInfo(arm, k) for k in range(pybullet.getNumJoints(arm))]
    masses = [pybullet.getDynamicsInfo(arm, k)[0] for k in range(-1, len(joints))]
    movable = [joint[0] for joint in joints if joint[2] != pybullet.JOINT_FIXED]
    for k, angle in zip(movable, q, strict=True):
        pybullet.resetJointState(arm, k, angle)
    (tip,) = (joint[0] for joint in joints if joint[12].decode() == frame)
    place = pybullet.getLinkState(arm, tip, computeForwardKinematics=True)[4][:2]
    M = np.array(pybullet.calculateMassMatrix(arm, list(q)))
    pybullet.disconnect(client)
    return sum(masses), np.array(place), M


def in_drake(file: Path, q: Array, frame: str) -> tuple[float, Array, Array]:
    package("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    plant = MultibodyPlant(0.0)
    (arm,) = Parser(plant).AddModels(str(file))
    if file.suffix == ".urdf":
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    place = plant.GetFrameByName(frame).CalcPoseInWorld(context).translation()[:2]
    return plant.CalcTotalMass(context, [arm]), place, plant.CalcMassMatrix(context)


def in_yourdfpy(file: Path, q: Array, frame: str) -> tuple[float, Array, None]:
    robot = package("yourdfpy").URDF.load(str(file), load_meshes=False)
    robot.update_cfg(q)
    mass = sum(link.inertial.mass for link in robot.robot.links)
    return mass, robot.get_transform(frame, "base")[:2, 3], None


READERS: dict[str, Callable[[Path, Array, str], tuple[float, Array, Array | None]]] = {
    "pinocchio": in_pinocchio,
    "mujoco": in_mujoco,
    "pybullet": in_pybullet,
    "drake": in_drake,
    "yourdfpy": in_yourdfpy,
}


@pytest.mark.parametrize("chain", [plain_chain(), extended_chain(), on_a_table()], ids=["plain", "extended", "table"])
@pytest.mark.parametrize("tool", READERS)
def test_tools_find_the_masses_frames_and_mass_matrix_of_the_chain(tool: str, chain: Chain, tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    file.write_text(chain_to_urdf(chain), encoding="utf-8")
    q = np.random.default_rng(3).uniform(-1.0, 1.0, chain.size)
    mass, tip, M = READERS[tool](file, q, "fore_tip")
    expected = sum(link.masses.sum() + link.payload for link in chain.links) + (chain.base.mass if chain.base else 0.0)
    assert mass == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(tip, tip_of(chain, q[None])[0], atol=1e-9)
    if M is not None:
        np.testing.assert_allclose(M, Mechanism(chain).mass_matrix(q[None])[0], rtol=1e-9)


def tip_of(chain: Chain, q: Array) -> Array:
    """(T, 2) positions of the chain's end at angles (T, nv)."""
    frame, moved = f"{chain.links[-1].name}_tip", np.zeros(2)
    if chain.base is not None:
        moved, q, chain = q[:, :1] * chain.base.axis, q[:, 1:], replace(chain, base=None)
    return np.array([Plane(chain, row).places[frame][0] for row in q]) + moved


def script(file: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("written_by_vjm", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def by_mujoco(file: Path, q: Array, v: Array, motors: Callable[[float], Array], duration: float) -> Array:
    mujoco = package("mujoco")
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, v
    step, positions = model.opt.timestep, []
    for frame in range(round(100 * duration) + 1):
        for _ in range(round(0.01 / step) if frame else 0):
            data.ctrl[:] = motors(data.time + step / 2)
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        positions.append(data.site("beam_tip").xpos[:2].copy())
    return np.array(positions)


def demo() -> Model:
    rig = vjm.load_experiment(DEMO).rig
    return Model.nominal(rig, virtual_joints=4, kelvin_voigt=3e-4)


def driven_hub() -> Model:
    chain = arm_of(steel_link(4, "revolute"))
    return Model(chain, rig_of(chain), 1e-4, 1e-4)


def largest_difference(model: Model, simulator: str, folder: Path, duration: float = 5.0) -> float:
    """Largest distance [m] of the tip in a simulator from where vjm has it."""
    chain = model.arm.chain
    count, samples = chain.active.size, round(1000 * duration) + 1
    motors = lambda time: np.full(count, 0.2 * np.sin(2 * np.pi * time))  # noqa: E731
    q, v = np.zeros(chain.size), np.zeros(chain.size)
    q[chain.passive] = 0.03
    torque = np.array([motors(time) for time in np.linspace(0, duration, samples)])
    expected = tip_of(chain, model.simulate(torque=torque, duration=duration, initial=[q, v]).q[::10])
    assert np.ptp(expected[:, 1]) > 0.1  # it does swing
    _, file = model.export(folder / "arm.urdf", simulator)
    if simulator == "mujoco":
        found = by_mujoco(file, q, v, motors, duration)
    else:
        package({"drake": "pydrake"}.get(simulator, simulator))
        found = script(file).simulate(q, v, motors, duration)[1]
    return float(np.linalg.norm(found - expected, axis=1).max())


@pytest.mark.parametrize("model", [demo, driven_hub])
@pytest.mark.parametrize(
    "simulator", ["mujoco", *(pytest.param(one, marks=pytest.mark.slow) for one in ("pinocchio", "drake", "pybullet"))]
)
def test_simulators_move_it_as_vjm_does(simulator: str, model: Callable[[], Model], tmp_path: Path) -> None:
    assert largest_difference(model(), simulator, tmp_path) < 1e-4


@pytest.mark.parametrize("chain", [plain_chain(), extended_chain(), on_a_table()], ids=["plain", "extended", "table"])
def test_sdf_and_mjcf_are_the_same_arm(chain: Chain, tmp_path: Path) -> None:
    """Drake reads SDF as Gazebo does; springs are compared with the chain's."""
    q = np.random.default_rng(4).uniform(-1.0, 1.0, chain.size)
    expected, M = tip_of(chain, q[None])[0], Mechanism(chain).mass_matrix(q[None])[0]
    weight = Mechanism(chain).base_weight
    rests = np.zeros(chain.size)
    rests[0] = -weight / chain.stiffness[0] if weight else 0.0
    for simulator, reader in (("gazebo", in_drake), ("mujoco", in_mujoco)):
        file = tmp_path / f"arm{SIMULATORS[simulator]}"
        file.write_text(simulator_file(chain, simulator, "arm.urdf", {"beam": 0.008}), encoding="utf-8")
        root = ElementTree.parse(file).getroot()
        if simulator == "gazebo":
            axes = list(root.iter("dynamics"))
            values = [[float(axis.findtext(tag) or "nan") for axis in axes] for tag in SDF_TAGS]
        else:
            elements = [joint for joint in root.iter("joint") if "name" in joint.attrib]
            values = [[float(joint.attrib[tag]) for joint in elements] for tag in MJCF_TAGS]
            assert [joint.attrib["name"] for joint in elements] == list(chain.joint_names)
            assert [motor.attrib["joint"] for motor in root.iter("motor")] == [
                chain.joint_names[k] for k in chain.active
            ]
        stiffness, reference, damping, friction = map(np.array, values)
        assert stiffness.tolist() == chain.stiffness.tolist()
        assert damping.tolist() == chain.damping.tolist()
        assert reference.tolist() == rests.tolist()
        assert friction[chain.active[0]] == 0.008
        assert friction.sum() == 0.008
        _, tip, found = reader(file, q, "fore_tip")
        np.testing.assert_allclose(tip, expected, atol=1e-9)
        np.testing.assert_allclose(found, M, rtol=1e-9)


SDF_TAGS = ("spring_stiffness", "spring_reference", "damping", "friction")
MJCF_TAGS = ("stiffness", "springref", "damping", "frictionloss")


def test_gravity_springs_and_payload_that_effects_add_go_along(tmp_path: Path) -> None:
    """A pendulum of a link that hardly bends, on a spring, under gravity: MuJoCo finds vjm's swing."""
    effects = (InPlaneGravity(gx=3.0), JointSpring(stiffness=2.0, link=0), TipPayload(mass=0.05, link=0))
    assert largest_difference(replace(driven_hub(), effects=effects), "mujoco", tmp_path, 1.0) < 1e-4


def test_dry_friction_stops_it_in_mujoco_where_it_does_in_vjm(tmp_path: Path) -> None:
    model = replace(driven_hub(), effects=(CoulombFriction(torque=0.1, link=0),))
    assert largest_difference(model, "mujoco", tmp_path, 1.0) < 5e-3  # MuJoCo's friction is that of a soft constraint


def test_what_a_simulator_cannot_have_is_listed(tmp_path: Path) -> None:
    model = replace(driven_hub(), effects=(CubicStiffness(coefficient=3.0, link=0), InPlaneGravity(gx=1.0)))
    assert model.arm.not_in_simulators == ("cubic stiffness (beam)",)
    for simulator, suffix in SIMULATORS.items():
        urdf, beside = model.export(tmp_path / "arm.urdf", simulator)
        assert (urdf.name, beside.name) == ("arm.urdf", f"arm{suffix}")
        text = beside.read_text(encoding="utf-8")
        assert "cubic stiffness (beam)" in text
        assert "in-plane gravity" not in text


def test_sites_are_the_markers_of_the_straight_arm() -> None:
    mujoco = package("mujoco")
    model = driven_hub()
    link = model.rig.links[0]
    text = model.arm.simulator_file("mujoco", "arm.urdf", [link.markers])
    compiled = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(compiled)
    mujoco.mj_kinematics(compiled, data)
    found = [data.site(f"beam.m{k}").xpos[0] for k in range(1, len(link.markers) + 1)]
    assert found == pytest.approx(link.markers)


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_hostile_names_survive(simulator: str) -> None:
    chain = Chain(HOSTILE, (plain_link(HOSTILE), plain_link("{{ 7 * 7 }}{% raw %}")))
    text = simulator_file(chain, simulator, '"""\n--.urdf', left_out=["cubic stiffness (a -- b)"])
    if SIMULATORS[simulator] == ".py":
        names = next(line for line in text.splitlines() if "_joint" in line)
        assert eval(names.strip().rstrip(","))[0] == f"{HOSTILE}_joint"
        compile(text, "arm.py", "exec")
    else:
        assert next(ElementTree.fromstring(text).iter("joint")).attrib["name"] == f"{HOSTILE}_joint"


def test_what_cannot_be_exported_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ChoiceError, match="mujoco"):
        driven_hub().export(tmp_path / "arm.urdf", "bullet")
    with pytest.raises(ShapeError, match=r"does not end in \.xml"):
        driven_hub().export(tmp_path / "arm.xml", "mujoco")
    floating = replace(plain_chain(), base=MovingBase(3.0, 0.0, 4.0, 0.7))
    with pytest.raises(ShapeError, match="carries a weight"):
        model_of(floating).export(tmp_path / "arm.urdf", "drake")
    with pytest.raises(ShapeError, match="hub_inertia"):
        simulator_file(replace(plain_chain(), armature=0.1), "gazebo", "arm.urdf")
    assert not list(tmp_path.iterdir())
