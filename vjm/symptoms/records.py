"""What goes into the search for symptoms, and what one symptom is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from vjm.errors import ShapeError
from vjm.records import Array, Recording, Rig

Kind = Literal[
    "offset",
    "gain",
    "delay",
    "drift",
    "amplitude",
    "phase",
    "frequency",
    "damping",
    "shape",
    "rest_amplitude",
    "rest_delay",
    "tone",
    "frequency_with_amplitude",
    "damping_with_amplitude",
    "against_angle",
    "against_velocity",
    "against_sign",
    "camera_lag",
    "camera_clock",
    "quiet_size",
    "quiet_colour",
    "course",
    "wander",
]

# A symptom is put into words where chance alone would show it once in so many looks, and where it is worth a word.
FALSE_ALARM = 1e-5
LEAST_SHARE = 0.01


@dataclass(frozen=True)
class Followed:
    """A recording and the model's open-loop simulation of it.

    Attributes:
        rig: the arm.
        recording: as measured; NaN where not.
        markers: (T, k, 2) simulated, in the frames of the measured ones [m].
        theta: (T, n_a) simulated angles of the active joints [rad].
        noise: 1-sigma of a marker coordinate [m] and of an encoder [rad].
        frequencies: the model's natural frequencies [Hz] where this recording has its own, with a payload for instance,
            mode by mode beside those that all recordings share; None: those.
    """

    rig: Rig
    recording: Recording
    markers: Array
    theta: Array
    noise: tuple[float, float]
    frequencies: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for name, given, wanted in (
            ("markers", self.markers, self.recording.markers),
            ("theta", self.theta, self.recording.theta),
        ):
            if given.shape != wanted.shape:
                raise ShapeError(name, f"shape {given.shape}", f"shape {wanted.shape}, as measured")
            if not np.isfinite(given).all():
                raise ShapeError(name, "numbers that are not finite", "a simulation of the whole recording")
        if not all(0 < each < np.inf for each in self.noise):
            raise ShapeError("noise", self.noise, "two positive numbers [m, rad]")
        count = sum(len(link.markers) for link in self.rig.links)
        if self.markers.shape[1:] != (count, 2):
            raise ShapeError("markers", f"shape {self.markers.shape}", f"shape (T, {count}, 2), as the rig has them")
        if self.theta.shape[1] != len(self.rig.active_links):
            raise ShapeError("theta", f"shape {self.theta.shape}", f"shape (T, {len(self.rig.active_links)})")


class Estimate(NamedTuple):
    """A number found in a residual.

    Attributes:
        value: in the unit of what it is.
        std: its standard error; infinite where the recording does not tell.
        p_value: chance that a residual without it shows as much.
    """

    value: float
    std: float
    p_value: float

    @property
    def sure(self) -> bool:
        """Whether it is more than chance."""
        return self.p_value < FALSE_ALARM

    def times(self, factor: float) -> Estimate:
        """The same in another unit."""
        return Estimate(self.value * factor, self.std * abs(factor), self.p_value)


UNKNOWN = Estimate(0.0, float("inf"), 1.0)


@dataclass(frozen=True)
class Symptom:
    """One way in which the model and a recording differ; no cause.

    Attributes:
        kind: what differs.
        recording: its file; None where it was seen in several together.
        sensor: a coordinate such as `beam.m5.y`, an encoder such as `beam.theta`, or `camera`; None: the whole arm.
        band: centre of the frequency band [Hz]; None: no band.
        value: measured less simulated.
        std: its standard error.
        unit: of both.
        p_value: chance that a residual without it shows as much.
        share: of all recordings' mean square residual, in units of the noise, that it describes.
        local: the same of its own recording (of those it was seen in).
        sentence: what an engineer would say.
    """

    kind: Kind
    recording: str | None
    sensor: str | None
    band: float | None
    value: float
    std: float
    unit: str
    p_value: float
    share: float
    local: float
    sentence: str

    @property
    def significant(self) -> bool:
        """Whether it is more than chance and describes enough of its recording's misfit to be worth a word."""
        return self.p_value < FALSE_ALARM and self.local >= LEAST_SHARE
