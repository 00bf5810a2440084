"""The virtual-joint model link by link, with standard errors, as result.json holds it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain, LinkChain
from vjm.parameters import Estimate

Array = NDArray[np.float64]
Result = dict[str, Any]


def finite(value: float | None) -> float | None:
    """The number; None where it is not finite."""
    return None if value is None or not math.isfinite(value) else float(value)


def model_result(chain: Chain, estimates: Sequence[Estimate] = (), covariance: Array | None = None) -> Result:
    """The virtual-joint model link by link, with the standard errors that follow from the estimates' covariance."""
    known = _Known(estimates, covariance)
    return {"links": [_link(link, known) for link in chain.links]}


def bending_stiffness(
    link: LinkChain, estimates: Sequence[Estimate], covariance: Array | None = None
) -> tuple[float, float | None]:
    """A link's bending stiffness EI and its standard error [N m^2].

    The estimate `LINK.bending_stiffness` where there is one; else the mean over the virtual joints of stiffness times
    cell, the cells being taken as known.

    Args:
        link: the identified link.
        estimates: what was identified.
        covariance: (p, p) of those with a standard error; None: uncorrelated.
    """
    found = next((each for each in estimates if each.name == f"{link.name}.bending_stiffness"), None)
    if found is not None:
        return found.value, finite(found.std)
    weights = link.cells / link.virtual_joints
    slopes = {f"{link.name}.stiffness_{j + 1}": float(weight) for j, weight in enumerate(weights)}
    return float(weights @ link.stiffness), _Known(estimates, covariance).std(slopes)


class _Known:
    """Standard errors of what follows from the estimates."""

    def __init__(self, estimates: Sequence[Estimate], covariance: Array | None) -> None:
        self.estimates = estimates
        estimated = [each for each in estimates if each.std is not None]
        self.index = {each.name: k for k, each in enumerate(estimated)}
        self.covariance = np.diag([(each.std or 0.0) ** 2 for each in estimated])
        if covariance is not None and covariance.shape == self.covariance.shape:
            self.covariance = covariance

    def std(self, slopes: Mapping[str, float]) -> float | None:
        """Of a quantity with these derivatives by the estimates; None where none of them was estimated."""
        known = {name: slope for name, slope in slopes.items() if name in self.index}
        if not known:
            return None
        rows = [self.index[name] for name in known]
        slope = np.array(list(known.values()))
        return finite(float(np.sqrt(max(slope @ self.covariance[np.ix_(rows, rows)] @ slope, 0.0))))


def _link(link: LinkChain, known: _Known) -> Result:
    value, std = bending_stiffness(link, known.estimates, known.covariance)
    fields = zip(link.lengths, link.mass_centers, link.masses, link.inertias, strict=True)
    return {
        "name": link.name,
        "bending_stiffness": {"value": finite(value), "std": std},
        "hub_inertia": finite(link.hub_inertia),
        "virtual_links": [
            {"length": finite(length), "mass_center": finite(center), "mass": finite(mass), "inertia": finite(inertia)}
            for length, center, mass, inertia in fields
        ],
        "virtual_joints": [_joint(link, j, known) for j in range(link.virtual_joints)],
    }


def _joint(link: LinkChain, j: int, known: _Known) -> Result:
    stiffness, damping = float(link.stiffness[j]), float(link.damping[j])
    bending, time = f"{link.name}.bending_stiffness", f"{link.name}.kelvin_voigt_time"
    # K = EI / cell and D = tau K where the link's own EI and tau were estimated, else each by itself.
    of_stiffness = {bending: 1 / float(link.cells[j]), f"{link.name}.stiffness_{j + 1}": 1.0}
    ratio = damping / stiffness if stiffness > 0 else 0.0
    of_damping = {bending: ratio / float(link.cells[j]), time: stiffness, f"{link.name}.damping_{j + 1}": 1.0}
    return {
        "stiffness": {"value": finite(stiffness), "std": known.std(of_stiffness)},
        "damping": {"value": finite(damping), "std": known.std(of_damping)},
    }
