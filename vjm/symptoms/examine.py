"""Everything that is looked at in one recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vjm.symptoms.alignment import Alignment, align
from vjm.symptoms.amplitude import FreeMotion, free_motion
from vjm.symptoms.bands import Bands, compare_bands
from vjm.symptoms.course import Course, Wander, course, wander
from vjm.symptoms.joints import profiles
from vjm.symptoms.lags import Lag, camera_lag
from vjm.symptoms.profiles import Profile
from vjm.symptoms.records import Followed
from vjm.symptoms.signals import Channels, middle_of_motion, observe
from vjm.symptoms.tones import Quiet, Tone, quiet, tone


@dataclass(frozen=True)
class Examined:
    """One recording, looked at from all sides.

    Attributes:
        followed: the recording and its simulation.
        sensors: the camera and the encoders, as far as they measured anything.
        misfit: sum of squares of the residual in units of the noise.
        alignments: offset, gain and delay, of each sensor.
        bands: amplitude, phase, frequency and damping; None where nothing was measured, or nothing moves.
        free: frequency and damping against amplitude.
        profiles: residuals against position, velocity and its sign.
        lag: camera against encoders; None without both, or without motion.
        tones: a sinusoid that the simulation lacks.
        quiet: of each sensor, where nothing moves.
        course: where in time the misfit sits.
        wanders: the slow part of the residual, of each sensor.
    """

    followed: Followed
    sensors: tuple[Channels, ...]
    misfit: float
    alignments: tuple[Alignment, ...]
    bands: Bands | None
    free: tuple[FreeMotion, ...]
    profiles: tuple[Profile, ...]
    lag: Lag | None
    tones: tuple[Tone, ...]
    quiet: tuple[Quiet, ...]
    course: Course | None
    wanders: tuple[Wander, ...]


def examine(index: int, followed: Followed, frequencies: Sequence[float]) -> Examined:
    """Look at one recording.

    Args:
        index: of the recording among all.
        followed: the recording.
        frequencies: natural frequencies [Hz].
    """
    sensors = observe(followed)
    misfit = float(sum(np.sum(each.residual**2) for each in sensors))
    alignments = tuple(align(each, middle_of_motion(sensors[0])) for each in sensors)
    nothing = Examined(followed, sensors, misfit, alignments, None, (), (), None, (), (), None, ())
    if not sensors:
        return nothing
    if followed.recording.kind in ("quiet", "static"):
        return replace(nothing, quiet=tuple(quiet(index, each) for each in sensors))
    own = followed.frequencies if followed.frequencies is not None else tuple(frequencies)
    bands = compare_bands(sensors, own)
    return replace(
        nothing,
        bands=bands,
        free=tuple(free_motion(index, followed.recording, sensors, bands)),
        profiles=tuple(profiles(index, followed, sensors)),
        lag=camera_lag(index, alignments, bands),
        tones=_tones(sensors, bands),
        course=course(index, sensors),
        wanders=_wanders(sensors, own),
    )


def _tones(sensors: Sequence[Channels], bands: Bands) -> tuple[Tone, ...]:
    present = [band.frequency for band in bands.bands]
    found = [tone(each, left, False, present) for each, left in zip(sensors, bands.left, strict=True)]
    return tuple(each for each in found if each is not None)


def _wanders(sensors: Sequence[Channels], frequencies: Sequence[float]) -> tuple[Wander, ...]:
    found = [wander(each, min(frequencies)) for each in sensors] if frequencies else []
    return tuple(each for each in found if each is not None)
