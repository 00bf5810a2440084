"""Results as tables of text, for the report, the terminal and notebooks alike."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from vjm.chain.virtual_links import Chain
from vjm.diagnosis.records import Diagnosis
from vjm.identification.records import ModeComparison, Whiteness
from vjm.records import Estimate, RecordingComparison
from vjm.report.text import (
    UNKNOWN,
    counted,
    interval,
    millimetres,
    named,
    number,
    place,
    probability,
    quantity,
    sizes_text,
    unit,
    with_error,
)

_LINK_FIELDS = {
    "stiffness": ("stiffness", 1),
    "damping": ("damping", 1),
    "length": ("lengths", 0),
    "mass": ("masses", 0),
    "mass_center": ("mass_centers", 0),
    "inertia": ("inertias", 0),
}  # quantity of a parameter: field of a LinkChain, and the number of its first element


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

    def without_empty(self, *columns: str) -> Table:
        """Return the table without those of the named columns that hold nothing but dashes."""
        empty = {k for k, name in enumerate(self.headers) if all(row[k] == UNKNOWN for row in self.rows)}
        kept = [k for k, name in enumerate(self.headers) if k not in empty or name not in columns]
        rows = tuple(tuple(row[k] for k in kept) for row in self.rows)
        return Table(self.caption, tuple(self.headers[k] for k in kept), rows, self.words, self.notes)


def parameter_table(estimates: Sequence[Estimate], nominal: Chain, beside: str = "nominal") -> Table:
    """Return every parameter beside its nominal value (the paper's Table 1), with standard error and 95 % interval.

    Args:
        estimates: the parameters.
        nominal: the chain they are compared with.
        beside: name of that chain.
    """
    rows = []
    for estimate in estimates:
        value, std = estimate.value, estimate.std
        state = "no" if not estimate.identifiable else "yes" if std is not None else "fixed"
        relative = None if std is None or value == 0 else abs(100 * std / value)
        compared = number(_nominal_value(estimate.name, nominal), 4)
        uncertain = with_error(value, std), interval(value, std), number(relative, 2)
        rows.append((estimate.name, state, compared, *uncertain, unit(estimate.unit)))
    uncertain_headers = ("identified ± standard error", "95 % interval", "error [%]")
    headers = ("parameter", "determined", beside, *uncertain_headers, "unit")
    return Table("Table 1. Parameters", headers, tuple(rows), words=2)


def _nominal_value(name: str, chain: Chain) -> float | None:
    """Return the value that an estimate's parameter has in a chain; None for a name that the chain does not know."""
    link_name, _, text = name.partition(".")
    for link in chain.links:
        if link.name == link_name and text in ("bending_stiffness", "kelvin_voigt_time", "hub_inertia"):
            return float(getattr(link, text))
        kind, _, index = text.rpartition("_")
        if link.name == link_name and kind in _LINK_FIELDS and index.isdecimal():
            field, first = _LINK_FIELDS[kind]
            values, at = getattr(link, field), int(index) - first
            return float(values[at]) if 0 <= at < values.size else None
    return None


def remedy_table(estimates: Sequence[Estimate]) -> Table | None:
    """Return the parameters that the recordings do not determine, why, and which recording would; None if all are."""
    missing = [estimate for estimate in estimates if not estimate.identifiable]
    rows = tuple((estimate.name, estimate.reason, estimate.remedy or UNKNOWN) for estimate in missing)
    headers = ("parameter", "reason", "recording that would determine it")
    return Table("Parameters that these recordings do not determine", headers, rows, words=3) if rows else None


def whiteness_table(whiteness: Sequence[Whiteness]) -> Table:
    """Return for each fitted recording whether its residual is white noise."""
    rows = []
    for item in whiteness:
        rms = math.sqrt(item.chi2) if item.chi2 >= 0 else None
        rows.append((item.file, "no" if item.coloured else "yes", number(rms, 3), number(item.correlation, 2)))
    headers = ("recording", "white", "residual / noise, all sensors", "largest correlation up to 10 samples later")
    return Table("Residuals of the recordings that the model was fitted to", headers, tuple(rows), words=2)


def mode_table(modes: Sequence[ModeComparison]) -> Table:
    """Return frequencies and damping ratios of the model beside the measured ones (the paper's Table 2)."""
    rows = []
    for k, mode in enumerate(modes):
        measured, damping = mode.frequency_measured, mode.damping_measured
        difference = None if measured is None else 100 * (mode.frequency_model / measured - 1)
        row = (
            f"mode {k + 1}",
            number(mode.frequency_model, 5),
            "not seen" if measured is None else with_error(measured, mode.frequency_std),
            UNKNOWN if difference is None else f"{difference:+.2f}".replace("-", "−"),
            number(100 * mode.damping_model, 3),
            "not seen" if damping is None else number(100 * damping, 3),
            UNKNOWN if mode.mac is None else f"{mode.mac:.4f}",
        )
        rows.append(row)
    frequency = ("model [Hz]", "measured [Hz]", "difference [%]")
    headers = ("", *frequency, "damping, model [%]", "damping, measured [%]", "shape, MAC")
    return Table("Table 2. Natural frequencies and damping", headers, tuple(rows)).without_empty("shape, MAC")


def recording_table(
    comparisons: Sequence[RecordingComparison], model: str, reference: str, alternative: str = "alternative"
) -> Table:
    """Return how closely each recording is followed, open loop over its whole length.

    Args:
        comparisons: the recordings beside their simulations.
        model, reference, alternative: names of the columns of `simulated`, `reference` and `alternative`.
    """
    rows, notes = [], []
    for item in comparisons:
        recording, simulated, noise = item.recording, item.simulated, item.noise[0]
        theta = None if simulated is None or simulated.theta_rms is None else 1e3 * simulated.theta_rms
        row = (
            recording.file,
            "held out" if recording.role == "holdout" else "train",
            recording.kind,
            *(millimetres(each.marker_rms if each else None) for each in (item.reference, item.alternative, simulated)),
            millimetres(noise),
            number(simulated.marker_rms / noise if simulated else None, 2),
            number(theta, 2),
        )
        rows.append(row)
        remarks = [f"not simulated: {item.problem}"] if simulated is None else []
        if simulated is not None and simulated.status != "converged":
            remarks.append("the search for the initial state has not converged: the residual may be too large")
        if simulated is not None and item.left_out:
            remarks.append(f"{counted(item.left_out, 'marker coordinate')} left out")
        notes.append("; ".join(remarks))
    numbers = (reference, alternative, model, "noise", f"{model} / noise", "encoder [mrad]")
    caption = "Fit per recording: RMS marker residual of an open-loop simulation"
    table = Table(caption, ("recording", "role", "kind", *numbers), tuple(rows), words=3, notes=tuple(notes))
    return table.without_empty(reference, alternative, "encoder [mrad]")


def cause_table(diagnosis: Diagnosis) -> Table:
    """Return every cause's parameters with their standard errors."""
    rows = []
    for cause in diagnosis.causes:
        where = place(cause.effect, diagnosis.model) or "everywhere"
        for name, size in cause.parameters.items():
            value = f"{size.value:.6g}" if size.std is None else with_error(size.value, size.std)
            everyday = UNKNOWN if size.std is None else quantity(size.value, size.std, size.unit)
            rows.append((named(cause.effect.id), where, name, value, unit(size.unit), everyday))
    headers = ("cause", "where", "parameter", "value ± standard error", "unit", "in everyday units")
    return Table("Causes", headers, tuple(rows), words=3)


def candidate_table(diagnosis: Diagnosis, most: int | None = None) -> Table:
    """Return every candidate as judged beside the model without effects, causes first.

    Args:
        diagnosis: the causes and candidates.
        most: number of rows at most; None: all, those that cannot be tested among them.
    """
    causes = {cause.effect.key for cause in diagnosis.causes}
    shown = sorted(diagnosis.candidates, key=lambda candidate: candidate.effect.key not in causes)
    if most is not None:
        shown = [candidate for candidate in shown if candidate.testable][:most]
    rows = []
    for candidate in shown:
        effect = candidate.effect
        row = (
            named(effect.id),
            place(effect, diagnosis.model) or "everywhere",
            "found" if effect.key in causes else "" if candidate.testable else "not testable",
            number(candidate.z, 3),
            probability(candidate.p_value) if candidate.testable else UNKNOWN,
            sizes_text(effect, candidate.sizes),
            sizes_text(effect, candidate.smallest_detectable, from_null=True),
        )
        rows.append(row)
    headers = ("candidate", "where", "", "z", "p, whole search", "size, by itself", "smallest detectable")
    caption = "Candidates, each by itself beside the model without effects (linearised)"
    return Table(caption, headers, tuple(rows), words=3, notes=tuple(candidate.reason for candidate in shown))
