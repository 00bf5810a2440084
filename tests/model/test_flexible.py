"""Pinocchio models with springs: dynamics and their derivatives, equilibria, modes and state space."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vjm
from tests.model.arms import arms
from tests.model.chains import model_of, plain_chain
from tests.model.robots import LINKS, UR5, Array, box_beam, robot
from vjm.chain.virtual_links import Chain, MovingBase
from vjm.errors import ChoiceError, MissingPackageError, ModelFileError, ShapeError, VjmError
from vjm.model.dynamics import torque_errors
from vjm.model.flexible import FlexibleModel
from vjm.model.urdf import chain_to_urdf
from vjm.simulation.measurement import MarkerArcs

ANYMAL = LINKS["anymal thigh"][0]
LENGTH, MASS, TIP, EI = 0.8, 1.3, 0.4, (900.0, 500.0)


@pytest.fixture(scope="module")
def ur5() -> FlexibleModel:
    """A UR5 with a forearm that bends and twists and an elastic elbow, damped."""
    text = vjm.flexify(robot(UR5), link="forearm_link", joints=2, bending_stiffness=(400.0, 300.0), torsion=200.0,
                       kelvin_voigt=0.003, joint="elbow_joint", stiffness=2e3, rotor_inertia=0.4)  # fmt: skip
    return FlexibleModel.from_urdf(text)


@pytest.fixture(scope="module")
def walker() -> FlexibleModel:
    """An ANYmal that floats, with an elastic thigh: q has more numbers than v."""
    text = vjm.flexify(robot(ANYMAL), link="LF_THIGH", axis="z", joints=2, bending_stiffness=20.0, kelvin_voigt=0.01)
    return FlexibleModel.from_urdf(text, pin.JointModelFreeFlyer())


def state(model: FlexibleModel, count: int, seed: int = 0) -> tuple[Array, Array, Array]:
    """Random q, v, and accelerations or torques."""
    rng = np.random.default_rng(seed)
    rest = pin.neutral(model.model)
    q = [pin.integrate(model.model, rest, turn) for turn in rng.uniform(-0.7, 0.7, (count, model.model.nv))]
    v, a = rng.normal(size=(2, count, model.model.nv))
    return np.array(q), v, a


def differences(model: FlexibleModel, f: Callable[[Array], Array], q: Array, step: float = 1e-6) -> Array:
    """The derivative of f by small turns of each coordinate."""
    columns = []
    for unit in np.eye(model.model.nv):
        ahead, back = (f(pin.integrate(model.model, q, sign * step * unit)) for sign in (1, -1))
        columns.append((ahead - back) / (2 * step))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("name", ["ur5", "walker"])
def test_dynamics_have_springs_dampers_and_rotors(name: str, request: pytest.FixtureRequest) -> None:
    """M a + h of Pinocchio, plus K phi + D v, sample by sample; forward undoes inverse; one sample or many."""
    model: FlexibleModel = request.getfixturevalue(name)
    q, v, a = state(model, 4)
    torque = model.inverse_dynamics(q, v, a)
    bare, data = model.model, model.model.createData()
    for k in range(4):
        angle = pin.difference(bare, pin.neutral(bare), q[k])
        expected = pin.rnea(bare, data, q[k], v[k], a[k]) + model.stiffness * angle + model.damping * v[k]
        assert torque[k] == pytest.approx(expected, abs=1e-10)
    assert model.forward_dynamics(q, v, torque) == pytest.approx(a, abs=1e-7)
    assert model.inverse_dynamics(q[0], v[0], a[0]) == pytest.approx(torque[0], abs=1e-12)
    assert model.spring_torques(q[0], v[0]).shape == (bare.nv,)
    motors = np.random.default_rng(1).normal(size=(4, model.active.size))
    whole = np.zeros((4, bare.nv))
    whole[:, model.active] = motors
    assert np.array_equal(model.forward_dynamics(q, v, motors), model.forward_dynamics(q, v, whole))


def test_the_rotor_is_on_the_motors_side_alone(ur5: FlexibleModel) -> None:
    without = FlexibleModel.from_urdf(
        vjm.flexify(robot(UR5), joint="elbow_joint", stiffness=2e3, rotor_inertia=0.1)
    ).linearise(np.zeros(7))[0]
    more = FlexibleModel.from_urdf(
        vjm.flexify(robot(UR5), joint="elbow_joint", stiffness=2e3, rotor_inertia=0.4)
    ).linearise(np.zeros(7))[0]
    expected = np.zeros((7, 7))
    expected[2, 2] = 0.3
    assert more - without == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("name", ["ur5", "walker"])
def test_derivatives_are_those_of_finite_differences(name: str, request: pytest.FixtureRequest) -> None:
    model: FlexibleModel = request.getfixturevalue(name)
    q, v, a = state(model, 2, 3)
    torque = model.inverse_dynamics(q, v, a)
    inverse, forward = model.inverse_dynamics_derivatives(q, v, a), model.forward_dynamics_derivatives(q, v, torque)
    spring = model.spring_torque_derivatives()
    for k in range(2):
        here = q[k], v[k]
        by_q = differences(model, lambda x: model.inverse_dynamics(x, here[1], a[k]), q[k])  # noqa: B023
        assert inverse[0][k] == pytest.approx(by_q, abs=1e-5)
        steps = 1e-6 * np.eye(model.model.nv)
        by_v = [
            model.inverse_dynamics(q[k], v[k] + h, a[k]) - model.inverse_dynamics(q[k], v[k] - h, a[k]) for h in steps
        ]
        assert inverse[1][k] == pytest.approx(np.array(by_v).T / 2e-6, abs=1e-5)
        by_a = [model.inverse_dynamics(*here, a[k] + h) - model.inverse_dynamics(*here, a[k] - h) for h in steps]
        assert inverse[2][k] == pytest.approx(np.array(by_a).T / 2e-6, abs=1e-5)
        scale = np.abs(forward[0][k]).max()
        by_q = differences(model, lambda x: model.forward_dynamics(x, here[1], torque[k]), q[k], 1e-7)  # noqa: B023
        assert forward[0][k] == pytest.approx(by_q, abs=1e-6 * scale)
        by_v = [
            model.forward_dynamics(q[k], v[k] + h, torque[k]) - model.forward_dynamics(q[k], v[k] - h, torque[k])
            for h in steps
        ]
        assert forward[1][k] == pytest.approx(np.array(by_v).T / 2e-6, abs=1e-6 * np.abs(forward[1][k]).max())
        by_tau = [
            model.forward_dynamics(*here, torque[k] + h) - model.forward_dynamics(*here, torque[k] - h) for h in steps
        ]
        assert forward[2][k] == pytest.approx(np.array(by_tau).T / 2e-6, abs=1e-6 * np.abs(forward[2][k]).max())
        by_q = differences(model, lambda x: model.spring_torques(x, here[1]), q[k])  # noqa: B023
        assert spring[0] == pytest.approx(by_q, abs=1e-5)


def test_loads_are_those_of_virtual_work(ur5: FlexibleModel) -> None:
    """J^T w by Pinocchio's frame Jacobian; its derivative by finite differences, force and moment."""
    q = state(ur5, 1, 5)[0][0]
    force, wrench = np.array([3.0, -20.0, 7.0]), np.array([5.0, 11.0, -9.0, 1.0, -2.0, 3.0])
    loads = {"ee_link": wrench, "forearm_link_virtual_1_link": force}
    torque, slope = ur5.load_torques(q, loads)
    data = ur5.model.createData()
    expected = np.zeros(ur5.model.nv)
    for name, load in (("ee_link", wrench), ("forearm_link_virtual_1_link", np.r_[force, 0, 0, 0])):
        J = pin.computeFrameJacobian(ur5.model, data, q, ur5.model.getFrameId(name), pin.LOCAL_WORLD_ALIGNED)
        expected += J.T @ load
    assert torque == pytest.approx(expected, abs=1e-12)
    assert slope == pytest.approx(differences(ur5, lambda x: ur5.load_torques(x, loads)[0], q), abs=1e-7)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_a_beam_sags_as_its_formula_says_in_any_posture(seed: int) -> None:
    """q l^4 / 8 EI + P l^3 / 3 EI across gravity, in both planes; n = 3 errs by less than 1e-3."""
    gravity = np.random.default_rng(seed).normal(size=3)
    gravity *= 9.81 / np.linalg.norm(gravity)
    model = _beam_model(1e4, gravity=gravity)
    rest = model.static_equilibrium(np.zeros(model.model.nq))
    assert rest.converged
    tip = _position(model, rest.q, "tool")
    bend = MASS / 8 + TIP / 3
    expected = gravity[1:] * bend * LENGTH**3 / (1e4 * np.array([EI[1], EI[0]]))
    assert tip[1:] == pytest.approx(expected, rel=1e-3, abs=1e-3 * np.abs(expected).max())
    moment = 9.81 * (MASS / 2 + TIP) * LENGTH
    assert rest.torque == pytest.approx([gravity[2] / 9.81 * moment], abs=1e-4 * moment)


def _beam_model(stiffer: float = 1.0, joints: int = 3, gravity: object = None) -> FlexibleModel:
    stiffness = [stiffer * value for value in EI]
    beam = box_beam(LENGTH, MASS, 0.02, 0.02, TIP)
    text = vjm.flexify(beam, link="bar", joints=joints, bending_stiffness=stiffness, torsion=stiffer * 300.0)
    return FlexibleModel.from_urdf(text, gravity=gravity)  # type: ignore[arg-type]


def _position(model: FlexibleModel, q: Array, frame: str) -> Array:
    data = model.model.createData()
    pin.framesForwardKinematics(model.model, data, q)
    return np.array(data.oMf[model.model.getFrameId(frame)].translation)


ENDS = {"ur5 forearm": "wrist_1_joint", "panda shoulder": "panda_joint3", "talos forearm": "arm_left_5_joint",
        "anymal thigh": "LF_KFE"}  # fmt: skip


@pytest.mark.parametrize("case", ENDS)
def test_links_of_robots_deflect_as_beams(case: str) -> None:
    """A wrench at the child joint: F l^3 / 3 EI and M l^2 / 2 EI across the link, in a random posture, weightless."""
    path, options = LINKS[case]
    EI, GJ = 5e5, 4e5
    text = vjm.flexify(robot(path), joints=3, bending_stiffness=EI, torsion=GJ, **options)  # type: ignore[arg-type]
    model = FlexibleModel.from_urdf(text, gravity=np.zeros(3))
    q = state(model, 1, 7)[0][0]
    q[model.passive] = 0.0  # all joints of these robots have as many numbers in q as in v
    data = model.model.createData()
    pin.framesForwardKinematics(model.model, data, q)
    root, end = (
        data.oMf[model.model.getFrameId(name)].translation.copy() for name in (str(options["link"]), ENDS[case])
    )
    link = data.oMf[model.model.getFrameId(str(options["link"]))].rotation
    axis = link @ vjm_axis(text, str(options["link"]))
    length = float((end - root) @ axis)
    across = np.eye(3) - np.outer(axis, axis)
    force, moment = np.random.default_rng(8).normal(size=(2, 3))
    arm = end - root - length * axis  # where the joint is beside the axis
    total = moment + np.cross(arm, force)
    rest = model.static_equilibrium(q, {ENDS[case]: np.r_[force, moment]})
    assert rest.converged
    turned = (
        length**2 / (2 * EI) * np.cross(axis, across @ force)
        + length / EI * across @ total
        + length / GJ * axis * (axis @ total)
    )
    moved = length**3 / (3 * EI) * across @ force + length**2 / (2 * EI) * np.cross(total, axis) + np.cross(turned, arm)
    shift = _position(model, rest.q, ENDS[case]) - end
    assert shift == pytest.approx(moved, rel=1e-4, abs=1e-4 * np.linalg.norm(moved))


def vjm_axis(text: str, link: str) -> Array:
    words = text.split(f'vjm:flexible_link name="{link}"')[1].split('axis="')[1].split('"')[0]
    return np.array([float(word) for word in words.split()])


def test_sag_under_gravity_converges_with_the_number_of_joints() -> None:
    """A UR5's forearm with its wrist and a load in the hand, in a posture of its own: three joints are within 0.2 %."""
    shifts = []
    for joints in (3, 12):
        text = vjm.flexify(robot(UR5), link="forearm_link", joints=joints, bending_stiffness=4e3, torsion=3e3)
        model = FlexibleModel.from_urdf(text)
        q = np.zeros(model.model.nq)
        q[model.indices(["shoulder_lift_joint", "elbow_joint", "wrist_1_joint"])] = (-0.9, 0.6, 0.8)
        rest = model.static_equilibrium(q, {"ee_link": (0, 5.0, -40.0)})
        assert rest.converged
        shifts.append(_position(model, rest.q, "ee_link") - _position(model, q, "ee_link"))
    assert np.linalg.norm(shifts[1]) > 3e-4
    assert shifts[0] == pytest.approx(shifts[1], abs=2e-3 * np.linalg.norm(shifts[1]))


@pytest.mark.parametrize(("share", "status"), [(0.98, "converged"), (1.02, "unstable")])
def test_a_column_buckles_under_eulers_load(share: float, status: str) -> None:
    """P = pi^2 EI / 4 l^2 of a clamped column with a free end, about its weaker axis."""
    model = _beam_model(joints=8, gravity=np.zeros(3))
    critical = np.pi**2 * min(EI) / (4 * LENGTH**2)
    rest = model.static_equilibrium(np.zeros(model.model.nq), {"tool": (-share * critical, 0, 0)})
    assert rest.status == status
    assert rest.converged == (status == "converged")


@pytest.mark.parametrize(("load", "deflection"), [(1.0, 0.30172), (5.0, 0.71379), (10.0, 0.81061)])
def test_large_deflections_are_the_elasticas(load: float, deflection: float) -> None:
    """P l^2 / EI and deflection / l of K. E. Bisshopp and D. C. Drucker, Large deflection of cantilever beams, 1945."""
    model = _beam_model(joints=10, gravity=np.zeros(3))
    rest = model.static_equilibrium(np.zeros(model.model.nq), {"tool": (0, 0, -load * EI[0] / LENGTH**2)})
    assert rest.converged
    assert rest.residual < 1e-6
    assert -_position(model, rest.q, "tool")[2] / LENGTH == pytest.approx(deflection, rel=3e-3)


def test_what_has_no_equilibrium_says_so() -> None:
    model = _beam_model()
    loose = FlexibleModel(model.model, 0.0, passive=["bar_virtual_1_torsion"])
    spun = loose.static_equilibrium(np.zeros(model.model.nq), {"tool": (0, 0, 0, 1.0, 0, 0)})
    assert not spun.converged  # a moment that nothing resists
    assert spun.status == "stalled"
    assert spun.residual == pytest.approx(1.0)


def test_state_space_is_the_derivative_of_the_dynamics(ur5: FlexibleModel) -> None:
    q = ur5.static_equilibrium(0.4 * np.arange(ur5.model.nq) / ur5.model.nq).q
    hold = ur5.inverse_dynamics(q, np.zeros(ur5.model.nv), np.zeros(ur5.model.nv))
    assert hold[ur5.passive] == pytest.approx(0.0, abs=1e-7)
    gauge = {"gauge": ("forearm_link_virtual_1_x", 0.03)}
    linear = ur5.state_space(
        q, markers={"hand": "ee_link", "rim": ("ee_link", (0, 0, 0.1))}, encoders=["elbow_joint"], strains=gauge
    )
    n, still = ur5.model.nv, np.zeros(ur5.model.nv)
    by_q, by_v, by_tau = ur5.forward_dynamics_derivatives(q, still, hold)
    assert linear.A[:n] == pytest.approx(np.eye(2 * n)[n:], abs=0)
    assert linear.A[n:] == pytest.approx(np.hstack([by_q, by_v]), abs=1e-8 * np.abs(by_q).max())
    assert linear.B[n:] == pytest.approx(by_tau[:, ur5.active], abs=1e-8 * np.abs(by_tau).max())
    by_turn = differences(ur5, lambda x: _position(ur5, x, "ee_link"), q)
    assert linear.C[:3, :n] == pytest.approx(by_turn, abs=1e-8)
    data = ur5.model.createData()

    def rim(x: Array) -> Array:
        pin.framesForwardKinematics(ur5.model, data, x)
        return np.asarray(data.oMf[ur5.model.getFrameId("ee_link")].act(np.array([0, 0, 0.1])))

    assert linear.C[3:6, :n] == pytest.approx(differences(ur5, rim, q), abs=1e-8)
    assert linear.outputs == ("hand.x", "hand.y", "hand.z", "rim.x", "rim.y", "rim.z", "elbow_joint", "gauge")
    assert linear.C[7, :n] @ np.eye(n)[ur5.indices(["forearm_link_virtual_1_x"])[0]] == pytest.approx(
        0.03 / ur5.cells["forearm_link_virtual_1_x"]
    )
    assert linear.C[:, n:].any() == np.False_
    assert linear.inputs[2] == "elbow_joint"
    assert linear.states[:1] + linear.states[n : n + 1] == ("shoulder_pan_joint", "shoulder_pan_joint'")


def test_modes_are_the_eigenvalues_of_the_state_space(ur5: FlexibleModel) -> None:
    q = ur5.static_equilibrium(np.full(ur5.model.nq, 0.3)).q
    undamped = FlexibleModel(ur5.model, ur5.stiffness, passive=[ur5.names[k] for k in ur5.passive])
    A = undamped.state_space(q, coordinates="passive", inputs=()).A
    frequencies = np.sort(np.linalg.eigvals(A).imag)[len(A) // 2 :] / (2 * np.pi)
    assert undamped.modes(q).frequencies == pytest.approx(frequencies, rel=1e-6)
    assert ur5.modes(q).damping_ratios.min() > 0
    free = undamped.modes(q, coordinates="all").frequencies  # motors let go: the arm on its springs alone
    assert free.size < ur5.model.nv


def test_state_space_as_python_control(ur5: FlexibleModel, monkeypatch: pytest.MonkeyPatch) -> None:
    linear = ur5.state_space(np.zeros(ur5.model.nq), encoders="active", coordinates="all")
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(
        MissingPackageError, match=r"a control\.StateSpace needs the package control.*pip install control"
    ):
        linear.control()
    monkeypatch.undo()
    control = pytest.importorskip("control")
    system = linear.control()
    assert isinstance(system, control.StateSpace)
    assert system.input_labels == list(linear.inputs)
    assert system.output_labels == list(linear.outputs)
    assert np.asarray(system.A) == pytest.approx(linear.A)


def test_casadi_functions(ur5: FlexibleModel) -> None:
    """The same numbers as by NumPy; without a Pinocchio that has CasADi, how to get one."""
    try:
        import pinocchio.casadi  # noqa: F401
    except ImportError:
        with pytest.raises(MissingPackageError, match="conda install -c conda-forge pinocchio casadi"):
            ur5.casadi()
        pytest.skip("this Pinocchio is built without CasADi")
    functions = ur5.casadi()
    (q,), (v,), (a,) = state(ur5, 1, 9)
    torque = ur5.inverse_dynamics(q, v, a)
    assert np.ravel(functions.inverse_dynamics(q, v, a)) == pytest.approx(torque)
    assert np.ravel(functions.forward_dynamics(q, v, torque)) == pytest.approx(a)
    assert np.ravel(functions.spring_torques(q, v)) == pytest.approx(ur5.spring_torques(q, v))


def test_casadi_functions_of_a_pendulum_in_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stands in for `pinocchio.casadi` with a pendulum's equation: what FlexibleModel adds are the springs."""
    casadi = pytest.importorskip("casadi")
    model = pin.buildModelFromXML(box_beam(1.0, 1.0, 0.1, 0.1))
    inertia, weight = float(pin.crba(model, model.createData(), np.zeros(1))[0, 0]), 9.81 * 0.5
    stand_in = SimpleNamespace(
        Model=lambda model: model,
        difference=lambda model, rest, q: q - rest,
        rnea=lambda model, data, q, v, a: inertia * a - weight * casadi.cos(q),
        aba=lambda model, data, q, v, tau: (tau + weight * casadi.cos(q)) / inertia,
    )
    monkeypatch.setattr(pin, "casadi", stand_in, raising=False)
    monkeypatch.setitem(sys.modules, "pinocchio.casadi", stand_in)
    flexible = FlexibleModel(model, 7.0, 0.3, passive=["motor"], preload=[0.2])
    functions = flexible.casadi()
    q, v, a = ([0.4], [-1.3], [2.1])
    torque = flexible.inverse_dynamics(q, v, a)
    assert float(functions.inverse_dynamics(q, v, a)) == pytest.approx(torque[0], rel=1e-9)
    assert float(functions.forward_dynamics(q, v, torque)) == pytest.approx(2.1, rel=1e-9)
    assert float(functions.spring_torques(q, v)) == pytest.approx(0.2 - 7.0 * 0.4 + 0.3 * 1.3)


@settings(max_examples=15)
@given(arms(), st.integers(0, 2**32 - 1))
def test_an_identified_arm_is_its_torque_errors(chain: Chain, seed: int) -> None:
    """Eq. (14) with opposite sign, of the model itself and of the URDF that it writes, also on a base that moves."""
    rng = np.random.default_rng(seed)
    moving = replace(chain, base=MovingBase(2.0, 800.0, 3.0, 0.4))
    for given_chain in (chain, moving):
        q, v, a = rng.normal(size=(3, 2, given_chain.size)) * 0.4
        expected = -torque_errors(given_chain, q, v, a, np.zeros((2, given_chain.active.size)))
        flexible = model_of(given_chain).flexible_model()
        assert flexible.inverse_dynamics(q, v, a) == pytest.approx(expected, abs=1e-9)
        assert np.array_equal(flexible.passive, given_chain.passive)
        read = FlexibleModel.from_urdf(chain_to_urdf(given_chain))
        configuration = [pin.integrate(read.model, pin.neutral(read.model), turn) for turn in q]
        assert read.inverse_dynamics(np.array(configuration), v, a) == pytest.approx(expected, abs=1e-9)
        assert np.array_equal(read.passive, given_chain.passive)
        assert read.cells == flexible.cells


def test_markers_of_an_identified_arm_are_outputs() -> None:
    """Their derivatives, against finite differences of the curve through the joints."""
    chain = plain_chain()
    model = model_of(chain)
    model = replace(
        model, rig=replace(model.rig, links=tuple(replace(link, markers=(0.1, 0.3)) for link in model.rig.links))
    )
    q = 0.1 * np.arange(1, chain.size + 1)
    slopes = model.marker_slopes(q)
    assert list(slopes)[:3] == ["beam.m1.x", "beam.m1.y", "beam.m2.x"]
    arcs = MarkerArcs.of(model.rig)
    steps = 1e-6 * np.eye(chain.size)
    expected = [(arcs.positions(chain, q + h) - arcs.positions(chain, q - h)).ravel() / 2e-6 for h in steps]
    assert np.array(list(slopes.values())) == pytest.approx(np.array(expected).T, abs=3e-6)
    linear = model.flexible_model().state_space(q, outputs=slopes, markers={"joint": "fore_virtual_1"})
    assert linear.outputs == ("joint.x", "joint.y", "joint.z", *slopes)
    assert linear.C[3:, : chain.size] == pytest.approx(np.array(list(slopes.values())))


def test_three_lines_with_any_pinocchio_model() -> None:
    model = pin.buildSampleModelManipulator()
    last = list(model.names)[-2:]
    flexible = FlexibleModel(model, [50.0, 60.0], [0.1, 0.2], joints=last)
    assert [flexible.names[k] for k in flexible.passive] == last
    assert flexible.stiffness[flexible.passive].tolist() == [50.0, 60.0]
    whole = FlexibleModel(model, flexible.stiffness, flexible.damping)
    q, v, a = state(flexible, 3)
    assert np.array_equal(whole.passive, flexible.passive)
    assert np.array_equal(whole.inverse_dynamics(q, v, a), flexible.inverse_dynamics(q, v, a))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda m: FlexibleModel(m, [1.0, 2.0]), ShapeError, r"stiffness: got shape \(2,\); expected one value"),
        (lambda m: FlexibleModel(m, -1.0), ShapeError, "none negative"),
        (lambda m: FlexibleModel(m, 1.0, np.nan), ShapeError, "finite values"),
        (lambda m: FlexibleModel(m, 1.0, joints=["knee"]), ChoiceError, "unknown joint 'knee'; choose one of: motor"),
        (
            lambda m: FlexibleModel(m, 1.0).linearise(np.zeros(1), coordinates="some"),
            ChoiceError,
            "all, active, passive",
        ),
        (lambda m: FlexibleModel(m, 1.0).inverse_dynamics([0, 0], [0], [0]), ShapeError, r"expected shape \(1,\)"),
        (lambda m: FlexibleModel(m, 1.0).static_equilibrium([0.0], {"hand": (0, 0, 1)}), ChoiceError, "unknown frame"),
        (lambda m: FlexibleModel(m, 1.0).static_equilibrium([0.0], {"bar": (0, 1)}), ShapeError, "force and moment"),
        (lambda m: FlexibleModel(m, 1.0).state_space([0.0], strains={"s": ("motor", 1)}), ChoiceError, "with a cell"),
        (lambda m: FlexibleModel.from_urdf(box_beam(1, 1, 0.1, 0.1)), ModelFileError, "it has no springs"),
        (
            lambda m: FlexibleModel(pin.buildModelFromXML(box_beam(1, 1, 0.1, 0.1), pin.JointModelFreeFlyer()), 1.0),
            ShapeError,
            "root_joint.*a spring",
        ),
    ],
)
def test_bad_input_is_refused(call: Callable[[pin.Model], object], error: type[VjmError], message: str) -> None:
    with pytest.raises(error, match=message):
        call(pin.buildModelFromXML(box_beam(1.0, 1.0, 0.1, 0.1)))


@pytest.mark.parametrize("name", ["ur5", "walker"])
def test_configuration_undoes_displacements(name: str, request: pytest.FixtureRequest) -> None:
    """Single postures and batches; a free body stays neutral; joints without limits have two numbers in q."""
    model: FlexibleModel = request.getfixturevalue(name)
    angles = np.random.default_rng(2).uniform(-3, 3, (5, model.model.nv))
    q = model.configuration(angles)
    assert q.shape == (5, model.model.nq)
    turns = model.displacements(q)
    angled = [k for k, given in enumerate(model.names) if "[" not in given]
    assert turns[:, angled] == pytest.approx(angles[:, angled], abs=1e-12)
    assert np.array_equal(model.configuration(angles[0]), q[0])
    pendulum = pin.Model()
    pendulum.addJoint(0, pin.JointModelRUBZ(), pin.SE3.Identity(), "free")
    endless = FlexibleModel(pendulum, 0.0)
    assert endless.displacements(endless.configuration([2.5])) == pytest.approx([2.5])
