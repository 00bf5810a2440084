"""Pictures of the symptoms: labelled, nothing on top of anything else, the finding in the title."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.diagnosis.trajectories import MOTION, STILL, found, simulated
from tests.report.test_figures import assert_readable
from vjm.diagnosis.symptoms import Symptoms
from vjm.diagnosis.symptoms.channels import Coefficient
from vjm.report.figures.symptoms import _significance, symptom_pictures
from vjm.report.output import _PICTURES

NAMES = tuple(name for name in _PICTURES if name.startswith("symptom"))


@cache
def wrong() -> Symptoms:
    """A slow first mode, a late camera, a hardening decay and a humming quiet record."""
    truth = replace(MOTION, frequencies=(1.194, 7.5))
    hard = replace(MOTION, frequencies=(1.194, 7.5), hardening=0.02)
    hum = lambda t, m, theta: (m + 2e-4 * np.sin(2 * np.pi * 13 * t)[:, None, None], theta)  # noqa: E731
    return found(
        *(simulated(k, truth, lag=3e-3, file=f"drive_{k}_with_a_name_that_is_rather_long.csv") for k in range(4)),
        simulated(5, hard, MOTION, kind="decay", duration=14, file="decay.csv"),
        simulated(6, STILL, STILL, kind="quiet", file="quiet.csv", change=hum),
    )


@cache
def right() -> Symptoms:
    """As simulated."""
    return found(simulated(0), simulated(1, kind="decay", file="decay.csv"), simulated(2, STILL, STILL, kind="quiet"))


@cache
def figures(of: Callable[[], Symptoms]) -> list[Figure]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return [picture.figure for picture in symptom_pictures(of())]


@pytest.mark.parametrize("of", [wrong, pytest.param(right, marks=pytest.mark.slow)])
def test_every_figure_is_readable(of: Callable[[], Symptoms]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for figure in figures(of):
            assert_readable(figure)


def test_titles_say_what_is_wrong() -> None:
    titles = [figure.texts[0].get_text().replace("\n", " ") for figure in figures(wrong)]
    assert titles[0].startswith("Largest residual: 14 × noise over all sensors, in decay.csv")
    assert "frequency at 1.2 Hz is 0.50 % lower than in the model" in titles[1]
    assert titles[2] == "Frequency and damping in free motion, one curve for each condition. Marks beside their line"
    assert "Camera is 3.0 ms late relative to the encoders" in titles[4]
    assert "at 13.0 Hz; the model does not" in titles[5]


@pytest.mark.parametrize("of", [wrong, right])
def test_every_figure_has_a_title_of_its_own(of: Callable[[], Symptoms]) -> None:
    titles = [figure.texts[0].get_text() for figure in figures(of)]
    assert len(set(titles)) == len(titles) == len(NAMES)


def test_titles_say_that_nothing_is_wrong() -> None:
    titles = [figure.texts[0].get_text().replace("\n", " ") for figure in figures(right)]
    assert titles[0] == "The model follows every recording to within noise"
    assert titles[1] == "Frequency, damping, amplitude and phase of all modes agree with the model"
    assert titles[2].startswith("Frequency and damping against amplitude agree")
    assert titles[3].startswith("Residual does not depend on position")
    assert titles[4].startswith("Camera and encoders are synchronous to within 0.0")
    assert titles[5] == "At rest, the sensors show white noise of the assumed size"


def test_pictures_have_their_names_and_captions() -> None:
    drawn = symptom_pictures(wrong())
    assert tuple(each.name for each in drawn) == NAMES
    for each in drawn:
        assert each.png.startswith(b"\x89PNG")
        assert each.caption.endswith(".")
        assert each.alternative.strip()


def test_what_there_is_nothing_of_is_not_drawn() -> None:
    assert symptom_pictures(found()) == []
    clamped = found(simulated(0, clamped=True, kind="driven"))
    assert [each.name for each in symptom_pictures(clamped)] == [
        "symptom_overview",
        "symptom_bands",
        "symptom_amplitude",
        "symptom_profiles",
    ]
    assert [each.name for each in symptom_pictures(found(simulated(0, STILL, STILL, kind="quiet")))] == [
        "symptom_quiet"
    ]


def test_colours_of_the_map_go_with_three_standard_errors() -> None:
    assert _significance(Coefficient(2.9, 1.0)) == 0.0
    assert _significance(Coefficient(3.1, 1.0)) == pytest.approx(0.2, abs=0.01)
    assert _significance(Coefficient(-30.0, 1.0)) == pytest.approx(-0.6)
    assert _significance(Coefficient(-1e4, 1.0)) == -1.0


def test_frequency_in_the_map_is_the_difference_in_per_cent() -> None:
    texts = [text.get_text() for text in figures(wrong)[1].axes[0].texts]
    assert texts.count("\N{MINUS SIGN}0.50") == 4
