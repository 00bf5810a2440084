"""Loss functions of weighted residuals: how much a value far from the model may count."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TUNING = 3.0  # standard deviations; a loss changes by less than a thousandth on clean data


@dataclass(frozen=True)
class Loss:
    """A loss rho(z) of z, the square of a weighted residual, with rho(z) = z for small z.

    Attributes:
        name: as `least_squares` of SciPy calls it.
        value: rho(z).
        slope: rho'(z), the weight that a value keeps.
    """

    name: str
    value: Callable[[Array], Array]
    slope: Callable[[Array], Array]


def _scaled(name: str, value: Callable[[Array], Array], slope: Callable[[Array], Array]) -> Loss:
    size = _TUNING**2
    return Loss(name, lambda z: size * value(z / size), lambda z: slope(z / size))


LINEAR = Loss("linear", lambda z: z, np.ones_like)
LOSSES = {
    loss.name: loss
    for loss in (
        LINEAR,
        _scaled(
            "huber",
            lambda z: np.where(z <= 1, z, 2 * np.sqrt(np.maximum(z, 1)) - 1),
            lambda z: 1 / np.sqrt(np.maximum(z, 1)),
        ),
        _scaled("soft_l1", lambda z: 2 * (np.sqrt(1 + z) - 1), lambda z: 1 / np.sqrt(1 + z)),
        _scaled("cauchy", np.log1p, lambda z: 1 / (1 + z)),
    )
}
