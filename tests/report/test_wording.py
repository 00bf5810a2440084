"""Numbers must come back from their text, to the digits shown."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vjm.text import in_sentence, interval, listed, millimetres, number, short, with_error

_EXPONENT = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


def parsed(text: str) -> float:
    mantissa, _, power = text.replace("\N{MINUS SIGN}", "-").partition(" × 10")
    return float(mantissa) * 10.0 ** int(power.translate(_EXPONENT) or 0)


def parsed_pair(text: str) -> tuple[float, float]:
    inner, _, power = text.partition(") × ")
    scale = "" if not power else f" × {power}"
    value, _, std = inner.lstrip("(").partition(" ± ")
    return parsed(value + scale), parsed(std + scale)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (1.2345, "1.23"),
        (-0.0012345, "−0.00123"),
        (9.999, "10.0"),
        (3.07e-7, "3.07 × 10⁻⁷"),
        (123456.0, "1.23 × 10⁵"),
        (None, "–"),
        (math.nan, "–"),
    ],
)
def test_number(value: float | None, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (1.97312, 0.00391, "1.9731 ± 0.0039"),
        (1.02899552, 6.52e-6, "1.0289955 ± 0.0000065"),
        (3.07e-4, 0.31e-4, "(3.07 ± 0.31) × 10⁻⁴"),
        (1234.0, 56.0, "1234 ± 56"),
        (0.5, None, "0.5000"),
        (0.5, math.inf, "0.5000"),
        (0.02, 3.0, "0.0 ± 3.0"),
    ],
)
def test_with_error(value: float, std: float | None, text: str) -> None:
    assert with_error(value, std) == text


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (1.97312, 0.00391, "1.9655 … 1.9808"),
        (3.07e-4, 0.31e-4, "(2.46 … 3.68) × 10⁻⁴"),
        (0.5, 0.5, "0.00 … 1.48"),
        (0.5, None, "–"),
        (math.nan, 0.1, "–"),
    ],
)
def test_interval(value: float, std: float | None, text: str) -> None:
    assert interval(value, std) == text


@given(st.floats(1e-12, 1e12), st.floats(1e-6, 1e2))
def test_value_and_error_come_back_to_two_digits_of_the_error(value: float, relative: float) -> None:
    std = value * relative
    back, back_std = parsed_pair(with_error(value, std))
    assert abs(back - value) <= 0.051 * std
    assert back_std == pytest.approx(std, rel=0.051)


@given(st.floats(-1e15, 1e15, allow_subnormal=False).filter(lambda value: abs(value) > 1e-15))
def test_number_comes_back_to_its_digits(value: float) -> None:
    assert parsed(number(value, 4)) == pytest.approx(value, rel=6e-4)


@pytest.mark.parametrize(
    ("metres", "text"), [(3.1e-4, "0.31 mm"), (0.0123, "12 mm"), (1.5, "1500 mm"), (2e-6, "2.0 µm"), (0.0, "0 mm")]
)
def test_millimetres(metres: float, text: str) -> None:
    assert millimetres(metres).replace("\N{NO-BREAK SPACE}", " ") == text


def test_names_in_sentences() -> None:
    assert listed([]) == ""
    assert listed(["a"]) == "a"
    assert listed(["a", "b", "c"]) == "a, b and c"
    assert short("a" * 100, 10) == "aaaaaa…aaa"
    assert short("two\nlines") == "two lines"


@pytest.mark.parametrize(
    ("title", "text"),
    [
        ("Tip payload", "tip payload"),
        ("In-plane gravity", "in-plane gravity"),
        ("Coulomb friction", "Coulomb friction"),
        ("PID controller", "PID controller"),
        ("", ""),
    ],
)
def test_titles_in_sentences(title: str, text: str) -> None:
    assert in_sentence(title) == text
