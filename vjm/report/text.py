"""Numbers with units, and effects, in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from vjm.effects.effect import Effect
from vjm.records import Estimate, Recording
from vjm.simulation.model import Model

UNKNOWN = "–"
MOST_NAMED = 3  # of a list in a sentence; the tables have all
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_PLAIN_EXPONENTS = range(-3, 5)  # decimal exponents written without a power of ten

# Everyday units, the largest first; each is used from a tenth of it on.
_UNITS: Mapping[str, tuple[tuple[float, str], ...]] = {
    "kg": ((1.0, "kg"), (1e-3, "g")),
    "N": ((1.0, "N"), (1e-3, "mN")),
    "N m": ((1.0, "N m"), (1e-3, "mN m")),
    "N m s/rad": ((1.0, "N m s/rad"), (1e-3, "mN m s/rad")),
    "s": ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")),
    "s/m": ((1.0, "s/m"), (1e-3, "ms/m")),
    "m": ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm")),
    "rad": ((math.pi / 180, "°"),),
    "rad/(N m)": ((math.pi / 180, "°/(N m)"),),
    "1/s": ((1e-2, "%/s"),),
}


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits; a dash for what is not known."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    if value == 0:
        return "0"
    exponent = _exponent(value, digits)
    if exponent in _PLAIN_EXPONENTS:
        return f"{value:.{max(digits - 1 - exponent, 0)}f}"
    return f"{value / 10.0**exponent:.{digits - 1}f} × {_power(exponent)}"


def with_error(value: float, std: float | None) -> str:
    """Return a number with its standard error and as many digits as that leaves certain: `(3.07 ± 0.31) × 10⁻⁴`."""
    if std is None or not math.isfinite(std) or std <= 0 or not math.isfinite(value):
        return number(value, 4)
    return _joined((value, std), " ± ", value, std)


def interval(value: float, std: float | None) -> str:
    """Return the 95 % interval of a quantity that cannot be negative: `1.966 … 1.981`; a dash without an error."""
    if std is None or not math.isfinite(std) or std <= 0 or not math.isfinite(value):
        return UNKNOWN
    half = 1.96 * std  # two-sided 95 % of a normal distribution
    return _joined((max(value - half, 0.0), value + half), " … ", value, std)


def _joined(numbers: Sequence[float], between: str, value: float, std: float) -> str:
    """Join numbers with as many digits as the standard error of a value leaves certain, under one power of ten."""
    last = _exponent(std, 2) - 1  # the error's second digit
    exponent = max(_exponent(value, 6), _exponent(std, 2)) if value else _exponent(std, 2)
    if exponent in _PLAIN_EXPONENTS and last >= -6:
        return between.join(f"{round(item, -last):.{max(-last, 0)}f}" for item in numbers)
    places, scale = max(exponent - last, 0), 10.0**exponent
    return f"({between.join(f'{item / scale:.{places}f}' for item in numbers)}) × {_power(exponent)}"


def _exponent(value: float, digits: int) -> int:
    """Return the decimal exponent of a value as it will be printed."""
    return 0 if value == 0 else int(f"{value:.{digits - 1}e}".split("e")[1])


def _power(exponent: int) -> str:
    return "10" + str(exponent).translate(_SUPERSCRIPTS)


def millimetres(value: float | None) -> str:
    """Return a length [m] in mm (below 0.0095 mm in µm) with two significant digits, or in whole millimetres."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    scaled = value * 1e3
    if 0 < abs(scaled) < 0.0095:
        return f"{number(scaled * 1e3, 2)}\N{NO-BREAK SPACE}µm"
    return f"{number(scaled, 2) if abs(scaled) < 99.5 else f'{scaled:.0f}'}\N{NO-BREAK SPACE}mm"


def unit(text: str) -> str:
    """Return a unit with raised exponents."""
    return text.replace("^2", "²").replace("^3", "³")


def quantity(value: float, std: float | None, unit_name: str, digits: int = 2) -> str:
    """Return a value with its standard error, if it has one, in an everyday unit: `13.30 ± 0.10 g`."""
    if not math.isfinite(value):
        return UNKNOWN
    factor, name = _everyday(value, unit_name)
    text = number(value / factor, digits) if std is None else with_error(value / factor, std / factor)
    between = "" if name.startswith("°") and "±" not in text and "×" not in text else " "
    return f"{text}{between}{name}".rstrip()


def _everyday(value: float, unit_name: str) -> tuple[float, str]:
    """Return the everyday unit in which a value reads best: in SI units, and its name."""
    scales = _UNITS.get(unit_name, ((1.0, unit(unit_name)),))
    return next((scale for scale in scales if abs(value) >= 0.1 * scale[0]), scales[-1])


def short(text: str, most: int = 36) -> str:
    """Return a name that fits: without its middle, line breaks and control characters."""
    clean = "".join(character if character.isprintable() else " " for character in text)
    if len(clean) <= most:
        return clean
    tail = most // 3
    return f"{clean[: most - tail - 1]}…{clean[-tail:]}"


def recording_label(recording: Recording, most: int = 36) -> str:
    """Return a recording's file name, shortened to so many characters, with its role."""
    return f"{short(recording.file, most)} ({'held out' if recording.role == 'holdout' else 'train'})"


def listed(names: Sequence[str]) -> str:
    """Return names as in a sentence: `a, b and c`."""
    return ", ".join(names) if len(names) < 2 else f"{', '.join(names[:-1])} and {names[-1]}"


def counted(count: int, noun: str) -> str:
    """Return a number of things: `1 recording`, `2 recordings`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def capital(text: str) -> str:
    """Return a sentence's beginning with a capital letter."""
    return text[:1].upper() + text[1:]


def named(identifier: str) -> str:
    """Return an effect's id as words: `Tip payload`."""
    return capital(identifier.replace("_", " "))


def place(effect: Effect, model: Model) -> str:
    """Return the name of the link, or of the joint at its proximal end, where an effect acts; empty if camera-wide."""
    return "" if effect.link is None else model.chain.links[effect.link].name


def clause(effect: Effect, model: Model, sizes: Mapping[str, Estimate] | None = None) -> str:
    """Return an effect with its numbers, as in "the data need: ...": `sizes` with errors, or else its own values."""
    texts = {}
    for parameter in effect.parameters:
        value, size = effect.values[parameter.name], (sizes or {}).get(parameter.name)
        if parameter.integer:
            texts[parameter.name] = str(int(value))
        elif size is None:
            texts[parameter.name] = quantity(value, None, parameter.unit, 3)
        else:
            texts[parameter.name] = quantity(size.value, size.std, size.unit, 4)
    if effect.clause:
        return effect.clause.format(link=place(effect, model) or model.chain.links[0].name, **texts)
    values = ", ".join(f"{name} {text}" for name, text in texts.items())
    where = f" ({place(effect, model)})" if effect.link is not None else ""
    return f"{effect.description or effect.id}{where}{': ' if values else ''}{values}"


def sizes_text(effect: Effect, sizes: Mapping[str, float], from_null: bool = False) -> str:
    """Return sizes of an effect's parameters, without errors: `13 g`, or `gx 0.10, gy 0.02 m/s²`.

    A dimensionless parameter whose null is not zero, such as a scale, is told by the difference: `+0.04 %`, or
    `off by 0.04 %` where `sizes` are themselves differences `from_null`.
    """
    for parameter in effect.parameters:
        scale = bool(parameter.null) and math.isfinite(parameter.null) and not parameter.unit
        if scale and list(sizes) == [parameter.name]:
            size = sizes[parameter.name]
            if from_null:
                return f"off by {number(100 * size, 2)} %"
            if math.isfinite(size):
                return f"{'+' if size >= parameter.null else '-'}{number(100 * abs(size - parameter.null), 2)} %"
    return _together(effect, sizes)


def _together(effect: Effect, sizes: Mapping[str, float]) -> str:
    """Return values by name; those of one unit share it: `along 4.0, across -6.0 mm`."""
    units = {parameter.name: parameter.unit for parameter in effect.parameters}
    if len(sizes) > 1 and len({units.get(name, "") for name in sizes}) == 1 and np.isfinite([*sizes.values()]).all():
        largest = max(abs(value) for value in sizes.values())
        factor, name = _everyday(largest, units.get(next(iter(sizes)), ""))
        last = max(1 - math.floor(math.log10(largest / factor)), 0) if largest > 0 else 0
        values = (f"{own} {round(value / factor, last) + 0.0:.{last}f}" for own, value in sizes.items())
        return f"{', '.join(values)} {name}".rstrip()
    texts = [(name, quantity(value, None, units.get(name, ""))) for name, value in sizes.items()]
    return texts[0][1] if len(texts) == 1 else ", ".join(f"{name} {text}" for name, text in texts) or UNKNOWN
