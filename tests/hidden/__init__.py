"""Experiments with a known effect hidden in them, made by the independent beam of `tests.fine_beam`."""
