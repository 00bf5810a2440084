"""Mistakes that people make: each is named with its remedy before anything is fitted, and nothing else is."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest

import vjm
from tests.diagnosis.rigs import RIG, recorded
from tests.fine_beam.make_hub import write_hub_experiment
from tests.hidden.rigs import write_hidden
from tests.hidden.severities import Planted
from tests.simulation.integrators import simulate
from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.cli import main
from vjm.diagnosis import diagnose
from vjm.effects import CoulombFriction, Effect, ViscousFriction
from vjm.errors import MistakeError
from vjm.experiment.conventions import Camera, Conventions, Units
from vjm.identification import identify
from vjm.identification.check import failure_of
from vjm.identification.mistakes import find_mistakes
from vjm.identification.mistakes.geometry import heading_mistakes
from vjm.model.modes import linearise
from vjm.records import Experiment, Link, Payload, Recording, RecordingComparison, Rig
from vjm.simulation.arm import Arm

DEMO = Path(vjm.__file__).parent / "demo" / "experiment.toml"
WIDTH, THICKNESS = 0.035, 0.0015  # m
QUICK = 10.0  # s
Change = Callable[[Experiment], Experiment]


@cache
def hub() -> Experiment:
    folder = Path(mkdtemp())
    experiment = vjm.load_experiment(write_hub_experiment(folder, 1))
    shutil.rmtree(folder)
    (link,) = experiment.rig.links
    modulus = 12 * link.bending_stiffness / (WIDTH * THICKNESS**3)
    section = {"width": WIDTH, "thickness": THICKNESS, "youngs_modulus": modulus}
    return replace(experiment, rig=replace(experiment.rig, links=(replace(link, **section),)))


@cache
def clamped() -> Experiment:
    return vjm.load_experiment(DEMO)


BOTH = (hub, clamped)


def recordings(change: Callable[[Recording], Recording]) -> Change:
    return lambda experiment: replace(experiment, recordings=tuple(map(change, experiment.recordings)))


def markers(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return recordings(lambda one: replace(one, markers=change(one.markers.copy())))


def factors(**by_key: float) -> Change:
    def changed(experiment: Experiment) -> Experiment:
        (link,) = experiment.rig.links
        values = {key: np.multiply(getattr(link, key), factor).tolist() for key, factor in by_key.items()}
        if not {"width", "thickness", "youngs_modulus"}.isdisjoint(values):
            values["bending_stiffness"] = None
        return replace(experiment, rig=replace(experiment.rig, links=(replace(link, **values),)))

    return changed


def sensors(**by_key: float) -> Change:
    def changed(experiment: Experiment) -> Experiment:
        values = {key: factor * getattr(experiment.rig, key) for key, factor in by_key.items()}
        return replace(experiment, rig=replace(experiment.rig, **values))

    return changed


def exchanged(one: int, other: int) -> Change:
    def change(places: np.ndarray) -> np.ndarray:
        places[:, [one, other]] = places[:, [other, one]]
        return places

    return markers(change)


def in_link_frame(one: Recording) -> Recording:
    known = np.isfinite(one.theta[:, 0])
    theta = np.interp(one.time, one.time[known], one.theta[known, 0])[:, None]
    x, y = np.moveaxis(one.markers, 2, 0)
    turned = np.cos(theta) * x + np.sin(theta) * y, np.cos(theta) * y - np.sin(theta) * x
    return replace(one, markers=np.stack(turned, axis=-1))


def turned_by(angle: float) -> np.ndarray:
    """Matrix that turns rows of coordinates counterclockwise."""
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def framed(frame: str) -> Change:
    def changed(experiment: Experiment) -> Experiment:
        links = tuple(replace(link, markers_frame=frame) for link in experiment.rig.links)
        return replace(experiment, rig=replace(experiment.rig, links=links))

    return changed


def exchanged_section(experiment: Experiment) -> Experiment:
    return factors(width=THICKNESS / WIDTH, thickness=WIDTH / THICKNESS)(experiment)


def loaded(experiment: Experiment) -> Experiment:
    (link,) = experiment.rig.links
    return replace(experiment, rig=replace(experiment.rig, links=(replace(link, payload=100.0),)))


def in_gravity(*gravity: float) -> Change:
    def changed(experiment: Experiment) -> Experiment:
        turned = recordings(lambda r: replace(r, gravity=gravity))(experiment)
        return replace(turned, rig=replace(experiment.rig, gravity=gravity))

    return changed


def never_tracked(experiment: Experiment) -> Experiment:
    """One recording in which a program wrote zeros for all that it did not see."""
    first, second, *others = experiment.recordings
    zeros = replace(second, markers=np.where(np.isfinite(second.markers), 0.0, np.nan))
    return replace(experiment, recordings=(first, zeros, *others))


CERTAIN = [  # name, rigs, mistake, words of the sentence
    ("mm", BOTH, markers(lambda m: 1e3 * m), ["millimetres", '[units] length = "mm"', "times those of its key"]),
    ("cm", BOTH, markers(lambda m: 1e2 * m), ["centimetres", '[units] length = "cm"']),
    ("inch", BOTH, markers(lambda m: m / 0.0254), ["inches", '[units] length = "in"']),
    ("length in mm", BOTH, factors(length=1e3), ["looks like mm", "'length' of [[link]] beam in metres, 1"]),
    ("lengths in mm", BOTH, factors(length=1e3, markers=1e3), ["its lengths look like millimetres", "'markers'"]),
    ("thickness in mm", BOTH, factors(thickness=1e3), ["'thickness' looks like mm", "in metres, 0.0015"]),
    ("width in mm", BOTH, factors(width=1e3), ["'width' looks like mm", "in metres, 0.035"]),
    ("section in mm", BOTH, factors(width=1e3, thickness=1e3), ["'width' looks like mm and 'thickness'"]),
    ("exchanged section", BOTH, exchanged_section, ["'width' and 'thickness' look exchanged", "exchange 'width'"]),
    (
        "untracked",
        BOTH,
        never_tracked,
        ["beam.m5 stand exactly where another marker or the zero of the coordinates is", "leave these cells empty"],
    ),
    ("E in GPa", BOTH, factors(youngs_modulus=1e-9), ["'youngs_modulus' looks like GPa", "in Pa"]),
    ("mass in g", BOTH, factors(mass=1e3), ["'mass' looks like grams", "in kg, 0.44"]),
    ("hub in kg cm^2", (hub,), factors(hub_inertia=1e4), ["'hub_inertia' looks like kg cm^2", "in kg m^2, 0.024"]),
    ("ms", BOTH, recordings(lambda r: replace(r, time=1e3 * r.time)), ["milliseconds", '[units] time = "ms"']),
    ("us", BOTH, recordings(lambda r: replace(r, time=1e6 * r.time)), ["microseconds", '[units] time = "us"']),
    ("degrees", (hub,), recordings(lambda r: replace(r, theta=np.rad2deg(r.theta))), ['[units] angle = "deg"']),
    ("reversed", BOTH, markers(lambda m: m[:, ::-1]), ["reversed", "from the base outwards", "[columns]"]),
    ("swapped", BOTH, exchanged(1, 2), ["beam.m2 and beam.m3 exchanged", "swapped", "[columns]"]),
    ("swapped ends", BOTH, exchanged(0, 4), ["beam.m1 and beam.m5 exchanged"]),
    ("x for y", BOTH, markers(lambda m: m[..., ::-1]), ["x and y look swapped", '[camera] axes = ["y", "x"]']),
    ("x flipped", BOTH, markers(lambda m: m * [-1, 1]), ["pointed the other way", '[camera] axes = ["-x", "y"]']),
    ("y flipped", (hub,), markers(lambda m: m * [1, -1]), ["y points the other way", 'axes = ["x", "-y"]']),
    ("origin", BOTH, markers(lambda m: np.add(m, (0.1, -0.05))), ["origin is another", "[camera] origin = [-0.1, 0.0"]),
    ("link's frame", (hub,), recordings(in_link_frame), ["do not turn", 'markers_frame = "link" in [[link]] beam']),
    ("base frame", (hub,), framed("link"), ["turn with beam.theta", 'markers_frame = "base" in [[link]] beam']),
    (
        "sign of theta",
        (hub,),
        recordings(lambda r: replace(r, theta=-r.theta)),
        ["its sign is wrong; multiply", "'beam.theta' by -1"],
    ),
    (
        "degrees, other sign",
        (hub,),
        recordings(lambda r: replace(r, theta=-np.rad2deg(r.theta))),
        ["by -1, whose sign"],
    ),
    (
        "zero of theta",
        (hub,),
        recordings(lambda r: replace(r, theta=r.theta - 0.5)),
        ["ahead of", "add 0.5 rad to beam"],
    ),
    ("camera turned", BOTH, markers(lambda m: m @ turned_by(0.4)), ["degrees ahead of", "[camera] rotation = -0.4"]),
    ("sign of torque", (hub,), recordings(lambda r: replace(r, tau=-r.tau)), ["its sign is wrong", "'beam.tau' by -1"]),
    (
        "N mm, other sign",
        (hub,),
        recordings(lambda r: replace(r, tau=-1e3 * r.tau)),
        ['"N mm", and multiply the column'],
    ),
    ("N mm", (hub,), recordings(lambda r: replace(r, tau=1e3 * r.tau)), ["1000 times", 'torque = "N mm"']),
    ("no torque", (hub,), recordings(lambda r: replace(r, tau=0 * r.tau)), ["zero throughout", 'input = "motion"']),
    ("noise in km", BOTH, sensors(marker_noise=1e-3), ["'marker_noise' of [sensors]", "1000 times too small"]),
    ("noise in mm", BOTH, sensors(marker_noise=1e3), ["'marker_noise' of [sensors]", "1000 times too large"]),
    ("angles' noise", (hub,), sensors(encoder_noise=1e-3), ["'encoder_noise' of [sensors]", "too small"]),
]
CASES = [
    pytest.param(rig, mistake, words, id=f"{name}, {rig.__name__}")
    for name, rigs, mistake, words in CERTAIN
    for rig in rigs
]


@pytest.mark.parametrize(("rig", "mistake", "words"), CASES)
def test_a_mistake_is_named(rig: Callable[[], Experiment], mistake: Change, words: list[str]) -> None:
    (found,) = find_mistakes(mistake(rig()))
    assert found.certain, found.gain
    for word in words:
        assert word in str(found)


@pytest.mark.parametrize(
    ("rig", "mistake"),
    [
        pytest.param(*case.values[:2], id=case.id, marks=[pytest.mark.slow] * (k % 8 > 0))
        for k, case in enumerate(CASES)
    ],
)
def test_a_mistake_is_refused(rig: Callable[[], Experiment], mistake: Change) -> None:
    experiment = mistake(rig())
    began = time.perf_counter()
    (found,) = find_mistakes(experiment)
    for run in (identify, diagnose):
        with pytest.raises(MistakeError) as caught:  # an InputError: status 2
            run(experiment)
        assert caught.value.mistakes == (str(found),)
    checked = vjm.check(experiment)
    assert checked.problem == str(found)
    assert checked.identifiable == {}
    assert time.perf_counter() - began < QUICK  # of all four


DOUBTS = [  # name, rig, mistake, words of the sentence
    ("mass x 10", hub, factors(mass=10.0), ["several times less than", "'mass' is too large, unless the torque is"]),
    ("mass / 10", hub, factors(mass=0.1, width=0.1), ["several times more than", "'mass' is too small"]),
    (
        "mass x 10",
        clamped,
        factors(mass=10.0),
        ["would be 0.368 Hz", "first_mode.csv shows 1.19 Hz", "masses, payloads"],
    ),
    ("E / 10", clamped, factors(youngs_modulus=0.1), ["would be 0.368 Hz", "what gives the bending stiffness"]),
    ("E x 10", clamped, factors(youngs_modulus=10.0), ["would be 3.68 Hz", "far off; check them"]),
    ("payload of 100 kg", clamped, loaded, ["would be 0.038 Hz", "'payload' looks like grams"]),
    ("gravity that is not", hub, in_gravity(0.0, -9.81), ["as if there were none", "[base] gravity = [0, 0]"]),
    ("gravity that is not", clamped, in_gravity(0.0, -9.81), ["would bend it by", "[base] gravity = [0, 0]"]),
]


@pytest.mark.parametrize(("rig", "mistake", "words"), [pytest.param(*rest, id=name) for name, *rest in DOUBTS])
def test_numbers_that_are_far_off_are_doubted(rig: Callable[[], Experiment], mistake: Change, words: list[str]) -> None:
    experiment = mistake(rig())
    (found,) = find_mistakes(experiment)
    assert not found.certain
    for word in words:
        assert word in str(found)
    assert str(found) in vjm.check(experiment).warnings


@pytest.mark.parametrize("rig", BOTH)
@pytest.mark.parametrize("seen", [pytest.param("as it is", marks=pytest.mark.slow), "by other conventions"])
def test_nothing_is_wrong_with_what_is_right(rig: Callable[[], Experiment], seen: str) -> None:
    experiment = rig()
    if seen != "as it is":
        conventions = Conventions(Units("mm", "deg", "ms", "N mm"), Camera((1.0, 2.0), 0.3, ("-y", "z")))
        experiment = replace(experiment, conventions=conventions)
    assert find_mistakes(experiment) == ()
    assert vjm.check(experiment).problem == ""


@pytest.mark.parametrize("share", [0.5, 1.0, 2.0])
def test_a_hub_as_heavy_as_the_link_is_known_roughly(share: float) -> None:
    """It may be 0.7 to 1.4 times what the rig says: a lighter link on a heavier hub is then no better told."""
    link = replace(RIG.links[0], hub_inertia=share * RIG.links[0].mass * RIG.links[0].length ** 2 / 3)
    chain = Chain("rig", (uniform_chain(link, layout(1.0, 3), kelvin_voigt=5e-4),))
    recordings = recorded(Arm(chain), 1, duration=20.0, factor=4.0)
    for factor in (0.7, 0.85, 1.18, 1.4):
        rig = replace(RIG, links=(replace(link, hub_inertia=factor * link.hub_inertia),))
        assert find_mistakes(Experiment(rig, tuple(recordings))) == (), factor


def without_section(experiment: Experiment) -> Experiment:
    """The link's EI alone is known, as where somebody measured it."""
    (link,) = experiment.rig.links
    plain = replace(link, width=None, thickness=None, youngs_modulus=None, bending_stiffness=link.bending_stiffness)
    return replace(experiment, rig=replace(experiment.rig, links=(plain,)))


def test_a_mass_in_grams_shows_in_the_torque_where_no_density_tells() -> None:
    (found,) = find_mistakes(factors(mass=1e3)(without_section(hub())))
    assert found.certain
    assert "'mass' looks like grams; give it in kg, 0.44" in str(found)


@pytest.mark.parametrize("wrong", [{"hub_inertia": 0.0}, {"hub_inertia": 10.0}, {"hub_inertia": 0.1}, {"mass": 2.0}])
def test_numbers_that_are_known_badly_are_no_mistake_of_a_unit(wrong: dict[str, float]) -> None:
    """A hub's inertia, that of the motor behind its gear, is a guess, or left out; it is identified."""
    assert find_mistakes(factors(**wrong)(without_section(hub()))) == ()


def stiffly_driven(ratio: float, second: float, count: int) -> Experiment:
    """Recordings of a drive that turns the link by 10 mrad and bends it by so many times that, and in another mode."""
    experiment = hub()
    length = experiment.rig.links[0].length
    link = replace(experiment.rig.links[0], markers=tuple((length * np.arange(1, count + 1) / count).tolist()))
    arc = np.linspace(0.0, 1.0, 301)
    rows = np.round(300 * np.arange(1, count + 1) / count).astype(int) - 1

    def moved(recording: Recording) -> Recording:
        turn = 0.01 * np.sin(2 * np.pi * 4.0 * recording.time)
        seen = np.isfinite(recording.markers).all(axis=(1, 2))
        # A cantilever that bends under a force at its tip, and its second mode, which no swing repeats.
        tilt = turn[seen, None] * (1.0 + ratio * (arc - arc**2 / 2))
        faster = second * np.sin(2 * np.pi * 11.0 * recording.time[seen])[:, None]
        tilt = tilt + faster * (arc - 1.5 * arc**2)
        steps = link.length * np.stack([np.cos(tilt), np.sin(tilt)], axis=2) * (arc[1] - arc[0])
        markers = np.full((turn.size, count, 2), np.nan)
        markers[seen] = np.cumsum(steps, axis=1)[:, rows]
        return replace(recording, theta=turn[:, None], markers=markers)

    recordings = tuple(moved(one) for one in experiment.recordings[:3])
    return replace(experiment, rig=replace(experiment.rig, links=(link,)), recordings=recordings)


@pytest.mark.parametrize("ratio", [-8.0, -6.0, -4.5, -3.0])
@pytest.mark.parametrize("second", [0.0, 0.002, 0.004, 0.01])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_a_stiff_drive_that_bends_the_link_more_than_it_turns_it_is_no_mistake(
    ratio: float, second: float, count: int
) -> None:
    """The heading at the base is told with an error that goes with bending, as the angle does."""
    assert heading_mistakes(stiffly_driven(ratio, second, count), (), None) == []


@pytest.mark.parametrize("count", [2, 3, 4, 5])
@pytest.mark.parametrize("wrong", [-1.0, np.rad2deg(1.0)])
def test_an_angle_of_a_link_that_bends_little_is_judged_from_few_markers_too(count: int, wrong: float) -> None:
    right = stiffly_driven(-0.1, 0.0, count)
    assert heading_mistakes(right, (), None) == []
    (found,) = heading_mistakes(recordings(lambda r: replace(r, theta=wrong * r.theta))(right), (), None)
    assert found.certain
    assert ("turn against" if wrong < 0 else 'angle = "deg"') in str(found)
    assert len(found.files) == 3


def test_one_recording_with_swapped_labels_is_the_one_named() -> None:
    (found,) = find_mistakes(
        replace(clamped(), recordings=(exchanged(1, 2)(clamped()).recordings[1], *clamped().recordings[2:]))
    )
    assert found.files == ("first_mode.csv",)


def test_remedies_start_from_the_conventions_there_are() -> None:
    changed = replace(clamped(), conventions=Conventions(Units(length="mm"), Camera((1.0, 2.0))))
    (units,) = find_mistakes(markers(lambda m: 1e-3 * m)(changed))
    assert 'look like metres; set [units] length = "m"' in str(units)
    (origin,) = find_mistakes(markers(lambda m: np.add(m, (0.2, 0.0)))(changed))
    assert "[camera] origin = [0.8" in str(origin)
    changed = replace(clamped(), conventions=Conventions(camera=Camera(axes=("-z", "x"))))
    (axes,) = find_mistakes(markers(lambda m: m[..., ::-1])(changed))
    assert 'axes = ["x", "-z"]' in str(axes)
    changed = replace(hub(), conventions=Conventions(Units(angle="deg"), Camera(rotation=0.1)))
    (zero,) = find_mistakes(recordings(lambda r: replace(r, theta=r.theta + 0.5))(changed))
    assert "behind where beam.theta has them" in str(zero)
    assert "[camera] rotation = 0.6 (radians), or add -28.7 deg to beam.theta" in str(zero)
    names = {"beam.theta": "Motor angle (deg)", "beam.tau": "Torque"}
    changed = replace(hub(), conventions=Conventions(columns=names))
    (theta,) = find_mistakes(recordings(lambda r: replace(r, theta=-r.theta))(changed))
    assert "multiply the column 'Motor angle (deg)' by -1" in str(theta)
    (torque,) = find_mistakes(recordings(lambda r: replace(r, tau=-r.tau))(changed))
    assert "multiply the column 'Torque' by -1" in str(torque)


def hanging(
    joint: str,
    gravity: tuple[float, float],
    stiffness: float,
    *,
    kind: str = "",
    payloads: tuple[float, ...] = (0.0, 0.0),
    payload: float = 0.0,
    curvature: float = 0.0,
    friction: Sequence[Effect] = (),
    turning: float = 0.0,
) -> Experiment:
    """Recordings of a chain that hangs in gravity, pushed or, where it is clamped or of kind `decay`, released.

    It may be turning, at so many rad/s, and there may be friction at its joint.
    """
    random = np.random.default_rng(0)
    arcs, revolute = (0.1, 0.2, 0.3, 0.4, 0.5), joint == "revolute"
    link = Link("beam", joint, 0.5, 0.2, stiffness, arcs, hub_inertia=0.01 if revolute else 0.0, payload=payload)
    rig = Rig("rig", (link,), gravity=gravity, marker_noise=3e-4)
    uniform = replace(uniform_chain(link, layout(0.5, 4), kelvin_voigt=5e-4), rest_curvature=curvature)
    chain = Chain("rig", (uniform,), gravity=gravity)
    instants, found = np.arange(0, 4, 0.005), []
    driven = revolute and kind != "decay"
    for k, carried in enumerate(payloads):
        wave = np.sin(2 * np.pi * (0.7 + 0.4 * k) * instants) + 0.5 * np.sin(2 * np.pi * 2.1 * instants)
        torque = 0.1 * driven * wave[:, None] if revolute else np.zeros((instants.size, 0))
        empty = np.full((instants.size, 5, 2), np.nan)
        given = {"kind": "driven" if driven else "decay", "file": f"r{k}.csv", "gravity": gravity, "payload": carried}
        blank = Recording(instants, empty, 0 * torque, torque, **given)
        start = linearise(chain, Payload(carried), gravity)[3]
        start = start if driven else start + (0.4 if revolute else 0.02) * np.linspace(1.0, 0.3, start.size)
        arm, rates = Arm.of(chain, friction), np.zeros(chain.size)
        rates[:1] = turning
        motion = simulate(arm, rig, blank, start, rates)
        places = np.full(motion.markers.shape, np.nan)
        places[::2] = motion.markers[::2] + 3e-4 * random.standard_normal(motion.markers[::2].shape)
        found.append(replace(blank, theta=motion.theta, markers=places))
    return Experiment(rig, tuple(found))


@pytest.mark.parametrize(
    ("joint", "gravity", "stiffness", "words"),
    [("revolute", (9.81, 0.0), 2.0, "gravity = [9.81, "), ("clamped", (0.0, -9.81), 0.4, "gravity = [0, -9.81]")],
)
def test_gravity_that_was_not_declared(joint: str, gravity: tuple[float, float], stiffness: float, words: str) -> None:
    declared = hanging(joint, gravity, stiffness)
    assert find_mistakes(declared) == ()
    unknown = recordings(lambda r: replace(r, gravity=(0.0, 0.0)))(declared)
    unknown = replace(unknown, rig=replace(declared.rig, gravity=(0.0, 0.0)))
    (found,) = find_mistakes(unknown)
    assert not found.certain  # a spring at the joint, or a link that is curved, looks alike
    assert words in str(found)
    checked = vjm.check(unknown)
    assert str(found) in checked.warnings
    assert not checked.problem
    assert identify(unknown, "torque", virtual_joints=2).warnings[0] == str(found)


def test_a_gravity_of_a_recording_alone_counts_for_its_frequency() -> None:
    hanging_down = hanging("clamped", (9.81, 0.0), 0.4)
    loose = replace(hanging_down, rig=replace(hanging_down.rig, gravity=(0.0, 0.0)))
    loaded = replace(loose.rig.links[0], payload=2.0)  # whose weight raises the frequency threefold, from 0.3 Hz
    heavy = replace(loose, rig=replace(loose.rig, links=(loaded,)))
    declared = replace(heavy, rig=replace(heavy.rig, gravity=(9.81, 0.0)))
    assert find_mistakes(heavy) == find_mistakes(declared)


@pytest.mark.parametrize(
    ("joint", "gravity", "declared", "words"),
    [
        ("revolute", (9.81, 0.0), (-9.81, 0.0), "as if it were [9.81, 0]; set [base] gravity = [9.81, 0]"),
        ("revolute", (9.81, 0.0), (0.0, 9.81), "as if it were [9.81, 0]"),
        ("clamped", (0.0, -9.81), (0.0, 9.81), "by 76.6 mm, to the other side"),
        ("clamped", (0.0, 0.0), (0.0, 9.81), "if the plane is horizontal, set [base] gravity = [0, 0]"),
    ],
)
def test_gravity_of_another_direction(
    joint: str, gravity: tuple[float, float], declared: tuple[float, float], words: str
) -> None:
    experiment = hanging(joint, gravity, 2.0 if joint == "revolute" else 0.4)
    assert find_mistakes(experiment) == ()
    tilted = np.array(gravity) @ turned_by(0.1)
    assert find_mistakes(in_gravity(*tilted.tolist())(experiment)) == ()
    (found,) = find_mistakes(in_gravity(*declared)(experiment))
    assert not found.certain
    assert words in str(found)


@pytest.mark.parametrize(
    ("gravity", "curvature", "measured", "sag"),
    [
        (
            (0.0, 0.0),
            -0.5,
            -62,
            "0 mm, its own weight by -76.6 mm: if the plane is vertical, set [base] gravity = [0, -9.8",
        ),
        ((0.0, -9.81), 0.6, 1, "-76.6 mm: if the plane is horizontal, set [base] gravity = [0, 0]"),
        ((0.0, -9.81), 1.1, 61, "-76.6 mm, to the other side: if the signs of x and y are right, set [base] gravity"),
    ],
)
def test_a_link_that_is_curved_at_rest_is_doubted_with_both_numbers(
    gravity: tuple[float, float], curvature: float, measured: float, sag: str
) -> None:
    (found,) = find_mistakes(hanging("clamped", gravity, 0.4, curvature=curvature))
    assert not found.certain
    (rest,) = re.findall(r"rests at y = (\S+) mm, and the declared gravity would bend it by ", str(found))
    assert float(rest) == pytest.approx(measured, abs=4)
    assert f"would bend it by {sag}" in str(found)
    assert "unless the link is curved at rest, which vjm diagnose finds as rest_curvature" in str(found)


def carrying(experiment: Experiment, *by_recording: float) -> Experiment:
    """Payloads of recordings times these factors."""
    pairs = zip(experiment.recordings, by_recording, strict=True)
    return replace(experiment, recordings=tuple(replace(each, payload=size * each.payload) for each, size in pairs))


@pytest.mark.parametrize("joint", ["revolute", "clamped"])
@pytest.mark.parametrize("gravity", [pytest.param((0.0, 0.0), marks=pytest.mark.slow), (9.81, 0.0)])
@pytest.mark.parametrize(
    ("payloads", "wrong"),
    [
        ((0.0, 0.012), (1.0, 1e3)),
        ((0.0, 0.0, 0.05), (1.0, 1.0, 1e3)),
        ((0.012, 0.02), (1e3, 1.0)),
        ((0.0, 0.012, 0.05), (1.0, 1e3, 1e3)),
    ],
)
def test_a_payload_in_grams_is_found_in_its_recording(
    joint: str, gravity: tuple[float, float], payloads: tuple[float, ...], wrong: tuple[float, ...]
) -> None:
    right = hanging(joint, gravity, 2.0 if joint == "revolute" else 0.4, payloads=payloads)
    assert find_mistakes(right) == ()
    found = find_mistakes(carrying(right, *wrong))
    assert [one.files for one in found] == [(f"r{k}.csv",) for k, factor in enumerate(wrong) if factor > 1.0]
    for one in found:
        (file,) = one.files
        remedy = f"'payload' looks like grams; give 'payload' of [[recording]] {file} in kg, {payloads[int(file[1])]}"
        assert remedy.split("; ")[1] in str(one)
        assert "looks like grams" in str(one)


@pytest.mark.parametrize(("joint", "payload"), [("revolute", 0.003), ("revolute", 0.1), ("clamped", 0.1)])
@pytest.mark.parametrize("carried", [0.0, 0.02])
def test_a_link_s_payload_in_grams_is_found(joint: str, payload: float, carried: float) -> None:
    right = hanging(joint, (0.0, 0.0), 2.0 if joint == "revolute" else 0.4, payload=payload, payloads=(0.0, carried))
    assert find_mistakes(right) == ()
    (found,) = find_mistakes(factors(payload=1e3)(right))
    assert found.certain
    assert "'payload' looks like grams" in str(found)
    assert f"in kg, {payload}" in str(found)


def test_masses_and_payloads_in_grams_are_found_together() -> None:
    right = hanging("revolute", (0.0, 0.0), 2.0, payload=0.1)
    (found,) = find_mistakes(factors(payload=1e3, mass=1e3)(right))
    assert found.certain
    assert "'mass' and 'payload' look like grams; give both in kg" in str(found)


DIRECTIONS = [(0.0, 0.0), (9.81, 0.0), (-9.81, 0.0), (0.0, -9.81)]


@pytest.mark.parametrize("stiffness", [0.4, 2.0])
@pytest.mark.parametrize("gravity", [(0.0, 0.0), (9.81, 0.0)])
def test_gravity_is_judged_in_free_swings_of_a_hub(stiffness: float, gravity: tuple[float, float]) -> None:
    right = hanging("revolute", gravity, stiffness, kind="decay")
    assert find_mistakes(right) == ()
    for declared in DIRECTIONS:
        if declared == gravity:
            continue
        (found,) = find_mistakes(in_gravity(*declared)(right))
        assert not found.certain
        (x, y), size = re.findall(r"set \[base\] gravity = \[(\S+), (\S+)\]", str(found))[0], np.hypot(*gravity)
        assert np.hypot(float(x) - gravity[0], float(y) - gravity[1]) <= 0.05 * size
        assert ("unless friction at the joint bears its weight" in str(found)) == (size == 0.0)


VISCOUS, DRY = ViscousFriction(coefficient=0.004, link=0), CoulombFriction(torque=0.05, link=0)


@pytest.mark.parametrize(
    ("gravity", "turning", "friction"),
    [
        *(((0.0, 0.0), turning, friction) for turning in (0.5, 6.0) for friction in ((), (VISCOUS,))),
        *(((9.81, 0.0), 0.0, friction) for friction in ((), (VISCOUS,))),
        pytest.param((0.0, 0.0), 6.0, (DRY,), marks=pytest.mark.slow),
        pytest.param((0.0, 0.0), 0.5, (DRY,), marks=pytest.mark.slow),
        pytest.param((9.81, 0.0), 0.0, (DRY,), marks=pytest.mark.slow),
    ],
)
def test_friction_that_ends_a_free_swing_is_no_gravity(
    gravity: tuple[float, float], turning: float, friction: Sequence[Effect]
) -> None:
    swing = hanging("revolute", gravity, 2.0, kind="decay", friction=friction, turning=turning)
    assert find_mistakes(swing) == ()


def test_an_arm_that_a_brake_holds_shows_no_gravity() -> None:
    held = hanging("revolute", (0.0, -9.81), 2.0, payloads=(0.0,))
    still = recordings(
        lambda r: replace(r, kind="decay", tau=0 * r.tau, theta=0 * r.theta, markers=0 * r.markers + r.markers[0])
    )(held)
    assert find_mistakes(still) == ()


@pytest.mark.parametrize("rig", BOTH)
def test_zeros_for_what_was_not_tracked_are_left_out(rig: Callable[[], Experiment]) -> None:
    first, second, *others = rig().recordings
    zeros = second.markers.copy()
    zeros[100:140] = np.where(np.isfinite(zeros[100:140]), 0.0, np.nan)
    experiment = replace(rig(), recordings=(first, replace(second, markers=zeros), *others))
    assert find_mistakes(experiment) == ()
    loaded = vjm.Experiment(experiment.rig, experiment.recordings)
    assert not any("clipped" in text for text in loaded.warnings)
    (text,) = (text for text in loaded.warnings if "not tracked" in text)
    assert text.startswith(f"{second.file}: in ")
    left = loaded.cleaned_recordings[1].markers
    assert np.isnan(left[100:140]).all()
    assert np.array_equal(
        np.delete(left, np.s_[100:140], axis=0), np.delete(second.markers, np.s_[100:140], axis=0), equal_nan=True
    )


@pytest.mark.parametrize("rig", BOTH)
@pytest.mark.parametrize("marker", [0, 2, 4])
@pytest.mark.parametrize("origin", [(0.0, 0.0), (0.3, -0.2), (0.9, -0.6), (1.0, 2.0)])
@pytest.mark.parametrize("share", [0.1, *(pytest.param(share, marks=pytest.mark.slow) for share in (0.4, 0.6)), 1.0])
def test_zeros_of_one_marker_are_no_mistake_of_another_kind(
    rig: Callable[[], Experiment], marker: int, origin: tuple[float, float], share: float
) -> None:
    """The camera's zero, where markers that were not tracked seem to be, is anywhere in the base frame."""
    first, second, *others = rig().recordings
    rows = np.random.default_rng(0).permutation(second.frames)[: round(share * second.frames.size)]
    zeros = second.markers.copy()
    zeros[rows, marker] = origin
    conventions = Conventions(camera=Camera(origin, 0.3, ("y", "-x")))
    recordings = (first, replace(second, markers=zeros), *others)
    experiment = replace(rig(), recordings=recordings, conventions=conventions)
    found = find_mistakes(experiment)
    if share < 0.5:
        assert found == ()
        left = experiment.cleaned_recordings[1].markers
        assert np.isnan(left[rows, marker]).all()
        kept = np.delete(np.arange(left.shape[0]), rows)
        assert np.array_equal(left[kept], second.markers[kept], equal_nan=True)
    else:
        (mistake,) = found
        assert mistake.certain
        assert str(mistake).startswith(f"{second.file}: beam.m{marker + 1} stand exactly where")


@pytest.mark.parametrize("rig", BOTH)
def test_zeros_on_the_way_of_a_marker_are_left_out_but_where_it_was_near(rig: Callable[[], Experiment]) -> None:
    first, second, *others = rig().recordings
    rows = np.random.default_rng(0).permutation(second.frames)[: second.frames.size // 3]
    zeros, tip = second.markers.copy(), (1.0, 0.0)
    zeros[rows, -1] = tip
    recordings = (first, replace(second, markers=zeros), *others)
    experiment = replace(rig(), recordings=recordings, conventions=Conventions(camera=Camera(tip)))
    assert find_mistakes(experiment) == ()
    kept = rows[np.isfinite(experiment.cleaned_recordings[1].markers[rows, -1]).all(axis=1)]
    assert kept.size < rows.size / 3
    steps = np.linalg.norm(np.diff(second.markers[second.frames, -1], axis=0), axis=1)
    errors = np.linalg.norm(second.markers[kept, -1] - tip, axis=1)
    assert errors.max(initial=0.0) < 2 * steps.max()


def test_an_arm_that_falls_has_no_frequency_that_is_compared() -> None:
    assert find_mistakes(hanging("revolute", (-9.81, 0.0), 2.0)) == ()


def test_a_quiet_recording_that_moves_is_doubted() -> None:
    assert not any("quiet" in text for text in vjm.check(clamped()).warnings)
    named = recordings(lambda r: replace(r, kind="quiet") if r.file == "first_mode.csv" else r)(clamped())
    (text,) = (text for text in vjm.check(named).warnings if "quiet" in text)
    assert re.fullmatch(r"first_mode.csv: it moves by \d+ × its noise, though the recording is of kind 'quiet'", text)
    first, *others = clamped().recordings
    glitch = first.markers.copy()
    glitch[30, 4, 1] += 0.03
    spoiled = replace(clamped(), recordings=(replace(first, markers=glitch), *others))
    assert first.kind == "quiet"
    assert not any("it moves by" in text for text in vjm.check(spoiled).warnings)


def test_the_key_of_a_recording_s_own_gravity_is_named() -> None:
    first, second, *others = hub().recordings
    heavy = replace(second, gravity=(0.0, -9.81))
    (found,) = find_mistakes(replace(hub(), recordings=(first, heavy, *others)))
    assert found.files == (second.file,)
    assert "set gravity in the [[recording]] = [0, 0]" in str(found)
    quiet, decay, *rest = clamped().recordings
    (found,) = find_mistakes(replace(clamped(), recordings=(quiet, replace(decay, gravity=(0.0, -9.81)), *rest)))
    assert found.files == (decay.file,)
    assert "set gravity in the [[recording]] = [0, 0]" in str(found)


def test_the_beginning_of_a_decay_shows_no_sag() -> None:
    released = hanging("clamped", (0.0, 0.0), 0.4)
    swing = np.s_[15:65]  # about a turning point
    part = recordings(
        lambda r: replace(
            r, time=r.time[swing], markers=r.markers[swing] * [1.0, 4.0], theta=r.theta[swing], tau=r.tau[swing]
        )
    )(released)
    assert np.nanmedian(part.recordings[0].markers[25:, -1, 1]) < -0.05
    assert find_mistakes(part) == ()


@pytest.mark.parametrize("rig", BOTH)
def test_nothing_held_out_is_a_warning_of_the_check(rig: Callable[[], Experiment]) -> None:
    wrong = markers(lambda m: 1e3 * m)(rig())  # whose check ends early, but warns all the same
    train = recordings(lambda r: replace(r, role="train"))(wrong)
    assert any("no recording is held out" in text for text in vjm.check(train).warnings)
    assert not any("held out" in text for text in vjm.check(wrong).warnings)


@pytest.mark.parametrize("rig", ["clamped", "hub"])
def test_commands_end_with_status_2(rig: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "experiment.toml"
    if rig == "hub":
        write_hub_experiment(tmp_path, 1)
        wrong, words = "mass = 440.0", "'mass' looks like grams"
        file.write_text(file.read_text().replace("mass = 0.44\n", f"{wrong}\n"))
    else:
        for each in DEMO.parent.glob("*.*"):
            shutil.copy(each, tmp_path)
        wrong, words = "thickness = 1.5", "'thickness' looks like mm"
        file.write_text(file.read_text().replace("thickness = 0.0015", wrong))
    assert wrong in file.read_text()
    for command in ("check", "identify", "diagnose"):
        out, began = [] if command == "check" else ["-o", str(tmp_path / "out")], time.perf_counter()
        assert main([command, str(file), *out]) == 2
        assert time.perf_counter() - began < QUICK
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line
    assert not (tmp_path / "out").exists()


def test_a_model_that_follows_nothing_has_failed() -> None:
    experiment = clamped()
    blind = replace(experiment.recordings[1], markers=experiment.recordings[1].markers * [[[1, 1]] * 4 + [[np.nan, 1]]])
    assert "beam.m5.x was left out" in failure_of(experiment, [RecordingComparison(blind, (3e-4, 1e-4), None)])
    held_out = RecordingComparison(experiment.recordings[-1], (3e-4, 1e-4), None, problem="diverged")
    assert "both_modes.csv: held out, but the model could not be simulated" in failure_of(experiment, [held_out])


@pytest.mark.parametrize("further", [0.06, -0.06])
def test_a_ruler_that_began_elsewhere_is_named_where_it_is_far(tmp_path: Path, further: float) -> None:
    write_hidden(tmp_path, "hub", [Planted("marker_datum", {"along": further})], 5)
    given = vjm.load_experiment(tmp_path / "experiment.toml")
    (mistake,) = find_mistakes(given)
    assert f"if the ruler began elsewhere, add {further:.2g}" in str(mistake)
    assert ("hub_radius" in str(mistake)) == (further > 0)
    (link,) = given.rig.links
    markers = tuple(min(arc + further, link.length) for arc in link.markers)
    corrected = replace(given, rig=replace(given.rig, links=(replace(link, markers=markers),)))
    assert list(find_mistakes(corrected)) == []


@pytest.mark.parametrize("radius", [0.0, 0.02, 0.04, 0.1])
def test_a_hub_s_radius_that_was_not_given_is_named_where_it_is_large(tmp_path: Path, radius: float) -> None:
    write_hidden(tmp_path, "hub", [Planted("hub_radius", {"radius": radius})], 5)
    given = vjm.load_experiment(tmp_path / "experiment.toml")
    found = find_mistakes(given)
    assert len(found) == (radius > 0.03)
    for mistake in found:
        assert mistake.certain
        assert f"'hub_radius' of [[link]] beam in m, {radius:.3g}" in str(mistake)
    (link,) = given.rig.links
    described = replace(given, rig=replace(given.rig, links=(replace(link, hub_radius=radius),)))
    assert list(find_mistakes(described)) == []
    elsewhere = replace(given, rig=replace(given.rig, links=(replace(link, hub_radius=radius + 0.2),)))
    assert list(find_mistakes(elsewhere)) != []
