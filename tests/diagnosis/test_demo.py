"""The demo's second half: what has changed about the beam is found, and README.md says what comes out."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

import vjm
from tests.fine_beam.make_demo import TRUTH_FILE

ROOT = Path(__file__).parents[2]
QUICK = ["tip_payload", "clamp_compliance", "stiffness_drift"]


def test_the_cause_hidden_in_the_later_recordings_is_named() -> None:
    experiment = vjm.load_experiment(Path(vjm.__file__).parent / "demo" / "later.toml")
    diagnosis = vjm.diagnose(experiment, effects=QUICK, budget=float("inf"))  # `vjm demo` looks for all of them
    truth = json.loads(TRUTH_FILE.read_text(encoding="utf-8"))["clamp_compliance_later"]
    assert diagnosis.verdict == "named"
    (cause,) = diagnosis.causes
    assert cause.effect.id == "clamp_compliance"
    found = cause.parameters["compliance"]
    assert found.std is not None
    assert found.value == pytest.approx(truth, abs=3 * found.std)
    assert found.std < 2e-3 * truth
    assert diagnosis.gain is not None
    assert diagnosis.gain.after < 1.03 * 3e-4
    stiffness = diagnosis.parameters[0]
    assert stiffness.value == pytest.approx(1.973629, rel=5e-4)

    readme = (ROOT / "README.md").read_text(encoding="utf-8").replace("\n", " ")
    quoted = {
        r"with a residual of ([\d.]+) mm RMS": 1e3 * diagnosis.gain.before,
        r"the clamp is compliant, ([\d.]+) ±": 1e3 * found.value,
        r"± ([\d.]+) mrad/\(N m\)": 1e3 * found.std,
        r"where the truth is ([\d.]+),": 1e3 * truth,
    }
    for pattern, value in quoted.items():
        (said,) = re.findall(pattern, readme)
        assert float(said) == pytest.approx(value, abs=10.0 ** -len(said.partition(".")[2])), pattern
