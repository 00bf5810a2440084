"""The benchmark's bookkeeping, with diagnoses whose merits are known."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.hidden.severities import EFFECTS, draw, twins

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

import hidden_cases as cases
import hidden_effects as benchmark
import hidden_figures as figures
from hidden_tables import report

Record = dict[str, Any]


def cause(effect: str, *like: str, **parameters: tuple[float, float]) -> Record:
    estimates = {name: {"value": value, "std": std, "unit": ""} for name, (value, std) in parameters.items()}
    return {"effect": effect, "link": None, "parameters": estimates, "indistinguishable_from": list(like)}


def record(
    truth: dict[str, dict[str, float]], verdict: str, *causes: Record, after: float = 3e-4, remaining: float = 0.5
) -> Record:
    """A finished case of the suite "everyday": one hold-out, 1.3 mm off before."""
    result = {
        "verdict": verdict,
        "causes": list(causes),
        "recordings": [
            {"file": "a.csv", "role": "train", "marker_rms_before_m": 9.0, "marker_rms_after_m": 9.0},
            {"file": "b.csv", "role": "holdout", "marker_rms_before_m": 1.3e-3, "marker_rms_after_m": after},
        ],
        "candidates": [],
        "remaining": {"p_value": remaining},
    }
    noise = {"a.csv": 3e-4, "b.csv": 3e-4}
    hidden = [{"effect": effect, "parameters": parameters} for effect, parameters in truth.items()]
    return {"suite": "everyday", "rig": "hub", "multiple": 0.0, "seconds": 2.0, "truth": hidden, "result": result} | {
        "noise_rms": noise,
        "right_rms": noise,
        "key": "",
    }


MASS = {"tip_payload": {"mass": 0.01}}
RIGHT = record(MASS, "named", cause("tip_payload", mass=(0.0103, 2e-4)))
WRONG = record(MASS, "named", cause("joint_spring", stiffness=(0.1, 0.01)), after=8e-4)
SET = record(MASS, "set", cause("clamp_compliance", "tip_payload", compliance=(5e-3, 1e-4)))
UNKNOWN = record(MASS, "unknown", remaining=1e-6)
BOTH = {"tip_payload": {"mass": 0.01}, "clock_scale": {"scale": 1.002}}


def test_a_class_that_holds_the_truth_is_right() -> None:
    assert [figures.right_first(each) for each in (RIGHT, WRONG, SET, UNKNOWN)] == [True, False, True, False]
    assert [figures.wrong_name(each) for each in (RIGHT, WRONG, SET, UNKNOWN)] == [False, True, False, False]
    assert [figures.column(each) for each in (RIGHT, WRONG, SET, UNKNOWN)] == [
        "tip_payload",
        "joint_spring",
        "set",
        "unknown",
    ]
    assert [figures.flagged(each) for each in (RIGHT, UNKNOWN)] == [False, True]
    doubted = record(MASS, "named", cause("joint_spring"), remaining=1e-4)
    assert figures.flagged(doubted)
    assert not figures.wrong_name(doubted)


def test_two_causes_need_a_class_each() -> None:
    clock, mass = cause("clock_scale"), cause("clamp_compliance", "tip_payload")
    for causes, found, right in (
        ([clock, mass], True, True),
        ([mass, cause("backlash"), clock], True, False),
        ([mass, cause("tip_payload")], False, False),
        ([cause("clock_scale", "tip_payload")], False, False),
        ([cause("clock_scale", "tip_payload"), mass], True, True),
    ):
        case = record(BOTH, "named", *causes)
        assert (figures.all_found(case), figures.all_right(case)) == (found, right)


def test_coverage_counts_each_parameter_of_what_was_named() -> None:
    assert figures.covered(RIGHT) == [True]
    assert figures.covered(WRONG) == []
    tone = {"external_tone": {"amplitude": 0.01, "frequency": 3.0, "phase": 6.27}}
    named = cause("external_tone", amplitude=(0.02, 1e-3), frequency=(3.0, 1e-3), phase=(0.01, 0.02))
    assert figures.covered(record(tone, "named", named)) == [False, True, True]


def test_gain_is_measured_against_the_noise_that_was_drawn() -> None:
    assert figures.gained(RIGHT) == pytest.approx(1.0)
    assert figures.gained(WRONG) == pytest.approx(0.5)
    assert figures.gained(record(MASS, "none", after=1.3e-3)) == pytest.approx(0.0)
    small = record(MASS, "none") | {"noise_rms": {"b.csv": 1.29e-3}, "right_rms": {"b.csv": 1.29e-3}}
    assert figures.gained(small) is None
    spoilt = RIGHT | {"noise_rms": {"b.csv": 1.4e-3}}
    assert figures.gained(spoilt) == pytest.approx(1.0)


def test_tables_say_what_happened() -> None:
    clean = record({}, "none"), record({}, "named", cause("backlash"))
    broken = {"key": "k", "suite": "everyday", "rig": "hub", "multiple": 0.0, "truth": [], "error": "ValueError: no"}
    made = [each | {"made": "today, abc1234", "seed": seed} for each, seed in ((RIGHT, 1), (WRONG, 2), (SET, 5))]
    other = [each | {"made": "later", "seed": 7} for each in (UNKNOWN, *clean, broken)]
    text = report([*made, *other])
    assert "| today, abc1234 | everyday | 1 to 2, 5 | 3 | 2/3 |" in text
    assert "| later | everyday | 7 | 4 | 1/3 |" in text
    assert "| right class named first | 2/4 = 50.0 % (15.0 to 85.0) |" in text
    assert "| false alarms, hub rig | 1/2 = 50.0 % (9.5 to 90.5) |" in text
    assert "| one wrong name alone | 1/4 = 25.0 % (4.6 to 69.9) |" in text
    assert "| broken off by an error | 1: ValueError: no |" in text
    assert "| hidden \\ named | tip_payload | backlash | joint_spring | none | unknown | set |" in text
    assert "| tip_payload | 1 |  | 1 |  | 1 | 1 |" in text
    assert "| nothing |  | 1 |  | 1 |  |  |" in text


def test_suites_hold_what_they_promise() -> None:
    everyday = cases.cases_of("everyday", [1, 2])
    assert len(everyday) == 2 * len(EFFECTS)
    assert len({case.key for suite in cases.SUITES for case in cases.cases_of(suite, [1, 2])}) == sum(
        len(cases.cases_of(suite, [1, 2])) for suite in cases.SUITES
    )
    assert len(cases.cases_of("severities", [1])) == 4 * len(EFFECTS)
    for case in cases.cases_of("missing", [1]):
        assert case.candidates is not None
        assert set(case.candidates) == set(EFFECTS) - twins("hub", case.effects[0])
    for first, second in cases.pairs_of(3):
        assert second not in twins("hub", first)
    assert len(cases.pairs_of(3)) >= 12
    assert cases.cases_of("outliers", [1])[0].conditions.dropped_frames == 0.1
    assert 0.5 <= cases.cases_of("coloured", [1])[0].conditions.noise_correlation <= 0.9
    assert cases.cases_of("reference", [1])[0].conditions.reference


def stub(file: Path, effects: list[str] | None) -> Record:
    """Always names the same payload; what is detectable is small. Breaks off where a candidate is missing."""
    if effects is not None:
        raise RuntimeError("not today")
    assert file.exists()
    result = dict(record({}, "named", cause("tip_payload", mass=(0.01, 1e-3)))["result"])
    files = ["both_modes.csv", "large.csv"]
    rows = [{"file": name, "marker_rms_before_m": 1e-3, "marker_rms_after_m": 5e-4} for name in files]
    sizes = {"linear_drag": {"coefficient": 1e-3}, "tip_payload": {"mass": None}}
    result["recordings"] = [row | {"role": "holdout"} for row in rows]
    result["candidates"] = [{"effect": name, "smallest_detectable": size} for name, size in sizes.items()]
    return result


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Severities on the clamped rig, which is quicker to simulate."""

    def few(suite: str, seeds: list[int]) -> list[cases.Case]:
        return [cases.Case("severities", "clamped", ("linear_drag",), seed, 5.0) for seed in seeds]

    monkeypatch.setattr(benchmark, "cases_of", few)


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_a_benchmark_can_be_stopped_and_taken_up(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "results" / "r.jsonl"
    words = ["severities", "--seeds", "1", "-o", str(out)]
    benchmark.main(words, stub)
    head, clean, drag = (json.loads(line) for line in out.read_text().splitlines())
    assert {"date", "commit", "machine", "suites"} <= set(head)
    assert clean["key"] == "clean/clamped/nothing/everyday/1"
    assert drag["truth"] == [{"effect": "linear_drag", "parameters": {"coefficient": pytest.approx(5e-3)}}]
    assert set(drag["noise_rms"]) >= {"both_modes.csv", "large.csv"}
    with out.open("a") as stream:
        stream.write('{"key": "severities/cut sho')
    capsys.readouterr()
    benchmark.main([*words, "--jobs", "2", "--seeds", "2"], stub)
    shown = capsys.readouterr()
    assert "severities/clamped/linear_drag/x5/2: named" in shown.err
    assert "x5/1" not in shown.err
    assert "| 5 | 0/2 = 0.0 % (0.0 to 65.8) | 2/2 = 100.0 % (34.2 to 100.0) |" in shown.out
    assert out.with_suffix(".md").read_text().strip() == shown.out.strip()
    benchmark.main([*words, "--seeds", "2", "--tables-only"], stub)
    assert capsys.readouterr().err == ""


def test_what_breaks_off_is_told_and_tried_again(tmp_path: Path) -> None:
    case = cases.Case("missing", "clamped", ("linear_drag",), 1)
    found = benchmark.run(case, {}, stub, keep=tmp_path)
    assert found["error"] == "RuntimeError: not today"
    assert (tmp_path / "missing-clamped-linear_drag-everyday-1" / "experiment.toml").exists()
    assert found["truth"][0]["parameters"] == dict(draw("linear_drag", 1, "clamped").parameters)
    hopeless = benchmark.run(cases.Case("severities", "clamped", ("backlash",), 1, 2.0), {}, stub)
    assert hopeless["error"].startswith("ValueError: backlash: no smallest detectable size")
