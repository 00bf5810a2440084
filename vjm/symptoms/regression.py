"""Least squares whose standard errors hold when the residual is no white noise.

Three estimates of the coefficients' covariance are made, and the largest of each variance is taken: of white noise of
the known size; of white noise of the residual's own size; and from sums of scores over stretches of time, which are
nearly independent however the residual is correlated within a stretch and between sensors (Liang and Zeger 1986,
Biometrika 73, "sandwich" over clusters).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from vjm.records import Array
from vjm.symptoms.records import UNKNOWN, Estimate

_SINGULAR = 1e-10  # relative eigenvalue of the scaled normal matrix
_INDISTINCT = 1e-6  # share of a column that the others leave of it, below which its coefficient means nothing


@dataclass(frozen=True)
class Regression:
    """Coefficients (p,) with errors.

    Attributes:
        values: (p,) in units of residual over column.
        noise_std: (p,) standard errors if the residual is white noise.
        block_std: (p,) standard errors from the sums over stretches of time.
        freedom: degrees of freedom of the latter.
        left: (N,) what the columns leave of the residual.
    """

    values: Array
    noise_std: Array
    block_std: Array
    freedom: int
    left: Array

    def __getitem__(self, index: int) -> Estimate:
        """One coefficient; unknown where the columns do not determine it."""
        return estimate(self.values[index], self.noise_std[index], self.block_std[index], self.freedom)


def estimate(value: float, noise_std: float, block_std: float, freedom: int) -> Estimate:
    """A number with the larger of two standard errors, and the larger of the two chances.

    Args:
        value: the number.
        noise_std: its standard error under white noise, normally distributed.
        block_std: its standard error from a few sums, of Student's distribution.
        freedom: of that distribution.
    """
    if not np.isfinite([value, noise_std, block_std]).all() or noise_std <= 0:
        return UNKNOWN
    chance = 2 * float(special.ndtr(-abs(value) / noise_std))
    if block_std > 0:
        chance = max(chance, 2 * float(special.stdtr(max(freedom, 1), -abs(value) / block_std)))
    return Estimate(float(value), float(max(noise_std, block_std)), chance)


def regress(columns: Array, residual: Array, blocks: NDArray[np.intp], lost: int = 0) -> Regression:
    """Coefficients of columns (N, p) in a residual (N,), both in units of the noise.

    Args:
        columns: anything finite; a column that depends on others gets an infinite standard error.
        residual: what is to be explained.
        blocks: (N,) stretch of time of each row, from 0.
        lost: degrees of freedom that were taken out of both beforehand.
    """
    size = np.sqrt(np.sum(columns**2, axis=0))
    scaled = columns / np.where(size > 0, size, 1.0)
    inverse, distinct = _inverse(scaled.T @ scaled)
    coefficients = inverse @ (scaled.T @ residual)
    left = residual - scaled @ coefficients
    chi2 = float(left @ left) / max(left.size - columns.shape[1] - lost, 1)
    count = int(blocks.max(initial=0)) + 1
    sums = (blocks == np.arange(count)[:, None]).astype(float) @ (scaled * left[:, None])
    filled = int(np.unique(blocks).size)
    freedom = max(filled - 1, 1)
    spread = inverse @ (sums.T @ sums) @ inverse * (filled / freedom)
    plain = np.diag(inverse) * max(chi2, 1.0)
    known = (size > 0) & distinct
    scale = np.where(known, size, 1.0)
    return Regression(
        np.where(known, coefficients / scale, 0.0),
        np.where(known, np.sqrt(np.maximum(plain, 0.0)) / scale, np.inf),
        np.sqrt(np.maximum(np.diag(spread), 0.0)) / scale,
        freedom,
        left,
    )


def solve(columns: Array, residual: Array) -> Array:
    """(p,) least-squares coefficients of columns (N, p) in a residual (N,); zero of those that are not determined."""
    size = np.sqrt(np.sum(columns**2, axis=0))
    safe = np.where(size > 0, size, 1.0)
    scaled = columns / safe
    inverse, _ = _inverse(scaled.T @ scaled)
    found: Array = inverse @ (scaled.T @ residual) / safe
    return found


def _inverse(gram: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Pseudo-inverse of a scaled normal matrix, and which coefficients it determines."""
    values, vectors = np.linalg.eigh(gram)
    kept = values > _SINGULAR * max(float(values[-1]), 1e-300)
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    lost = np.sum(vectors[:, ~kept] ** 2, axis=1)
    return inverse, (lost < 1e-3) & (np.diag(inverse) * _INDISTINCT < 1)
