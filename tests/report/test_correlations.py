"""The correlation figure: of the estimated parameters only, and its title names the strongest pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.report.fits import demo_fit, elbow_fit, pictures_of
from tests.report.test_figures import figure_of
from vjm.records import Estimate
from vjm.report.figures.identification import identification_pictures
from vjm.report.figures.panels import Picture

Array = NDArray[np.float64]


def estimates(count: int) -> tuple[Estimate, ...]:
    return tuple(Estimate(f"beam.stiffness_{k + 1}", 1.0, 0.1, "N m/rad") for k in range(count))


def drawn(count: int, covariance: Array) -> Picture | None:
    fit = demo_fit()
    bare = replace(fit, torque_data=(), recordings=fit.recordings[:1])
    bare = replace(bare, trajectory=None, parameters=estimates(count), covariance=covariance)
    return next((each for each in identification_pictures(bare) if each.name == "correlations"), None)


def title(matrix: Array) -> str:
    picture = drawn(len(matrix), 0.01 * matrix)
    assert picture is not None
    return picture.alternative


def test_only_what_was_estimated_is_correlated() -> None:
    (axes,) = figure_of(pictures_of(elbow_fit()), "correlations").axes
    names = [label.get_text().partition(" ")[0] for label in axes.get_yticklabels()]
    assert names == [
        f"{link}.{what}" for link in ("upper", "fore") for what in ("bending_stiffness", "kelvin_voigt_time")
    ]
    assert [text.get_text() for text in axes.texts] == ["−0.60"] * 12


def test_what_is_not_finite_is_left_out() -> None:
    covariance = np.diag([1.0, np.inf, 4.0])
    covariance[0, 2] = covariance[2, 0] = 1.0
    picture = drawn(3, covariance)
    assert picture is not None
    assert "beam.stiffness_1 and beam.stiffness_3 (+0.50)" in picture.alternative
    assert drawn(2, covariance) is None  # not theirs


def test_one_parameter_has_no_correlations() -> None:
    assert drawn(1, np.eye(1)) is None
    assert drawn(0, np.empty((0, 0))) is None


def test_title_names_the_strongest_pair() -> None:
    matrix = np.eye(3)
    assert "All parameters distinguishable" in title(matrix)
    matrix[0, 2] = matrix[2, 0] = -0.95
    assert title(matrix) == "The recordings hardly distinguish beam.stiffness_1 and beam.stiffness_3 (−0.95)"
    matrix[0, 1] = matrix[1, 0] = 0.97
    assert "2 pairs" in title(matrix)
    assert "beam.stiffness_1 and beam.stiffness_2 (+0.97)" in title(matrix)


@pytest.mark.parametrize(("count", "written"), [(3, 6), (30, 0)])
def test_cells_hold_the_numbers_where_there_is_room(count: int, written: int) -> None:
    picture = drawn(count, np.eye(count))
    assert picture is not None
    assert len(picture.figure.axes[0].texts) == written
