"""Recordings made after a change are cleaned as well as those made before it, though the model misses them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import vjm
from tests.hidden.rigs import Conditions, write_hidden
from tests.hidden.severities import Planted, draw
from vjm.diagnosis.baseline import fit_baseline


@pytest.mark.parametrize("seed", [502, pytest.param(503, marks=pytest.mark.slow)])
def test_wrong_sightings_after_a_change_are_left_out(tmp_path: Path, seed: int) -> None:
    payload = draw("tip_payload", seed, "clamped", 1.0)
    with_outliers, without = (
        _written(tmp_path / str(share), seed, Conditions(outliers=share, reference=True), payload)
        for share in (0.005, 0.0)
    )
    base = fit_baseline(with_outliers)
    found, wrong = [], []
    for observed in base.changed:
        shown, right = (_markers(each, observed.recording.file) for each in (with_outliers, without))
        wrong.append(np.abs(shown - right) > 4e-3)
        found.append(~np.isfinite(observed.recording.markers) & wrong[-1])
    assert len(base.changed) == 4
    assert np.sum(wrong) > 40
    assert np.sum(found) > 0.95 * np.sum(wrong)


def _written(folder: Path, seed: int, conditions: Conditions, payload: Planted) -> vjm.Experiment:
    write_hidden(folder, "clamped", [payload], seed, conditions)
    return vjm.load_experiment(folder / "experiment.toml")


def _markers(experiment: vjm.Experiment, file: str) -> NDArray[np.float64]:
    return next(each.markers for each in experiment.recordings if each.file == file)
