"""Time steps of a batch of beams with hidden physics: ETDRK4 as in `integrator`, and dry friction that sticks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.fine_beam.extended import Extended, times
from tests.fine_beam.integrator import phi_functions

Array = NDArray[np.float64]

_STILL = 1e-10  # rad/s; a joint slower than this at the end of a step sticks
_SAME = 1e-10  # N m; friction that a further trial would change less is found
_MOST_TRIALS = 12
_SPLITS = 7  # of a step in which dry friction changes: 16 us remain of 2 ms


class Drive(NamedTuple):
    """Torques (T - 1, B), N m, at the start and the end of each of T - 1 intervals; linear between."""

    start: Array
    end: Array


class _Weights(NamedTuple):
    """Of one step length, transposed for states in rows, one matrix (G, d, d) for each distinct payload."""

    whole: Array
    half: Array
    half_weight: Array
    first: Array
    middle: Array
    last: Array


class Stepper:
    """Integrates states y (B, d) of an extended beam."""

    def __init__(self, beam: Extended) -> None:
        self._beam = beam
        self._sticks = beam.revolute and beam.physics.has_dry_friction
        groups = range(len(beam.bodies))
        self._linear = [beam.linear(k) for k in groups]
        rates = np.stack([matrix[beam.parts.rates].T for matrix in self._linear])
        self._linear_rates = rates if len(rates) == 1 else rates[beam.group]
        self._weights: dict[float, _Weights] = {}

    def run(self, time: Array, drive: Drive, state: Array, longest: float) -> Array:
        """States (T, B, d) at the instants (T,), s, from state (B, d); steps of at most `longest` s."""
        states = np.empty((len(time), *state.shape))
        states[0] = state
        friction = np.zeros(len(state))
        for k, interval in enumerate(np.diff(time)):
            count = max(1, int(np.ceil(interval / longest - 1e-6)))
            length = round(interval / count, 12)
            limit = self._beam.physics.torque_saturation_limit
            torques = np.clip(np.linspace(drive.start[k], drive.end[k], 2 * count + 1), -limit, limit)
            for step in range(count):
                given, now = torques[2 * step : 2 * step + 3], time[k] + step * length
                if self._sticks:
                    state, friction = self._cover(state, now, length, given, friction, _SPLITS)
                else:
                    state = self._advance(state, now, length, given)
            states[k + 1] = state
        if not np.all(np.isfinite(states)):
            raise ArithmeticError("the simulation diverged: take a shorter step")
        return states

    def _cover(
        self, state: Array, time: float, length: float, torques: Array, guess: Array, splits: int
    ) -> tuple[Array, Array]:
        """One step under dry friction; halved, and halved again, where a joint starts, stops or turns back in it."""
        covered = self._stick_or_slip(state, time, length, torques, guess, whole=splits > 0)
        if covered is not None:
            return covered
        early = np.stack([torques[0], 0.5 * (torques[0] + torques[1]), torques[1]])
        late = np.stack([torques[1], 0.5 * (torques[1] + torques[2]), torques[2]])
        state, guess = self._cover(state, time, 0.5 * length, early, guess, splits - 1)
        return self._cover(state, time + 0.5 * length, 0.5 * length, late, guess, splits - 1)

    def _stick_or_slip(
        self, state: Array, time: float, length: float, torques: Array, guess: Array, whole: bool
    ) -> tuple[Array, Array] | None:
        """One step with friction (B,), constant over it and in [-T, T]; the states and the friction.

        A joint that moves at the end had all the friction against it; any other ends at rest. T is that at the rate in
        the middle of the step. Under `whole`, None as soon as a joint that moved stops or a joint at rest does not stay
        so.
        """
        joint, level = self._beam.parts.rates.start, self._beam.physics.dry_friction
        before = state[:, joint]
        resting = np.abs(before) < _STILL
        friction = np.where(resting, guess, -level(before) * np.sign(before))
        gain = np.full(len(state), length / self._inertia())  # rad/s of the joint for 1 N m over the step
        previous = None
        for _ in range(_MOST_TRIALS):
            trial = self._advance(state, time, length, torques, friction)
            rate = trial[:, joint]
            if whole and np.any(~resting & (rate * before <= 0.0)):
                return None
            if previous is not None:
                change = friction - previous[0]
                moved = np.abs(change) > 1e-12
                gain[moved] = (rate - previous[1])[moved] / change[moved]
            limit = level(0.5 * (before + rate))
            wanted = np.clip(friction - rate / gain, -limit, limit)
            if np.all((np.abs(wanted - friction) < _SAME) | (np.abs(rate) < _STILL)):
                break
            previous = friction, rate
            friction = wanted
        return None if whole and np.any(resting & (np.abs(rate) >= _STILL)) else (trial, friction)

    def _inertia(self) -> float:
        """Roughly what the joint's torque accelerates within one step, kg m^2."""
        share = self._beam.physics.motor_share if self._beam.motor else 1.0
        return share * self._beam.beam.hub_inertia + 0.002 * self._beam.beam.mass * self._beam.beam.length**2

    def _advance(
        self, state: Array, time: float, length: float, torques: Array, friction: Array | float = 0.0
    ) -> Array:
        """One step of `length` s with torques (3, B) at its start, middle and end, and constant friction (B,)."""
        weights = self._weights_of(length)
        middle = time + 0.5 * length
        first = self._remainder(state, time, torques[0], friction)
        free = times(weights.half, state)
        stage = free + times(weights.half_weight, first)
        second = self._remainder(stage, middle, torques[1], friction)
        third = self._remainder(free + times(weights.half_weight, second), middle, torques[1], friction)
        last = times(weights.half, stage) + times(weights.half_weight, 2.0 * third - first)
        fourth = self._remainder(last, time + length, torques[2], friction)
        driven = times(weights.first, first) + times(weights.middle, second + third) + times(weights.last, fourth)
        return times(weights.whole, state) + driven

    def _remainder(self, state: Array, time: float, torque: Array, friction: Array | float) -> Array:
        """Time derivative of the states less its linear part, (B, d)."""
        parts = self._beam.parts
        derivative = np.zeros_like(state)
        if parts.torque.stop > parts.torque.start:
            derivative[:, parts.torque.start] = torque / self._beam.physics.actuator_lag_time_constant
            torque = state[:, parts.torque.start]
        exact = self._beam.accelerations(state, time, torque + friction)
        derivative[:, parts.rates] = exact - times(self._linear_rates, state)
        if parts.slip.stop > parts.slip.start:
            derivative[:, parts.slip] = self._beam.slip_rates(state)
        return derivative

    def _weights_of(self, length: float) -> _Weights:
        """Matrices for a step of `length` s."""
        if length not in self._weights:
            distinct = [_weights(matrix, length) for matrix in self._linear]
            group = self._beam.group if len(distinct) > 1 else np.zeros(1, dtype=int)
            self._weights[length] = _Weights(*(np.stack(each)[group] for each in zip(*distinct, strict=True)))
        return self._weights[length]


def _weights(linear: Array, length: float) -> _Weights:
    """Of one linear system, transposed, (d, d) each."""
    whole, phi_1, phi_2, phi_3 = phi_functions(linear * length)
    half, half_phi, _, _ = phi_functions(linear * (0.5 * length))
    return _Weights(
        whole=whole.T,
        half=half.T,
        half_weight=0.5 * length * half_phi.T,
        first=length * (phi_1 - 3.0 * phi_2 + 4.0 * phi_3).T,
        middle=length * (2.0 * phi_2 - 4.0 * phi_3).T,
        last=length * (4.0 * phi_3 - phi_2).T,
    )
