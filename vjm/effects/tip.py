"""A mass on the tip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from vjm.chain.virtual_links import Chain
from vjm.effects.drag import Rods
from vjm.effects.effect import Effect, Motion, TipEffect, changed_link, magnitude, shape_parameter
from vjm.records import Array, Recording, Rig


@dataclass(frozen=True)
class TipPayload(TipEffect):
    """A point mass at the distal end of the last link.

    Attributes:
        mass: [kg].
    """

    mass: float = magnitude("kg", 0.01, lower=0.0)

    id = "tip_payload"
    description = "an unknown mass on the tip"
    clause = "an unknown mass of {mass} on the tip of {link}"
    reference = "L. Meirovitch, Fundamentals of Vibrations, McGraw-Hill, 2001"
    distinguishing_experiment = (
        "a recording with a known mass on the tip, static sag under gravity, or driven recordings"
    )
    common = True
    in_urdf = True

    def chain(self, chain: Chain) -> Chain:
        """With a larger payload."""
        if self.is_null:
            return chain
        return changed_link(chain, -1, payload=chain.links[-1].payload + self.mass)


@dataclass(frozen=True)
class InPlaneGravity(Effect):
    """Uniform gravity in the plane, beside what is known: the base is tilted.

    Attributes:
        gx, gy: in the base frame [m/s^2].
    """

    gx: float = magnitude("m/s^2", 0.25, lower=-30.0, upper=30.0)
    gy: float = magnitude("m/s^2", 0.25, lower=-30.0, upper=30.0)

    id = "in_plane_gravity"
    description = "gravity in the plane of motion: the base is tilted"
    clause = "gravity of {gx} along x and {gy} along y in the plane of motion: the base is tilted"
    reference = "B. Siciliano et al., Robotics: Modelling, Planning and Control, Springer, 2009, chapter 7"
    distinguishing_experiment = "recordings at several hub angles"

    def true_inputs(self, recording: Recording) -> Recording:
        """With more gravity."""
        if self.is_null:
            return recording
        x, y = recording.gravity
        return replace(recording, gravity=(x + self.gx, y + self.gy))


_LOWEST = 0.2  # Hz, where no recording is known
_FREQUENCIES = 12
_USUAL_RATE = 100.0  # frames a second, where none is known


@dataclass(frozen=True)
class ExternalTone(TipEffect):
    """A lateral force on the tip, amplitude sin(2 pi frequency t + phase), normal to the last virtual link.

    A search varies amplitude cos(phase) and amplitude sin(phase), in which the motion is about linear.

    Attributes:
        amplitude: [N].
        frequency: [Hz].
        phase: at the start of each recording [rad].
        lowest: frequency to which searches may go [Hz]; a force that takes longer than the recordings is none.
    """

    amplitude: float = magnitude("N", 0.01, lower=0.0)
    frequency: float = shape_parameter("Hz", 5.0, lower=1e-2, upper=1e4, from_spectrum=True)
    phase: float = shape_parameter("rad", 0.0, lower=-np.pi, upper=np.pi)
    lowest: float = field(default=0.0, kw_only=True, compare=False)

    id = "external_tone"
    description = "a sinusoidal force on the tip from outside"
    clause = "a sinusoidal force of {amplitude} at {frequency} on the tip of {link} from outside"
    reference = "J. P. Den Hartog, Mechanical Vibrations, 4th edition, McGraw-Hill, 1956"
    distinguishing_experiment = "a quiet recording, in which nothing drives the arm"
    abscissa = "frequency"

    @property
    def coordinates(self) -> Array:
        """(3,) cosine's and sine's amplitude over an everyday one, logarithm of the frequency over an everyday one."""
        amplitude, frequency, _ = self.parameters()
        radius = amplitude.coordinate(self.amplitude)
        return np.array(
            [radius * np.cos(self.phase), radius * np.sin(self.phase), frequency.coordinate(self.frequency)]
        )

    def at(self, coordinates: Array) -> Self:
        """The same at other coordinates (3,); without amplitude, at phase zero."""
        amplitude, frequency, _ = self.parameters()
        cosine, sine, tone = np.asarray(coordinates, dtype=float).tolist()
        return replace(
            self,
            amplitude=amplitude.value(float(np.hypot(cosine, sine))),
            frequency=frequency.value(tone),
            phase=float(np.arctan2(sine, cosine)),
        )

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Of the frequency only."""
        frequency = self.parameters()[1]
        lowest = frequency.coordinate(max(frequency.lower, self.lowest))
        return np.array([-np.inf, -np.inf, lowest]), np.array([np.inf, np.inf, frequency.bounds[1]])

    @property
    def magnitude_count(self) -> int:
        """Cosine and sine."""
        return 2

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """From one period in the longest recording to what a camera shows: the recordings' spectra know better."""
        rates = [_rate(recording) for recording in recordings if recording.frames.size > 1]
        longest = max((float(np.ptp(recording.time)) for recording in recordings), default=0.0)
        lowest = 1 / longest if longest > 0 else _LOWEST
        highest = max(max(rates, default=_USUAL_RATE) / 2, 2 * lowest)
        frequencies = np.geomspace(lowest, highest, _FREQUENCIES).tolist()
        own = [replace(self, link=link, lowest=lowest) for link in self.places(rig)]
        return tuple(replace(each, frequency=frequency) for each in own for frequency in frequencies)

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """On the end of the last virtual link."""
        if self.is_null:
            return None
        rods, still = Rods(chain), np.zeros(chain.size)
        amplitude, pulsation, phase = self.amplitude, 2 * np.pi * self.frequency, self.phase
        reach = float(rods.lengths[-1])
        last = np.zeros(rods.lengths.size)
        last[-1] = 1.0

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            push = amplitude * np.sin(pulsation * np.asarray(time) + phase)[..., None] * last
            return rods.torques(rods.motion(q, still).direction, push, reach * push)

        return force


def _rate(recording: Recording) -> float:
    """Frames a second."""
    return 1 / float(np.median(np.diff(recording.time[recording.frames])))
