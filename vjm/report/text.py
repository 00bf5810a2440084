"""What was found, in sentences: the first thing a user reads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vjm.chain.virtual_links import Chain, LinkChain
from vjm.identification.comparison import Comparison
from vjm.identification.records import Identification, TrajectorySummary
from vjm.records import RecordingComparison
from vjm.report.result_json import bending_stiffness
from vjm.simulation.model import Model

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_PLAIN_RANGE = range(-3, 5)  # decimal exponents written without a power of ten
_LEAST_MILLIMETRES = 0.0095
_TWO_SIDED_95 = 1.96  # standard errors
UNKNOWN = "–"


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many significant digits; a dash for what is not known."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    if value == 0:
        return "0"
    exponent = _exponent(value, digits)
    if exponent in _PLAIN_RANGE:
        return f"{value:.{max(digits - 1 - exponent, 0)}f}"
    return f"{value / 10.0**exponent:.{digits - 1}f} × {_power(exponent)}"


def with_error(value: float, std: float | None) -> str:
    """A number with its standard error, as many digits as the error leaves certain: `(3.07 ± 0.31) × 10⁻⁴`."""
    if std is None or not math.isfinite(std) or std <= 0 or not math.isfinite(value):
        return number(value, 4)
    return _joined((value, std), " ± ", value, std)


def interval(value: float, std: float | None) -> str:
    """The 95 % interval of a quantity that cannot be negative: `1.966 … 1.981`; a dash where no error is known."""
    if std is None or not math.isfinite(std) or std <= 0 or not math.isfinite(value):
        return UNKNOWN
    return _joined((max(value - _TWO_SIDED_95 * std, 0.0), value + _TWO_SIDED_95 * std), " … ", value, std)


def _joined(numbers: Sequence[float], between: str, value: float, std: float) -> str:
    """Numbers with as many digits as the standard error of a value leaves certain, all with the same power of ten."""
    last = _exponent(std, 2) - 1  # the error's second digit
    exponent = max(_exponent(value, 6), _exponent(std, 2)) if value else _exponent(std, 2)
    if exponent in _PLAIN_RANGE and last >= -6:
        return between.join(f"{round(each, -last):.{max(-last, 0)}f}" for each in numbers)
    places, scale = max(exponent - last, 0), 10.0**exponent
    return f"({between.join(f'{each / scale:.{places}f}' for each in numbers)}) × {_power(exponent)}"


def _exponent(value: float, digits: int) -> int:
    """Decimal exponent of the value as it will be printed."""
    if value == 0:
        return 0
    return int(f"{value:.{digits - 1}e}".split("e")[1])


def _power(exponent: int) -> str:
    return "10" + str(exponent).translate(_SUPERSCRIPTS)


def millimetres(value: float | None) -> str:
    """A length [m] as text in mm (small ones in µm), two significant digits or whole millimetres."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    scaled = value * 1e3
    if 0 < abs(scaled) < _LEAST_MILLIMETRES:
        return f"{number(scaled * 1e3, 2)}\N{NO-BREAK SPACE}µm"
    return f"{number(scaled, 2) if abs(scaled) < 99.5 else f'{scaled:.0f}'}\N{NO-BREAK SPACE}mm"


def short(text: str, most: int = 36) -> str:
    """A name that fits: its middle gives way, and line breaks and control characters with it."""
    clean = "".join(character if character.isprintable() else " " for character in text)
    if len(clean) <= most:
        return clean
    tail = most // 3
    return f"{clean[: most - tail - 1]}…{clean[-tail:]}"


def listed(names: Sequence[str]) -> str:
    """Names in a sentence: `a, b and c`."""
    return ", ".join(names) if len(names) < 2 else f"{', '.join(names[:-1])} and {names[-1]}"


def counted(count: int, noun: str) -> str:
    """`1 recording`, `2 recordings`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


Grade = Literal["good", "fair", "poor"]
_AT_NOISE, _NEAR_NOISE = 1.1, 1.5  # residual over noise
_MOST_NAMED = 3


@dataclass(frozen=True)
class Verdict:
    """A finding.

    Attributes:
        headline: one sentence.
        grade: `good`: as close as the noise allows; `fair`: something small is missing; `poor`: do not trust it yet.
        points: what supports it.
    """

    headline: str
    grade: Grade
    points: tuple[str, ...]


def identification_verdict(fit: Identification) -> Verdict:
    """What an identification found, and how far it can be trusted."""
    headline, grade = _how_close(fit.recordings, "identified")
    if fit.status != "converged":
        headline, grade = f"The search has not converged: {fit.remedy or 'do not use this model'}.", "poor"
    points = [*_closeness(fit.recordings), *_stiffnesses(fit), *_undetermined(fit), *_unsimulated(fit.recordings)]
    return Verdict(headline, grade, tuple(points))


def comparison_verdict(comparison: Comparison) -> Verdict:
    """How well a given model follows the recordings."""
    headline, grade = _how_close(comparison.recordings, "given")
    points = [*_closeness(comparison.recordings), *_unsimulated(comparison.recordings)]
    return Verdict(headline, grade, tuple(points))


def _ratio(fit: RecordingComparison) -> float:
    return 0.0 if fit.simulated is None else fit.simulated.marker_rms / fit.noise[0]


def _how_close(fits: Sequence[RecordingComparison], name: str) -> tuple[str, Grade]:
    """One sentence on the worst held-out recording; on the training ones where none was held out."""
    replayed = [fit for fit in fits if fit.simulated is not None]
    held_out = [fit for fit in replayed if fit.recording.role == "holdout"]
    if not replayed:
        return "No recording could be simulated.", "poor"
    worst = max(_ratio(fit) for fit in held_out or replayed)
    ending = "" if held_out else " No recording was held out: how it predicts is not tested."
    what = "predicts every held-out recording" if held_out else "follows every training recording"
    if len(held_out) == 1:
        what = f"predicts the held-out recording {short(held_out[0].recording.file)}"
    if worst <= _AT_NOISE:
        return f"The {name} model {what} to within the camera's noise.{ending}", "good" if held_out else "fair"
    if worst <= _NEAR_NOISE:
        return f"The {name} model {what} to {number(worst, 2)} times the camera's noise.{ending}", "fair"
    what = "held-out" if held_out else "training"
    missed = f"misses {what} recordings by up to {number(worst, 2)} times the camera's noise"
    return f"The {name} model {missed}: something is missing from it.{ending}", "poor"


def _closeness(fits: Sequence[RecordingComparison]) -> list[str]:
    """The worst of the held-out recordings, in millimetres; then of the others."""
    points = []
    for role, words in (("holdout", "held out"), ("train", "train")):
        group = [fit for fit in fits if fit.simulated is not None and fit.recording.role == role]
        for fit in sorted(group, key=_ratio, reverse=True)[: _MOST_NAMED if role == "holdout" else 1]:
            points.append(_one_recording(fit, words if len(group) == 1 or role == "holdout" else f"worst of {words}"))
    return points


def _one_recording(fit: RecordingComparison, words: str) -> str:
    seconds = float(fit.recording.time[-1] - fit.recording.time[0])
    rms = millimetres(fit.simulated.marker_rms if fit.simulated else None)
    text = (
        f"{short(fit.recording.file)} ({words}): {rms} RMS "
        f"over its whole {number(seconds, 2)}\N{NO-BREAK SPACE}s, open loop"
    )
    if fit.alternative is not None:
        others = [("torque method", fit.alternative), ("nominal values", fit.reference)]
        named = [f"{words}: {millimetres(each.marker_rms)}" for words, each in others if each is not None]
        text += f" ({', '.join(named)})"
    elif fit.reference is not None:
        text += f"; {millimetres(fit.reference.marker_rms)} with nominal values"
    return f"{text}; the camera's noise is {millimetres(fit.noise[0])}."


def _stiffnesses(fit: Identification) -> list[str]:
    points = []
    for link in fit.model.chain.links:
        value, std = bending_stiffness(link, fit.parameters, fit.covariance)
        text = f"{link.name}: bending stiffness {with_error(value, std)} {unit('N m^2')}"
        before = nominal_value(f"{link.name}.bending_stiffness", fit.nominal.chain)
        if before:
            change = 100 * (value / before - 1)
            text += f", {abs(change):.1f} % {'above' if change > 0 else 'below'} nominal"
        points.append(f"{text}; {counted(link.virtual_joints, 'virtual joint')}.")
    return points


def _undetermined(fit: Identification) -> list[str]:
    missing = [estimate for estimate in fit.parameters if not estimate.identifiable]
    if not missing:
        return []
    if len(missing) <= _MOST_NAMED:
        return [
            f"Not determined by these recordings: {each.name} ({each.reason})"
            + (f"; it takes {each.remedy}." if each.remedy else ".")
            for each in missing
        ]
    names = listed([each.name for each in missing[:_MOST_NAMED]])
    return [f"{len(missing)} of {len(fit.parameters)} parameters are not determined by these recordings: {names} …"]


def _unsimulated(fits: Sequence[RecordingComparison]) -> list[str]:
    missing = [fit for fit in fits if fit.simulated is None]
    shown = [f"{short(fit.recording.file)} ({fit.problem})" for fit in missing[:_MOST_NAMED]]
    return [f"Not simulated: {listed(shown)}."] if missing else []


def settings(fit: Identification) -> list[tuple[str, str]]:
    """How the identification was made: term and description."""
    rows = [
        ("Method", f"{fit.method}, parameters {fit.parametrisation}; {fit.status}"),
        ("Virtual joints", listed([f"{link.name}: {link.virtual_joints}" for link in fit.model.chain.links])),
        ("Marker noise", f"{millimetres(fit.model.marker_noise)} ({_source(fit.experiment.rig.marker_noise)})"),
        *_encoder(fit.model),
        *_trajectories(fit.trajectory),
    ]
    if fit.objective is not None:
        before, after = number(fit.objective_nominal, 4), number(fit.objective, 4)
        rows.append(("J, eq. (15)", f"nominal model {before}, identified {after}"))
    for k, link in enumerate(fit.model.rig.links):
        shapes = [data.angles.shapes[k] for data in fit.torque_data[:1]]
        rows += [(f"Shape functions, {link.name}", f"{shape.family}, order {shape.order}") for shape in shapes]
    for data in fit.torque_data:
        frames, lost = data.angles.time.size, data.angles.unsolved
        smoothing = data.derivatives.smoothing
        how = "interpolated" if smoothing is None else f"smoothing spline, penalty 10^{smoothing:.1f}"
        text = f"{frames} frames, {lost} without a solution; {how}"
        rows.append((f"Used from {data.recording.file}", text))
        noise = data.derivatives.noise(np.sqrt(np.diag(data.angles.covariance))).max(axis=1)
        values = f"{number(1e3 * noise[0], 2)} mrad, {number(noise[1], 2)} rad/s, {number(noise[2], 2)} rad/s²"
        rows.append((f"Noise in {data.recording.file}", f"angle, rate and acceleration of the worst joint: {values}"))
    return rows


def _trajectories(summary: TrajectorySummary | None) -> list[tuple[str, str]]:
    if summary is None:
        return []
    mean = number(summary.chi2_per_sample, 4)
    text = f"mean square residual {mean} times the noise's, over {summary.fit.point.count} measured values"
    searched = f"{counted(summary.fit.iterations, 'simulation')} of all recordings"
    return [("Trajectories", f"{text}; {searched} in the last search")]


def _encoder(model: Model) -> list[tuple[str, str]]:
    if not model.rig.active_links:
        return []
    noise = f"{number(1e3 * model.encoder_noise, 2)} mrad ({_source(model.rig.encoder_noise)})"
    return [("Encoder noise", noise)]


def _source(given: float | None) -> str:
    return "estimated from the recordings" if given is None else "from the experiment file"


_ARRAYS = {
    "stiffness": ("stiffness", 1),
    "damping": ("damping", 1),
    "length": ("lengths", 0),
    "mass": ("masses", 0),
    "mass_center": ("mass_centers", 0),
    "inertia": ("inertias", 0),
}  # quantity: field of a LinkChain, and the number of its first element


def unit(text: str) -> str:
    """A unit with raised exponents."""
    return text.replace("^2", "²").replace("^3", "³")


def nominal_value(name: str, nominal: Chain) -> float | None:
    """What an estimate's parameter is in a chain; None for a name the chain knows nothing of."""
    link_name, _, quantity = name.partition(".")
    link = next((each for each in nominal.links if each.name == link_name), None)
    if link is None:
        return None
    if quantity == "bending_stiffness":
        return link.bending_stiffness
    if quantity == "kelvin_voigt_time":
        return link.kelvin_voigt_time
    if quantity == "hub_inertia":
        return link.hub_inertia
    return _element(quantity, link)


def _element(quantity: str, link: LinkChain) -> float | None:
    kind, _, text = quantity.rpartition("_")
    if kind not in _ARRAYS or not text.isdecimal():
        return None
    field, first = _ARRAYS[kind]
    values, at = getattr(link, field), int(text) - first
    return float(values[at]) if 0 <= at < values.size else None
