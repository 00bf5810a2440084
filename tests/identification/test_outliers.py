"""Single wrong sightings beside a model that misses: what leaps is left out, what is smooth or a step is not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from vjm.identification.outliers import _outliers

Array = NDArray[np.float64]

NOISE = 3e-4
FRAMES = 500


def missed(seed: int, size: float, dropped: float = 0.1) -> tuple[Array, Array]:
    """Instants (T,) and residuals (T, 2, 2) [m] of a model without motion, of two modes seen at 100 Hz with noise."""
    random = np.random.default_rng(seed)
    time = np.arange(FRAMES) / 100
    motion = np.sin(2 * np.pi * 2.1 * time) * np.exp(-0.3 * time) + 0.07 * np.sin(2 * np.pi * 9 * time)
    residual = (size * motion)[:, None, None] * np.array([0.4, 1.0])[None, :, None] * np.array([0.2, 1.0])
    residual = residual + NOISE * random.standard_normal(residual.shape)
    residual[random.random(FRAMES) < dropped] = np.nan
    return time, residual


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("size", [0.0, 0.01, 0.1])
def test_wrong_sightings_are_left_out_however_much_the_model_misses(seed: int, size: float) -> None:
    time, residual = missed(seed, size)
    seen = np.flatnonzero(np.isfinite(residual[:, 0, 0]))
    frames = np.random.default_rng([seed, 1]).choice(seen[5:-5:12], 6, replace=False)
    residual[frames, 1] += 0.012
    wrong = _outliers(residual / NOISE, time)
    assert wrong[frames, 1].mean() > 0.9
    wrong[frames, 1] = False
    assert wrong.sum() <= 2  # of 1800 values


@pytest.mark.parametrize("seed", range(5))
def test_a_marker_that_slips_is_no_outlier(seed: int) -> None:
    time, residual = missed(seed, 0.03, dropped=0.0)
    residual[250:, 1] += 0.02
    assert _outliers(residual / NOISE, time).sum() <= 1


@pytest.mark.parametrize("seed", range(5))
def test_a_wrong_model_alone_makes_no_outliers(seed: int) -> None:
    time, residual = missed(seed, 0.1, dropped=0.0)
    assert not _outliers(residual / NOISE, time).any()
