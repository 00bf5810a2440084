"""A weak spring and damper between active joints and the angles that encoders measured, for fits of what sticks.

Simulated open loop, a joint that sticks a moment too early stays off for the rest of the recording, and a fit is lost
among such accidents. Held, it comes back: residuals tell what the model lacks, and parameters that are right leave
nothing but noise, as they do open loop.

Source: L. Ljung, System Identification: Theory for the User, 2nd ed. 1999, section 4.3 (a predictor that is corrected
by what was measured, with a gain that is given).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect
from vjm.errors import InsufficientDataError
from vjm.markers.smoothing import Smoother
from vjm.model import dynamics
from vjm.records import Array, Recording

_GRID = 1e-3  # s; encoders are no faster, and in between it is interpolated
_MOMENT = 1e-4  # s, over which what encoders show is differentiated


@dataclass(frozen=True)
class EncoderFeedback:
    """What draws active joints towards measured angles; of one recording, or of C copies together.

    Attributes:
        theta, rate: (S, n_a) or (S, C, n_a) angles [rad] and rates [rad/s] at every `_GRID` since the start.
        stiffness, damping: (n_a,) or (C, n_a) [N m/rad, N m s/rad].
    """

    theta: Array = field(repr=False)
    rate: Array = field(repr=False)
    stiffness: Array
    damping: Array

    @classmethod
    def of(
        cls, recording: Recording, chain: Chain, noise: float, frequency: float, ratio: float
    ) -> EncoderFeedback | None:
        """A guide on which a chain's active joints would swing slowly.

        Args:
            recording: where angles were measured.
            chain: gives the inertia that is drawn.
            noise: 1-sigma of an angle [rad].
            frequency: of that swing [Hz].
            ratio: its damping ratio.

        Returns:
            The guide; None where there is no active joint, or too little was measured.
        """
        known = np.isfinite(recording.theta).all(axis=1)
        if not chain.active.size:
            return None
        try:
            smoother = Smoother.of(recording.time[known])
        except InsufficientDataError:
            return None
        smooth = smoother.derivatives(recording.theta[known], np.full(chain.active.size, noise))
        time = recording.time[known] - recording.time[0]
        grid = _GRID * np.arange(int(np.ceil(np.ptp(recording.time) / _GRID)) + 2)
        theta, rate = (
            np.stack([np.interp(grid, time, column) for column in columns.T], axis=-1)
            for columns in (smooth.value, smooth.rate)
        )
        mechanism = dynamics.build(chain, recording.payload)
        inertia = np.diag(dynamics.mass_matrix(mechanism, np.zeros((1, chain.size)))[0])[chain.active]
        omega = 2 * np.pi * frequency
        return cls(theta, rate, inertia * omega**2, 2 * ratio * omega * inertia)

    @classmethod
    def together(cls, feedbacks: Sequence[EncoderFeedback | None]) -> EncoderFeedback | None:
        """Of copies that are advanced together, those without a guide left alone; None where none has one."""
        given = [each for each in feedbacks if each is not None]
        if not given:
            return None
        longest, none = max(len(each.theta) for each in given), np.zeros(given[0].stiffness.shape)

        def column(values: Array) -> Array:
            return np.concatenate([values, np.repeat(values[-1:], longest - len(values), axis=0)])

        return cls(
            np.stack([column(each.theta if each else none[None]) for each in feedbacks], axis=1),
            np.stack([column(each.rate if each else none[None]) for each in feedbacks], axis=1),
            np.stack([each.stiffness if each else none for each in feedbacks]),
            np.stack([each.damping if each else none for each in feedbacks]),
        )

    def torque(self, time: ArrayLike, theta: Array, rate: Array) -> Array:
        """(..., n_a) on joints at angles and rates (..., n_a) that the encoders would show, since the start [N m]."""
        place = np.clip(np.asarray(time, dtype=float) / _GRID, 0.0, len(self.theta) - 2)
        first = place.astype(int)
        share = (place - first)[..., None]
        angle = (1 - share) * self.theta[first] + share * self.theta[first + 1]
        speed = (1 - share) * self.rate[first] + share * self.rate[first + 1]
        found: Array = self.stiffness * (angle - theta) + self.damping * (speed - rate)
        return found


def shown(sensors: Sequence[Effect], theta: Array, rate: Array) -> tuple[Array, Array]:
    """What encoders would show of active joints' angles [rad] and rates [rad/s] (..., n_a)."""
    changing = [effect for effect in sensors if type(effect).encoder_angles is not Effect.encoder_angles]
    if not changing:
        return theta, rate
    before, at, after = (
        theta.reshape(-1, theta.shape[-1]) + t * rate.reshape(-1, theta.shape[-1]) for t in (-_MOMENT, 0, _MOMENT)
    )
    for effect in changing:
        before, at, after = (effect.encoder_angles(each) for each in (before, at, after))
    return at.reshape(theta.shape), ((after - before) / (2 * _MOMENT)).reshape(theta.shape)
