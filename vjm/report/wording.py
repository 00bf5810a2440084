"""Numbers and names as a person reads them."""

from __future__ import annotations

import math
from collections.abc import Sequence

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
