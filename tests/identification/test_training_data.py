"""Numbers of virtual joints before anything is fitted: what the modes seen need in the layout asked for."""

from __future__ import annotations

from typing import NoReturn

import numpy as np
import pytest

from tests.chain.test_layout_accuracy import errors
from tests.identification.test_recovery import demo
from vjm.chain.layout import LAYOUTS
from vjm.errors import InsufficientDataError
from vjm.identification import training_data
from vjm.identification.identify import identify
from vjm.identification.torque_method import fit_torque
from vjm.identification.training_data import FREQUENCY_TOLERANCE, JointChoice
from vjm.records import Experiment, Link

LINK = Link("beam", "clamped", 1.0, 1.0, 1.0, (0.5, 1.0))


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_error_of_a_number_of_joints_is_that_of_its_layout(name: str) -> None:
    """Against the frequencies of Euler and Bernoulli's beam."""
    error = JointChoice.of(LINK, 2, 4, layout_name=name).error
    assert error == pytest.approx(np.abs(errors(4, name)[:2]).max(), abs=1e-5)


@pytest.mark.parametrize("name", ["fourth-order", "end-corrected"])
def test_the_smallest_number_of_joints_is_chosen_that_is_right_in_its_layout(name: str) -> None:
    n = JointChoice.of(LINK, 2, layout_name=name).joints
    assert np.abs(errors(n, name)[:2]).max() < FREQUENCY_TOLERANCE < np.abs(errors(n - 1, name)[:2]).max()


@pytest.mark.parametrize("method", ["torque", "trajectory"])
def test_an_identification_states_the_error_of_the_layout_it_has(method: str) -> None:
    short = tuple(r for r in demo().recordings if r.file == "first_mode.csv")
    fit = identify(Experiment(demo().rig, short), method, 3, layout="equal", baselines=False)
    stated = 100 * JointChoice.of(LINK, fit.shape.orders[0], 3, layout_name="equal").error
    assert stated > 20
    assert f"accurate to {stated:.0f} %" in fit.notes[0]


def test_what_the_torque_method_lacks_is_said_with_its_whole_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> NoReturn:
        raise InsufficientDataError("angles", "too few frames", "record more; light the markers")

    monkeypatch.setattr(training_data, "_prepare", refuse)
    data = training_data.TrainingData.of(demo())
    with pytest.raises(InsufficientDataError, match="the torque method: angles: too few frames") as caught:
        fit_torque(data)
    assert caught.value.remedy == "record more; light the markers"
    assert str(data.problems[0]) == "angles: too few frames; record more; light the markers"
