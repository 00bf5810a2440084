"""Weak feedback from encoders' angles to active joints, for fits of joints that stick.

Simulated open loop, a joint that sticks a moment too early stays off for the rest of the recording, and the cost has
many minima. With feedback it comes back: residuals show what the model lacks, and parameters that are right leave
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
from vjm.errors import InsufficientDataError
from vjm.markers.smoothing import Smoother
from vjm.model import dynamics
from vjm.records import Array, Recording

_GRID = 1e-3  # s; encoders are no faster, and in between it is interpolated


@dataclass(frozen=True)
class EncoderFeedback:
    """Springs and dampers from active joints to measured angles, of one recording or of C copies.

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
        """Return feedback on which a chain's active joints would oscillate slowly.

        Args:
            recording: where angles were measured.
            chain: gives the joints' inertia.
            noise: 1-sigma of an angle [rad].
            frequency: of that oscillation [Hz].
            ratio: its damping ratio.

        Returns:
            The feedback; None where there is no active joint, or too little was measured.
        """
        known = np.isfinite(recording.theta).all(axis=1)
        if not chain.active.size:
            return None
        try:
            smoother = Smoother(recording.time[known])
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
    def stacked(cls, feedbacks: Sequence[EncoderFeedback | None]) -> EncoderFeedback | None:
        """Return the feedback of copies that are advanced together; None where none has any."""
        given = [feedback for feedback in feedbacks if feedback is not None]
        if not given:
            return None
        longest, zero = max(len(feedback.theta) for feedback in given), np.zeros(given[0].stiffness.shape)

        def extend(values: Array) -> Array:
            return np.concatenate([values, np.repeat(values[-1:], longest - len(values), axis=0)])

        return cls(
            np.stack([extend(feedback.theta if feedback else zero[None]) for feedback in feedbacks], axis=1),
            np.stack([extend(feedback.rate if feedback else zero[None]) for feedback in feedbacks], axis=1),
            np.stack([feedback.stiffness if feedback else zero for feedback in feedbacks]),
            np.stack([feedback.damping if feedback else zero for feedback in feedbacks]),
        )

    def torque(self, time: ArrayLike, theta: Array, rate: Array) -> Array:
        """Return torques (..., n_a) [N m] at a time since the start [s], for encoders' readings (..., n_a)."""
        place = np.clip(np.asarray(time, dtype=float) / _GRID, 0.0, len(self.theta) - 2)
        first = place.astype(int)
        share = (place - first)[..., None]
        angle = (1 - share) * self.theta[first] + share * self.theta[first + 1]
        speed = (1 - share) * self.rate[first] + share * self.rate[first + 1]
        torque: Array = self.stiffness * (angle - theta) + self.damping * (speed - rate)
        return torque
