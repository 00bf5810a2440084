"""Inertia of a rigid link in space, cut across its axis into pieces that add up to it exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vjm.errors import ShapeError
from vjm.records import Array

_ROUNDING = 1e-9  # relative; tensors in files have seven digits and more where two of their moments cancel


@dataclass(frozen=True)
class BodyInertia:
    """Mass, centre of mass and inertia tensor of a rigid body.

    The second moments C = sum of dm x x^T about the centre hold the same as the tensor I = tr(C) 1 - C. They are
    positive semidefinite exactly where a body of that inertia can exist: where I is positive and its principal moments
    satisfy the triangle inequality (P. M. Wensing, S. Kim and J.-J. E. Slotine, Linear matrix inequalities for
    physically consistent inertial parameter identification, IEEE Robotics and Automation Letters 3(1), 2018).
    """

    mass: float  # [kg]
    center: Array  # (3,) centre of mass [m]
    tensor: Array  # (3, 3) about the centre [kg m^2]

    @classmethod
    def of_moments(cls, mass: float, center: Array, second_moments: Array) -> BodyInertia:
        """Return the inertia with second moments of mass (3, 3) about the centre [kg m^2]."""
        return cls(mass, center, np.trace(second_moments) * np.eye(3) - second_moments)

    @property
    def second_moments(self) -> Array:
        """Second moments of mass about the centre (3, 3) [kg m^2]."""
        return np.asarray(np.trace(self.tensor) / 2 * np.eye(3) - self.tensor)

    def scaled(self, share: float) -> BodyInertia:
        """Return a share of the body: of its mass and of its tensor, about the same centre."""
        return BodyInertia(share * self.mass, self.center, share * self.tensor)


def split_inertia(
    body: BodyInertia, start: Array, direction: Array, lengths: Array, uniform_mass: float | None = None
) -> list[BodyInertia]:
    """Cut a body across an axis into pieces whose masses, centres and tensors add up to its own exactly.

    Its mass is taken as a uniform bar over the whole length, as heavy as the body's moments along the axis allow, and
    two equal lumps with the rest of those moments, such as the housings of the joints at a link's ends. The bar is as
    heavy as can be so that no piece is lighter than need be; a uniform body is a bar alone. Across the axis every piece
    has the body's own moments for its mass: with C the second moments, e the axis and v = e^T C e, a piece at s
    with second moment u along the axis has its centre at c + (s - s_c) C e / v and the second moments
    m_j / m (C - C e e^T C / v) + u C e e^T C / v^2, the conditional moments of a normal distribution (T. W. Anderson,
    An Introduction to Multivariate Statistical Analysis, 3rd ed. 2003, section 2.5). Both terms are positive
    semidefinite, so each piece can exist.

    Args:
        body: the body.
        start: (3,) a point of the axis, where the first piece begins [m].
        direction: (3,) unit vector along the axis.
        lengths: (k,) of the pieces [m]; mass beyond the ends belongs to the first and the last piece.
        uniform_mass: of the bar [kg]; None: as heavy as can be.

    Raises:
        ShapeError: a body that cannot exist, has no extent along the axis, or cannot contain so heavy a bar.
    """
    C = body.second_moments
    if not 0 < body.mass < np.inf or not np.isfinite(C).all():
        raise ShapeError("mass", body.mass, "a mass above zero and a finite inertia, which virtual links share")
    smallest, largest = np.linalg.eigvalsh(C)[[0, -1]]
    if smallest < -_ROUNDING * max(largest, 0.0) or largest <= 0:
        moments = np.linalg.eigvalsh(body.tensor)
        value = f"principal moments {', '.join(f'{moment:.6g}' for moment in moments)} kg m^2"
        raise ShapeError("inertia", value, "a body that can exist: no moment above the sum of the other two, none zero")
    length = float(lengths.sum())
    axial_moment = float(direction @ C @ direction)
    variance = axial_moment / body.mass / length**2
    if variance < _ROUNDING:
        raise ShapeError("inertia", "a body without extent along the axis", "one that can be cut across its axis")
    position = float((body.center - start) @ direction)
    heaviest = _largest_share(position / length, variance)
    share = heaviest if uniform_mass is None else uniform_mass / body.mass
    if not 0 < share <= heaviest * (1 + _ROUNDING):
        most = f"above zero and at most {heaviest * body.mass:.6g} kg: what its mass, centre and inertia leave room for"
        raise ShapeError("mass of the section", f"{uniform_mass:.6g} kg", most)
    masses, centers, seconds = _pieces_along(position, axial_moment, body.mass, lengths, share)
    slope = C @ direction / axial_moment
    across = C - axial_moment * np.outer(slope, slope)
    return [
        BodyInertia.of_moments(
            mass, body.center + (center - position) * slope, mass / body.mass * across + second * np.outer(slope, slope)
        )
        for mass, center, second in zip(masses, centers, seconds, strict=True)
    ]


def _largest_share(center: float, variance: float) -> float:
    """Return the largest share w of the mass that can be a uniform bar on [0, 1], from the body's centre and variance.

    The rest has mass 1 - w, first moment center - w/2 and second moment variance + center^2 - w/3. There is such a mass
    on [low, high] if its variance is not negative (a quadratic inequality of w) and at most (mean - low) (high - mean)
    (a linear one). The interval is that of the bar and of the uniform bar with the body's own centre and variance.
    """
    d = center - 0.5
    b = variance + 1 / 12 + d**2
    root = np.sqrt((variance - 1 / 12) ** 2 + 2 * d**2 * (variance + 1 / 12) + d**4)
    half_length = np.sqrt(3 * variance)
    low, high = min(0.0, center - half_length), max(1.0, center + half_length)
    room = (center - low) * (high - center) - variance
    return float(min(1.0, 2 * variance / (b + root), room / ((low + high) / 2 - 1 / 3 - low * high)))


def _pieces_along(
    center: float, second: float, mass: float, lengths: Array, share: float
) -> tuple[Array, Array, Array]:
    """Return masses [kg], centres [m] and second moments about them [kg m^2] of the pieces, along the axis."""
    length, edges = float(lengths.sum()), np.cumsum(lengths)
    bar = share * mass * lengths / length
    masses, firsts = bar.copy(), bar * (edges - lengths / 2)
    seconds = bar * ((edges - lengths / 2) ** 2 + lengths**2 / 12)
    lump = mass - float(bar.sum())
    if lump > 1e-13 * mass:  # more than rounding
        mean = (mass * center - float(firsts.sum())) / lump
        spread = max((second + mass * center**2 - float(seconds.sum())) / lump - mean**2, 0.0) ** 0.5
        for place in (mean - spread, mean + spread):
            j = int(np.searchsorted(edges[:-1], place))
            masses[j] += lump / 2
            firsts[j] += lump / 2 * place
            seconds[j] += lump / 2 * place**2
    centers = firsts / masses
    return masses, centers, seconds - masses * centers**2
