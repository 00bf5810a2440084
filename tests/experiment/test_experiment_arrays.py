"""Records built in Python: the same as those read from files, refused with the same words."""

from __future__ import annotations

import contextlib
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from experiment_files import FILES, TOML, write_experiment
from hypothesis import given, settings
from hypothesis import strategies as st

import vjm
from vjm.errors import ExperimentError, RecordingError, ShapeError

TIME = 0.01 * np.arange(40)
MARKERS = np.stack([np.broadcast_to([0.2, 0.6, 1.0], (40, 3)), 0.01 * np.sin(9 * TIME)[:, None] * [1, 2, 4]], axis=2)


def link(**changed: Any) -> vjm.Link:
    given = {"name": "beam", "joint": "clamped", "length": 1.0, "mass": 0.44, "bending_stiffness": 1.9}
    return vjm.Link(**{**given, "markers": [0.2, 0.6, 1.0], **changed})


def hub(**changed: Any) -> vjm.Link:
    return link(joint="revolute", **changed)


def recording(**changed: Any) -> vjm.Recording:
    return vjm.Recording(**{"time": TIME, "markers": MARKERS, "kind": "decay", **changed})


def frame(**changed: Any) -> pd.DataFrame:
    columns = {f"beam.m{k + 1}.{axis}": MARKERS[:, k, i] for k in range(3) for i, axis in enumerate("xy")}
    return pd.DataFrame({"t": TIME, **columns}).assign(**changed)


def read(table: Any, **changed: Any) -> vjm.Recording:
    return vjm.Recording.from_dataframe(table, link(), **{"kind": "decay", **changed})


def from_python(document: dict[str, Any], read_one: Callable[..., vjm.Recording]) -> vjm.Experiment:
    """The small experiment with its links, rig and recordings written out in Python."""
    links = [vjm.Link(**table) for table in document["link"]]
    rig = vjm.Rig(document["name"], links, **document["base"], **document["sensors"])
    return vjm.Experiment(rig, [read_one(rig, table) for table in document["recording"]])


@pytest.mark.parametrize("as_lists", [False, True])
def test_arrays_make_the_experiment_that_files_make(tmp_path: Path, as_lists: bool) -> None:
    loaded = vjm.load_experiment(write_experiment(tmp_path, TOML))
    arrays = {
        one.file: {key: getattr(one, key) for key in ("time", "markers", "theta", "tau")} for one in loaded.recordings
    }

    def read_one(_: vjm.Rig, table: dict[str, Any]) -> vjm.Recording:
        own = arrays[table["file"]]
        return vjm.Recording(**{key: value.tolist() if as_lists else value for key, value in own.items()}, **table)

    document = tomllib.loads(TOML)
    built = from_python(document, read_one)
    assert replace(loaded, file=None) == built
    assert built.warnings == loaded.warnings


def test_tables_make_the_experiment_that_files_make(tmp_path: Path) -> None:
    toml = TOML.replace('repeat = "drive"', 'repeat = "drive"\ncondition = "Reference"', 1)
    loaded = vjm.load_experiment(write_experiment(tmp_path, toml))
    built = from_python(
        tomllib.loads(toml),
        lambda rig, table: vjm.Recording.from_dataframe(pd.read_csv(tmp_path / table["file"]), rig, **table),
    )
    assert set(FILES) == {one.file for one in built.recordings}
    assert replace(loaded, file=None) == built
    assert len(loaded.warnings) == 2
    assert built.warnings == loaded.warnings


def test_what_is_left_out_has_its_default() -> None:
    experiment = vjm.Experiment(vjm.Rig("rig", link(), gravity=(0.0, -9.81)), [recording(), recording(gravity=[0, 0])])
    assert [one.gravity for one in experiment.recordings] == [(0.0, -9.81), (0.0, 0.0)]
    assert [one.file for one in experiment.recordings] == ["recording_1", "recording_2"]
    assert experiment.recordings[0].theta.shape == experiment.recordings[0].tau.shape == (40, 0)
    assert vjm.Experiment(link(), recording()).rig == vjm.Rig("beam", (link(),))
    driven = vjm.Experiment(hub(), recording(theta=np.sin(TIME))).recordings[0]
    assert driven.theta.shape == (40, 1)
    assert np.isnan(driven.tau).all()
    section = {"width": 0.035, "thickness": 0.0015, "youngs_modulus": 1.93e11}
    stiff = link(bending_stiffness=None, **section)
    assert stiff.bending_stiffness == pytest.approx(1.93e11 * 0.035 * 0.0015**3 / 12)
    assert replace(stiff, mass=1.0).bending_stiffness == stiff.bending_stiffness
    assert read(frame(), file="a.csv").file == "a.csv"


def test_numbers_of_numpy_are_numbers() -> None:
    assert link(length=np.float32(1), markers=np.array([0.2, 1]), virtual_joints=np.int64(3)) == link(
        markers=(0.2, 1.0), virtual_joints=3
    )


def test_an_experiment_shows_itself_in_a_few_lines() -> None:
    experiment = vjm.Experiment(link(), [recording() for _ in range(20)])
    text = repr(experiment)
    assert "beam (clamped, 1 m, 3 markers)" in text
    assert "recording_1" in text
    assert "markers (40, 3, 2)" in text
    assert len(text.splitlines()) < 12


def test_the_package_lists_its_public_names_only() -> None:
    assert {"Link", "Rig", "Recording", "Experiment"} < set(dir(vjm))
    assert set(dir(vjm)) == {*vjm.__all__, "__version__"}


REFUSED = [  # what is built, words of the message
    (lambda: link(mass=-0.44), ["link beam", "'mass'", "got -0.44", "positive number [kg]"]),
    (lambda: link(mass="0.44"), ["'mass'", "got '0.44'"]),
    (lambda: link(mass=True), ["'mass'", "got True"]),
    (lambda: link(length=np.inf), ["'length'", "got inf", "[m]"]),
    (lambda: link(length=None), ["'length'", "got None"]),
    (lambda: link(joint="free"), ["'joint'", "'free'", '"revolute" or "clamped"']),
    (lambda: link(name="my beam"), ["link my beam", "letters, digits and underscores"]),
    (lambda: link(name=3), ["[link]", "'name'", "got 3"]),
    (lambda: link(markers=[0.2, 1.2]), ["'markers'", "item 2 is 1.2", "beyond the link", "1 m"]),
    (lambda: link(markers=[0.6, 0.2]), ["item 2 is 0.2 after 0.6", "strictly increasing"]),
    (lambda: link(markers=0.2), ["'markers'", "got 0.2"]),
    (lambda: link(markers=np.ones((2, 2))), ["item 1 is [1.0, 1.0]"]),
    (lambda: link(markers_frame="tip"), ['"base" or "link"']),
    (lambda: link(hub_inertia=0.1), ["'hub_inertia'", "clamped"]),
    (lambda: link(payload=-1), ["'payload'", "zero or positive [kg]"]),
    (lambda: link(virtual_joints=61), ["'virtual_joints'", "from 1 to 60"]),
    (lambda: link(bending_stiffness=None), ["'bending_stiffness'", "missing", "either youngs_modulus"]),
    (lambda: link(bending_stiffness=None, width=0.1, thickness=0.1), ["'youngs_modulus'", "missing"]),
    (lambda: link(width=0.1), ["'width'", "together with bending_stiffness"]),
    (lambda: link(width=0.1, thickness=0.1, youngs_modulus=1.0), ["'youngs_modulus'", "together"]),
    (lambda: vjm.Rig("", link()), ["[rig]", "'name'", "not empty"]),
    (lambda: vjm.Rig("rig", []), ["rig rig", "'links'", "at least one vjm.Link"]),
    (lambda: vjm.Rig("rig", [link(), "tip"]), ["'links'", "got 'tip'"]),
    (lambda: vjm.Rig("rig", [link(), link()]), ["link[2] beam", "already the name of link[1]"]),
    (lambda: vjm.Rig("rig", link(), gravity=9.81), ["'gravity'", "got 9.81", "two finite numbers"]),
    (lambda: vjm.Rig("rig", link(), marker_noise=0), ["'marker_noise'", "got 0", "positive number [m]"]),
    (lambda: recording(kind="free"), ["recording", "'kind'", "'free'", '"driven", "decay", "static" or "quiet"']),
    (lambda: recording(role="test", file="a.csv"), ["recording a.csv", "'role'", '"train" or "holdout"']),
    (lambda: recording(payload=-1), ["'payload'", "zero or positive"]),
    (lambda: recording(gravity=[0, 0, 0]), ["'gravity'", "got [0, 0, 0]"]),
    (lambda: recording(repeat=""), ["'repeat'", "label"]),
    (lambda: recording(time=None), ["'time'", "got None", "(T,) instants [s]"]),
    (lambda: recording(time=TIME[:-1]), ["'markers'", "shape (40, 3, 2)", "T = 39"]),
    (lambda: recording(time=TIME[::-1]), ["index 1, column 'time'", "does not increase, 0.38 after 0.39"]),
    (lambda: recording(time=np.where(TIME == 0, np.nan, TIME)), ["index 0", "the time is missing"]),
    (lambda: recording(markers=MARKERS[..., 0]), ["'markers'", "shape (40, 3)", "(T, k, 2)"]),
    (lambda: recording(markers="none"), ["'markers'", "got 'none'"]),
    (lambda: recording(markers=MARKERS + 0j), ["'markers'", "got array([[[", "an array (T, k, 2) positions [m]"]),
    (lambda: recording(time=10**400), ["'time'", "got 1000000", "an array (T,)"]),
    (lambda: vjm.Experiment(link(), np.array(1.0)), ["'recordings'", "got array(1.)", "at least one vjm.Recording"]),
    (lambda: recording(markers=np.where(MARKERS > 0.9, np.inf, MARKERS)), ["'markers'", "infinite"]),
    (lambda: recording(theta=TIME[1:]), ["'theta'", "shape (39, 1)", "T = 40"]),
    (lambda: recording(theta=TIME, tau=np.ones((40, 2))), ["'tau'", "(40, 2)", "(40, 1), as theta"]),
    (lambda: vjm.Experiment("rig", recording()), ["'rig'", "got 'rig'", "vjm.Rig"]),
    (lambda: vjm.Experiment(link(), []), ["'recordings'", "at least one vjm.Recording"]),
    (lambda: vjm.Experiment(link(markers=[]), recording()), ["link[1] beam", "no link has a marker"]),
    (lambda: vjm.Experiment(link(), recording(markers=MARKERS[:, :2])), ["recording_1", "2 markers", "3", "beam 3"]),
    (lambda: vjm.Experiment(link(), recording(theta=TIME)), ["'theta'", "1 column;", "expected 0"]),
    (lambda: vjm.Experiment(hub(), recording()), ["'beam.theta'", "missing", "active joint of link 'beam'"]),
    (lambda: vjm.Experiment(hub(), recording(theta=np.nan * TIME)), ["'beam.theta'", "every cell is empty"]),
    (lambda: vjm.Experiment(hub(), recording(theta=TIME, kind="driven")), ["'beam.tau'", "every cell is empty"]),
    (
        lambda: vjm.Experiment(link(), recording(time=TIME[:9], markers=MARKERS[:9], file="a.csv")),
        ["a.csv: 9 usable frames; expected at least 10"],
    ),
    (
        lambda: vjm.Experiment(link(), recording(time=[], markers=MARKERS[:0], file="a.csv")),
        ["a.csv: 0 usable frames; expected at least 10"],
    ),
    (
        lambda: vjm.Experiment(link(), [recording(repeat="a"), recording(repeat="a", payload=0.1)]),
        ["recording[2] recording_2", "'payload'", "0.1", "recording[1] recording_1", "label 'a'"],
    ),
    (lambda: read(frame().drop(columns="t")), ["'t'", "missing"]),
    (lambda: read(frame().rename(columns={"beam.m1.x": "beam.m4.x"})), ["'beam.m4.x'", "has 3 markers", "K = 1..3"]),
    (lambda: read(frame().rename(columns={"beam.m1.x": "beam.m1.y"})), ["'beam.m1.y'", "twice"]),
    (lambda: read(frame(**{"beam.m1.x": "far"})), ["index 0", "'beam.m1.x'", "'far' is not a number"]),
    (lambda: read(frame(**{"beam.m1.x": np.inf})), ["index 0", "'beam.m1.x'", "infinite"]),
    (lambda: read(frame(t=0.0)), ["index 1", "'t'", "does not increase"]),
    (lambda: read(frame()[:5]), ["5 usable frames"]),
    (lambda: read(frame(), kind="free"), ["'kind'", "'free'"]),
    (lambda: read(MARKERS[0]), ["pandas DataFrame"]),
    (lambda: read(frame(), file=TIME), ["'file'", "the name of a CSV file"]),
    (lambda: read(frame(**{"beam.m1.x": 1j})), ["index 0", "'beam.m1.x'", "1j is not a number"]),
    (lambda: vjm.load_experiment(None), ["got None", "the path of an experiment file"]),
    (lambda: vjm.load_experiment(b"experiment.toml"), ["got b'experiment.toml'", "the path of"]),
]  # fmt: skip


@pytest.mark.parametrize(("build", "words"), REFUSED, ids=range(len(REFUSED)))
def test_what_is_refused(build: Callable[[], object], words: list[str]) -> None:
    with pytest.raises(vjm.InputError) as caught:
        build()
    for word in words:
        assert word in str(caught.value)


ANYTHING = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=4), st.lists(st.floats(), max_size=4),
    st.builds(np.zeros, st.lists(st.integers(0, 3), max_size=3)), st.just(object()),
)  # fmt: skip


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_anything_is_accepted_or_refused_in_our_words(data: st.DataObject) -> None:
    """No value of any field of any record leads to an exception that is not vjm's."""
    makers: list[tuple[Callable[..., object], list[str]]] = [
        (link, list(vjm.Link.__dataclass_fields__)),
        (lambda **changed: vjm.Rig(**{"name": "rig", "links": link(), **changed}), list(vjm.Rig.__dataclass_fields__)),
        (lambda **changed: vjm.Experiment(link(), recording(**changed)), list(vjm.Recording.__dataclass_fields__)),
        (lambda **changed: read(frame(**changed)), list(frame().columns)),
    ]
    make, names = data.draw(st.sampled_from(makers))
    cell = make is makers[3][0]
    value = data.draw(ANYTHING.filter(lambda value: not cell or np.ndim(value) == 0))
    with contextlib.suppress(vjm.InputError):
        assert repr(make(**{data.draw(st.sampled_from(names)): value}))


@settings(max_examples=50, deadline=None)
@given(st.integers(10, 30), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_valid_arrays_come_back_unchanged(count: int, markers: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    time = np.cumsum(random.uniform(1e-4, 1, count))
    theta, tau = random.normal(size=count), random.normal(size=(count, 1))
    positions = random.normal(size=(count, markers, 2))
    one = vjm.Recording(time, positions, theta, tau, kind="driven")
    kept = vjm.Experiment(hub(markers=np.linspace(0.1, 1.0, markers)), one).recordings[0]
    for key, value in {"time": time, "markers": positions, "theta": theta[:, None], "tau": tau}.items():
        np.testing.assert_array_equal(getattr(kept, key), value)


def with_gravity(experiment: vjm.Experiment, gravity: tuple[float, float]) -> vjm.Experiment:
    return replace(experiment, rig=replace(experiment.rig, gravity=gravity))


def test_recordings_without_a_gravity_of_their_own_take_that_of_any_rig() -> None:
    experiment = vjm.Experiment(link(), [recording(), read(frame()), recording(gravity=(0.0, 1.0))])
    for gravity in ((0.0, -9.81), (9.81, 0.0), (0.0, 0.0)):
        experiment = with_gravity(experiment, gravity)
        for other in (experiment, vjm.Experiment(experiment.rig, experiment.recordings)):
            assert [one.gravity for one in other.recordings] == [gravity, gravity, (0.0, 1.0)]


def test_a_recording_outside_an_experiment_is_simulated_under_the_rig_s_gravity() -> None:
    model = vjm.Model.nominal(vjm.Rig("rig", link(), gravity=(0.0, -9.81), marker_noise=1e-4), 3, 1e-3)
    inside = vjm.Experiment(model.rig, recording()).recordings[0]
    assert np.array_equal(model.simulate(recording()).markers, model.simulate(inside).markers)


def test_a_recording_of_other_markers_than_the_model_s_is_refused() -> None:
    model = vjm.Model.nominal(link(), 3)
    for chosen in ([0, 1], [0, 1, 2, 2]):
        with pytest.raises(RecordingError, match="markers; expected 3"):
            model.simulate(recording(markers=MARKERS[:, chosen]))


def test_what_is_masked_was_not_measured() -> None:
    mask = np.zeros(MARKERS.shape, dtype=bool)
    mask[5:9] = True
    masked = recording(markers=np.ma.masked_array(np.where(mask, 1e3, MARKERS), mask)).markers
    assert np.array_equal(masked, np.where(mask, np.nan, MARKERS), equal_nan=True)


def test_what_a_caller_does_to_an_array_later_changes_no_recording() -> None:
    buffer = MARKERS.copy()
    first = recording(markers=buffer)
    view = buffer.view()
    view.flags.writeable = False  # as pandas hands out
    second = recording(markers=view)
    buffer *= 2
    assert np.array_equal(first.markers, MARKERS)
    assert np.array_equal(second.markers, MARKERS)
    with pytest.raises(ValueError, match="read-only"):
        first.markers[0] = 0.0
    assert replace(first, role="holdout").markers is first.markers  # no copy of what nothing can change


@pytest.mark.parametrize("factor", [0.1, 0.3, 1.0 / 3.0])
def test_a_marker_on_the_tip_is_there_in_spite_of_rounding(factor: float) -> None:
    for arcs in ([factor * k for k in (1, 2, 3)], np.linspace(factor, 3 * factor, 3, dtype=np.float32)):
        assert link(length=round(3 * factor, 12), markers=arcs).markers[-1] == pytest.approx(3 * factor, rel=1e-6)
    with pytest.raises(ExperimentError, match="beyond the link"):
        link(length=1.0, markers=[1.000001])


def test_names_of_recordings_are_their_own() -> None:
    named = vjm.Experiment(link(), [recording(file="recording_2"), recording(), recording(file="a")])
    assert [one.file for one in named.recordings] == ["recording_2", "recording_3", "a"]
    with pytest.raises(ExperimentError, match="also the name of a recording of other markers"):
        vjm.Experiment(link(), [recording(file="a"), recording(file="a", markers=2 * MARKERS)])
    assert any("listed 2 times" in text for text in vjm.Experiment(link(), [recording(file="a")] * 2).warnings)


def test_a_part_of_a_recording_is_no_other_one() -> None:
    time = 0.01 * np.arange(100)

    def recorded(seed: int, rows: slice = np.s_[:], **changed: Any) -> vjm.Recording:
        random = np.random.default_rng(seed)
        places = 0.01 * np.sin(9 * time)[:, None] * [1, 2] + 1e-4 * random.standard_normal((100, 2))
        markers = np.stack([np.broadcast_to([0.5, 1.0], (100, 2)), places], axis=2)[rows]
        return vjm.Recording(**{"time": time[rows] + 7 * seed, "markers": markers, "kind": "decay", **changed})

    def said(*recordings: vjm.Recording) -> tuple[str, ...]:
        return vjm.Experiment(link(markers=[0.5, 1.0]), recordings).warnings

    assert said(recorded(0), recorded(1, role="holdout")) == ()
    (text,) = said(recorded(0, file="a"), recorded(1), recorded(0, np.s_[30:70], role="holdout", file="b"))
    assert text == "b: 100 % of its frames are those of a, a copy: it predicts nothing that was not fitted"
    (text,) = said(recorded(0, np.s_[:60], file="a"), recorded(0, np.s_[20:], file="b"))
    assert text == "b: 67 % of its frames are those of a, a copy: it counts twice"
    assert said(recorded(0, np.s_[:50]), recorded(0, np.s_[50:])) == ()  # cut in two


def test_dates_are_no_seconds() -> None:
    dates = np.datetime64("2026-01-01") + (1e9 * TIME).astype("timedelta64[ns]")
    for time in (dates, dates - dates[0], pd.Series(dates)):
        with pytest.raises(RecordingError, match="dates or durations"):
            recording(time=time)
        with pytest.raises(RecordingError, match="dates or durations"):
            read(frame(t=time))


def wrapped(angle: np.ndarray) -> np.ndarray:
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi


@pytest.mark.parametrize("seed", range(5))
def test_an_encoder_that_starts_over_after_a_turn_is_named(seed: int) -> None:
    noise = 1e-3 * np.random.default_rng(seed).standard_normal(TIME.size)
    turning = 0.15 * np.arange(TIME.size) + noise  # 6 rad
    there_and_back = np.pi * np.sin(9 * TIME) ** 2 + noise
    for angle in (turning, there_and_back + 0.5):
        assert vjm.Experiment(hub(), recording(theta=angle))
        with pytest.raises(RecordingError, match=r"a full turn at once; expected .*numpy.unwrap"):
            vjm.Experiment(hub(), recording(theta=wrapped(angle)))


def test_neither_an_outlier_nor_degrees_are_a_full_turn() -> None:
    outlier, degrees = 0.1 * np.sin(9 * TIME), 60 * np.sin(10 * TIME)
    outlier[17] += 6.2
    for angle in (outlier, degrees, degrees + 6.3 * (np.arange(TIME.size) > 20)):
        assert vjm.Experiment(hub(), recording(theta=angle))


def test_what_is_no_experiment_is_refused() -> None:
    for function in (
        vjm.identify,
        vjm.diagnose,
        vjm.check,
        lambda value: vjm.compare(value, vjm.Model.nominal(link())),
    ):
        with pytest.raises(ExperimentError, match=r"got 'arm.toml'; expected a vjm.Experiment"):
            function("arm.toml")
    experiment = vjm.Experiment(link(), recording())
    for joints in (3.0, "3", [3]):
        with pytest.raises(vjm.VjmError, match="a whole number"):
            vjm.identify(experiment, virtual_joints=joints)  # type: ignore[arg-type]
        with pytest.raises(vjm.VjmError, match="a whole number"):
            vjm.Model.nominal(link(), joints)  # type: ignore[arg-type]
    other = vjm.Model.nominal(vjm.Rig("two", [hub(name="upper"), link(name="fore")]))
    with pytest.raises(ShapeError, match="links"):
        vjm.compare(experiment, other)
    hinged = vjm.Model.nominal(vjm.Rig("hinged", [hub(name=experiment.rig.links[0].name)]))
    expected = r"model: got links beam \(revolute\); expected the experiment's links beam \(clamped\)"
    with pytest.raises(ShapeError, match=expected):
        vjm.compare(experiment, hinged)
    with pytest.raises(RecordingError, match="empty"):
        read(frame().iloc[:0])
