"""Units of length, mass and time change nothing but the numbers' units: no decision is made in metres or seconds."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import vjm
from tests.scaling import scaled
from vjm.identification.records import Identification
from vjm.records import Experiment

BOOM, ODD = (4.0, 60.0, 3.0), (1.3e-4, 1e-9, 3e-4)


@cache
def demo() -> Experiment:
    return vjm.load_experiment(Path(vjm.__file__).parent / "demo" / "experiment.toml")


def identified(length: float, mass: float, time: float) -> Identification:
    return vjm.identify(scaled(demo(), length, mass, time), baselines=False)


@pytest.mark.slow
def test_an_arm_of_another_size_is_identified_alike() -> None:
    """A boom, and a cantilever as of an atomic force microscope."""
    here, there = identified(*BOOM), identified(*ODD)
    length, mass, time = (odd / boom for odd, boom in zip(ODD, BOOM, strict=True))
    units = {"N m^2": mass * length**3 / time**2, "s": time, "kg m^2": mass * length**2}
    assert there.status == here.status
    assert there.model.chain.size == here.model.chain.size
    for one, other in zip(here.parameters, there.parameters, strict=True):
        # Rounding may move estimates by hundredths of their errors, where it decides on the last of equal frames.
        assert other.value / units[one.unit] == pytest.approx(one.value, abs=0.02 * one.std)
        assert other.std / units[one.unit] == pytest.approx(one.std, rel=1e-3)
        assert other.error / units[one.unit] == pytest.approx(one.error, rel=1e-2)
    assert there.objective == pytest.approx(here.objective, rel=1e-3)
    for one, other in zip(here.recordings, there.recordings, strict=True):
        assert one.simulated is not None
        assert other.simulated is not None
        assert other.simulated.marker_rms / length == pytest.approx(one.simulated.marker_rms, rel=1e-4)
    frequencies = np.array([mode.frequency_model for mode in there.modes]) * time
    np.testing.assert_allclose(frequencies, [mode.frequency_model for mode in here.modes], rtol=1e-5)
