"""The pictures of what is wrong, before any cause is named."""

from __future__ import annotations

from collections.abc import Iterator

from matplotlib.figure import Figure

from vjm.report.figures.pictures import Picture
from vjm.report.figures.style import png
from vjm.report.figures.symptom_bands import bands, has_free_motion, with_amplitude
from vjm.report.figures.symptom_motion import lags, overview, worst
from vjm.report.figures.symptom_profiles import chosen, profiles
from vjm.report.figures.symptom_quiet import quiet, shown
from vjm.symptoms import Symptoms

# Every file name that these pictures may have.
NAMES = (
    "symptom_overview",
    "symptom_bands",
    "symptom_amplitude",
    "symptom_profiles",
    "symptom_lag",
    "symptom_quiet",
)


def symptom_pictures(found: Symptoms) -> list[Picture]:
    """All pictures that the recordings have something for.

    Args:
        found: the symptoms.
    """
    return list(_pictures(found))


def _pictures(found: Symptoms) -> Iterator[Picture]:
    if worst(found):
        caption = (
            "The recordings that the model follows worst, and what it leaves of them: a residual that grows is a wrong "
            "frequency, one that keeps the motion's shape a wrong size or time."
        )
        yield _picture("symptom_overview", caption, overview(found))
    if any(each.bands is not None and each.bands.bands for each in found.recordings):
        caption = (
            "How far each vibration is off in amplitude and phase: a column of one colour is off in every recording, a "
            "row of one colour is that recording's own."
        )
        yield _picture("symptom_bands", caption, bands(found))
    if has_free_motion(found):
        caption = (
            "Frequency and damping while nothing drives the arm: where the measured ones are not on the model's line, "
            "they are off; where they have another slope, they depend on amplitude as the model does not."
        )
        yield _picture("symptom_amplitude", caption, with_amplitude(found))
    if chosen(found):
        caption = (
            "What the model misses against position, velocity and direction, each without what the other two explain: "
            "a slope goes with the motion, a step in the middle changes with its direction."
        )
        yield _picture("symptom_profiles", caption, profiles(found))
    if any(each.lag is not None for each in found.recordings):
        caption = "Delay of each sensor against the model: dark marks off the zero line are two clocks that disagree."
        yield _picture("symptom_lag", caption, lags(found))
    if shown(found):
        caption = "The sensors at rest: a line above the dashed one is no noise, a slope is noise that is not white."
        yield _picture("symptom_quiet", caption, quiet(found))


def _picture(name: str, caption: str, figure: Figure) -> Picture:
    return Picture(name, caption, figure.texts[0].get_text().replace("\n", " ").replace(r"\$", "$"), png(figure))
