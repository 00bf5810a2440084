"""Whatever the files hold, a command answers or refuses; thousands are drawn by `benchmarks/spoiled_files.py`."""

from __future__ import annotations

import copy
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import Phase, given, settings

from tests.spoiled import PLACES, SECONDS, Case, cases, run, sound
from vjm.report import output

PICTURES = output.identification_pictures


@pytest.fixture(autouse=True, scope="module")
def _no_pictures() -> object:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(output, "identification_pictures", lambda _: [])  # they take longer than all else together
        yield


@settings(max_examples=20, phases=[Phase.generate, Phase.shrink])
@given(cases(slow=False))
def test_a_command_answers_or_refuses(case: Case) -> None:
    with TemporaryDirectory() as parent:
        outcome = run(case, Path(parent))
    assert not outcome.faults, f"{outcome.faults}: {outcome.stderr}"


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(
    ("name", "command"), [("experiment.toml", "check"), ("a.csv", "check"), ("model.json", "urdf")]
)
def test_what_is_no_file_is_named_and_refused(tmp_path: Path, place: str, name: str, command: str) -> None:
    case = copy.deepcopy(sound("clamped"))
    case.places[name], case.command = place, [command, "{MODEL}" if command == "urdf" else "{EXPERIMENT}"]
    outcome = run(case, tmp_path)
    assert (outcome.status, outcome.faults) == (2, ()) or place == "not readable"  # which root can read all the same
    assert str(tmp_path / "rig" / name) in outcome.stderr


def test_a_pause_longer_than_the_rest(tmp_path: Path) -> None:
    case = copy.deepcopy(sound("driven"))
    for table in case.tables.values():
        table.column("t", "Time")[24:] += 4300.0 * (1.0 if table.column("t", "Time")[1] > 1 else 1e-3)
    case.command = ["check", "{EXPERIMENT}", "-o", "{OUT}"]
    outcome = run(case, tmp_path)
    assert (outcome.status, outcome.faults) == (0, ()), outcome.stderr


@pytest.mark.parametrize("field", ["lengths", "masses", "inertias", "stiffness"])
def test_a_model_whose_products_are_not_finite(tmp_path: Path, field: str) -> None:
    case = copy.deepcopy(sound("hub"))
    case.model["chain"]["links"][0][field][0] = 1e307
    case.command = ["urdf", "{MODEL}"]
    outcome = run(case, tmp_path)
    assert (outcome.status, outcome.faults) == (2, ()), outcome.stderr
    assert field in outcome.stderr


def test_a_period_far_longer_than_the_recording(tmp_path: Path) -> None:
    case = copy.deepcopy(sound("clamped"))
    link = case.model["chain"]["links"][0]
    link["inertias"] = [1e15 * inertia for inertia in link["inertias"]]
    case.command = ["simulate", "{EXPERIMENT}", "{MODEL}", "-o", "{OUT}"]
    outcome = run(case, tmp_path)
    assert (outcome.status, outcome.faults) == (0, ()), outcome.stderr
    assert outcome.seconds < 0.5 * SECONDS  # it took more than all of them, nearly all beyond the recording


@pytest.mark.slow
def test_torques_of_a_billionth(tmp_path: Path) -> None:
    case = copy.deepcopy(sound("hub"))
    case.tables["a.csv"].column("arm.tau", "arm.tau")[:] *= 1e-9
    case.command = ["identify", "{EXPERIMENT}", "-o", "{OUT}"]
    outcome = run(case, tmp_path)
    assert outcome.faults == (), outcome.stderr
    assert outcome.seconds < 0.5 * SECONDS  # it stiffened the arm to a mode of 10 kHz, with steps without end


def test_a_recording_that_is_followed_exactly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output, "identification_pictures", PICTURES)
    case = copy.deepcopy(sound("clamped"))
    for table in case.tables.values():
        for name in table.columns[1:]:
            table.column(name)[:] = 0.0 if name.endswith("y") else 0.25 if "m1" in name else 0.5
    case.toml = [line for line in case.toml if not line.startswith("marker_noise")]
    case.command = ["simulate", "{EXPERIMENT}", "{MODEL}", "-o", "{OUT}"]
    outcome = run(case, tmp_path)
    assert (outcome.status, outcome.faults) == (0, ()), outcome.stderr


def test_an_empty_header(tmp_path: Path) -> None:
    case = copy.deepcopy(sound("clamped"))
    case.command = ["check", "{EXPERIMENT}"]
    for name in case.tables:
        case.tables[name].columns = ["\r"]
    outcome = run(case, tmp_path)
    assert (outcome.status, outcome.faults) == (2, ()), outcome.stderr


@pytest.mark.parametrize("kind", ["clamped", "hub", "two"])
def test_a_replay_of_times_in_milliseconds(tmp_path: Path, kind: str) -> None:
    case = copy.deepcopy(sound(kind))
    for table in case.tables.values():
        table.column("t")[:] *= 1e3
    case.command = ["simulate", "{EXPERIMENT}", "{MODEL}", "-o", "{OUT}"]
    outcome = run(case, tmp_path)
    assert (outcome.status, outcome.faults) == (2, ()), outcome.stderr
    assert '[units] time = "ms"' in outcome.stderr  # it took steps for 26 minutes of motion
