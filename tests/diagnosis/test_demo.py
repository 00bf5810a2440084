"""The demo's second half: what has changed about the beam is found, and README.md says what comes out."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

import vjm
from tests.fine_beam.make_demo import TRUTH_FILE
from vjm.report.result_json import result_object

ROOT = Path(__file__).parents[2]
QUICK = ["tip_payload", "clamp_compliance", "stiffness_drift"]


def result() -> dict[str, Any]:
    """The result in the folder VJM_DEMO that `vjm demo` wrote; without one, that of a search among few effects."""
    if folder := os.environ.get("VJM_DEMO"):
        return dict(json.loads((Path(folder) / "diagnosis" / "result.json").read_text(encoding="utf-8")))
    experiment = vjm.load_experiment(Path(vjm.__file__).parent / "demo" / "later.toml")
    return dict(result_object(vjm.diagnose(experiment, effects=QUICK, budget=float("inf"))))


@pytest.mark.slow
def test_the_cause_hidden_in_the_later_recordings_is_named() -> None:
    diagnosis = result()
    truth = json.loads(TRUTH_FILE.read_text(encoding="utf-8"))["clamp_compliance_later"]
    assert diagnosis["verdict"] == "named"
    (cause,) = diagnosis["causes"]
    assert cause["effect"] == "clamp_compliance"
    value, std = (cause["parameters"]["compliance"][key] for key in ("value", "std"))
    assert value == pytest.approx(truth, abs=3 * std)
    assert std < 2e-3 * truth
    assert diagnosis["gain"]["holdout_rms_after_m"] < 1.03 * 3e-4
    assert diagnosis["estimates"][0]["value"] == pytest.approx(1.973629, rel=5e-4)

    readme = (ROOT / "README.md").read_text(encoding="utf-8").replace("\n", " ")
    quoted = {
        r"with a residual of ([\d.]+) mm RMS": 1e3 * diagnosis["gain"]["holdout_rms_before_m"],
        r"the clamp is compliant, ([\d.]+) ±": 1e3 * value,
        r"± ([\d.]+) mrad/\(N m\)": 1e3 * std,
        r"where the truth is ([\d.]+),": 1e3 * truth,
    }
    for pattern, number in quoted.items():
        (said,) = re.findall(pattern, readme)
        assert float(said) == pytest.approx(number, abs=10.0 ** -len(said.partition(".")[2])), pattern
