"""Simulations without one cause keep all else that acts on the arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.report.diagnoses import pair
from vjm.diagnosis.diagnose import _simulate_without_each_cause
from vjm.effects import ViscousFriction


def test_what_was_present_before_a_change_stays_when_a_cause_is_left_out() -> None:
    diagnosis = pair()
    causes = [cause.effect for cause in diagnosis.causes]
    friction = ViscousFriction(link=0, coefficient=0.05)
    model = replace(diagnosis.model, effects=(friction, *causes), reference_effects=1)
    first = diagnosis.most_improved
    assert first is not None
    without = _simulate_without_each_cause(replace(diagnosis, model=model)).causes[0].without
    assert without is not None
    assert first.simulated is not None
    near = first.simulated.simulation
    expected = replace(model, effects=(friction, causes[1])).replay(first.recording, near)
    np.testing.assert_allclose(without.simulation.markers, expected.simulation.markers, rtol=0, atol=1e-12)
    frictionless = replace(model, effects=(causes[1],), reference_effects=0).replay(first.recording, near)
    assert np.abs(without.simulation.markers - frictionless.simulation.markers).max() > 1e-4


def test_a_single_cause_leaves_the_model_fitted_without_it() -> None:
    diagnosis = pair()
    first = diagnosis.most_improved
    assert first is not None
    (cause,) = _simulate_without_each_cause(replace(diagnosis, causes=diagnosis.causes[:1])).causes
    assert cause.without is first.reference
