"""The tables of a diagnosis, as text; the command line prints the same ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vjm.chain.virtual_links import Chain
from vjm.identification.records import ModeComparison
from vjm.identification.uncertainty import Whiteness
from vjm.records import Estimate, RecordingComparison
from vjm.report.diagnosis_text import differences_text, named, place, probability, quantity, sizes_text
from vjm.report.text import (
    UNKNOWN,
    counted,
    interval,
    millimetres,
    nominal_value,
    number,
    unit,
    with_error,
)

if TYPE_CHECKING:
    from vjm.records import RecordingComparison
from vjm.diagnosis.records import Candidate, Diagnosis


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        caption: what it holds.
        headers: one for each column.
        rows: cells as text.
        words: number of columns, from the left, that hold words; the others hold numbers.
        notes: at the end of a row, a remark that needs room; empty where there is none.
    """

    caption: str
    headers: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: int = 1
    notes: tuple[str, ...] = ()


def parameter_table(estimates: Sequence[Estimate], nominal: Chain, beside: str = "nominal") -> Table:
    """Every parameter beside its nominal value (the paper's Table 1), with its standard error and 95 % interval.

    Args:
        estimates: the parameters.
        nominal: what they are compared with.
        beside: what to call that.
    """
    rows = []
    for estimate in estimates:
        value, std = estimate.value, estimate.std
        state = "no" if not estimate.identifiable else "yes" if std is not None else "fixed"
        relative = None if std is None or value == 0 else abs(100 * std / value)
        rows.append(
            (
                estimate.name,
                state,
                number(nominal_value(estimate.name, nominal), 4),
                with_error(value, std),
                interval(value, std),
                number(relative, 2),
                unit(estimate.unit),
            )
        )
    headers = (
        "parameter",
        "determined",
        beside,
        "identified ± standard error",
        "95 % interval",
        "error [%]",
        "unit",
    )
    return Table("Table 1. Parameters", headers, tuple(rows), words=2)


def remedy_table(estimates: Sequence[Estimate]) -> Table | None:
    """What the recordings do not determine, why, and which recording would; None where they determine everything."""
    missing = [each for each in estimates if not each.identifiable]
    rows = tuple((each.name, each.reason, each.remedy or UNKNOWN) for each in missing)
    headers = ("parameter", "why not", "what would determine it")
    return Table("What these recordings do not determine", headers, rows, words=3) if rows else None


def whiteness_table(whiteness: Sequence[Whiteness]) -> Table:
    """Whether what is left of each fitted recording is noise."""
    rows = tuple(
        (
            each.file,
            "no" if each.coloured else "yes",
            number(math.sqrt(each.chi2) if each.chi2 >= 0 else None, 3),
            number(each.correlation, 2),
        )
        for each in whiteness
    )
    headers = (
        "recording",
        "white noise",
        "residual / noise, all sensors",
        "largest correlation up to 10 samples later",
    )
    return Table("What the model leaves of the recordings it was fitted to", headers, rows, words=2)


def mode_table(modes: Sequence[ModeComparison]) -> Table:
    """Frequencies and damping ratios of the model beside the measured ones (the paper's Table 2)."""
    rows: list[tuple[str, ...]] = []
    for k, mode in enumerate(modes):
        measured = mode.frequency_measured
        difference = None if measured is None else 100 * (mode.frequency_model / measured - 1)
        rows.append(
            (
                f"mode {k + 1}",
                number(mode.frequency_model, 5),
                "not seen" if measured is None else with_error(measured, mode.frequency_std),
                UNKNOWN if difference is None else f"{difference:+.2f}".replace("-", "−"),
                number(100 * mode.damping_model, 3),
                "not seen" if mode.damping_measured is None else number(100 * mode.damping_measured, 3),
                UNKNOWN if mode.mac is None else f"{mode.mac:.4f}",
            )
        )
    frequency = ("model [Hz]", "measured [Hz]", "difference [%]")
    headers: tuple[str, ...] = ("", *frequency, "damping, model [%]", "damping, measured [%]", "shape, MAC")
    if all(mode.mac is None for mode in modes):
        headers, rows = headers[:-1], [row[:-1] for row in rows]
    return Table("Table 2. Natural frequencies and damping", headers, tuple(rows))


def recording_table(fits: Sequence[RecordingComparison], name: str = "identified") -> Table:
    """How closely each recording is followed, open loop over its whole length."""
    rows: list[tuple[str, ...]] = []
    notes = []
    for fit in fits:
        recording, replay, nominal, torque = fit.recording, fit.simulated, fit.reference, fit.alternative
        theta = None if replay is None or replay.theta_rms is None else 1e3 * replay.theta_rms
        rows.append(
            (
                recording.file,
                "held out" if recording.role == "holdout" else "train",
                recording.kind,
                millimetres(nominal.marker_rms if nominal else None),
                millimetres(torque.marker_rms if torque else None),
                millimetres(replay.marker_rms if replay else None),
                millimetres(fit.noise[0]),
                number(replay.marker_rms / fit.noise[0] if replay else None, 2),
                number(theta, 2),
            )
        )
        notes.append("; ".join(_remarks(fit)))
    headers: tuple[str, ...] = (
        "recording",
        "role",
        "kind",
        "nominal",
        "torque method",
        name,
        "noise",
        f"{name} / noise",
        "encoder [mrad]",
    )
    for column in ("encoder [mrad]", "torque method"):  # an arm without encoders, a fit by the torque method itself
        at = headers.index(column)
        if all(row[at] == UNKNOWN for row in rows):
            headers, rows = _without(headers, at), [_without(row, at) for row in rows]
    caption = "Fit per recording: RMS marker residual of an open-loop simulation"
    return Table(caption, headers, tuple(rows), words=3, notes=tuple(notes))


def _without(row: tuple[str, ...], at: int) -> tuple[str, ...]:
    return (*row[:at], *row[at + 1 :])


def _remarks(fit: RecordingComparison) -> list[str]:
    """What a reader of a recording's row should know."""
    if fit.simulated is None:
        return [f"not simulated: {fit.problem}"]
    found = []
    if fit.simulated.status != "converged":
        found.append("the search for the initial state has not converged: the residual may be too large")
    if fit.left_out:
        found.append(f"{counted(fit.left_out, 'marker coordinate')} left out")
    return found


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
                *(millimetres(_rms(each, name)) for name in ("reference", "alternative", "simulated")),
                millimetres(each.noise[0]),
                number(_ratio(each), 2),
            )
        )
    names = ("without", "next best", "with", "noise", "with / noise")
    headers: tuple[str, ...] = ("recording", "role", "kind", *names)
    if all(each.alternative is None for each in diagnosis.recordings):
        headers, rows = (*headers[:4], *headers[5:]), [(*row[:4], *row[5:]) for row in rows]
    if not diagnosis.causes:
        headers, rows = _without_diagnosis_tables(headers, "with"), [(*row[:4], *row[5:6]) for row in rows]
    caption = "Fit per recording: RMS marker residual of an open-loop simulation"
    return Table(caption, headers, tuple(rows), words=3)


def _without_diagnosis_tables(headers: tuple[str, ...], first: str) -> tuple[str, ...]:
    """Without the causes, the model is the one without: only it and the noise are left."""
    return (*headers[: headers.index(first)], "noise")


def _rms(each: RecordingComparison, name: str) -> float | None:
    replay = getattr(each, name)
    return None if replay is None else float(replay.marker_rms)


def _ratio(each: RecordingComparison) -> float | None:
    return None if each.simulated is None else each.simulated.marker_rms / each.noise[0]
