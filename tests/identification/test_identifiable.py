"""What cannot be told is not called determined."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.identification.test_recovery import demo
from vjm.identification.check import Check, check
from vjm.records import Experiment


@pytest.fixture(scope="module")
def tip_only() -> Check:
    """The demo seen by its tip marker alone: one mode, one row of the equation of motion."""
    experiment = demo()
    link = replace(experiment.rig.links[0], markers=(1.0,))
    kept = tuple(replace(r, markers=r.markers[:, 4:5]) for r in experiment.recordings if r.file == "first_mode.csv")
    return check(Experiment(replace(experiment.rig, links=(link,)), kept))


@pytest.mark.parametrize("kind", ["lengths", "full"])
def test_one_row_cannot_hold_a_length_beside_a_stiffness(tip_only: Check, kind: str) -> None:
    found = {estimate.name: estimate for estimate in tip_only.identifiable[kind]}
    assert not found["beam.stiffness_1"].identifiable
    assert not found["beam.length_0"].identifiable
    assert "in combination with" in found["beam.stiffness_1"].reason


def test_more_parameters_never_make_one_surer(tip_only: Check) -> None:
    errors = []
    for kind in ("joints", "lengths", "full"):
        (stiffness,) = [e for e in tip_only.identifiable[kind] if e.name == "beam.stiffness_1"]
        assert stiffness.std is not None
        errors.append(stiffness.std)
    assert errors[0] < 1.01 * errors[1]
    assert errors[0] < 1.01 * errors[2]
