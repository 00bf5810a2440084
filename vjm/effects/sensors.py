"""Markers that are not where they should be, encoders, and clocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from vjm.chain.curve import rotate
from vjm.effects.effect import ColumnEffect, Effect, LinkEffect, is_recorded, magnitude, shape_parameter
from vjm.errors import ShapeError
from vjm.records import Array, Recording, Rig


@dataclass(frozen=True)
class _MarkerEffect(LinkEffect):
    """Displaces markers of a link, as these move with it.

    Attributes:
        columns: numbers of the link's markers among all links' markers; None: unknown, right on an arm of one link.
    """

    columns: tuple[int, ...] | None = field(default=None, kw_only=True)

    def placed(self, rig: Rig, link: int | None) -> Self:
        """Return the effect on a link of a rig, with the link's markers."""
        part = rig.marker_slices[link or 0]
        return replace(super().placed(rig, link), columns=tuple(range(part.start, part.stop)))

    def own_columns(self, count: int) -> Sequence[int]:
        """Return the numbers of the link's markers among all, of which there are so many.

        Raises:
            ShapeError: a link further out whose markers are unknown.
        """
        if self.columns is None and self.link_index > 0:
            raise ShapeError(self.id, f"link {self.link_index} without `columns`", "an instance from `variants`")
        return range(count) if self.columns is None else self.columns

    @staticmethod
    def displaced(positions: Array, headings: Array, columns: Sequence[int], offset: tuple[float, float]) -> Array:
        """Return positions (..., k, 2) [m], in some columns displaced along and across the link by an offset [m]."""
        moved, own = positions.copy(), [*columns]
        moved[..., own, :] += rotate(np.array(offset), headings[..., own])
        return moved


@dataclass(frozen=True)
class MarkerOffset(_MarkerEffect):
    """One marker, the k-th of its link from 1, that is not where the rig's file says.

    Attributes:
        along, across: where it is, less where it should be, along the link's tangent and normal [m].
    """

    marker: int = shape_parameter("", 1, lower=1, integer=True)
    along: float = magnitude("m", 0.005, lower=-0.5, upper=0.5, in_rig_units=True)
    across: float = magnitude("m", 0.005, lower=-0.5, upper=0.5, in_rig_units=True)

    description = "marker offset: a marker that is not where the experiment file says"
    clause = "marker {marker} of '{link}' is off by {along} along and {across} across the link"
    assumptions = "a marker that moves rigidly with the link, the same offset in every recording"
    reference = "J. M. Hollerbach and C. W. Wampler, The calibration index, Int. J. Robotics Research 15(6), 1996"
    distinguishing_experiment = "measure the marker's position on the link with a ruler"
    abscissa = "marker"

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Return the links with markers."""
        return tuple(i for i, link in enumerate(rig.links) if link.markers)

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """Return one for each marker."""
        return tuple(
            replace(absent, marker=k)
            for absent in super().variants(rig, recordings)
            for k in range(1, len(absent.columns or ()) + 1)
        )

    def marker_positions(self, positions: Array, headings: Array, time: Array) -> Array:
        """Return the positions with that marker displaced."""
        column = self.own_columns(positions.shape[-2])[self.marker - 1]
        return self.displaced(positions, headings, [column], (self.along, self.across))


@dataclass(frozen=True)
class MarkerDatum(_MarkerEffect):
    """All markers of a link that are not where the rig's file says, by the same vector: the ruler began elsewhere.

    Attributes:
        along, across: where they are, less where they should be, along the link's tangent and normal [m].
    """

    along: float = magnitude("m", 0.005, lower=-0.5, upper=0.5, in_rig_units=True)
    across: float = magnitude("m", 0.005, lower=-0.5, upper=0.5, in_rig_units=True)

    description = "datum of the markers: all of a link are off by the same distance"
    clause = "all markers of '{link}' are off by {along} along and {across} across the link"
    assumptions = "markers that move rigidly with the link, the same offset of all in every recording"
    reference = "J. M. Hollerbach and C. W. Wampler, The calibration index, Int. J. Robotics Research 15(6), 1996"
    distinguishing_experiment = "measure the first marker's distance from the joint's axis with a ruler"
    abscissa = "marker"

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Return the links with several markers; one alone is a misplaced marker."""
        return tuple(i for i, link in enumerate(rig.links) if len(link.markers) > 1)

    def marker_positions(self, positions: Array, headings: Array, time: Array) -> Array:
        """Return the positions with the link's markers displaced."""
        columns = self.own_columns(positions.shape[-2])
        return self.displaced(positions, headings, columns, (self.along, self.across))


@dataclass(frozen=True)
class EncoderOffset(ColumnEffect):
    """An encoder whose zero is not where the link points along x; the offset is its reading less the true angle."""

    offset: float = magnitude("rad", 0.005, lower=-np.pi, upper=np.pi)

    on_drive = False
    description = "zero offset of the encoder"
    clause = "the encoder zero of '{link}' is off by {offset}"
    assumptions = "the same offset in every recording and at all angles"
    reference = "J. M. Hollerbach and C. W. Wampler, The calibration index, Int. J. Robotics Research 15(6), 1996"
    distinguishing_experiment = "a fixed fiducial beside the base in the camera's view; sag at several hub angles"
    column_of = "theta"

    def encoder_angles(self, theta: Array) -> Array:
        """Return shifted angles."""
        return self.with_column(theta, offset=self.offset)


@dataclass(frozen=True)
class EncoderEccentricity(ColumnEffect):
    """An encoder whose disc is off the joint's axis: it reads sine sin(theta) + cosine (cos(theta) - 1) too much."""

    sine: float = magnitude("rad", 0.005, lower=-0.2, upper=0.2)
    cosine: float = magnitude("rad", 0.005, lower=-0.2, upper=0.2)

    on_drive = False
    description = "eccentric encoder: an error that returns with every turn of the joint"
    clause = "the encoder of '{link}' is eccentric: it reads {sine} sin(angle) and {cosine} (cos(angle) - 1) too much"
    assumptions = "one wave in a turn of the joint, on whose side the encoder is; an encoder set to zero at zero"
    reference = "L. M. Sanchez-Brea and T. Morlanes, Metrological errors in optical encoders, Meas. Sci. Technol., 2008"
    distinguishing_experiment = "a slow sweep of the joint over a whole turn; a second reading head opposite the first"
    column_of = "theta"

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Return the reason if there is no encoder, or a joint turns as its encoder says."""
        given = any(recording.input == "motion" for recording in recordings)
        return super().untestable(rig, recordings) or ("the encoder's error is in the given motion" if given else "")

    def encoder_angles(self, theta: Array) -> Array:
        """Return angles with the error."""
        angle = theta[:, self.own_column]
        error = self.sine * np.sin(angle) + self.cosine * (np.cos(angle) - 1)
        return self.with_column(theta, offset=error)


@dataclass(frozen=True)
class _ClockEffect(Effect):
    """Acts on the camera's clock against that of encoders and torques; alone it can be compared with nothing."""

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        known = is_recorded(recordings, "tau") or is_recorded(recordings, "theta")
        return "" if known else "only the camera was recorded: there is no second clock to compare with"


@dataclass(frozen=True)
class TimeOffset(_ClockEffect):
    """A camera that shows an earlier state than that of its time stamp."""

    delay: float = magnitude("s", 0.03, lower=-0.2, upper=0.2, in_rig_units=True)

    description = "camera delay: frames later than their time stamps"
    clause = "camera frames are {delay} late"
    assumptions = "one constant delay of all frames and recordings"
    reference = "P. Furgale et al., Unified temporal and spatial calibration for multi-sensor systems, IROS, 2013"
    distinguishing_experiment = "driven recordings with fast motion, and two different initial states"
    abscissa = "velocity"
    common = True

    def camera_instants(self, time: Array, positions: Array) -> Array:
        """Return earlier instants."""
        return time - self.delay

    def longest_delay(self, rig: Rig) -> float:
        """Return the bound of the delay."""
        return self.placed(rig, None).parameters[0].upper


@dataclass(frozen=True)
class ClockScale(_ClockEffect):
    """A camera whose clock runs faster than the encoder's, by the scale."""

    scale: float = magnitude("", 0.002, null=1.0, lower=0.8, upper=1.25)

    description = "camera clock scale: it runs at another rate than the encoder's"
    clause = "the camera clock runs {scale} times as fast as the encoder's"
    assumptions = "one constant rate; clocks that agree at each recording's start"
    reference = "E. Olson, A passive solution to the sensor synchronization problem, IROS, 2010"
    distinguishing_experiment = "long driven recordings"

    def camera_instants(self, time: Array, positions: Array) -> Array:
        """Return the instants by the encoder's clock."""
        return time / self.scale


@dataclass(frozen=True)
class TimestampJitter(Effect):
    """A camera whose frames are taken earlier or later than stamped, at random, with a standard deviation: the jitter.

    It changes no prediction: the noise of a frame's markers grows with their speed, and is common to all of them. A
    search varies its variance, in which the likelihood is smooth.
    """

    jitter: float = magnitude("s", 4e-3, lower=0.0, upper=0.2, in_rig_units=True)

    description = "random jitter of the camera's frame times"
    clause = "camera frame times jitter by {jitter} (1 sigma)"
    assumptions = (
        "independent errors of the frames, normal, with one standard deviation; all markers of a frame taken at once"
    )
    reference = "A. V. Balakrishnan, On the problem of time jitter in sampling, IRE Trans. Inf. Theory 8(3), 1962"
    distinguishing_experiment = "a camera with a hardware trigger; repeats of one fast drive"
    abscissa = "velocity"

    @property
    def coordinates(self) -> Array:
        """(1,) variance over that of a typical magnitude."""
        return np.array([self.parameters[0].coordinate(self.jitter) ** 2])

    def at(self, coordinates: Array) -> Self:
        """Return the same effect at another variance (1,)."""
        (variance,) = np.asarray(coordinates, dtype=float).tolist()
        return replace(self, jitter=self.parameters[0].value(float(np.sqrt(max(variance, 0.0)))))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (1,), (1,) of the coordinate."""
        return np.zeros(1), np.array([self.parameters[0].bounds[1] ** 2])

    @property
    def timing_noise(self) -> float:
        """The jitter."""
        return self.jitter
