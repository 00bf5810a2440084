"""Results as a notebook user reads them: parameters by name, joint angles by recording, options by their choices."""

from __future__ import annotations

from functools import cache
from typing import Any, get_args

import numpy as np
import pytest

import vjm
from tests.identification.test_recovery import demo
from vjm.identification import Identification, identify
from vjm.identification.identify import LossName
from vjm.simulation.least_squares import LOSSES


@cache
def fit() -> Identification:
    return identify(demo(), "torque")


def test_a_parameter_is_found_by_its_name() -> None:
    assert fit()["beam.bending_stiffness"] is fit().parameters[0]
    with pytest.raises(vjm.VjmError, match=r"beam.mass.*beam.bending_stiffness, beam.kelvin_voigt_time"):
        fit()["beam.mass"]


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


def test_editors_complete_every_loss() -> None:
    assert get_args(LossName) == LOSSES
