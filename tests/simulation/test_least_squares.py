"""Levenberg and Marquardt's damping."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from vjm.simulation.least_squares import Damping


@given(st.floats(-9.0, 3.0), st.floats(-10.0, 3.0))
def test_the_next_step_is_clearly_shorter(knee: float, first: float) -> None:
    """Of a step whose length falls once the damping is as large as its own eigenvalue."""

    def length(damping: float) -> float:
        return 1 / (1 + damping / 10**knee)

    for begun in (Damping(), Damping(10**first)):
        found = begun.worse(length)
        assert found.value > begun.value
        assert length(found.value) < 0.5 * length(begun.value)
        # And not a hundred times shorter: it need not be.
        assert length(found.value) > 0.05 * length(begun.value)


def test_a_step_that_does_not_become_shorter_exhausts_it() -> None:
    assert Damping().worse(lambda damping: 1.0).exhausted
    assert not Damping().exhausted


def test_it_fades_after_steps_that_help() -> None:
    damping = Damping(1e-3)
    for _ in range(20):
        better = damping.better()
        assert better.value < damping.value or better.value == 0.0
        damping = better
    assert damping.value == 0.0
