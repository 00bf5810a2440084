"""When dry friction stops, holds and releases joints."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vjm.simulation.nonsmooth import DryFrictionCoefficients, Pieces
from vjm.simulation.stick_slip import FrictionHistory, under_friction

Array = NDArray[np.float64]
HALF = 0.01  # s


def concatenated(halves: list[FrictionHistory]) -> FrictionHistory:
    return FrictionHistory(*(np.stack(values) for values in zip(*halves, strict=True)))


def pushed(seed: int, joints: int, halves: int = 24) -> tuple[FrictionHistory, Array, Array]:
    """Joints under pushes (halves, 2, joints), means and changes, beside a braking (joints,)."""
    rng = np.random.default_rng(seed)
    rate, history = rng.normal(0.0, 0.02, joints), []
    braking = rng.uniform(0.0, 2.0, joints)
    pushes = rng.normal(0.0, [[1.5], [0.3]], (halves, 2, joints))
    for push, change in pushes:
        history.append(under_friction(rate, (push, change), (braking, 0.0 * braking), HALF)[0])
        rate = history[-1].after
    return concatenated(history), pushes, braking


def rate_at(history: FrictionHistory, pushes: Array, braking: Array, instant: float, joint: int) -> float:
    """The rate at a number of half steps: by the push until it stops, and from then by what friction leaves of it."""
    half, share = int(instant), instant - int(instant)
    before, stop = history.before[half, joint], history.stop[half, joint]
    push, change = pushes[half, :, joint]
    if share < stop:
        mean = push - np.sign(before) * braking[joint] + change * (share - 1) / 2
        return float(before + HALF * share * mean)
    passed = np.linspace(stop, share, 50)
    push = push + change * (passed - 0.5)
    if history.restarted[half, joint] == 0.0 and abs(push[0]) > braking[joint]:
        return 0.0  # it turns round and stops again in the same half step, as if it were held in between
    left = np.sign(push) * np.maximum(np.abs(push) - braking[joint], 0.0)
    return float(HALF * np.trapezoid(left, passed))


@given(st.integers(0, 10_000))
def test_friction_in_a_half_step_is_that_of_tiny_steps(seed: int) -> None:
    """Rates and moments of the friction, under pushes that change linearly, and bounds that do so in motion."""
    rng, count = np.random.default_rng(seed), 4000
    rate = float(rng.choice([0.0, 0.01, 0.1])) * rng.uniform(-1.0, 1.0)
    push, braking = rng.normal(0.0, 1.5, 2), np.array([rng.uniform(0.5, 2.0), 0.0])
    if abs(rate) > HALF * (np.abs(push).sum() + 2 * braking[0]):
        braking[1] = rng.normal(0.0, 0.2)
    x = (np.arange(count) + 0.5) / count - 0.5
    pushes, bounds, step = push[0] + push[1] * x, braking[0] + braking[1] * x, HALF / count
    rates, friction = np.full(count + 1, rate), np.empty(count)
    for k in range(count):
        friction[k] = np.clip(-rates[k] / step - pushes[k], -bounds[k], bounds[k])  # what would stop it, or less
        rates[k + 1] = rates[k] + step * (pushes[k] + friction[k])
    signs = np.sign(np.where(np.abs(rates) < 1e-12, 0.0, rates))
    phases = signs[np.r_[True, np.diff(signs) != 0.0]].tolist()  # +1, 0, -1: it slips forwards, is held, slips back
    # None turns round and is stopped again, or is about to be, or stops for less than this half step.
    assume(phases in ([phases[0]], [phases[0], 0.0], [0.0, phases[-1]]) or (len(phases) == 3 and phases[1] == 0.0))
    assume(phases[-1] in (phases[0], 0.0) or abs(pushes[-1]) > bounds[-1])
    assume(len(phases) == 1 or rate * (rate + HALF * (push[0] - np.sign(rate) * braking[0])) <= 0.0)
    (start,), (p, dp), (b, db) = (np.array(values).reshape(-1, 1) for values in ([rate], push, braking))
    with np.errstate(all="ignore"):
        found, moments = under_friction(start, (p, dp), (b, db), HALF)
    assert found.after[0] == pytest.approx(rates[-1], abs=2 * step * bounds.max())
    for order, moment in enumerate(moments):  # the kink at a release is no part of the higher ones
        tolerance = 3e-3 + 0.03 * abs(push[1]) * (order > 0 and np.isfinite(found.release[0]))
        assert moment[0] == pytest.approx(np.mean(friction * x**order), abs=tolerance), order


@given(st.integers(0, 10_000), st.integers(1, 3), st.sampled_from([2, 4, 6]))
def test_pieces_are_where_joints_are_held_or_slip_in_one_direction(seed: int, joints: int, width: int) -> None:
    (history, pushes, braking), edges = pushed(seed, joints), np.arange(0, 25, width)
    pieces = Pieces.of(edges, history)
    assert (np.diff(pieces.bounds) > 0.0).all()
    assert np.isin(edges, pieces.bounds).all()
    for piece, (start, end) in enumerate(pairwise(pieces.bounds.tolist())):
        for share in (0.01, 0.5, 0.99):
            instant = start + share * (end - start)
            for joint in range(joints):
                rate = rate_at(history, pushes, braking, instant, joint)
                if pieces.held[piece, joint]:
                    assert rate == 0.0
                elif abs(rate) > HALF * abs(pushes[int(instant), 1, joint]) / 8:  # else it may turn twice unnoticed
                    assert np.sign(rate) in (pieces.direction[piece, joint], 0.0)


@given(st.integers(0, 10_000), st.integers(1, 5))
def test_pieces_of_a_stretch_are_those_of_the_whole(seed: int, first: int) -> None:
    (history, _, _), edges = pushed(seed, 2), np.arange(0, 25, 4)
    whole, part = Pieces.of(edges, history), Pieces.of(edges[first:], history)
    assert part.bounds == pytest.approx(whole.bounds[-part.bounds.size :], abs=1e-12)
    for one, other in zip(part[1:], whole[1:], strict=True):
        assert np.allclose(one, other[-len(one) :], atol=1e-12)


@given(st.integers(0, 10_000))
def test_what_is_lost_of_a_small_change_of_a_rate_is_what_a_simulation_loses(seed: int) -> None:
    """A joint that slips in one half step, and stops or turns round in it, with its rate changed a little."""
    rng = np.random.default_rng(seed)
    rate, push, change = rng.normal(0.0, 0.02, 1), rng.normal(0.0, 2.0, 1), rng.normal(0.0, 1.0, 1)
    braking, step = rng.uniform(0.1, 2.0, 1), 1e-7 * rate
    one, other = (
        under_friction(each, (push, change), (braking, 0.0 * braking), HALF)[0] for each in (rate, rate + step)
    )
    if np.isfinite(one.stop) != np.isfinite(other.stop):
        return  # it stops at the very end
    kept = float(((other.after - one.after) / step)[0])
    pieces = Pieces.of(np.array([0, 1]), concatenated([one]))
    assert 1.0 - pieces.lost.sum() == pytest.approx(kept, abs=1e-6)


def test_a_joint_without_friction_is_never_held() -> None:
    with np.errstate(invalid="ignore"):
        still, braking = (np.zeros(2), np.zeros(2)), (np.array([0.0, 1.0]), np.zeros(2))
        history = concatenated([under_friction(np.zeros(2), still, braking, HALF)[0]])
    pieces = Pieces.of(np.array([0, 1]), history)
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
