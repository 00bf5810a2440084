"""Stiffness and damping of a whole robot's virtual joints from 3D markers; the motions are MuJoCo's."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

import vjm
from tests.model import robots
from vjm.chain.layout import layout, layout_of_lengths
from vjm.errors import ChoiceError, InsufficientDataError, ShapeError, VjmError
from vjm.identification.robot import RobotIdentification
from vjm.model.kinematics import MarkerTree, marker_tree

pytest.importorskip("mujoco")
from tests.identification.tube_robot import Array, Motion, Tube, simulate, wandering

TUBE = Tube()
PLACES = [("tube", [arc, *offset[1:]]) for arc, offset in TUBE.markers]
NAMES = [
    f"tube.{kind}_{what}{end}"
    for kind, end in (("bending", "_y"), ("bending", "_z"), ("torsional", ""))
    for what in ("stiffness", "damping")
]
FOREARM = 0.39225  # of a UR5 [m]
ENCODER, TORQUE = 2e-5, 0.02  # noise of encoders [rad] and of torques [N m]


def robot(tube: Tube = TUBE, joints: int = 3, **options: Any) -> vjm.FlexibleModel:
    """The robot as it is guessed: stiffness a third off, damping by half."""
    options = {"bending_stiffness": (30.0, 45.0), "torsion": 10.0, "kelvin_voigt": 1.5e-3} | options
    model = vjm.FlexibleModel.from_urdf(vjm.flexify(tube.urdf, link="tube", joints=joints, **options))
    model.model.armature = np.r_[0.02, 0.02, np.zeros(model.model.nv - 2)]
    return model


def truth(tube: Tube = TUBE) -> Array:
    """The parameters in the order of `NAMES`."""
    return np.array([value for B in (*tube.bending, tube.torsion) for value in (B, B * tube.kelvin_voigt)])


@lru_cache(maxsize=4)
def motion(tube: Tube = TUBE, rate: float = 250.0, duration: float = 8.0, size: float = 0.12) -> Motion:
    """A motion of the robot whose tube is cut into thirteen pieces."""
    return simulate(tube.mjcf, ["yaw", "pitch"], wandering(duration, rate, 0, size=size), rate, len(PLACES))


@lru_cache(maxsize=1)
def coarse_motion() -> Motion:
    """A motion of the robot that is cut as the model that is identified, with markers on the curve of its joints."""
    cuts = layout(TUBE.length, 3, distal="joined")
    mjcf = TUBE.mjcf_of(cuts.lengths, cuts.cells, layout_of_lengths(cuts.lengths, "joined").cells)
    found = simulate(mjcf, ["yaw", "pitch"], wandering(6.0, 250.0, 1, size=0.12), 250.0, len(PLACES))
    tree = marker_tree(robot(), [(frame, np.array(place)) for frame, place in PLACES])
    return replace(found, markers=tree.positions(np.hstack([found.q, found.passive]))[0])


def identified(
    motion: Motion, noise: float, seed: int, model: vjm.FlexibleModel, **options: Any
) -> RobotIdentification:
    """An identification from markers with noise [m], encoders and torque sensors."""
    rng = np.random.default_rng(seed)
    markers = motion.markers + noise * rng.normal(size=motion.markers.shape)
    q = motion.q + ENCODER * rng.normal(size=motion.q.shape)
    torque = motion.torque + TORQUE * rng.normal(size=motion.q.shape)
    given: dict[str, Any] = {"time": motion.time, "markers": PLACES, "bandwidth": 20.0} | options
    return vjm.identify_stiffness(model, q, None, None, torque, markers, **given)


@pytest.mark.parametrize(
    ("rate", "noise", "seed"),
    [(250.0, 3e-4, 1), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((250.0, 5e-4, 2), (500.0, 1e-4, 3)))],
)
def test_bending_torsion_and_damping_of_a_finer_tube_are_found(rate: float, noise: float, seed: int) -> None:
    """Four virtual joints against MuJoCo's twelve: within 2 %."""
    fit = identified(motion(rate=rate), noise, seed, robot(joints=4))
    assert [each.name for each in fit.parameters] == NAMES
    assert [each.value for each in fit.parameters] == pytest.approx(truth(), rel=0.02)
    assert not fit.not_identifiable
    assert fit.marker_noise == pytest.approx(noise, rel=0.05)
    assert fit.condition < 100
    assert fit["tube.bending_stiffness_y"].unit == "N m^2"
    assert fit["tube.bending_damping_y"].unit == "N m^2 s"
    # The motors' torques are explained but for the noise of markers and sensors, and joints alike for gravity.
    assert fit.residual_torque[:, :2].std(axis=0).max() < 0.05 * np.ptp(motion(rate=rate).torque, axis=0).max()
    K = fit.model.stiffness[fit.model.indices(["tube_virtual_1_y"])]
    assert float(K[0]) == pytest.approx(fit.parameters[0].value / fit.model.cells["tube_virtual_1_y"])


@pytest.mark.slow
def test_standard_errors_cover_the_truth_and_no_more() -> None:
    """95 % intervals over 20 seeds, and the scatter is what they say."""
    fits = [identified(coarse_motion(), 3e-4, seed, robot()) for seed in range(20)]
    values = np.array([[each.value for each in fit.parameters] for fit in fits])
    stds = np.array([[each.std for each in fit.parameters] for fit in fits])
    assert (np.abs(values - truth()) < 1.96 * stds).sum(axis=0).min() >= 17
    assert values.mean(axis=0) == pytest.approx(truth(), rel=5e-3)
    # The ratio of a standard deviation of 20 values to the true one is within 0.6 and 1.5 in 199 of 200 cases.
    ratio = values.std(axis=0, ddof=1) / stds.mean(axis=0)
    assert ((ratio > 0.6) & (ratio < 1.5)).all()
    covariance = np.cov(values.T)
    assert np.diag(fits[0].covariance) == pytest.approx(np.diag(covariance), rel=1.3)


def test_least_squares_is_biased_and_instruments_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same frames as equations and as instruments: ordinary least squares, with a bias of percents."""
    from vjm.identification import robot as module

    options: dict[str, Any] = {"bandwidth": 30.0}
    instruments = [identified(coarse_motion(), 5e-4, seed, robot(), **options) for seed in range(3)]
    solve = module._Problem.solve

    def ordinary(self: Any, *arguments: Any) -> Any:
        self.halves = [self.mean, self.mean]
        return solve(self, *arguments)

    monkeypatch.setattr(module._Problem, "solve", ordinary)
    plain = [identified(coarse_motion(), 5e-4, seed, robot(), **options) for seed in range(3)]

    def bias(fits: list[RobotIdentification]) -> Array:
        errors = [
            [(each.value - true) / true for each, true in zip(fit.parameters, truth(), strict=True)] for fit in fits
        ]
        return np.abs(np.mean(errors, axis=0))

    assert bias(instruments)[::2].max() < 0.005
    assert bias(plain)[::2].max() > 0.02


def test_torsion_that_is_not_excited_is_not_identifiable() -> None:
    """A tool on the tube's axis twists nothing: its torsion is held, the rest is as right as ever."""
    tube = replace(TUBE, beside=0.0)
    fit = identified(motion(tube), 3e-4, 1, robot(tube))
    assert [each.name for each in fit.not_identifiable] == NAMES[4:]
    torsion = fit["tube.torsional_stiffness"]
    assert "the motion does not excite the torsion of tube" in torsion.reason
    assert torsion.std is None
    assert torsion.value == pytest.approx(10.0)  # the guess
    assert [each.value for each in fit.parameters[:4]] == pytest.approx(truth(tube)[:4], rel=0.02)
    assert fit.covariance.shape == (4, 4)
    assert "tube.torsional_stiffness: not identifiable, the motion does not excite" in str(fit)


def test_torsion_that_no_marker_shows_is_not_identifiable() -> None:
    found = coarse_motion()
    places = [("tube", [arc, 0.0, 0.0]) for arc in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)]
    tree = marker_tree(robot(), [(frame, np.array(place)) for frame, place in places])
    found = replace(found, markers=tree.positions(np.hstack([found.q, found.passive]))[0])
    fit = identified(found, 1e-4, 1, robot(), markers=places)
    assert fit["tube.torsional_stiffness"].reason == "no marker moves with the torsion of tube"
    assert "beside" in fit["tube.torsional_stiffness"].remedy
    assert fit["tube.bending_stiffness_z"].value == pytest.approx(33.0, rel=0.03)


def test_a_ur5s_forearm_is_found() -> None:
    """MuJoCo reads the URDF of a forearm of ten virtual joints by itself; three are identified."""
    text = robots.robot(robots.UR5).read_text(encoding="utf-8")
    bending, torsion, time = (400.0, 300.0), 150.0, 2e-3
    options: dict[str, Any] = {"link": "forearm_link", "kelvin_voigt": time}
    fine = vjm.flexify(text, joints=10, bending_stiffness=bending, torsion=torsion, **options)
    posture = (0.3, -1.2, 1.4, -0.4, 0.9, 0.0)
    motors = [f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]
    # In the middle of a rigid piece a beam that twists and bends is where the piece is.
    lengths = layout(FOREARM, 10, distal="joined").lengths
    middles = (np.cumsum(lengths) - lengths / 2)[1:10].tolist()
    places = [("forearm_link", [side, 0.05, arc]) for arc in middles for side in (-0.1, 0.1)]
    targets = wandering(6.0, 250.0, 1, highest=20.0, size=0.06, around=posture)
    # Places of the link's frame, whose z axis is along it, on whichever virtual link is there at rest.
    bodies = ["forearm_link", *(f"forearm_link_virtual_{j}_link" for j in range(1, 11))]
    arcs = np.r_[0.0, np.cumsum(lengths)[:-1]]
    pieces = [int(np.searchsorted(arcs, place[2])) - 1 for _, place in places]
    sites = [(bodies[k], [*place[:2], place[2] - arcs[k]]) for k, (_, place) in zip(pieces, places, strict=True)]
    found = simulate(in_mujoco(fine, motors, sites, 0.1, 4000.0), motors, targets, 250.0, len(places))
    guess = vjm.flexify(text, joints=3, bending_stiffness=200.0, torsion=200.0, **options)
    fit = identified(found, 1e-4, 1, vjm.FlexibleModel.from_urdf(guess), markers=places)
    assert not fit.not_identifiable
    stiffness, damping = fit.parameters[::2], fit.parameters[1::2]
    assert [each.value for each in stiffness] == pytest.approx([*bending, torsion], rel=0.02)
    for each, true in zip(damping, (*bending, torsion), strict=True):
        assert each.std is not None
        assert each.std < 0.02 * each.value
        assert each.value == pytest.approx(true * time, abs=0.01 * true * time + 2 * each.std)


def in_mujoco(urdf: str, motors: list[str], sites: list[tuple[str, list[float]]], armature: float, kp: float) -> Any:
    """A URDF without its shapes, with its springs, motors that hold their targets, and sites on its bodies."""
    import mujoco

    model = vjm.FlexibleModel.from_urdf(urdf)
    shapes = re.compile(r"<(visual|collision)\b.*?</\1>", re.DOTALL)
    spec = mujoco.MjSpec.from_string(shapes.sub("", urdf))
    spec.option.timestep, spec.option.integrator = 1e-4, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for k, name in enumerate(model.names):
        joint = spec.joint(name)
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.stiffness[0] = model.stiffness[k]
        joint.damping[0] = model.damping[k]
    for name in motors:
        spec.joint(name).armature = armature
        actuator = spec.add_actuator(target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=kp, kv=kp / 50)
    for m, (body, place) in enumerate(sites):
        spec.body(body).add_site(name=f"m{m}", pos=place)
    return spec.compile()


def test_an_elastic_joint_is_found() -> None:
    """Its spring has a stiffness of its own; the markers are on the rigid link behind it."""
    options: dict[str, Any] = {"joint": "pitch", "rotor_inertia": 0.02}
    text = vjm.flexify(TUBE.urdf, stiffness=300.0, kelvin_voigt=2e-3, **options)
    motors = ["yaw", "pitch"]
    robot = in_mujoco(text, motors, PLACES, 0.02, 400.0)
    found = simulate(robot, motors, wandering(6.0, 250.0, 2, size=0.1), 250.0, len(PLACES))
    guess = vjm.FlexibleModel.from_urdf(vjm.flexify(TUBE.urdf, stiffness=700.0, **options))
    fit = identified(found, 3e-4, 1, guess)
    stiffness, damping = fit.parameters
    assert stiffness.name == "pitch_spring.stiffness"
    assert stiffness.value == pytest.approx(300.0, rel=0.005)
    assert damping.value == pytest.approx(0.6, rel=0.02)
    # Rotor and all: the motors' torques are explained to what noise and a filter of 20 Hz leave.
    assert np.abs(fit.residual_torque[:, 1]).mean() < 0.1 * np.abs(found.torque[:, 1]).mean()


def test_joints_that_are_not_tied_have_values_of_their_own() -> None:
    fit = identified(coarse_motion(), 1e-4, 1, robot(), tied=False)
    assert len(fit.parameters) == 18
    first = fit["tube_virtual_1_y.stiffness"]
    assert first.unit == "N m/rad"
    assert fit["tube_virtual_1_y.damping"].unit == "N m s/rad"
    assert first.value * fit.model.cells["tube_virtual_1_y"] == pytest.approx(45.0, rel=0.02)


def test_rates_and_accelerations_may_be_given() -> None:
    """Those of a spline through exact angles; markers by name."""
    from scipy.interpolate import make_interp_spline

    found = coarse_motion()
    spline = make_interp_spline(found.time, found.q, k=7)
    noisy = found.markers + 1e-4 * np.random.default_rng(1).normal(size=found.markers.shape)
    named = {f"marker {k}": place for k, place in enumerate(PLACES)}
    fit = vjm.identify_stiffness(
        robot(), found.q, spline(found.time, 1), spline(found.time, 2), None, noisy,
        time=found.time, markers=named, bandwidth=20.0,
    )  # fmt: skip
    assert [each.value for each in fit.parameters] == pytest.approx(truth(), rel=0.02)
    assert np.isnan(fit.residual_torque[:, :2]).all()


@pytest.mark.parametrize("count", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_markers_may_hide(count: int) -> None:
    """One in ten, at random, and all but three for half a second: nearly all other frames are used."""
    found = coarse_motion()
    markers = found.markers.copy()
    markers[np.random.default_rng(1).random(markers.shape[:2]) < 0.1] = np.nan
    markers[300:420, 3:] = np.nan
    fits = [identified(replace(found, markers=markers), 3e-4, seed, robot()) for seed in range(count)]
    whole = identified(found, 3e-4, 0, robot())
    errors = []
    for fit in fits:
        assert fit.marker_noise == pytest.approx(3e-4, rel=0.05)
        assert not ((fit.time > found.time[305]) & (fit.time < found.time[415])).any()
        assert fit.time.size > 0.85 * whole.time.size
        for each, true, other in zip(fit.parameters, truth(), whole.parameters, strict=True):
            assert each.std is not None
            assert other.std is not None
            assert other.std < each.std < 3 * other.std
            errors.append((each.value - true) / each.std)
    assert np.abs(errors).max() < 4
    if count == 8:  # the root mean square of 48 errors, in part correlated, in units of their standard deviations
        assert 0.75 < np.sqrt(np.mean(np.square(errors))) < 1.3


def test_positions_of_markers_have_their_derivatives() -> None:
    """Central differences; joints that slide too."""
    tree = marker_tree(robot(), [(frame, np.array(place)) for frame, place in PLACES])
    joints = (*tree.joints[:3], replace(tree.joints[3], slides=True), *tree.joints[4:])
    for each in (tree, MarkerTree(joints, tree.bodies, tree.offsets, tree.slopes)):
        q = np.random.default_rng(1).uniform(-0.5, 0.5, (2, len(joints)))
        slopes = each.positions(q)[1]
        for k, step in enumerate(1e-6 * np.eye(len(joints))):
            difference = (each.positions(q + step)[0] - each.positions(q - step)[0]) / 2e-6
            assert slopes[..., k] == pytest.approx(difference, abs=1e-8)


def test_markers_are_on_the_curve_of_a_beam() -> None:
    """A tube bent to a circle and twisted evenly: points on it are the circle's, to second order in the bend."""
    tree = marker_tree(robot(), [("tube", np.array([arc, 0.0, 0.0])) for arc in (0.15, 0.3, 0.45, 0.6)])
    model, kappa = robot(), 0.01
    q = np.zeros((1, model.model.nv))
    for j in (1, 2, 3):
        name = f"tube_virtual_{j}_z"
        q[0, model.indices([name])] = kappa * model.cells[name]
    places = tree.positions(q)[0][0] - [0.05, 0.0, 0.4]
    assert places[:, 1] == pytest.approx(kappa * np.array([0.15, 0.3, 0.45, 0.6]) ** 2 / 2, rel=1e-3)
    twisted = marker_tree(model, [("tube", np.array([arc, 0.1, 0.0])) for arc in (0.15, 0.3, 0.45, 0.6)])
    q = np.zeros((1, model.model.nv))
    for j in (1, 2, 3):
        name = f"tube_virtual_{j}_torsion"
        q[0, model.indices([name])] = kappa * model.cells[name]
    places = twisted.positions(q)[0][0] - [0.05, 0.0, 0.4]
    assert places[:, 2] == pytest.approx(0.1 * kappa * np.array([0.15, 0.3, 0.45, 0.6]), rel=1e-3)


def test_a_marker_may_be_given_in_any_virtual_link() -> None:
    """The place in the link's frame and the one in the frame of a virtual link mark the same point, however bent."""
    model = robot()
    second = 0.6 * 0.5  # three joints in all: the second in the middle
    one, other = (
        marker_tree(model, [(frame, np.array([arc, 0.03, 0.01]))])
        for frame, arc in (("tube", 0.35), ("tube_virtual_2_link", 0.35 - second))
    )
    q = np.random.default_rng(3).uniform(-0.2, 0.2, (4, model.model.nv))
    assert one.positions(q)[0] == pytest.approx(other.positions(q)[0], abs=1e-12)


def test_a_robot_that_floats_is_refused() -> None:
    import pinocchio as pin

    text = vjm.flexify(TUBE.urdf, link="tube", joints=2, bending_stiffness=10.0)
    model = vjm.FlexibleModel.from_urdf(text, pin.JointModelFreeFlyer())
    with pytest.raises(ShapeError, match="6 coordinates; expected joints of one coordinate each"):
        marker_tree(model, [("tube", np.zeros(3))])


BAD: list[tuple[str, Callable[[dict[str, Any]], dict[str, Any]], type[VjmError], str]] = [
    ("no model", lambda a: a | {"model": 1.0}, ShapeError, "a vjm.FlexibleModel with passive joints"),
    ("angles", lambda a: a | {"q_active": a["q_active"][:, :1]}, ShapeError, "q_active.*shape .T, n_a. = .1500, 2."),
    ("letters", lambda a: a | {"q_active": "abc"}, ShapeError, "q_active: got 'abc'; expected an array of numbers"),
    ("NaN", lambda a: a | {"torques": a["torques"] * np.nan}, ShapeError, "torques: got NaN or infinity in row 0"),
    ("markers", lambda a: a | {"marker_positions_3d": a["marker_positions_3d"][:, 1:]}, ShapeError, "1500, 12, 3"),
    ("infinity", lambda a: a | {"marker_positions_3d": a["marker_positions_3d"] * np.inf}, ShapeError, "infinity|NaN"),
    ("millimetres", lambda a: a | {"marker_positions_3d": 1e3 * a["marker_positions_3d"]}, ShapeError, "in metres"),
    ("degrees", lambda a: a | {"q_active": np.degrees(a["q_active"])}, ShapeError, "and degrees .*angles in radians"),
    (
        "one frame for all",
        lambda a: a | {name: np.repeat(a[name][:1], 1500, axis=0) for name in ("q_active", "marker_positions_3d")},
        InsufficientDataError,
        "every frame shows the markers at the same places",
    ),
    ("order", lambda a: a | {"marker_positions_3d": a["marker_positions_3d"][:, ::-1]}, ShapeError, "order of"),
    ("frame", lambda a: a | {"markers": [("hose", [0, 0, 0]), *PLACES[1:]]}, ChoiceError, "hose.*virtual_1_link"),
    ("place", lambda a: a | {"markers": [("tube", [0, 0]), *PLACES[1:]]}, ShapeError, "marker in tube.*three finite"),
    ("no pair", lambda a: a | {"markers": [3.0, *PLACES[1:]]}, ShapeError, "a frame and an offset"),
    ("time", lambda a: a | {"time": a["time"][::-1]}, ShapeError, "growing"),
    ("short", lambda a: a | {"time": a["time"][:9]}, InsufficientDataError, "40 frames"),
    ("bandwidth", lambda a: a | {"bandwidth": 200.0}, ShapeError, "a frequency up to 62.5 Hz"),
    ("hidden", lambda a: a | {"marker_positions_3d": np.nan * a["marker_positions_3d"]}, VjmError, "only 0 frames"),
    (
        "few markers",
        lambda a: a | {"markers": PLACES[-2:], "marker_positions_3d": a["marker_positions_3d"][:, -2:]},
        InsufficientDataError,
        "do not tell apart the angles of tube_virtual_1_y.*fewer joints",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("change", "error", "says"), [case[1:] for case in BAD], ids=[case[0] for case in BAD])
def test_bad_input_is_refused(
    change: Callable[[dict[str, Any]], dict[str, Any]], error: type[VjmError], says: str
) -> None:
    found = coarse_motion()
    arguments = {
        "model": robot(), "q_active": found.q, "rates": None, "accelerations": None, "torques": found.torque,
        "marker_positions_3d": found.markers, "time": found.time, "markers": PLACES,
    }  # fmt: skip
    with pytest.raises(error, match=says):
        vjm.identify_stiffness(**change(arguments))
