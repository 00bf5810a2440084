"""Properties of reading: no input leads to an unforeseen exception, valid input comes back unchanged."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from experiment_files import DRIVEN, FREE, TOML, csv_text, rows, write_experiment
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vjm.errors import InputError, RecordingError
from vjm.experiment.load import _parse_at_once, _parse_row_by_row, load_experiment
from vjm.records import Experiment

FINITE = st.floats(allow_nan=False, allow_infinity=False)
NUMBER_LIKE = st.text("0123456789+-.eE \t", max_size=8)
JUNK = st.one_of(
    st.text(max_size=6),
    NUMBER_LIKE,
    FINITE.map(repr),
    st.sampled_from(
        ["nan", "inf", "-inf", "1e999", '"', '""', ",", "\n", "\r", "\0", "1,2", "'", "NULL", "1e308", "\ufeff"]
    ),
)
pytestmark = pytest.mark.filterwarnings("error")


def outcome(file: Path) -> Experiment | InputError:
    """What loading gives or how it refuses; any other exception is a failure of the test."""
    try:
        return load_experiment(file)
    except InputError as error:
        return error


@settings(max_examples=120, deadline=None)
@given(st.lists(st.tuples(st.integers(-1, 39), st.integers(0, len(FREE) - 1), JUNK), min_size=1, max_size=4))
def test_junk_in_cells(replacements: list[tuple[int, int, str]]) -> None:
    table = [list(FREE), *rows(FREE)]
    for row, column, junk in replacements:
        table[row + 1][column] = junk
    text = csv_text(table[0], table[1:]).encode("utf-8", "replace").decode("utf-8")
    with tempfile.TemporaryDirectory() as folder:
        file = write_experiment(Path(folder), free=text)
        result = outcome(file)
    if isinstance(result, InputError):
        assert folder in str(result)
    else:
        assert not np.isinf(result.recordings[2].markers).any()
        assert (np.diff(result.recordings[2].time) > 0).all()


@settings(max_examples=120, deadline=None)
@given(st.data())
def test_junk_in_the_experiment_file(data: st.DataObject) -> None:
    lines = TOML.split("\n")
    for _ in range(data.draw(st.integers(1, 3))):
        number = data.draw(st.integers(0, len(lines) - 1))
        key, equals, _ = lines[number].partition(" = ")
        values = st.sampled_from(
            ["-1", "0", "1", "1.5", "true", '"a"', "[]", "[1, 2]", "{}", "1e999", "nan", "0x" + "f" * 400]
        )
        new = data.draw(
            st.one_of(values.map(lambda value, key=key: f"{key} = {value}"), st.text(max_size=20), st.just(""))
        )
        lines[number] = new if equals or data.draw(st.booleans()) else lines[number]
    with tempfile.TemporaryDirectory() as folder:
        file = write_experiment(Path(folder), "\n".join(lines).encode("utf-8", "replace").decode("utf-8"))
        result = outcome(file)
    assert isinstance(result, Experiment) or folder in str(result)


@settings(max_examples=300, deadline=None)
@example([["1e", "1"]])
@example([["-", "1"]])
@example([["1e5", ".5"]])
@example([["1.", "-0"]])
@given(st.lists(st.lists(st.one_of(NUMBER_LIKE, FINITE.map(repr)), min_size=1, max_size=3), min_size=1, max_size=4))
def test_fast_and_slow_path_agree(table: list[list[str]]) -> None:
    body = "\n".join(",".join(line) for line in table).rstrip("\r\n")
    columns = ("a", "b")
    parsed = _parse_at_once(body.encode(), len(columns)) if body.strip() else None
    if parsed is None:
        return
    fast, lines = parsed
    for separator, decimal in (",.", ";.", ";,", "\t,"):
        text = body.translate(str.maketrans(",.", separator + decimal))
        slow, slow_lines = _parse_row_by_row(Path("a.csv"), columns, (separator, decimal), text, (True, True))
        assert lines.tolist() == slow_lines.tolist()
        np.testing.assert_array_max_ulp(fast[np.isfinite(fast)], slow[np.isfinite(slow)], maxulp=1)
        np.testing.assert_array_equal(np.isnan(fast), np.isnan(slow))


@st.composite
def experiments(draw: st.DrawFn) -> tuple[str, dict[str, float], list[str], np.ndarray]:
    """An experiment file, its link's numbers, a recording's columns and its table; NaN: not measured."""
    positive = st.floats(1e-3, 1e3)
    link = {key: draw(positive) for key in ("length", "mass", "bending_stiffness", "hub_inertia", "payload")}
    parts = sorted(draw(st.lists(st.floats(0.01, 1.0), min_size=1, max_size=4, unique=True)))
    arcs = [part * link["length"] for part in parts]
    columns = ["t", "a_1.theta", "a_1.tau", *(f"a_1.m{k}.{axis}" for k in range(1, len(arcs) + 1) for axis in "xy")]
    count = draw(st.integers(10, 25))
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    table = generator.normal(size=(count, len(columns))) * 10.0 ** generator.integers(-12, 8, (count, len(columns)))
    table[:, 0] = np.cumsum(generator.uniform(1e-4, 1.0, count)) + draw(st.floats(-1e3, 1e3))
    table[1:, 1:3][generator.random((count - 1, 2)) < 0.3] = np.nan
    keys = "".join(f"{key} = {value!r}\n" for key, value in link.items())
    toml = 'schema = 1\nname = "x"\n[base]\ngravity = [0.0, 0.0]\n[[link]]\nname = "a_1"\njoint = "revolute"\n'
    toml += f'{keys}markers = {arcs!r}\n[[recording]]\nfile = "r.csv"\nkind = "driven"\nrole = "train"\n'
    return toml, link, columns, table


@settings(max_examples=60, deadline=None)
@given(experiments())
def test_valid_experiments_come_back_unchanged(drawn: tuple[str, dict[str, float], list[str], np.ndarray]) -> None:
    toml, link, columns, table = drawn
    cells = [["" if np.isnan(x) else repr(float(x)) for x in line] for line in table]
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "experiment.toml").write_text(toml)
        (Path(folder) / "r.csv").write_text(csv_text(columns, cells))
        experiment = load_experiment(Path(folder) / "experiment.toml")
    read = experiment.recordings[0]
    assert {key: getattr(experiment.rig.links[0], key) for key in link} == link
    np.testing.assert_array_equal(read.time, table[:, 0])
    np.testing.assert_array_equal(read.theta[:, 0], table[:, 1])
    np.testing.assert_array_equal(read.tau[:, 0], table[:, 2])
    np.testing.assert_array_equal(read.markers.reshape(len(table), -1), table[:, 3:])


@settings(max_examples=60, deadline=None)
@given(st.permutations(range(40)))
def test_rows_out_of_order_are_refused(order: list[int]) -> None:
    cells = rows(DRIVEN)
    with tempfile.TemporaryDirectory() as folder:
        file = write_experiment(Path(folder), drive_1=csv_text(DRIVEN, [cells[row] for row in order]))
        if order == sorted(order):
            load_experiment(file)
            return
        with pytest.raises(RecordingError) as caught:
            load_experiment(file)
    first = next(i for i in range(1, 40) if order[i] < order[i - 1])
    assert (caught.value.row, caught.value.column) == (first + 2, "t")
