"""The actuator at an active joint: a torque that comes late, is clipped, or depends on the motor's angle.

Between its samples a recorded torque is linear, and what an actuator makes of it is not. That is replaced by the
piecewise linear function nearest in the mean square, which has the same integrals over each hat function of the
samples, so that motion slower than the sampling cannot tell the two apart.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import factorial
from typing import Self

import numpy as np
from scipy import linalg

from vjm.chain.virtual_links import Chain
from vjm.effects.effect import (
    ColumnEffect,
    JointEffect,
    Parameter,
    StateFunction,
    WaveEffect,
    magnitude,
    shape_parameter,
)
from vjm.records import Array, Payload, Recording, Rig


@dataclass(frozen=True)
class _Actuator(ColumnEffect, ABC):
    """Makes another torque of the one recorded at an active joint."""

    @abstractmethod
    def true_torque(self, time: Array, torque: Array) -> Array:
        """Return the torque (T,) [N m] that acts where one (T,) was recorded at instants (T,) [s]."""

    def true_inputs(self, recording: Recording) -> Recording:
        """Return the recording with the true torque, made of the samples at which all joints' torques are known."""
        known = np.isfinite(recording.tau).all(axis=1)
        if self.is_null or np.count_nonzero(known) < 2:
            return recording
        tau, column = recording.tau.copy(), self.own_column
        tau[known, column] = self.true_torque(recording.time[known], tau[known, column])
        return replace(recording, tau=tau)


@dataclass(frozen=True)
class ActuatorLag(_Actuator):
    """A true torque y that follows the recorded one u as a first-order lag: time_constant y' = u - y.

    Where a recording begins, y = u; that is off by time_constant u' in one that begins in motion, but dies out within
    the time constant and acts like a change of the initial state, which is estimated.
    """

    time_constant: float = magnitude("s", 0.01, lower=0.0, upper=0.5, in_rig_units=True)

    description = "actuator lag: the true torque follows the recorded one late"
    clause = "the actuator torque at the joint of '{link}' lags the recorded one, time constant {time_constant}"
    assumptions = "a linear lag of first order, the same for all torques; no lag built up before a recording"
    reference = "M. W. Spong, S. Hutchinson and M. Vidyasagar, Robot Modeling and Control, Wiley, 2006, chapter 6"
    distinguishing_experiment = "a fast chirp, with encoder and torque on one clock"

    def true_torque(self, time: Array, torque: Array) -> Array:
        """Return the torque (T,) [N m] that follows one (T,) recorded at instants (T,) [s]."""
        return torque + _lag_change(time, torque, self.time_constant)


def _lag_change(time: Array, torque: Array, time_constant: float) -> Array:
    """Return the change (T,) of a torque (T,) [N m], linear between instants (T,) [s], by a first-order lag."""
    steps, rises = np.diff(time), np.diff(torque)
    phi1, phi2, phi3 = _phi(steps / time_constant)
    decay = np.exp(-steps / time_constant)
    # The change d = y - u falls to decay d - phi1 (rise of u) in an interval, from zero at the first instant.
    bands = np.stack([np.ones(time.size), np.append(-decay, 0.0)])
    exact = linalg.solve_banded((1, 0), bands, np.append(0.0, -phi1 * rises))
    return _nearest_piecewise_linear(
        steps, exact[:-1] * phi2 - rises * phi3, exact[:-1] * (phi1 - phi2) - rises * (phi2 - phi3)
    )


def _clipped(time: Array, torque: Array, limit: float) -> Array:
    """Return a torque (T,) [N m], linear between instants (T,) [s], clipped at plus and minus a limit [N m]."""
    steps, rises = np.diff(time), np.diff(torque)
    result, falling, rising = torque.clip(-limit, limit), np.zeros(steps.size), np.zeros(steps.size)
    for side in (1.0, -1.0):
        crossed = (side * torque[1:] > limit) != (side * torque[:-1] > limit)
        kink = np.divide(side * limit - torque[:-1], rises, out=np.zeros(steps.size), where=crossed)
        # Above the line between the clipped samples there is a triangle with its corner at the kink.
        height = side * np.abs(rises) * kink * (1 - kink)
        falling, rising = falling + height * (2 - kink) / 6, rising + height * (1 + kink) / 6
    return np.asarray(result + _nearest_piecewise_linear(steps, falling, rising))


def _nearest_piecewise_linear(steps: Array, falling: Array, rising: Array) -> Array:
    """Return the piecewise linear function (T,) nearest in the mean square to one that is known by its moments.

    Args:
        steps: (T - 1,) lengths of the intervals [s].
        falling, rising: (T - 1,) means over each interval of the function times 1 - s and s, s being from 0 to 1 there.
    """
    moments = np.append(steps * falling, 0.0) + np.append(0.0, steps * rising)
    diagonal = (np.append(steps, 0.0) + np.append(0.0, steps)) / 3
    return np.asarray(linalg.solveh_banded(np.stack([np.append(0.0, steps / 6), diagonal]), moments))


def _phi(x: Array) -> tuple[Array, Array, Array]:
    """Return phi_1, phi_2 and phi_3 of -x (...) >= 0, by a power series where differences would cancel."""
    small = np.minimum(x, 1.0)
    phi3 = np.polyval([(-1.0) ** k / factorial(k + 3) for k in reversed(range(18))], small)
    phi2 = 1 / 2 - small * phi3
    phi1 = 1 - small * phi2
    large = np.maximum(x, 1.0)
    far1 = -np.expm1(-large) / large
    far2 = (1 - far1) / large
    far3 = (1 / 2 - far2) / large
    return np.where(x < 1, phi1, far1), np.where(x < 1, phi2, far2), np.where(x < 1, phi3, far3)


@dataclass(frozen=True)
class TorqueSaturation(_Actuator):
    """A true torque that is the recorded one clipped at plus and minus the limit.

    A limit above all recorded torques changes nothing: a search varies how far one over the limit lies beyond one over
    the largest of them.

    Attributes:
        peak: largest recorded torque [N m].
    """

    limit: float = magnitude("N m", 0.05, null=np.inf, lower=1e-3, reciprocal=True, in_rig_units=True)
    peak: float = field(default=np.inf, kw_only=True, compare=False)

    description = "torque saturation: the true torque is clipped"
    clause = "the torque at the joint of '{link}' saturates at {limit}"
    assumptions = "one limit for both directions, at all rates and temperatures"
    reference = "T. Hu and Z. Lin, Control Systems with Actuator Saturation: Analysis and Design, Birkhaeuser, 2001"
    distinguishing_experiment = "the same drive at half the amplitude"

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The limit, counted from the largest recorded torque where that is known."""
        (limit,) = super().parameters
        if not np.isfinite(self.peak):
            return (limit,)
        # Differences are taken at a tenth of the coordinate: at a limit of 1 / 1.2 of the peak.
        return (replace(limit, typical_magnitude=self.peak / 2, threshold=self.peak, lower=self.peak / 100),)

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Return the reason if no joint is driven."""
        idle = not any(np.nan_to_num(recording.tau).any() for recording in recordings)
        return super().untestable(rig, recordings) or ("no joint was driven" if idle else "")

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """Return one for each joint, with its largest recorded torque."""
        return tuple(
            replace(variant, peak=variant._peak_torque(recordings) or np.inf)
            for variant in super().variants(rig, recordings)
        )

    def true_torque(self, time: Array, torque: Array) -> Array:
        """Return the clipped torque (T,) [N m] of one (T,) recorded at instants (T,) [s]."""
        return _clipped(time, torque, self.limit)

    def _peak_torque(self, recordings: Sequence[Recording]) -> float:
        """Return the largest torque recorded at the joint [N m]; zero without any."""
        torques = [np.abs(recording.tau[:, self.own_column]) for recording in recordings]
        return max((float(np.nanmax(torque)) for torque in torques if np.isfinite(torque).any()), default=0.0)


# Radians of a wave over a time step, whose error is then 0.6 % (2^4 / 2880, of Simpson's rule), at a fast rate of the
# joint in rad / T, the link's own unit: that of a swing by 0.7 rad in the first mode of a clamped link (3.5 rad / T).
_WAVE_STEP, _FAST = 2.0, 2.4


@dataclass(frozen=True)
class Cogging(WaveEffect, JointEffect):
    """A torque by the motor's angle q: amplitude sin(count q + phase), with count waves in a turn of the joint.

    The count is estimated like any other number: behind a gear it is none of the whole ones, and a joint that turns
    little shows it only so well. A wave longer than the joint's whole turn is none.
    """

    amplitude: float = magnitude("N m", 0.004, lower=0.0, in_rig_units=True)
    count: float = shape_parameter("per turn", 24.0, lower=1.0, upper=2000.0, from_spectrum="joint_angle")
    phase: float = shape_parameter("rad", 0.0, lower=-np.pi, upper=np.pi)

    description = "cogging: a motor torque that is periodic in the joint angle"
    clause = "cogging torque of {amplitude} at the joint of '{link}', {count}"
    assumptions = "a single wave in the joint's angle, the same at all torques and rates"
    reference = (
        "T. M. Jahns and W. L. Soong, Pulsating torque minimization techniques, IEEE Trans. Ind. Electron., 1996"
    )
    distinguishing_experiment = "a slow sweep of the joint over a wide range"
    abscissa = "joint_angle"

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """Return it with counts down to one wave in the joint's largest turn."""
        variants = []
        for variant in super().variants(rig, recordings):
            column = rig.active_links.index(variant.link_index)
            angles = [recording.theta[:, column] for recording in recordings]
            ranges = [float(np.nanmax(angle) - np.nanmin(angle)) for angle in angles if np.isfinite(angle).any()]
            largest = max(ranges, default=0.0)
            variants.append(replace(variant, lowest=2 * np.pi / largest if largest > 0 else 0.0))
        return tuple(variants)

    def force(self, chain: Chain, payload: Payload) -> StateFunction | None:
        """Return the torque on the joint."""
        joint = self.active_joint(chain)
        return self.force_on(
            joint, lambda time, q, v, z: self.amplitude * np.sin(self.count * q[..., joint] + self.phase)
        )

    def max_step(self, chain: Chain) -> float:
        """Return the time step [s] that resolves the waves in fast motion."""
        return _WAVE_STEP / (self.count * _FAST) * self.units(chain)[2]
