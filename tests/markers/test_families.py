"""Shape families, their fits and their orders."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vjm.markers.shape import (
    FAMILIES,
    _cantilever_roots,
    basis,
    choose_order,
    fit_shape,
)

ARCS = np.array([0.2, 0.4, 0.6, 0.8, 1.0])


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("order", [1, 3, 5, 9])
def test_derivatives_are_the_slopes_of_the_functions(family: str, order: int) -> None:
    x, step, length = np.linspace(0.05, 1.25, 25), 1e-5, 1.3
    for derivative in (0, 1):
        above, below = (basis(family, order, x + sign * step, length, derivative) for sign in (1, -1))
        slope = (above - below) / (2 * step)
        exact = basis(family, order, x, length, derivative + 1)
        assert np.abs(slope - exact).max() <= 1e-6 * max(1.0, np.abs(exact).max())


@pytest.mark.parametrize("family", ["clamped-polynomial", "trigonometric", "cantilever"])
def test_clamped_families_have_no_deflection_or_slope_at_the_clamp(family: str) -> None:
    assert np.abs(basis(family, 5, 0.0, 1.0)).max() < 1e-12
    assert np.abs(basis(family, 5, 0.0, 1.0, 1)).max() < 1e-10


def test_cantilever_modes_satisfy_their_differential_equation_and_free_end() -> None:
    # y'''' = beta^4 y, and no moment at the tip; the fourth derivative by differences of the second
    x, step = np.linspace(0.1, 0.9, 9), 1e-3
    beta = _cantilever_roots(4)
    second = [basis("cantilever", 4, x + k * step, 1.0, 2) for k in (-1, 0, 1)]
    fourth = (second[0] - 2 * second[1] + second[2]) / step**2
    values = basis("cantilever", 4, x, 1.0)
    assert np.allclose(fourth, beta**4 * values, atol=1e-4 * beta**4)
    assert np.abs(basis("cantilever", 4, 1.0, 1.0, 2)).max() < 1e-9
    assert np.abs(basis("cantilever", 4, 1.0, 1.0)) == pytest.approx(np.ones(4))


def test_roots_of_the_clamped_free_beam() -> None:
    roots = _cantilever_roots(12)
    assert roots[:3] == pytest.approx([1.8751040687, 4.6940911330, 7.8547574382], abs=1e-10)
    assert roots[-1] == pytest.approx(11.5 * np.pi, abs=1e-10)


@pytest.mark.parametrize("family", FAMILIES)
@given(seed=st.integers(0, 2**31))
@settings(max_examples=15, deadline=None)
def test_a_curve_of_the_family_comes_back_from_its_markers(family: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=(7, 3))
    y = truth @ basis(family, 3, ARCS, 1.0).T
    y[2, 4] = y[3, 0] = np.nan  # a missing marker leaves enough
    y[5, 1:] = np.nan  # this leaves too few
    fit = fit_shape(ARCS, y, 1.0, family, 3)
    rows = [0, 1, 2, 3, 4, 6]
    assert np.allclose(fit.coefficients[rows], truth[rows], atol=1e-8)
    assert np.isnan(fit.coefficients[5]).all()
    assert np.nanmax(np.abs(fit.residuals)) < 1e-9


def test_measured_positions_and_fixed_ones_agree() -> None:
    rng = np.random.default_rng(3)
    y = rng.normal(size=(20, 5))
    y[4, 2] = np.nan
    fixed = fit_shape(ARCS, y, 1.0, "clamped-polynomial", 2)
    measured = fit_shape(np.tile(ARCS, (20, 1)), y, 1.0, "clamped-polynomial", 2)
    assert np.allclose(fixed.coefficients, measured.coefficients)


def test_covariance_is_what_noise_does() -> None:
    rng = np.random.default_rng(5)
    fit = fit_shape(ARCS, rng.normal(size=(40_000, 5)), 1.0, "cantilever", 3)
    assert np.cov(fit.coefficients.T) == pytest.approx(fit.covariance, rel=0.05, abs=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_a_wild_marker_does_not_bend_the_robust_curve(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = 0.05 * rng.normal(size=(200, 2))
    y = truth @ basis("cantilever", 2, ARCS, 1.0).T + 3e-4 * rng.normal(size=(200, 5))
    y[::20, 2] += 1.0
    plain, robust = (fit_shape(ARCS, y, 1.0, "cantilever", 2, robust=flag) for flag in (False, True))
    wild = np.abs(plain.coefficients - truth)[::20].max()
    assert wild > 0.05
    assert np.abs(robust.coefficients - truth)[::20].max() < 0.02 * wild


@pytest.mark.parametrize("modes", [1, 2, 3])
def test_cross_validation_finds_the_number_of_modes(modes: int) -> None:
    rng = np.random.default_rng(modes)
    amplitudes = rng.normal(size=(300, modes)) * np.array([0.05, 0.01, 0.005])[:modes]
    y = amplitudes @ basis("cantilever", modes, ARCS, 1.0).T + 3e-4 * rng.normal(size=(300, 5))
    assert choose_order(ARCS, y, 1.0) == modes
    assert choose_order([1.0], y[:, -1:], 1.0) == 1


def test_modes_need_as_many_markers() -> None:
    # eq. (1): k >= 2 l / lambda_min with lambda = 2 pi l / beta l: k >= beta l / pi
    assert np.ceil(_cantilever_roots(60) / np.pi).tolist() == list(range(1, 61))
