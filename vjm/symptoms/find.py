"""All symptoms of all recordings, the largest share of the misfit first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vjm.errors import ShapeError
from vjm.symptoms.amplitude import Trend, trends
from vjm.symptoms.examine import Examined, examine
from vjm.symptoms.lags import pooled
from vjm.symptoms.listing import of_all, of_recording
from vjm.symptoms.profiles import Profile, joined
from vjm.symptoms.records import Estimate, Followed, Symptom


@dataclass(frozen=True)
class Symptoms:
    """What is wrong, before any cause is named.

    Attributes:
        found: all that was looked for, significant or not, the largest share first.
        recordings: each of them from all sides, in the order given.
        trends: of frequency and damping with amplitude, over all recordings.
        profiles: torques that are missing, against the joints' motion, over all recordings.
        lag: of the camera behind the encoders, over all recordings [s].
        clock: by how much more time the camera counts than the encoders, over all recordings.
        frequencies: centres of the bands [Hz].
    """

    found: tuple[Symptom, ...]
    recordings: tuple[Examined, ...]
    trends: tuple[Trend, ...]
    profiles: tuple[Profile, ...]
    lag: Estimate
    clock: Estimate
    frequencies: tuple[float, ...]

    @property
    def significant(self) -> tuple[Symptom, ...]:
        """Those that are more than chance and worth a word."""
        return tuple(each for each in self.found if each.significant)

    def headlines(self, most: int = 8) -> tuple[Symptom, ...]:
        """The largest symptom of each kind and band; its sentence says in how many other recordings it is the same.

        Args:
            most: how many at most.
        """
        groups: dict[tuple[str, int | None], list[Symptom]] = {}
        for symptom in self.significant:
            groups.setdefault((symptom.kind, self._band(symptom)), []).append(symptom)
        # When the misfit comes is told after what it is.
        ordered = sorted(groups.values(), key=lambda group: group[0].kind == "course")
        return tuple(_headline(group) for group in ordered[:most])

    def _band(self, symptom: Symptom) -> int | None:
        if symptom.band is None or not self.frequencies:
            return None
        return int(np.argmin([abs(np.log(symptom.band / each)) for each in self.frequencies]))


def _headline(group: Sequence[Symptom]) -> Symptom:
    first = group[0]
    same = {each.recording for each in group if each.value * first.value > 0} - {first.recording}
    if not same:
        return first
    more = "another recording" if len(same) == 1 else f"{len(same)} other recordings"
    return replace(first, sentence=f"{first.sentence.removesuffix('.')}; likewise in {more}.")


def symptoms(followed: Sequence[Followed], frequencies: Sequence[float]) -> Symptoms:
    """What differs between recordings and the model's simulations of them.

    Args:
        followed: the recordings, each with its simulation.
        frequencies: natural frequencies around which to look [Hz], those of the model for instance; those that a
            recording cannot show, or does not move at, are passed over.

    Raises:
        ShapeError: frequencies that are not positive, or a recording that has another number of them.
    """
    if not all(0 < each < np.inf for each in frequencies):
        raise ShapeError("frequencies", list(frequencies), "positive numbers [Hz]")
    for each in followed:
        if each.frequencies is not None and len(each.frequencies) != len(frequencies):
            expected = f"{len(frequencies)}, as all recordings have"
            raise ShapeError(f"frequencies of {each.recording.file}", len(each.frequencies), expected)
    examined = [examine(index, each, frequencies) for index, each in enumerate(followed)]
    total = float(sum(each.misfit for each in examined))
    free = [motion for each in examined for motion in each.free]
    bands, sensors = [each.bands for each in examined], [each.sensors for each in examined]
    changes = [trend for mode in range(len(frequencies)) for trend in trends(free, bands, sensors, mode)]
    lags = [each.lag for each in examined if each.lag is not None]
    lag, clock = pooled([each.lag for each in lags]), pooled([each.clock for each in lags])
    found = [symptom for each in examined for symptom in of_recording(each, total)]
    together = _together(examined)
    found += of_all(examined, changes, together, lag, clock, total)
    found.sort(key=lambda each: -each.share)
    bands_at = tuple(float(frequency) for frequency in frequencies)
    return Symptoms(tuple(found), tuple(examined), tuple(changes), together, lag, clock, bands_at)


def _together(examined: Sequence[Examined]) -> tuple[Profile, ...]:
    """Torques and accelerations that several recordings show; a residual is each recording's own."""
    groups: dict[tuple[str, str], list[Profile]] = {}
    for profile in (profile for one in examined for profile in one.profiles if profile.quantity != "residual"):
        groups.setdefault((profile.sensor, profile.quantity), []).append(profile)
    found = [joined(group) for group in groups.values()]
    return tuple(each for each in found if each is not None)
