"""The correlation picture: of the estimated parameters only, and its title names the strongest pair."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.report.fits import elbow_fit
from vjm.records import Estimate
from vjm.report.figures.residuals import correlation_map, correlations

Array = NDArray[np.float64]


def estimates(count: int) -> tuple[Estimate, ...]:
    return tuple(Estimate(f"beam.stiffness_{k + 1}", 1.0, 0.1, "N m/rad") for k in range(count))


def title(matrix: Array) -> str:
    figure = correlation_map(estimates(len(matrix)), 0.01 * matrix)
    assert figure is not None
    return figure.texts[0].get_text().replace("\n", " ")


def test_only_what_was_estimated_is_correlated() -> None:
    fit = elbow_fit()
    names, matrix = correlations(fit.parameters, fit.covariance)
    assert names == [
        f"{link}.{what}" for link in ("upper", "fore") for what in ("bending_stiffness", "kelvin_voigt_time")
    ]
    assert matrix == pytest.approx(np.full((4, 4), -0.6) + 1.6 * np.eye(4))


def test_what_is_not_finite_is_left_out() -> None:
    covariance = np.diag([1.0, np.inf, 4.0])
    covariance[0, 2] = covariance[2, 0] = 1.0
    names, matrix = correlations(estimates(3), covariance)
    assert names == ["beam.stiffness_1", "beam.stiffness_3"]
    assert matrix[0, 1] == pytest.approx(0.5)
    assert correlations(estimates(2), covariance)[0] == []  # not theirs


def test_one_parameter_has_no_correlations() -> None:
    assert correlation_map(estimates(1), np.eye(1)) is None
    assert correlation_map((), np.empty((0, 0))) is None


def test_title_names_the_strongest_pair() -> None:
    matrix = np.eye(3)
    assert "tell all parameters apart" in title(matrix)
    matrix[0, 2] = matrix[2, 0] = -0.95
    assert title(matrix) == "The recordings hardly tell beam.stiffness_1 and beam.stiffness_3 (−0.95) apart"
    matrix[0, 1] = matrix[1, 0] = 0.97
    assert "2 pairs" in title(matrix)
    assert "beam.stiffness_1 and beam.stiffness_2 (+0.97)" in title(matrix)


def test_cells_hold_the_numbers_where_there_is_room() -> None:
    for count, written in ((3, 6), (30, 0)):
        figure = correlation_map(estimates(count), np.eye(count))
        assert figure is not None
        assert len(figure.axes[0].texts) == written
