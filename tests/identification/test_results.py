"""Results as a notebook user reads them: parameters by name, joint angles by recording, options by their choices."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vjm
from tests.identification.test_recovery import demo
from vjm.identification import Identification, identify
from vjm.records import Estimate


@cache
def fit() -> Identification:
    return identify(demo(), "torque")


def test_a_parameter_is_found_by_its_name() -> None:
    assert fit()["beam.bending_stiffness"] is fit().parameters[0]
    with pytest.raises(vjm.VjmError, match=r"beam.mass.*beam.bending_stiffness, beam.kelvin_voigt_time"):
        fit()["beam.mass"]


def test_an_estimate_prints_as_a_line_with_its_error_and_unit() -> None:
    estimate = Estimate("beam.bending_stiffness", 1.97412, 3e-4, "N m^2", discretization_shift=-4e-4)
    assert str(estimate) == "beam.bending_stiffness = 1.97412 ± 0.00050 N m²"
    assert str(Estimate("beam.hub_inertia", 0.02, None, "kg m^2")) == "beam.hub_inertia = 0.02000 kg m²"
    assert str(Estimate("beam.ratio", 0.5, 0.01, "")) == "beam.ratio = 0.500 ± 0.010"


def test_measured_and_simulated_joint_angles_agree_to_their_noise() -> None:
    recording = next(each for each in demo().recordings if each.kind == "decay" and each.role == "train")
    measured, simulated = fit().phi(recording.file)
    chain = fit().model.chain
    assert measured.shape == simulated.shape == (recording.time.size, chain.passive.size)
    shown = np.isfinite(measured).all(axis=1)
    assert shown[recording.frames].mean() > 0.9
    assert not shown[np.setdiff1d(np.arange(recording.time.size), recording.frames)].any()
    difference = measured[shown] - simulated[shown]
    assert np.std(difference) < 0.2 * np.std(simulated)
    np.testing.assert_array_equal(fit().phi(recording)[0], measured)


def test_without_baselines_the_same_model_is_saved_with_fewer_curves(tmp_path: Path) -> None:
    bare = identify(demo(), "torque", baselines=False)
    assert bare["beam.bending_stiffness"] == fit()["beam.bending_stiffness"]
    for one, other in zip(bare.recordings, fit().recordings, strict=True):
        assert one.reference is None
        assert other.reference is not None
        assert one.simulated is not None
        assert other.simulated is not None
        assert one.simulated.marker_rms == other.simulated.marker_rms
    vjm.save(bare, tmp_path)
    assert (tmp_path / "report.html").stat().st_size > 10_000


def test_an_unknown_recording_is_refused_with_those_there_are() -> None:
    with pytest.raises(vjm.VjmError, match=r"absent.csv.*first_mode.csv"):
        fit().phi("absent.csv")


@pytest.mark.parametrize(
    ("option", "choice"),
    [
        ("method", "torque+frequency"),
        ("parameters", "lengths"),
        ("layout", "half-ends"),
        ("family", "polynomial"),
        ("angles", "curvature"),
        ("derivatives", "interpolating"),
        ("loss", "huber"),
    ],
)
def test_an_unknown_option_is_refused_with_its_choices(option: str, choice: str) -> None:
    options: dict[str, Any] = {option: "guess"}
    with pytest.raises(vjm.InputError, match=f"unknown {option} 'guess'; choose one of: .*") as error:
        identify(demo(), **options)
    assert choice in str(error.value)
