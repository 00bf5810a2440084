"""Intervals of parameters hold a beam's own, which a chain with few joints is biased from."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

import vjm
from tests.hidden.rigs import write_hidden
from tests.hidden.settings import Rig, setting_of
from vjm.chain.layout import LayoutName, nominal_chain, rig_layouts
from vjm.identification.discretization import DiscretizationBias, first_order_bias
from vjm.identification.records import Identification
from vjm.records import Experiment


@cache
def identified(rig: Rig, seed: int) -> Identification:
    """A fit of three recordings of a continuous beam."""
    with TemporaryDirectory() as folder:
        write_hidden(Path(folder), rig, (), seed)
        experiment = vjm.load_experiment(Path(folder) / "experiment.toml")
    moving = [one for one in experiment.recordings if one.role == "train" and one.kind != "quiet"]
    return vjm.identify(Experiment(experiment.rig, tuple(moving[:3])), baselines=False)


def off(rig: Rig, seed: int) -> list[float]:
    """By how many of their standard errors the parameters are off."""
    beam = setting_of(rig, seed).beam
    truth = {
        "beam.bending_stiffness": beam.bending_stiffness,
        "beam.kelvin_voigt_time": beam.kelvin_voigt_time,
        "beam.hub_inertia": beam.hub_inertia,
    }
    found = identified(rig, seed).parameters
    return [abs(estimate.value - truth[estimate.name]) / (estimate.error or np.nan) for estimate in found]


@pytest.mark.parametrize("rig", ["hub", pytest.param("clamped", marks=pytest.mark.slow)])
def test_the_standard_error_includes_what_more_joints_would_change(rig: Rig) -> None:
    fit = identified(rig, 1)
    assert max(off(rig, 1)) < 2.5
    stiffness = fit.parameters[0]
    assert stiffness.std is not None
    assert stiffness.std_discretisation is not None
    assert stiffness.error is not None
    assert stiffness.ci95 is not None
    assert stiffness.std_discretisation > 3 * stiffness.std  # else the noise alone would hold the truth
    assert np.diff(stiffness.ci95) == pytest.approx(2 * 1.96 * np.hypot(stiffness.std, stiffness.std_discretisation))
    link = fit.to_dict()["model"]["links"][0]
    assert link["bending_stiffness"]["ci95"] == pytest.approx(stiffness.ci95)
    # K = EI / cell: it has the same relative errors.
    joint, cell = link["virtual_joints"][0]["stiffness"], fit.model.chain.links[0].cells[0]
    for name in ("std", "std_discretisation"):
        assert joint[name] == pytest.approx(getattr(stiffness, name) / cell, rel=1e-6)


def test_one_step_finds_the_shift_that_several_do() -> None:
    fit = identified("hub", 1)
    assert fit.trajectory is not None
    bias = DiscretizationBias.of(fit.trajectory.point, fit.model.rig)
    first_order = first_order_bias(fit.trajectory.point, fit.model.rig)
    assert bias is not None
    assert first_order is not None
    assert first_order.shift == pytest.approx(bias.shift, rel=0.3)
    corrected = bias.corrected(fit.trajectory, np.inf)
    assert corrected is not None
    assert first_order.decrease == pytest.approx(fit.trajectory.chi2 - corrected.chi2, rel=0.3)


@cache
def fine_swing() -> Experiment:
    """A swing, free of noise, of 40 joints: a beam's, whose bending stiffness is 2 N m^2."""
    rig = vjm.Rig("fine", [vjm.Link("beam", "clamped", 1.0, 0.44, 2.0, (0.25, 0.5, 0.75, 1.0))], marker_noise=3e-4)
    chain = nominal_chain(rig, rig_layouts(rig, [40], "fourth-order"), 2e-3)
    bent = np.stack([0.005 * (1 - np.arange(40) / 40), np.zeros(40)])
    motion = replace(vjm.Model.nominal(rig), chain=chain).simulate(torque=np.zeros((76, 0)), duration=1.5, initial=bent)
    return Experiment(rig, (vjm.Recording(motion.time, motion.markers, motion.theta, kind="decay"),))


@pytest.mark.parametrize(
    ("layout", "n"),
    [("fourth-order", 4), ("fourth-order", 8), ("end-corrected", 4), ("end-corrected", 8), ("half-ends", 8)],
)
def test_the_shift_leads_from_any_layout_to_the_beam(layout: LayoutName, n: int) -> None:
    stiffness = vjm.identify(fine_swing(), virtual_joints=n, layout=layout, baselines=False).parameters[0]
    # What the chain of 40 joints and that with three times n lack of a beam: 1e-5 of the stiffness.
    assert stiffness.discretization_shift == pytest.approx(2.0 - stiffness.value, rel=0.02, abs=2e-5)


@pytest.mark.parametrize(("size", "kept"), [(0.0, True), (30.0, False)])
def test_a_correction_that_leads_away_from_the_recordings_is_dropped(size: float, kept: bool) -> None:
    """Each offset is `size` standard errors of the measurements."""
    fit = identified("clamped", 1).trajectory
    assert fit is not None
    random = np.random.default_rng(1)
    offset = [size * random.normal(size=run.observed.count) / run.observed.weights for run in fit.point.runs]
    corrected = DiscretizationBias(tuple(offset), np.zeros(fit.point.x.size)).corrected(fit, 2.0)
    assert (corrected is not None) == kept
    assert corrected is None or corrected.misfit == pytest.approx(fit.misfit, rel=1e-3)


@pytest.mark.parametrize(
    ("times_less_noise", "kept"), [pytest.param(1, True, marks=pytest.mark.slow), (32, True), (320, False)]
)
def test_a_correction_whose_own_error_would_show_is_dropped(times_less_noise: float, kept: bool) -> None:
    """It adds about an 80th of the bias, as errors are of fourth order: that shows where noise is 320 times less."""
    fit = identified("hub", 1)
    assert fit.trajectory is not None
    point = fit.trajectory.point
    noise = [tuple(size / times_less_noise for size in run.observed.noise) for run in point.runs]
    observed = tuple(replace(run.observed, noise=each) for run, each in zip(point.runs, noise, strict=True))
    runs = tuple(replace(run, observed=each) for run, each in zip(point.runs, observed, strict=True))
    bias = DiscretizationBias.of(
        replace(point, problem=replace(point.problem, observed=observed), runs=runs), fit.model.rig
    )
    assert (bias is not None) == kept


@pytest.mark.slow
def test_intervals_hold_the_truth() -> None:
    """95 % of them: 17 of 20 or more."""
    held = [max(off(rig, seed)) < 1.96 for rig in ("hub", "clamped") for seed in range(1, 11)]
    assert sum(held) >= 17
