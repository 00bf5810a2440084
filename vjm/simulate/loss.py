"""Loss functions of weighted residuals: how much a value far from the model may count."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TUNING = 3.0**2  # standard deviations squared, from which a loss departs from the square


@dataclass(frozen=True)
class Loss:
    """A loss rho(z) of z, the square of a weighted residual, with rho(z) = z for small z.

    Attributes:
        name: as `least_squares` of SciPy calls it.
        shape: rho for a tuning constant of one, and its slope.
    """

    name: str
    shape: tuple[Callable[[Array], Array], Callable[[Array], Array]]

    def __reduce__(self) -> tuple[Callable[[str], Loss], tuple[str]]:
        return loss_of, (self.name,)

    def value(self, z: Array) -> Array:
        """rho(z)."""
        return _TUNING * self.shape[0](z / _TUNING)

    def slope(self, z: Array) -> Array:
        """rho'(z), the weight that a value keeps."""
        return self.shape[1](z / _TUNING)


LINEAR = Loss("linear", (lambda z: z, np.ones_like))
LOSSES = {
    loss.name: loss
    for loss in (
        LINEAR,
        Loss(
            "huber",
            (
                lambda z: np.where(z <= 1, z, 2 * np.sqrt(np.maximum(z, 1)) - 1),
                lambda z: 1 / np.sqrt(np.maximum(z, 1)),
            ),
        ),
        Loss("soft_l1", (lambda z: 2 * (np.sqrt(1 + z) - 1), lambda z: 1 / np.sqrt(1 + z))),
        Loss("cauchy", (np.log1p, lambda z: 1 / (1 + z))),
    )
}


def loss_of(name: str) -> Loss:
    """The loss of that name."""
    return LOSSES[name]
