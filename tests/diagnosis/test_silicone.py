"""A measured beam before and after something was put on its tip: what changed, and what was there already."""

from __future__ import annotations

from pathlib import Path

import pytest

import vjm

DATA = Path(__file__).parents[3] / "shared" / "data" / "silicone_beam"
WEIGHED = 0.052  # kg, by the scale of those who measured

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the measured beam's data are not there")


SOME = ["tip_payload", "clamp_compliance", "linear_drag", "structural_damping", "viscoelastic_creep", "cubic_stiffness"]


@pytest.mark.parametrize("effects", [SOME, pytest.param(None, marks=pytest.mark.slow)], ids=["some", "all"])
def test_the_mass_on_the_tip_is_named_and_weighed(effects: list[str] | None) -> None:
    diagnosis = vjm.diagnose(vjm.load_experiment(DATA / "experiment.toml"), effects=effects, budget=float("inf"))
    assert diagnosis.verdict == "named"
    assert [cause.effect.id for cause in diagnosis.causes] == ["tip_payload"]
    assert diagnosis.causes[0].parameters["mass"].value == pytest.approx(WEIGHED, rel=0.1)
    loaded = next(each for each in diagnosis.recordings if each.recording.file == "loaded_b.csv")
    assert loaded.reference is not None
    assert loaded.simulated is not None
    assert loaded.simulated.marker_rms < 0.3 * loaded.reference.marker_rms
    # The silicone creeps, on the tip or not.
    (said,) = [warning for warning in diagnosis.warnings if "already in the reference recordings" in warning]
    assert "viscoelastic_creep" in said
    # No screen is a guide from so far away; the fit is, and what is left is told beside what was missing before.
    assert diagnosis.causes[0].p_value < 1e-12
    assert "what was missing before the change" in diagnosis.causes[0].evidence
    assert "by a model without effects" in diagnosis.remaining.description
    assert any("table of candidates" in note for note in diagnosis.notes)
    assert diagnosis.next_best
