"""The tables of a diagnosis, as text; the command line prints the same ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from vjm.report.diagnosis_words import probability
from vjm.report.effect_words import differences_text, named, place, quantity, sizes_text
from vjm.report.tables import Table, unit
from vjm.report.wording import UNKNOWN, millimetres, number, with_error

if TYPE_CHECKING:
    from vjm.diagnosis.records import Candidate, Diagnosis, Replayed


def cause_table(diagnosis: Diagnosis) -> Table:
    """Every cause's parameters with their standard errors."""
    rows = []
    for cause in diagnosis.causes:
        for name, size in cause.parameters.items():
            value = f"{size.value:.6g}" if size.std is None else with_error(size.value, size.std)
            where = place(cause.effect, diagnosis.model) or "everywhere"
            everyday = UNKNOWN if size.std is None else quantity(size.value, size.std, size.unit)
            rows.append((named(cause.effect.id), where, name, value, unit(size.unit), everyday))
    headers = ("cause", "where", "parameter", "value ± standard error", "unit", "in everyday units")
    return Table("What was found", headers, tuple(rows), words=3)


def candidate_table(diagnosis: Diagnosis, most: int | None = None) -> Table:
    """Every effect that was looked for beside the model without any, those found first; of many, the first ones.

    Args:
        diagnosis: what was looked for.
        most: number of rows at most; None: all, those that cannot be tested among them.
    """
    found = {cause.effect.key for cause in diagnosis.causes}
    shown: Sequence[Candidate] = sorted(diagnosis.candidates, key=lambda each: each.effect.key not in found)
    if most is not None:
        shown = [each for each in shown if each.testable][:most]
    rows, notes = [], []
    for each in shown:
        verdict = "found" if each.effect.key in found else ""
        rows.append(
            (
                named(each.effect.id),
                place(each.effect, diagnosis.model) or "everywhere",
                verdict or ("" if each.testable else "not testable"),
                number(each.z, 3),
                probability(each.p_value) if each.testable else UNKNOWN,
                sizes_text(each.effect, each.sizes),
                differences_text(each.effect, each.smallest_detectable),
            )
        )
        notes.append(each.reason)
    headers = ("candidate", "where", "", "z", "p, whole search", "size, by itself", "smallest that would be seen")
    caption = "What was looked for: each candidate by itself, linearised, beside the model without any"
    return Table(caption, headers, tuple(rows), words=3, notes=tuple(notes))


def followed_table(diagnosis: Diagnosis) -> Table:
    """How closely each recording is followed without and with the causes, and with the next best explanation."""
    rows: list[tuple[str, ...]] = []
    for each in diagnosis.recordings:
        rows.append(
            (
                each.recording.file,
                "held out" if each.recording.role == "holdout" else "train",
                each.recording.kind,
                *(millimetres(_rms(each, name)) for name in ("before", "runner_up", "after")),
                millimetres(each.noise),
                number(_ratio(each), 2),
            )
        )
    names = ("without", "next best", "with", "noise", "with / noise")
    headers: tuple[str, ...] = ("recording", "role", "kind", *names)
    if all(each.runner_up is None for each in diagnosis.recordings):
        headers, rows = (*headers[:4], *headers[5:]), [(*row[:4], *row[5:]) for row in rows]
    if not diagnosis.causes:
        headers, rows = _without(headers, "with"), [(*row[:4], *row[5:6]) for row in rows]
    caption = "Fit per recording: RMS marker residual of an open-loop simulation"
    return Table(caption, headers, tuple(rows), words=3)


def _without(headers: tuple[str, ...], first: str) -> tuple[str, ...]:
    """Without the causes, the model is the one without: only it and the noise are left."""
    return (*headers[: headers.index(first)], "noise")


def _rms(each: Replayed, name: str) -> float | None:
    replay = getattr(each, name)
    return None if replay is None else float(replay.marker_rms)


def _ratio(each: Replayed) -> float | None:
    return None if each.after is None else each.after.marker_rms / each.noise
