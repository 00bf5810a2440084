"""Numbers and sentences as an engineer says them."""

from __future__ import annotations

import math

import pytest

from vjm.symptoms import wording


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (2.04e-3, "m", "2.0 mm"),
        (-3e-6, "m", "3.0 µm"),
        (0.2, "rad", "11 deg"),
        (1e-4, "rad", "0.10 mrad"),
        (4.04e-3, "s", "4.0 ms"),
        (12.0, "s", "12 s"),
        (0.0123, "N m", "0.012 N m"),
        (0.29, "m/s²", "290 mm/s²"),
        (1234.0, "rad/s²", "1200 rad/s²"),
        (0.0, "m", "0 µm"),
    ],
)
def test_quantities(value: float, unit: str, text: str) -> None:
    assert wording.quantity(value, unit) == text


def test_sentences_say_which_way() -> None:
    assert wording.frequency(1.2, -0.004, 5.0, -0.21, -0.2).endswith(
        "slower at 1.2 Hz than the model: after 5.0 s it lags by 11 deg"
    )
    assert wording.frequency(1.2, 0.004, 5.0, 0.21, -0.1).endswith("in 5.0 s it gains 12 deg")
    assert wording.frequency(1.2, 0.1, 50.0, 38.0, 38.0).endswith("leads by 6.0 periods")
    assert wording.damping(2.0, 0.05, 5.0).endswith("after 5.0 s its amplitude is 22 % smaller than the model's")
    assert wording.damping(2.0, -0.5, 5.0).endswith("is 12 times the model's")
    assert "3.0 % less wide" in wording.amplitude(2.0, math.log(0.97))
    assert wording.with_amplitude("frequency", 1.2, 0.008, 0.0, (5e-3, 0.04), "m") == (
        "at 40 mm the swing at 1.2 Hz is 0.80 % faster than at 5.0 mm; the model's is the same"
    )
    assert wording.with_amplitude("damping", 1.2, -0.008, -0.004, (5e-3, 0.04), "m").endswith(
        "; the model's is 0.0040 lower"
    )
    assert wording.against("against_sign", "a.theta", "torque", -0.02, "N m", "a.theta") == (
        "the torque missing at a.theta jumps down by 0.020 N m when a.theta turns from backwards to forwards"
    )
    assert wording.sentence(None, "the camera is late") == "The camera is late."
    assert wording.sentence("a.csv", "the arm is late") == "a.csv: the arm is late."
