"""Recordings and options that support no statement: never a cause, always a reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vjm
from vjm.errors import ChoiceError, InsufficientDataError, RecordingError, ShapeError
from vjm.records import Experiment, Recording

DEMO = Path(vjm.__file__).parent / "demo" / "later.toml"
FEW = ["tip_payload", "quadratic_drag"]


def changed(change: Callable[[Sequence[Recording]], Sequence[Recording]]) -> Experiment:
    """The demo's later experiment with other recordings."""
    experiment = vjm.load_experiment(DEMO)
    return replace(experiment, recordings=tuple(change(experiment.recordings)))


def short(recording: Recording, duration: float = 2.0) -> Recording:
    rows = recording.time <= duration
    names = ("time", "theta", "tau", "markers")
    return replace(recording, **{name: getattr(recording, name)[rows] for name in names})


CASES: dict[str, tuple[Callable[[Sequence[Recording]], Sequence[Recording]], str]] = {
    "nothing held out": (
        lambda all_: [short(replace(each, condition=None)) for each in all_ if each.role == "train"],
        "no recording is held out",
    ),
    "one recording": (
        lambda all_: [short(replace(each, condition=None)) for each in all_ if each.file == "first_mode.csv"],
        "only one training recording moves",
    ),
    "nothing but the reference": (
        lambda all_: [short(replace(each, condition="reference")) for each in all_ if "later" not in each.file],
        'every training recording has condition = "reference"',
    ),
}


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.slow] * (case == "nothing but the reference")) for case in CASES]
)
def test_what_supports_no_statement_names_no_cause(case: str) -> None:
    change, reason = CASES[case]
    diagnosis = vjm.diagnose(changed(change), effects=FEW)
    assert diagnosis.verdict == "insufficient"
    assert diagnosis.causes == ()
    assert any(reason in warning for warning in diagnosis.warnings)
    assert diagnosis.next_experiment


def test_what_was_never_seen_is_an_error() -> None:
    def blind(recordings: Sequence[Recording]) -> list[Recording]:
        return [replace(each, markers=np.full_like(each.markers, np.nan)) for each in recordings]

    with pytest.raises(RecordingError):
        vjm.diagnose(changed(blind), effects=FEW)


def test_options_that_mean_nothing_are_refused() -> None:
    experiment = vjm.load_experiment(DEMO)
    with pytest.raises(ChoiceError, match="rust"):
        vjm.diagnose(experiment, effects=["rust"])
    with pytest.raises(ShapeError, match="each once"):
        vjm.diagnose(experiment, effects=["tip_payload", "tip_payload"])
    for options in ({"jobs": 0}, {"max_effects": 0}, {"seed": -1}, {"seed": True}, {"budget": 0}):
        with pytest.raises(ShapeError):
            vjm.diagnose(experiment, **options)


def test_numbers_of_numpy_are_numbers() -> None:
    one = np.int64(1)
    with pytest.raises(InsufficientDataError):  # about the recordings, of which nothing can be fitted
        vjm.diagnose(changed(lambda all_: [short(all_[0])]), FEW, jobs=one, max_effects=one, seed=one, budget=one)
