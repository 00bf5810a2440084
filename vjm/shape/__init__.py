"""Link shape functions fitted to markers."""

from vjm.shape.families import FAMILIES, basis
from vjm.shape.fit import ShapeFit, fit_shape
from vjm.shape.order import OrderChoice, choose_order, required_markers, visible_modes

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
