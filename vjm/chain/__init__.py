"""Virtual links and joints: the chain as data, where to cut it, and the curve it stands for."""

from vjm.chain.curve import marker_positions
from vjm.chain.layout import LAYOUTS, Layout, free_layout, layout, uniform_chain
from vjm.chain.virtual_links import Chain, LinkChain

__all__ = ["LAYOUTS", "Chain", "Layout", "LinkChain", "free_layout", "layout", "marker_positions", "uniform_chain"]
