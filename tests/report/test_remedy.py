"""What is not determined comes with the recording that would determine it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.report.fits import hub_chain
from vjm.identification.check import estimates
from vjm.identification.parameters import Parametrisation, at_bounds
from vjm.identification.uncertainty import Information
from vjm.records import Estimate

Array = NDArray[np.float64]


def found(kind: str, relative: float, x: Array | None = None) -> dict[str, Estimate]:
    """The estimates of a driven link, all with the same relative standard error."""
    parametrisation = Parametrisation(hub_chain(), kind, (0,))
    at = parametrisation.start if x is None else x
    information = Information(np.eye(at.size), np.eye(at.size), at_bounds(at, parametrisation.bounds))
    physical = np.diag((relative * parametrisation.physical(at)) ** 2)
    return {each.name: each for each in estimates(parametrisation, at, information, physical)}


def test_what_is_determined_needs_no_remedy() -> None:
    assert {each.remedy for each in found("full", 0.1).values()} == {""}


@pytest.mark.parametrize(
    ("kind", "name", "words"),
    [
        ("uniform", "beam.bending_stiffness", "more markers"),
        ("uniform", "beam.kelvin_voigt_time", "a longer free decay, or one that excites mode 2 (about 8"),
        ("uniform", "beam.hub_inertia", "torque changes faster"),
        ("joints", "beam.stiffness_1", "markers nearer to this joint, or a recording that excites mode"),
        ("joints", "beam.damping_4", "a longer free decay, or one that excites mode"),
        ("full", "beam.length_1", "known payload"),
        ("full", "beam.mass_2", "known payload"),
        ("full", "beam.mass_center_2", "higher modes"),
        ("full", "beam.inertia_2", "known payload"),
    ],
)
def test_remedy_goes_with_the_kind_of_parameter(kind: str, name: str, words: str) -> None:
    estimate = found(kind, 0.9)[name]
    assert not estimate.identifiable
    assert words in estimate.remedy


def test_the_mode_named_is_the_one_that_bends_the_joint() -> None:
    """The first mode of a driven link bends its root, the second its middle; the tip bends in fast ones only."""
    remedies = {name: each.remedy for name, each in found("joints", 0.9).items()}
    numbers = [int(remedies[f"beam.damping_{j}"].split("mode ")[1].split()[0]) for j in (1, 2, 3, 4)]
    assert (numbers[0], numbers[2]) == (1, 2)
    assert numbers[3] > 2


def test_at_a_bound_fewer_parameters_help_as_well() -> None:
    x = Parametrisation(hub_chain(), "joints", (0,)).start
    x[4] = 0.0  # the first joint's damping
    estimate = found("joints", 0.1, x)["beam.damping_1"]
    assert "at its bound" in estimate.reason
    assert estimate.remedy.endswith("or fewer parameters (--parameters uniform)")
