"""Link shape functions fitted to markers."""

from vjm.markers.shape import (
    FAMILIES,
    OrderChoice,
    ShapeFit,
    basis,
    choose_order,
    fit_shape,
    required_markers,
    visible_modes,
)

__all__ = [
    "FAMILIES",
    "OrderChoice",
    "ShapeFit",
    "basis",
    "choose_order",
    "fit_shape",
    "required_markers",
    "visible_modes",
]
