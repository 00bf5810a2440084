"""Numbers with their units, and names, as a sentence or a table has them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

UNKNOWN = "–"
MOST_NAMED = 3  # of a list in a sentence; the tables have all
_PERSONS = ("Coulomb", "Kelvin-Voigt", "Stribeck")
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
    # Reciprocals of stiffnesses in N m/rad, in which torsional springs and gears are quoted.
    "rad/(N m)": ((1.0, "rad/(N m)"), (1e-3, "mrad/(N m)"), (1e-6, "µrad/(N m)")),
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
        return _signed(f"{value:.{max(digits - 1 - exponent, 0)}f}")
    return _signed(f"{value / 10.0**exponent:.{digits - 1}f} × {_power(exponent)}")


def ratio(value: float) -> str:
    """Return a ratio, such as that of a residual to the noise, with two decimals, or three digits: `1.00`, `12.9`."""
    return f"{value:.2f}" if 0.095 <= value < 9.995 else number(value)


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
    if exponent == 0 or (exponent in _PLAIN_EXPONENTS and last >= -6):
        return _signed(between.join(f"{round(item, -last):.{max(-last, 0)}f}" for item in numbers))
    places, scale = max(exponent - last, 0), 10.0**exponent
    return _signed(f"({between.join(f'{item / scale:.{places}f}' for item in numbers)}) × {_power(exponent)}")


def _signed(text: str) -> str:
    """Return a number with a minus sign in place of the hyphen."""
    return text.replace("-", "\N{MINUS SIGN}")


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
    # The larger of the two says in what unit they read best.
    factor, name = everyday_unit(std if std is not None and abs(value) < std < math.inf else value, unit_name)
    text = number(value / factor, digits) if std is None else with_error(value / factor, std / factor)
    separator = "" if name.startswith("°") and "±" not in text and "×" not in text else " "
    return f"{text}{separator}{name}".rstrip()


def everyday_unit(value: float, unit_name: str) -> tuple[float, str]:
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


def listed(names: Sequence[str]) -> str:
    """Return names as in a sentence: `a, b and c`."""
    return ", ".join(names) if len(names) < 2 else f"{', '.join(names[:-1])} and {names[-1]}"


def counted(count: int, noun: str) -> str:
    """Return a number of things: `1 recording`, `2 recordings`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def in_sentence(title: str) -> str:
    """Return a title without its capital letter, unless a name or an abbreviation needs it: `Coulomb friction`."""
    first = title.partition(" ")[0]
    return title if first in _PERSONS or first[1:] != first[1:].lower() else title[:1].lower() + title[1:]


def capital(text: str) -> str:
    """Return a sentence's beginning with a capital letter."""
    return text[:1].upper() + text[1:]
