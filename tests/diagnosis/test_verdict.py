"""The verdict follows from findings alone: small records, no simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vjm.diagnosis.alternatives import ranked
from vjm.diagnosis.diagnose import _default_budget
from vjm.diagnosis.records import (
    Alternative,
    Budget,
    Cause,
    Diagnosis,
    Proposal,
    RepeatComparison,
    ResidualBand,
    ResidualTest,
)
from vjm.diagnosis.verdict import _block_length, _estimate_gain, conclude, is_unexplained, why_insufficient
from vjm.effects import CameraRotation, CubicStiffness, EncoderOffset, TipPayload
from vjm.records import (
    Array,
    Estimate,
    Experiment,
    Link,
    Recording,
    RecordingComparison,
    Rig,
    SimulatedRecording,
    Simulation,
)

NOISE = (3e-4, 1e-4)
RIG = Rig("rig", (Link("beam", "clamped", 1.0, 0.4, 2.0, (0.5, 1.0)),))


def recording(file: str = "slew.csv", role: Any = "holdout", count: int = 400, **changes: Any) -> Recording:
    time, nothing = np.arange(count) / 100, np.zeros((count, 0))
    plain = Recording(time, np.zeros((count, 2, 2)), nothing, nothing, kind="decay", role=role, file=file)
    return replace(plain, **changes)


def seen_in(frames: int) -> Recording:
    """A held-out recording whose markers are seen in its first frames only."""
    whole = recording()
    return replace(whole, markers=whole.markers + np.where(np.arange(400) < frames, 0.0, np.nan)[:, None, None])


def beside(measured: Recording, residual: Array | float) -> SimulatedRecording:
    """A simulation that leaves a residual (T, k, 2) [m] of a recording."""
    markers = measured.markers - residual
    nothing = np.zeros((len(markers), 0))
    simulation = Simulation(measured.time, nothing, nothing, nothing, np.broadcast_to(markers, measured.markers.shape))
    return SimulatedRecording(measured, simulation, NOISE, "converged")


def compared(
    measured: Recording, before: Array | float, after: Array | float, next_best: Array | float | None = None
) -> RecordingComparison:
    other = None if next_best is None else beside(measured, next_best)
    return RecordingComparison(measured, NOISE, beside(measured, after), beside(measured, before), other)


class StandIn:
    """A model whose estimates alone are read."""

    estimates: tuple[Estimate, ...] = ()


def cause(effect: Any = None, *others: Any) -> Cause:
    alternatives = tuple(Alternative(other, 1.0) for other in others)
    return Cause(effect or TipPayload(link=0, mass=0.01), {}, 1e-9, 1e4, alternatives, "")


def findings(**changes: Any) -> Diagnosis:
    """A cause that explains everything."""
    experiment = Experiment(RIG, (recording("a.csv", "train"), recording("b.csv", "train"), recording()))
    found = Diagnosis(
        experiment=experiment,
        causes=(cause(),),
        candidates=(),
        model=StandIn(),  # type: ignore[arg-type]
        reference=StandIn(),  # type: ignore[arg-type]
        recordings=(compared(recording(), 3e-3, 3e-4),),
        residuals=ResidualTest((), 0.4, 0.0),
        baseline_misfit=10.0,
        decrease=99.0,
        negligible=25.0,
        noise="white",
    )
    return replace(found, **changes)


def misfits(changed: float) -> dict[str, float]:
    """Of a model that missed the reference recordings by three times the noise."""
    return {"baseline_misfit": 3.0, "reference_misfit": 3.0, "changed_misfit": changed}


SMALL = {"decrease": 0.009, "recordings": (compared(recording(), 3e-4, 3e-4),)}
CERTAIN = ResidualTest((ResidualBand("a.csv", "markers", (0.5, 2.0), 100, 80.0, 1e-9),), 1e-8, 80.0)


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, "named"),
        ({"causes": ()}, "none"),
        ({"causes": (cause(None, CubicStiffness(link=0)),)}, "set"),
        ({"residuals": CERTAIN}, "unknown"),
        ({"residuals": replace(CERTAIN, excess=20.0)}, "named"),  # significant, and too little to matter
        ({"residuals": replace(CERTAIN, p_value=0.01)}, "named"),
        ({"needed": (CubicStiffness(link=0),)}, "unknown"),
        ({**misfits(5.9), "residuals": CERTAIN}, "named"),  # as much was missing before the change
        ({**misfits(6.1)}, "unknown"),
        # An effect that was found in the recordings before the change suits these best.
        ({**misfits(6.1), "baseline_misfit": 10.0, "residuals": CERTAIN}, "named"),
        (SMALL, "none"),
        ({**SMALL, "decrease": 0.011}, "named"),  # held-out recordings judge the model and drop nothing
        ({**SMALL, "residuals": CERTAIN}, "unknown"),
        ({"insufficient": ("no recording is held out",)}, "insufficient"),
    ],
)
def test_the_verdict_follows_from_what_was_found(changes: dict[str, Any], verdict: str) -> None:
    found = findings(**changes)
    assert conclude(found).verdict == verdict
    assert is_unexplained(found) == (verdict == "unknown")


def test_large_causes_come_before_small_ones() -> None:
    effects = [TipPayload(link=0, mass=1e-3), CubicStiffness(link=0), EncoderOffset(link=0), CameraRotation()]
    sizes, gains = [90.0, 1e5, 50.0, 2e3], [1e-6, 1e-3, 5e-6, 1e-5]
    causes = tuple(
        replace(cause(effect), decrease=size, holdout_gain=gain)
        for effect, size, gain in zip(effects, sizes, gains, strict=True)
    )
    diagnosis = conclude(findings(causes=ranked(causes)))
    assert [one.effect.id for one in diagnosis.main_causes] == ["cubic_stiffness", "camera_rotation"]
    # Of small ones, what gains most where it was not fitted comes first.
    assert [one.effect.id for one in diagnosis.minor_causes] == ["encoder_offset", "tip_payload"]
    assert diagnosis.causes == diagnosis.main_causes + diagnosis.minor_causes


def test_a_small_cause_alone_is_the_main_one() -> None:
    diagnosis = conclude(findings(causes=ranked([replace(cause(), decrease=30.0)])))
    assert [one.role for one in diagnosis.causes] == ["main"]


def test_the_model_without_causes_is_recommended_where_they_make_predictions_worse() -> None:
    random = np.random.default_rng(1)
    small, large = (size * random.standard_normal((400, 2, 2)) for size in (3e-4, 6e-4))
    worse = conclude(findings(recordings=(compared(recording(), small, large),)))
    assert worse.recommended is worse.reference
    assert worse.gain is not None
    assert worse.gain.harmful
    better = conclude(findings(recordings=(compared(recording(), large, small),)))
    assert better.recommended is better.model


@pytest.mark.parametrize(
    ("duration", "rate", "one", "two"),
    [
        (6.0, 100, 240.0, 120.0),
        (12.0, 25, 360.0, 180.0),
        (6.0, 175, 360.0, 180.0),
        (12.0, 250, 480.0, 240.0),
    ],
    ids=["usual", "long", "fast camera", "both"],
)
@pytest.mark.parametrize("scale", [1.0, 0.2])
def test_the_usual_budget_grows_with_periods_and_frames(
    duration: float, rate: int, one: float, two: float, scale: float
) -> None:
    """From 40 periods and 3,500 frames on, whichever is more beyond it, up to twice the usual one; at any speed."""
    duration, rate = scale * duration, round(rate / scale)
    time = np.linspace(0.0, duration, int(duration * rate))
    recording = Recording(time, np.zeros((time.size, 1, 2)), kind="decay", role="train")
    stiffness = 0.44 * (2 * np.pi / 1.875104**2 / scale) ** 2  # of 1 Hz
    link = Link("beam", "revolute", 1.0, 0.44, stiffness, (0.5, 1.0), hub_inertia=0.02)

    def budgets(*links: Link) -> dict[int, float]:
        experiment = SimpleNamespace(with_role=lambda role: [recording] * 5, rig=Rig("arm", links))
        return {jobs: _default_budget(experiment, jobs) for jobs in (1, 2, 8)}  # type: ignore[arg-type]

    usual = budgets(link)
    assert usual == pytest.approx({1: one, 2: two, 8: two}, rel=2e-3)
    longer = budgets(link, replace(link, name="tip", joint="clamped", hub_inertia=0.0))  # slower, and without an elbow
    assert all(longer[jobs] <= usual[jobs] for jobs in usual)
    assert budgets(link, replace(link, name="elbow")) == pytest.approx({1: 480.0, 2: 240.0, 8: 240.0})


def test_a_search_that_was_ended_says_what_it_has_not_tried() -> None:
    ended = conclude(findings(budget=Budget(60.0, 61.0, True, ("backlash", "hysteresis"))))
    (said,) = [warning for warning in ended.warnings if "budget of 60 s" in warning]
    assert "backlash, hysteresis" in said
    assert not [warning for warning in conclude(findings(budget=Budget(60.0, 30.0))).warnings if "budget" in warning]


def test_a_cause_of_no_use_is_no_cause() -> None:
    base = StandIn()
    diagnosis = conclude(findings(**SMALL, reference=base, next_best=(CubicStiffness(link=0),)))
    assert diagnosis.causes == diagnosis.next_best == ()
    assert diagnosis.model is base
    assert any("Tip payload: certain, but too small to matter" in warning for warning in diagnosis.warnings)
    assert diagnosis.gain is not None
    assert diagnosis.gain.reduction == 0.0
    assert diagnosis.gain.interval == (0.0, 0.0)


def test_insufficient_data_give_reasons_and_nothing_else() -> None:
    diagnosis = conclude(findings(causes=(), insufficient=("one is too few", "so is none"), warnings=("a gap",)))
    assert diagnosis.warnings == ("one is too few", "so is none", "a gap")
    assert diagnosis.next_experiment == "one is too few"
    assert diagnosis.gain is None
    assert diagnosis.remaining.p_value is None


def test_what_remains_is_described() -> None:
    repeats = RepeatComparison(3.0, 1.0, NOISE[0])
    found = findings(residuals=CERTAIN, resemblance="most like a spring", repeats=repeats, needed=(CubicStiffness(),))
    described = conclude(found).remaining.description
    assert described.split("; ")[0] == "largest in the markers of a.csv, 0.500 to 2.00 Hz"
    for part in ("most like a spring", "100 % of it recurs in repeated", "cubic stiffness would explain"):
        assert part in described
    assert "repeated recordings differ by 0.30 mm" in conclude(found).noise
    other = replace(repeats, common=1.0, individual=2.0)
    assert "100 % of it differs between" in conclude(replace(found, repeats=other)).remaining.description
    assert conclude(findings()).remaining.description == ""
    before = conclude(findings(**misfits(4.0))).remaining.description
    assert "residual 4.00 × noise in the changed recordings, 3.00 × noise in the reference" in before


@pytest.mark.parametrize(("evidence", "expected"), [(31.0, "repeat a.csv"), (29.0, "record ")])
def test_the_next_experiment_is_one_that_would_distinguish(evidence: float, expected: str) -> None:
    twins = cause(CameraRotation(angle=0.01), EncoderOffset(link=0, offset=0.01))
    text = conclude(findings(causes=(twins,), proposals=(Proposal("repeat a.csv", evidence),))).next_experiment
    assert text is not None
    assert text.startswith(f"to distinguish camera rotation from encoder offset: {expected}")


def test_where_something_is_unknown_a_quiet_recording_comes_first() -> None:
    found = findings(needed=(CubicStiffness(link=0),))
    assert 'kind = "quiet"' in str(conclude(found).next_experiment)
    rest = Experiment(RIG, (*found.experiment.recordings, recording("rest.csv", "train", kind="quiet")))
    assert "half and twice" in str(conclude(replace(found, experiment=rest)).next_experiment)
    assert conclude(findings()).next_experiment is None


def test_the_gain_is_of_changed_held_out_recordings() -> None:
    given = [
        compared(recording("train.csv", "train"), 1.0, 0.0),
        compared(recording("before.csv", condition="reference"), 2e-3, 2e-3),
        compared(recording("slew.csv"), 3e-3, 1e-3, 2e-3),
    ]
    gain = _estimate_gain(given, 0)
    assert gain is not None
    assert (gain.before, gain.after, gain.next_best) == pytest.approx((3e-3, 1e-3, 2e-3))
    assert (gain.reduction, *gain.interval) == pytest.approx((2 / 3,) * 3)
    gain = _estimate_gain(given[:2], 0)
    assert gain is not None
    assert gain.reduction == 0.0
    assert _estimate_gain(given[:1], 0) is None
    part = _estimate_gain([compared(seen_in(200), 3e-3, 1e-3)], 0)
    assert part is not None
    assert part.before == pytest.approx(3e-3)
    assert _estimate_gain([compared(seen_in(200), 3e-3, 1e-3), compared(seen_in(0), 3e-3, 1e-3)], 0) == part


def autoregression(random: np.random.Generator, count: int, correlation: float, channels: int = 4) -> Array:
    noise = random.standard_normal((count + 200, channels))
    for k in range(1, len(noise)):
        noise[k] += correlation * noise[k - 1]
    return noise[200:].reshape(count, channels // 2, 2)


@pytest.mark.parametrize("correlation", [pytest.param(0.0, marks=pytest.mark.slow), 0.97])
def test_the_gains_interval_covers_as_often_as_it_says(correlation: float) -> None:
    """Residuals correlated over many frames: a fixed block of a few frames would claim far too much."""
    random = np.random.default_rng(5)
    covered, widths = 0, []
    for _ in range(60):
        measured = recording(count=1500)
        before, after = (2 * autoregression(random, 1500, correlation), autoregression(random, 1500, correlation))
        gain = _estimate_gain([compared(measured, before, after)], 0)
        assert gain is not None
        covered += gain.interval[0] < 0.5 < gain.interval[1]
        widths.append(gain.interval[1] - gain.interval[0])
    assert covered >= 50
    assert np.mean(widths) < (0.04 if correlation == 0 else 0.4)


def test_scaling_time_changes_no_interval() -> None:
    random = np.random.default_rng(1)
    measured = recording(count=600)
    before, after = autoregression(random, 600, 0.9), autoregression(random, 600, 0.9)
    slow = replace(measured, time=1000 * measured.time)
    assert _estimate_gain([compared(slow, before, after)], 0) == _estimate_gain([compared(measured, before, after)], 0)


def test_blocks_are_as_long_as_theory_says() -> None:
    """For a first-order autoregression the optimal length is known: (6 rho^2 / (1 - rho^2)^2 n)^(1/3)."""
    count, rho = 20_000, 0.8
    lengths = [
        _block_length(autoregression(np.random.default_rng(seed), count, rho, 2).reshape(count, 2)[:, 0])
        for seed in range(10)
    ]
    expected = (6 * rho**2 / (1 - rho**2) ** 2 * count) ** (1 / 3)
    assert np.mean(lengths) == pytest.approx(expected, rel=0.2)
    white = [_block_length(np.random.default_rng(seed).standard_normal(count)) for seed in range(10)]
    assert np.mean(white) < 6
    assert _block_length(np.ones(100)) == _block_length(np.ones(1)) == _block_length(np.arange(5.0)) == 1
    assert _block_length(np.arange(300.0)) <= 100


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda a, b, c: (a, b), "no recording is held out"),
        (lambda a, b, c: (a, c), "only one training recording moves"),
        (lambda a, b, c: (a, b, replace(c, condition="reference")), "are held out: none is left"),
        (lambda a, b, c: (replace(a, condition="reference"), c), "every training recording"),
        (lambda a, b, c: (replace(a, repeat="x"), replace(b, repeat="x", condition="reference"), c), 'repeats "x"'),
        (lambda a, b, c: (a, b, seen_in(29)), "almost no frames with markers"),
    ],
)
def test_recordings_that_support_no_statement_are_told_why(change: Callable[..., Any], reason: str) -> None:
    given = recording("a.csv", "train"), recording("b.csv", "train"), recording()
    (said,) = why_insufficient(Experiment(RIG, change(*given)))
    assert reason in said
    assert why_insufficient(Experiment(RIG, given)) == ()


def test_a_cause_that_shows_in_predictions_alone_is_a_cause() -> None:
    """A search that ended in segments, of which it explains little, for each has an initial state of its own."""
    random = np.random.default_rng(1)
    small, large = (size * random.standard_normal((400, 2, 2)) for size in (3e-4, 6e-4))
    seen = conclude(findings(decrease=0.009, recordings=(compared(recording(), large, small),)))
    assert [cause.effect.id for cause in seen.causes] == ["tip_payload"]
    unseen = conclude(findings(decrease=0.009, recordings=(compared(recording(), small, small),)))
    assert unseen.causes == ()
