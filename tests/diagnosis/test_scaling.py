"""What is found does not depend on the size of the arm: verdict, causes, sizes over their errors, and the way there."""

from __future__ import annotations

from pathlib import Path

import pytest

import vjm
from tests.diagnosis.rigs import first_seconds
from tests.scaling import scaled

# Before and after the change, and one held out: enough to tell the change by.
FEW = ("first_mode.csv", "second_mode.csv", "later_first_mode.csv", "later_second_mode.csv", "later_both_modes.csv")
QUICK = ["tip_payload", "clamp_compliance"]


def diagnosed(length: float, mass: float, time: float) -> tuple[vjm.Diagnosis, int]:
    """The diagnosis of the demo's later recordings in other units, and how often it reported progress."""
    experiment = vjm.load_experiment(Path(vjm.__file__).parent / "demo" / "later.toml")
    kept = tuple(first_seconds(recording, 1.2) for recording in experiment.recordings if recording.file in FEW)
    reports: list[str] = []
    found = vjm.diagnose(
        scaled(vjm.Experiment(experiment.rig, kept), length, mass, time),
        effects=QUICK,
        budget=float("inf"),
        progress=lambda text, done, total: reports.append(text),
    )
    return found, len(reports)


def test_an_arm_of_another_size_is_diagnosed_alike() -> None:
    """A toy and a boom."""
    toy, boom = (0.3, 0.02, 0.2), (4.0, 60.0, 3.0)
    (here, steps), (there, as_many) = diagnosed(*toy), diagnosed(*boom)
    length, mass, time = (large / small for large, small in zip(boom, toy, strict=True))
    assert there.verdict == here.verdict == "named"
    (one,), (other,) = here.causes, there.causes
    assert other.effect.id == one.effect.id == "clamp_compliance"
    assert other.role == one.role
    size, same = one.parameters["compliance"], other.parameters["compliance"]
    assert size.std is not None
    assert same.std is not None
    assert same.value / same.std == pytest.approx(size.value / size.std, rel=1e-3)
    assert same.value * mass * length**2 / time**2 == pytest.approx(size.value, abs=0.02 * size.std)
    assert there.gain is not None
    assert here.gain is not None
    assert there.gain.after / length == pytest.approx(here.gain.after, rel=1e-4)
    assert as_many == pytest.approx(steps, rel=0.1)
    scores = {candidate.effect.id: candidate.z for candidate in here.candidates}
    assert {each.effect.id: each.z for each in there.candidates} == pytest.approx(scores, rel=0.02, abs=0.05)
