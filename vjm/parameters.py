"""A parameter's estimate: value, standard error, unit, and whether the data determine it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Estimate:
    """One identified (or fixed) parameter.

    Attributes:
        name: `LINK.quantity` or `LINK.quantity_J`, as `beam.bending_stiffness` or `beam.stiffness_2`.
        value: in `unit`.
        std: standard error in `unit`; None for a parameter that was not estimated.
        unit: SI.
        identifiable: whether the data determine it.
        reason: in words, why not; empty where they do.
        remedy: in words, which recording would; empty where they do.
    """

    name: str
    value: float
    std: float | None
    unit: str
    identifiable: bool = True
    reason: str = ""
    remedy: str = ""
