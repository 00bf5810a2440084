"""Settings of all tests."""

from __future__ import annotations

from hypothesis import settings

# A busy machine is no failure, and a failure should come back when the test is run again.
settings.register_profile("vjm", deadline=None, derandomize=True)
settings.load_profile("vjm")
