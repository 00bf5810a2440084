"""The pictures of a diagnosis, drawn, named and captioned."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.experiment.records import REFERENCE
from vjm.report.abscissae import most_improved
from vjm.report.choose import tip_signal
from vjm.report.effect_words import named
from vjm.report.figures.diagnosis_evidence import evidence
from vjm.report.figures.diagnosis_gain import before_and_after, gain_of_recordings
from vjm.report.figures.pictures import Picture
from vjm.report.figures.style import png
from vjm.report.figures.symptoms import symptom_pictures
from vjm.report.wording import short

if TYPE_CHECKING:
    from vjm.diagnosis.records import Cause, Diagnosis, Replayed

_MOST_CAUSES = 4
_MOST_HELD_OUT = 3
# Every file name that these pictures may have.
NAMES = (
    *(f"cause_{k + 1}" for k in range(_MOST_CAUSES)),
    "gain",
    *(f"held_out_{k + 1}" for k in range(_MOST_HELD_OUT)),
)


def diagnosis_pictures(diagnosis: Diagnosis) -> list[Picture]:
    """All figures of a diagnosis: what is wrong, the evidence, what is gained."""
    wrong = [] if diagnosis.symptoms is None else symptom_pictures(diagnosis.symptoms)
    return [*wrong, *_causes(diagnosis), *_gained(diagnosis)]


def _causes(diagnosis: Diagnosis) -> Iterator[Picture]:
    for k, cause in enumerate(diagnosis.causes[:_MOST_CAUSES]):
        shown = _without(cause, diagnosis)
        if not shown:
            continue
        beside = "the same model without this cause" if len(diagnosis.causes) > 1 else "the model fitted without it"
        caption = (
            f"{named(cause.effect.id)}, in the recording where the causes gain most, beside {beside}. Left: what the "
            "models miss, against what makes this cause plain. Right: what was missing against what the cause adds; on "
            "the dashed line the two are the same."
        )
        yield _picture(f"cause_{k + 1}", caption, evidence(cause, diagnosis, shown))


def _without(cause: Cause, diagnosis: Diagnosis) -> list[Replayed]:
    """Recordings followed without this cause but with the others, the one in which all causes gain most first."""
    first = most_improved(diagnosis)
    if first is None:
        return []
    if len(diagnosis.causes) == 1:
        return [first, *(each for each in diagnosis.recordings if each is not first)]
    others = tuple(each.effect for each in diagnosis.causes if each is not cause)
    try:
        before = replace(diagnosis.model, effects=others).replay(first.recording)
    except (InsufficientDataError, SimulationDivergedError):
        return [first]
    return [replace(first, before=before)]


def _gained(diagnosis: Diagnosis) -> Iterator[Picture]:
    if any(each.before is not None for each in diagnosis.recordings):
        caption = "Open-loop simulation of each whole recording; a model that misses nothing lies on the noise mark."
        yield _picture("gain", caption, gain_of_recordings(diagnosis))
    if not diagnosis.causes:
        return
    for k, each in enumerate(_held_out(diagnosis)):
        caption = f"Tip marker in {short(each.recording.file)}: measured, and as simulated before and after."
        yield _picture(f"held_out_{k + 1}", caption, before_and_after(each, diagnosis))


def _held_out(diagnosis: Diagnosis) -> list[Replayed]:
    """Held-out recordings, the one that gains most first; a training one where none is held out."""
    rig = diagnosis.model.rig
    usable = [
        each
        for each in diagnosis.recordings
        if each.before is not None
        and each.after is not None
        and each.recording.kind != "quiet"
        and tip_signal(rig, each.recording) is not None
    ]
    usable.sort(key=lambda each: -each.before.marker_rms if each.before else 0.0)
    held_out = [each for each in usable if each.recording.role == "holdout"]
    changed = [each for each in held_out if each.recording.condition != REFERENCE]
    return (changed or held_out)[:_MOST_HELD_OUT] or usable[:1]


def _picture(name: str, caption: str, figure: Figure) -> Picture:
    return Picture(name, caption, figure.texts[0].get_text().replace("\n", " ").replace(r"\$", "$"), png(figure))
