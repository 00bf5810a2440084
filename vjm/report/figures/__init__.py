"""Figures, one group a module: records in, a matplotlib `Figure` out."""
