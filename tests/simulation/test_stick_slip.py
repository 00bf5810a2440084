"""When dry friction stops, holds and releases joints."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vjm.simulation.stick_slip import FrictionHistory, under_friction
from vjm.simulation.variational_equations import DryFrictionCoefficients

Array = NDArray[np.float64]
HALF = 0.01  # s


def concatenated(halves: list[FrictionHistory]) -> FrictionHistory:
    return FrictionHistory(*(np.stack(values) for values in zip(*halves, strict=True)))


def pushed(seed: int, joints: int, halves: int = 24) -> FrictionHistory:
    """Joints under pushes that change from one half step to the next, beside friction that often holds them."""
    rng = np.random.default_rng(seed)
    rate, history = rng.normal(0.0, 0.02, joints), []
    braking = rng.uniform(0.0, 2.0, joints)
    for push in rng.normal(0.0, 1.5, (halves, joints)):
        history.append(under_friction(rate, push, braking, HALF))
        rate = history[-1].after
    return concatenated(history)


def rate_at(history: FrictionHistory, instant: float, joint: int) -> float:
    """The rate at a number of half steps, by the accelerations before and after a stop."""
    half, share = int(instant), instant - int(instant)
    before, _, stop, slipping, restarted = (float(values[half, joint]) for values in history)
    return before + HALF * share * slipping if share < stop else HALF * (share - stop) * restarted


@given(st.integers(0, 10_000), st.integers(1, 3), st.sampled_from([2, 4, 6]))
def test_pieces_are_where_joints_are_held_or_slip_in_one_direction(seed: int, joints: int, width: int) -> None:
    history, edges = pushed(seed, joints), np.arange(0, 25, width)
    pieces = history.pieces(edges)
    shares = np.bincount(pieces.interval, pieces.end - pieces.start)
    assert shares == pytest.approx(np.ones(edges.size - 1))
    assert (pieces.end > pieces.start).all()
    assert pieces.interval[pieces.at_edges[:-1]].tolist() == list(range(edges.size - 1))
    for piece, (interval, start, end) in enumerate(zip(pieces.interval, pieces.start, pieces.end, strict=True)):
        for share in (0.01, 0.5, 0.99):
            instant = edges[interval] + width * (start + share * (end - start))
            for joint in range(joints):
                rate = rate_at(history, instant, joint)
                if pieces.held[piece, joint]:
                    assert rate == 0.0
                else:
                    assert np.sign(rate) in (pieces.direction[piece, joint], 0.0)


@given(st.integers(0, 10_000), st.integers(1, 5))
def test_pieces_of_a_stretch_are_those_of_the_whole(seed: int, first: int) -> None:
    history, edges = pushed(seed, 2), np.arange(0, 25, 4)
    whole, part = history.pieces(edges), history.pieces(edges[first:])
    chosen = whole.interval >= first
    assert part.interval.tolist() == (whole.interval[chosen] - first).tolist()
    for one, other in zip(part[1:], whole[1:], strict=True):
        assert np.allclose(one, other[chosen], atol=1e-12)


@given(st.integers(0, 10_000))
def test_what_is_lost_of_a_small_change_of_a_rate_is_what_a_simulation_loses(seed: int) -> None:
    """A joint that slips in one half step, and stops or turns round in it, with its rate changed a little."""
    rng = np.random.default_rng(seed)
    rate, push, braking = rng.normal(0.0, 0.02, 1), rng.normal(0.0, 2.0, 1), rng.uniform(0.1, 2.0, 1)
    step = 1e-7 * rate
    one, other = (under_friction(each, push, braking, HALF) for each in (rate, rate + step))
    if np.isfinite(one.stop) != np.isfinite(other.stop):
        return  # it stops at the very end
    kept = float(((other.after - one.after) / step)[0])
    pieces = concatenated([one]).pieces(np.array([0, 1]))
    assert 1.0 - pieces.lost.sum() == pytest.approx(kept, abs=1e-6)


def test_a_joint_without_friction_is_never_held() -> None:
    with np.errstate(invalid="ignore"):
        history = concatenated([under_friction(np.zeros(2), np.zeros(2), np.array([0.0, 1.0]), HALF)])
    pieces = history.pieces(np.array([0, 1]))
    assert pieces.held.tolist() == [[False, True]]
    assert pieces.lost.tolist() == [[0.0, 1.0]]


@pytest.mark.parametrize("seed", range(3))
def test_joints_that_stop_at_once_lose_their_own_shares(seed: int) -> None:
    """By the impulses of their friction alone, which leave rates that these do not reach."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 4))
    rates = rng.normal(size=(2, 4))
    response = np.linalg.solve(root @ root.T, rates.T)
    held = np.array([[False, False], [True, False], [False, False], [True, True]])
    lost = np.array([[0.3, 0.8], [0.0, 0.5], [0.0, 1.0], [0.0, 0.0]])
    friction = DryFrictionCoefficients(rates, np.repeat(response[None], 4, axis=0), np.zeros((4, 2, 4, 0)))
    after = friction.stopped(held, lost)
    left = np.where(held, 0.0, 1.0 - lost)[:, :, None] * rates
    assert (rates @ after)[[0, 1, 3]] == pytest.approx(left[[0, 1, 3]], abs=1e-12)
    assert (rates @ after)[2, 1] == pytest.approx(np.zeros(4), abs=1e-12)  # the other joint is free, and feels it
    unreached = np.linalg.svd(rates)[2][2:] @ (root @ root.T)  # momenta that no torque on the joints changes
    assert unreached @ after == pytest.approx(np.repeat(unreached[None], 4, axis=0), abs=1e-9)
