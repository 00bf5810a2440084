"""A cause's parameters and standard errors, from the covariance of its coordinates; its p-value and its evidence."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.diagnosis.rigs import chain_of, point_of, recorded
from vjm.diagnosis import alternatives
from vjm.diagnosis.alternatives import _with_errors, equivalent_increase, estimate_causes, ranked
from vjm.diagnosis.records import EQUIVALENT, Alternative
from vjm.effects import EncoderOffset, GearElasticity, MarkerOffset, TipPayload, ViscoelasticCreep
from vjm.identification.trajectory_fit import fit_trajectory
from vjm.simulation.arm import Arm


def test_standard_errors_follow_each_parameters_scale() -> None:
    """Sizes and dampings go with their coordinates, a time constant exponentially, a gear's stiffness inversely."""
    creep = ViscoelasticCreep(link=0, ratio=0.04, time_constant=0.12)
    parameters = _with_errors(creep, np.diag([0.01, 0.04]))
    unit = {parameter.name: parameter.typical_magnitude for parameter in creep.parameters}
    assert parameters["ratio"].value == pytest.approx(0.04)
    assert parameters["ratio"].std == pytest.approx(0.1 * unit["ratio"], rel=1e-4)
    assert parameters["time_constant"].std == pytest.approx(0.2 * 0.12, rel=1e-4)
    assert parameters["time_constant"].unit == "s"
    gear = GearElasticity(link=0, stiffness=56.0)
    coordinate, _, damping = gear.coordinates
    assert damping == 0.0
    parameters = _with_errors(gear, np.diag([1e-4, 0.0, 0.04]))
    assert parameters["stiffness"].std == pytest.approx(56.0 * 0.01 / coordinate, rel=1e-3)
    # At its bound, where the logarithm would have no slope, a damping has the error that it has elsewhere.
    assert parameters["damping"].std == pytest.approx(0.2 * gear.parameters[2].typical_magnitude, rel=1e-4)
    for square, std in ((0.0, 0.04), (9.0, 0.04)):  # of a radius of gyration over a typical one
        body = TipPayload(link=0).at(np.array([0.5, square, -0.2]))
        parameters = _with_errors(body, np.diag([0.01, std**2, 0.09]))
        change = (square + std) ** 0.5 - square**0.5
        assert parameters["radius_of_gyration"].std == pytest.approx(change * body.parameters[1].typical_magnitude)
        assert parameters["mass"].std == pytest.approx(0.1 * body.parameters[0].typical_magnitude, rel=1e-4)
        assert parameters["offset"].std == pytest.approx(0.3 * body.parameters[2].typical_magnitude, rel=1e-4)
        interval = parameters["radius_of_gyration"].ci95
        assert interval is not None
        assert (interval[0] == 0.0) == (square == 0.0)  # no radius is negative
    offset = _with_errors(EncoderOffset(link=0, column=0), np.eye(1))["offset"].ci95
    assert offset is not None
    assert offset[0] == -offset[1] < 0  # an angle may be


def test_indices_have_no_standard_error_and_nor_does_what_is_not_determined() -> None:
    marker = MarkerOffset(marker=2, along=-0.003)
    parameters = _with_errors(marker, np.eye(marker.coordinates.size))
    assert parameters["marker"].std is None
    assert parameters["along"].std is not None
    unknown = _with_errors(marker, np.full((marker.coordinates.size,) * 2, np.nan))
    assert all(parameter.std is None for parameter in unknown.values())


def model(effects: tuple[Any, ...], chi2: float, converged: bool = True, count: int = 1000) -> Any:
    """A fit of effects to a number of values."""
    x = np.concatenate([np.zeros(0), *(effect.coordinates for effect in effects)])
    stops = np.cumsum([effect.coordinates.size for effect in effects], dtype=int).tolist()
    parts = tuple(slice(stop - effect.coordinates.size, stop) for effect, stop in zip(effects, stops, strict=True))
    problem = SimpleNamespace(effects_at=lambda x: effects, parts=parts, reference_effects=0)
    return SimpleNamespace(
        effects=effects,
        effect_keys=frozenset(effect.key for effect in effects),
        estimate=x,
        point=SimpleNamespace(problem=problem, count=count, expected_chi2=count),
        chi2=chi2,
        misfit=float(np.sqrt(chi2 / count)),
        converged=converged,
    )


@pytest.fixture(autouse=True)
def inflation(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> float:
    """What the fits of `model` leave is white noise, unless a test says by how much more chi^2 scatters."""
    value = getattr(request, "param", 1.0)
    known = alternatives.information_of

    def information(fit: Any) -> Any:
        return (
            SimpleNamespace(inflation=value, covariance=np.eye(4)) if isinstance(fit, SimpleNamespace) else known(fit)
        )

    monkeypatch.setattr(alternatives, "information_of", information)
    return float(value)


@pytest.mark.parametrize("inflation", [0.5, 4.0], indirect=True)
def test_a_p_value_allows_for_residuals_that_last(inflation: float) -> None:
    payload, seen = TipPayload(link=0, mass=0.01), []
    family = SimpleNamespace(p_of_fit=lambda effect, decrease: seen.append(decrease) or 1e-9)
    search = SimpleNamespace(start=None, refit_without=lambda *_: model((), 1400.0))
    result = SimpleNamespace(best=model((payload,), 1000.0), first_tests=family, p_values={}, fits={}, segment_fits={})
    estimate_causes(cast(Any, result), cast(Any, search), {}, 1.0)
    assert seen == [400.0 / max(inflation, 1.0)]


@pytest.mark.parametrize("reference_misfit", [1.0, 3.0])
def test_causes_are_ordered_by_what_is_missed_without_them(reference_misfit: float) -> None:
    payload, offset = TipPayload(link=0, mass=0.01), EncoderOffset(link=0, column=0, offset=0.01)
    best, alternative = model((payload, offset), 1000.0), Alternative(MarkerOffset(), 3.0)
    start = model((), 50_000.0)
    tried = {frozenset({offset.key}): model((offset,), 9000.0)}
    family = SimpleNamespace(p_of_fit=lambda effect, decrease: {8000.0: 1e-9, 29_000.0: 0.5}[decrease])
    search = SimpleNamespace(start=start, refit_without=lambda best, effect, fits: model((payload,), 30_000.0))
    p_values = {payload.key: 1e-3, offset.key: 1e-5}
    result = SimpleNamespace(best=best, first_tests=family, p_values=p_values, fits=tried, segment_fits={})
    others = {payload.key: (alternative,)}
    causes = ranked(estimate_causes(cast(Any, result), cast(Any, search), others, reference_misfit))
    assert [cause.effect for cause in causes] == [offset, payload]
    assert [cause.decrease for cause in causes] == [29_000.0, 8000.0]
    assert [cause.p_value for cause in causes] == [1e-5, 1e-9]
    assert [cause.alternatives for cause in causes] == [(), (alternative,)]
    assert causes[1].evidence.startswith("training residual falls from 3.00 to ")
    assert ("residual before the change" in causes[1].evidence) == (reference_misfit > 1)


@pytest.mark.parametrize("share", [1.0, 0.1])
def test_a_refit_out_of_time_is_no_measure_of_what_is_missed(share: float) -> None:
    """One to segments is, be they only some of them."""
    payload = TipPayload(link=0, mass=0.01)
    best = model((payload,), 1000.0)
    family = SimpleNamespace(p_of_fit=lambda effect, decrease: 1e-9)
    for converged, missed in ((True, 8_999_000.0), (False, 6000.0)):
        search = SimpleNamespace(start=None, refit_without=lambda *_, done=converged: model((), 9e6, done))
        result = SimpleNamespace(best=best, first_tests=family, p_values={}, fits={}, segment_fits={})
        result.segment_fits = {frozenset(): model((), share * 7000.0, count=int(share * 1000))}
        (cause,) = estimate_causes(cast(Any, result), cast(Any, search), {}, 1.0)
        assert cause.decrease == pytest.approx(missed)
        assert not cause.evidence.startswith("its fit ended")


def test_a_cause_whose_fit_was_no_better_than_that_without_it_explains_nothing() -> None:
    """Where time has run out; it is the main one all the same if there is no other."""
    payload = TipPayload(link=0, mass=0.01)
    family = SimpleNamespace(p_of_fit=lambda effect, decrease: 0.5 if decrease == 0.0 else 1e-9)
    better = model((), 900.0)
    search = SimpleNamespace(start=better, refit_without=lambda *_: better)
    result = SimpleNamespace(
        best=model((payload,), 1000.0), first_tests=family, p_values={}, fits={frozenset(): better}, segment_fits={}
    )
    (cause,) = ranked(estimate_causes(cast(Any, result), cast(Any, search), {}, 1.0))
    assert (cause.decrease, cause.p_value, cause.role) == (0.0, 0.5, "main")
    assert cause.evidence == "its fit ended before it was better than that without it"


@pytest.mark.parametrize("alone", [True, False])
def test_a_cause_that_was_not_fitted_without_does_not_claim_what_others_explain(
    alone: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    payload, offset = TipPayload(link=0, mass=0.01), EncoderOffset(link=0, column=0, offset=0.01)
    best = model((payload,) if alone else (payload, offset), 1000.0)
    family = SimpleNamespace(p_of_fit=lambda effect, decrease: 1e-9)
    start = model((), 50_000.0)
    search = SimpleNamespace(refit_without=lambda *_: start if alone else None, out_of_time=True)
    result = SimpleNamespace(best=best, first_tests=family, p_values={}, fits={}, segment_fits={})
    monkeypatch.setattr(alternatives, "predicted_increase", lambda fit, effect: 70.0 if effect is payload else 30.0)
    causes = estimate_causes(cast(Any, result), cast(Any, search), {}, 1.0)
    assert [cause.decrease for cause in causes] == ([49_000.0] if alone else [70.0, 30.0])
    assert all(cause.evidence.startswith("not fitted without it, out of time") != alone for cause in causes)


@pytest.mark.parametrize("seed", [1, 2])
def test_models_are_equivalent_further_apart_where_something_else_is_missing(seed: int) -> None:
    """What is left lasts: there are far fewer independent looks at it than values."""
    complete, incomplete = (
        fit_trajectory(point.problem, point.x)
        for point in (
            point_of(chain_of(), (), recorded(arm, seed))
            for arm in (Arm(chain_of()), Arm.of(chain_of(), (TipPayload(link=0, mass=0.01),)))
        )
    )
    assert equivalent_increase(complete) == pytest.approx(EQUIVALENT, rel=0.15)
    assert equivalent_increase(incomplete) > 10 * EQUIVALENT * incomplete.misfit**2
