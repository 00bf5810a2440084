"""A measured beam before and after something was put on its tip: what changed, and what was there already."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import vjm
from tests.diagnosis.rigs import first_seconds

DATA = Path(__file__).parents[3] / "shared" / "data" / "silicone_beam"
WEIGHED = 0.052  # kg, by the scale of those who measured

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the measured beam's data are not there")


# A compliant clamp with a damper leaves less than the mass does, but not so much less as two parameters must.
RIVALS = [
    *("tip_payload", "clamp_compliance", "linear_drag"),
    *("viscoelastic_creep", "structural_damping", "cubic_stiffness"),
]


def shortened(duration: float) -> vjm.Experiment:
    experiment = vjm.load_experiment(DATA / "experiment.toml")
    return replace(experiment, recordings=tuple(first_seconds(each, duration) for each in experiment.recordings))


@pytest.mark.slow
def test_a_mass_on_the_tip_is_not_told_from_a_taper() -> None:
    """The taper leaves less, but what either leaves is no white noise."""
    rivals = ["tip_payload", "taper", "viscoelastic_creep"]
    (cause,) = vjm.diagnose(shortened(1.0), effects=rivals, budget=float("inf")).causes
    found = {effect.id: effect.values for effect in (cause.effect, *(each.effect for each in cause.alternatives))}
    assert set(found) == {"tip_payload", "taper"}
    assert found["tip_payload"]["mass"] == pytest.approx(WEIGHED, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("effects", "duration"), [(RIVALS[:4], 1.5), (RIVALS, 10.0)], ids=["some", "rivals"])
def test_the_mass_on_the_tip_is_named_and_weighed(effects: list[str], duration: float) -> None:
    experiment = shortened(duration)
    diagnosis = vjm.diagnose(experiment, effects=effects, budget=float("inf"))
    assert diagnosis.verdict == "named"
    assert [cause.effect.id for cause in diagnosis.causes] == ["tip_payload"]
    assert diagnosis.causes[0].parameters["mass"].value == pytest.approx(WEIGHED, rel=0.05)
    loaded = next(each for each in diagnosis.recordings if each.recording.file == "loaded_b.csv")
    assert loaded.reference is not None
    assert loaded.simulated is not None
    assert loaded.simulated.marker_rms < 0.25 * loaded.reference.marker_rms
    # The silicone creeps, on the tip or not.
    (said,) = [warning for warning in diagnosis.warnings if "present before the change" in warning]
    assert "viscoelastic creep" in said
    # No screen is a guide from so far away; the fit is, and what is left is told beside what was missing before.
    assert diagnosis.causes[0].p_value < 1e-12
    assert "the residual before the change" in diagnosis.causes[0].evidence
    assert "reference recordings without effects" in diagnosis.remaining.description
    assert any("candidate table" in note for note in diagnosis.notes)


@pytest.mark.slow
def test_among_all_effects_one_stands_beside_the_mass() -> None:
    """Where more is missing anyway, a link that is thicker at its tip is as good as a mass; another mass would tell."""
    diagnosis = vjm.diagnose(vjm.load_experiment(DATA / "experiment.toml"), budget=float("inf"))
    assert diagnosis.verdict == "set"
    (cause,) = diagnosis.causes
    (other,) = cause.alternatives
    found = {effect.id: effect.values for effect in (cause.effect, other.effect)}
    assert set(found) == {"tip_payload", "taper"}
    assert found["tip_payload"]["mass"] == pytest.approx(WEIGHED, rel=0.05)
    assert diagnosis.gain is not None
    assert diagnosis.gain.reduction > 0.75
    assert diagnosis.next_experiment is not None
    assert "known mass" in diagnosis.next_experiment
