"""Settings of all tests."""

from __future__ import annotations

import gc
import os

# Before NumPy is imported: its matrices are small here, and threads of one test only wait for those of another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

# Figures and whole searches are many objects that live long: looking through them after every 700 new ones takes up to
# 5 % of a test's time.
gc.set_threshold(50_000)

# A busy machine is no failure, and a failure should come back when the test is run again.
settings.register_profile("vjm", deadline=None, derandomize=True)
settings.load_profile("vjm")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let slow tests take their time."""
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(pytest.mark.timeout(0))
