"""Fits of models with effects."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.diagnosis.rigs import RIG, chain_of, in_segments, point_of, recorded
from vjm.diagnosis import candidate_fit, reference, selection
from vjm.diagnosis.alternatives import _with_errors
from vjm.diagnosis.candidate_fit import (
    SearchOptions,
    StoppingRule,
    _multistart,
    continued,
    information_of,
    predicted_increase,
    refit,
    refit_other_frequencies,
)
from vjm.diagnosis.cross_validation import is_determined
from vjm.diagnosis.diagnose import _with_residual
from vjm.diagnosis.discretization import corrected_for_discretization
from vjm.diagnosis.records import Candidate
from vjm.diagnosis.reference import find_preexisting_effects
from vjm.diagnosis.segments import fit_segments, largest_chi2_in_longer
from vjm.diagnosis.workers import SERIAL
from vjm.effects import (
    ActuatorLag,
    Backlash,
    BaseCompliance,
    CoulombFriction,
    CubicStiffness,
    Effect,
    GearElasticity,
    InPlaneGravity,
    JointSpring,
    Stribeck,
    TipPayload,
    ViscoelasticCreep,
    ViscousFriction,
)
from vjm.errors import SimulationDivergedError
from vjm.identification import trajectory_fit
from vjm.identification.discretization import first_order_bias
from vjm.identification.trajectory_fit import (
    Point,
    TrajectoryFit,
    _TrajectoryStep,
    _trial_point,
    fit_trajectory,
)
from vjm.simulation.arm import Arm
from vjm.simulation.run import Run

Array = NDArray[np.float64]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_time_constant_does_not_run_away(seed: int) -> None:
    truth = ViscoelasticCreep(link=0, ratio=0.04, time_constant=0.12)
    recordings = recorded(Arm.of(chain_of(), (truth,)), seed, duration=4.0)
    point = point_of(chain_of(), (), recordings)
    problem = replace(point.problem, effects=(truth,))
    near, *far = (
        fit_trajectory(problem, np.r_[point.x, replace(truth, time_constant=constant).coordinates]).point
        for constant in (0.12, 0.02, 1.0)
    )
    assert near.misfit == pytest.approx(1.0, abs=0.03)
    assert [each.chi2 for each in far] == pytest.approx([near.chi2, near.chi2], abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_a_gear_has_its_stiffness_though_its_search_begins_far_away(seed: int) -> None:
    """Over whole recordings, a wrong stiffness soon swings in any phase, and a fit ends wherever it stands."""
    truth = GearElasticity(link=0, stiffness=56.0, motor_share=0.35)
    recordings = recorded(Arm.of(chain_of(), (truth,)), seed, duration=8.0)
    found = refit(in_segments(recordings), [replace(truth, stiffness=10.0, motor_share=0.5)])
    assert found is not None
    assert found.point.misfit == pytest.approx(1.0, abs=0.03)
    assert found.effects[0].values["stiffness"] == pytest.approx(56.0, rel=0.015)
    assert found.effects[0].values["motor_share"] == pytest.approx(0.35, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("damping", [0.0, 0.05, 0.3])
def test_a_gear_s_damping_is_found_though_there_may_be_none(damping: float) -> None:
    """At zero it ends at its bound; what is found of the gear beside it is as certain as anywhere."""
    truth = GearElasticity(link=0, stiffness=56.0, motor_share=0.35, damping=damping)
    recordings = recorded(Arm.of(chain_of(), (truth,)), 2, duration=4.0)
    found = refit(in_segments(recordings), [replace(truth, stiffness=10.0, motor_share=0.5, damping=0.0)])
    assert found is not None
    assert found.point.misfit == pytest.approx(1.0, abs=0.03)
    (gear,), (part,) = found.effects, found.point.problem.parts
    sizes = _with_errors(gear, information_of(found).covariance[part, part])
    for name, most in (("stiffness", 0.8), ("motor_share", 0.01), ("damping", 0.05)):
        size, true = sizes[name], truth.values[name]
        assert size.std is not None
        assert abs(size.value - true) < 3 * size.std
        assert size.std < most
    assert is_determined(found, gear, 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stiffness", "damping", "seed"),
    [
        *((30.0, 0.3, seed) for seed in (1, 2, 3)),
        *((500.0, 2.0, seed) for seed in (1, 2, 3)),
        *((2000.0, 4.0, seed) for seed in (1, 2, 3)),
    ],
)
def test_a_backlash_has_its_gap_whatever_its_flanks_are_like(stiffness: float, damping: float, seed: int) -> None:
    """Taken for granted they would be an error of the gap."""
    truth = Backlash(link=0, gap=0.01, motor_share=0.4, flank_stiffness=stiffness, flank_damping=damping).placed(RIG, 0)
    recordings = recorded(Arm.of(chain_of(), (truth,)), seed, duration=4.0)
    start = replace(truth, gap=0.012, flank_stiffness=1000.0, flank_damping=2.5)
    found = refit(in_segments(recordings), [start])
    assert found is not None
    assert found.point.misfit == pytest.approx(1.0, abs=0.03)
    (backlash,), (part,) = found.effects, found.point.problem.parts
    assert backlash.values["gap"] == pytest.approx(0.01, rel=0.015)
    assert backlash.values["motor_share"] == pytest.approx(0.4, rel=0.01)
    sizes = _with_errors(backlash, information_of(found).covariance[part, part])
    for name, size in sizes.items():
        assert size.std is not None
        assert abs(size.value - truth.values[name]) < 3 * size.std, name


@pytest.mark.parametrize("seed", [1, 2])
def test_dry_friction_is_fitted_beside_the_error_of_a_coarse_chain(seed: int) -> None:
    """Of an arm with twelve virtual joints, by a model with three."""
    truth = CoulombFriction(link=0, torque=0.008)
    found = refit(in_segments(recorded(Arm.of(chain_of(12), (truth,)), seed)), [truth])
    assert found is not None
    fit = continued(found, np.inf)
    bias = first_order_bias(fit.point, RIG)
    assert bias is not None
    corrected, shifted = (corrected_for_discretization(fit, RIG, bias.decrease * share) for share in (0.5, 1.5))
    assert corrected is not None
    assert corrected.shift is not None
    # What the chain's error adds to chi^2 is gone; the chain stays, and what a beam's parameters are is said beside it.
    assert bias.decrease > 50
    assert fit.chi2 - corrected.chi2 == pytest.approx(bias.decrease, rel=0.1)
    assert corrected.point.x == pytest.approx(fit.point.x)
    errors = np.sqrt(np.diag(information_of(fit).covariance))
    assert (np.abs(corrected.shift - bias.shift) < errors).all()
    assert abs(corrected.estimate[-1] - truth.coordinates[0]) < 3 * errors[-1]
    # An error that is negligible moves the estimates alone.
    assert shifted is not None
    assert shifted.chi2 == fit.chi2
    assert shifted.shift == pytest.approx(bias.shift)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_the_error_of_long_steps_is_corrected_with_that_of_few_joints(seed: int) -> None:
    """Friction that falls with the joint's rate changes within a step."""
    noise, truth = (2e-4, 6e-5), Stribeck(link=0, torque=0.008, speed=0.08).placed(RIG, 0)
    recordings = recorded(Arm.of(chain_of(12), (truth,)), seed, noise=noise, duration=4.0)
    point = point_of(chain_of(), [truth], recordings, noise)
    problem = replace(point.problem, effects=(truth,), step_multiple=2.0)
    fit = continued(fit_trajectory(problem, np.concatenate([point.x, truth.coordinates])), np.inf)
    corrected = corrected_for_discretization(fit, RIG)
    assert corrected is not None
    (part,) = fit.point.problem.parts
    errors = np.sqrt(np.diag(information_of(fit).covariance[part, part]))
    assert np.abs((fit.estimate[part] - truth.coordinates) / errors).max() > 3.5
    assert (np.abs(corrected.estimate[part] - truth.coordinates) < 2 * errors).all()
    assert corrected.chi2 < corrected.point.noise_limit


def test_an_estimate_that_left_its_bound_is_as_uncertain_as_anywhere() -> None:
    """At the bound it counts as known, and correlated parameters as better known than they are."""
    body = TipPayload(link=0, mass=0.01, radius_of_gyration=0.0, offset=0.05).placed(RIG, 0)
    recordings = recorded(Arm.of(chain_of(), (body,)), 1)
    point = point_of(chain_of(), [body], recordings)
    problem = replace(point.problem, effects=(body,))
    at_bound = problem.point(np.concatenate([point.x, body.coordinates]), point.states)
    assert at_bound.held.any()
    shift = np.where(at_bound.held, 0.5, 0.0)
    free = problem.point(at_bound.x + shift, at_bound.states)
    found, expected = (
        information_of(fit) for fit in (TrajectoryFit(at_bound, shift=shift), TrajectoryFit(free, shift=0 * shift))
    )
    assert not found.held.any()
    assert found.normal == pytest.approx(expected.normal)
    assert information_of(TrajectoryFit(at_bound)).held.any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_sizes_of_a_backlash_are_those_beside_more_joints(seed: int) -> None:
    """Of an arm with eighteen virtual joints, by a model with three."""
    truth = Backlash(link=0, gap=0.01, motor_share=0.4).placed(RIG, 0)
    recordings = recorded(Arm.of(chain_of(18), (truth,)), seed, duration=4.0)
    found = refit(in_segments(recordings), [replace(truth, gap=0.012, flank_damping=2.5)])
    assert found is not None
    fit = continued(found, np.inf)
    bias, corrected = first_order_bias(fit.point, RIG), corrected_for_discretization(fit, RIG)
    assert bias is not None
    assert corrected is not None
    assert corrected.shift is not None
    (part,) = fit.point.problem.parts
    errors = np.sqrt(np.diag(information_of(fit).covariance[part, part]))
    before = (fit.point.x[part] - truth.coordinates) / errors
    assert np.abs(before).max() > 10.0  # the motor's share
    for shift in (bias.shift, corrected.shift):
        after = before + shift[part] / errors
        assert (np.abs(after) < 4.0).all()
        assert np.sqrt(np.mean(after**2)) < 2.0
    # What the chain's error adds to chi^2 is gone, and nothing else stands in for it.
    assert fit.chi2 - corrected.chi2 == pytest.approx(bias.decrease, rel=0.2)
    assert corrected.chi2 < corrected.point.noise_limit


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_a_segment_that_sticks_is_begun_from_rest_or_from_the_end_of_the_one_before(seed: int) -> None:
    truth = CoulombFriction(link=0, torque=0.008)
    recordings = recorded(Arm.of(chain_of(), (truth,)), seed, duration=4.0)
    point = point_of(chain_of(), [truth], recordings)
    problem = replace(point.problem, effects=(truth,))
    point = replace(point, problem=problem, x=np.concatenate([point.x, truth.coordinates]))
    duration = problem.first_horizon(point.x) / 2
    right = fit_segments(TrajectoryFit(point), problem.observed, duration, StoppingRule(max_steps=0)).point
    off = np.zeros(right.states[0].size)
    off[right.chain.size + right.chain.active] = 0.3
    states = [state + off * (k % 2) for k, state in enumerate(right.states)]
    wrong = right.problem.simulated(right.x, states, states, [1.0] * len(states))
    assert max(run.chi2 / run.observed.count for run in wrong.runs) > 10
    found = _multistart(wrong)
    assert sum(run.chi2 for run in found) < 1.1 * right.chi2


@pytest.mark.parametrize(("seed", "start"), [(1, 0.0035), pytest.param(3, 0.013, marks=pytest.mark.slow)])
def test_dry_friction_has_its_torque_though_its_search_begins_far_away(seed: int, start: float) -> None:
    """The likelihood of where a segment begins has many maxima; in the nearest one friction comes out too small."""
    truth = CoulombFriction(link=0, torque=0.008)
    recordings = recorded(Arm.of(chain_of(), (truth,)), seed, duration=4.0)
    found = refit(in_segments(recordings), [replace(truth, torque=start)])
    assert found is not None
    assert found.point.misfit < 1.1
    assert found.effects[0].values["torque"] == pytest.approx(0.008, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_fit_beside_dry_friction_ends_in_its_minimum(seed: int) -> None:
    """From the truth a search arrives at the same parameters; states may be in minima of their own."""
    truth = CoulombFriction(link=0, torque=0.008)
    recordings = recorded(Arm.of(chain_of(), (truth,)), seed, duration=4.0)
    found = refit(in_segments(recordings), [replace(truth, torque=0.0075)])
    assert found is not None
    fit = continued(found, np.inf)
    assert found.chi2 - 20 < fit.chi2 <= found.chi2
    problem, x = fit.point.problem, fit.point.x.copy()
    x[-1:] = truth.coordinates
    std = np.sqrt(np.diag(information_of(fit).covariance))
    assert abs(fit.point.x[-1] - x[-1]) < 3 * std[-1]
    from_truth = fit_trajectory(problem, x, states=fit.point.states)
    assert (np.abs(fit.point.x - from_truth.point.x) < 0.5 * std).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 4, 7])
def test_whole_recordings_that_stick_are_followed_from_segments(seed: int) -> None:
    """They tell much more of friction, and chi^2 is as low as from the truth; three searches end at kinks at first."""
    truth = CoulombFriction(link=0, torque=0.008)
    recordings = recorded(Arm.of(chain_of(), (truth,)), seed, duration=4.0)
    whole = point_of(chain_of(), (), recordings).problem.observed
    found = refit(in_segments(recordings), [replace(truth, torque=0.0075)])
    assert found is not None
    largest = largest_chi2_in_longer(found, whole, np.inf)
    fit = fit_segments(found, whole, np.inf, StoppingRule(largest))
    problem = fit.point.problem
    x = np.r_[problem.parametrisation.start, truth.coordinates]
    resting = [np.zeros(2 * chain_of().size)] * len(whole)
    assert fit.chi2 < fit_trajectory(problem, x, states=resting).chi2 + 2
    std, before = (float(np.sqrt(information_of(each).covariance[-1, -1])) for each in (fit, found))
    assert std < 0.3 * before
    assert abs(fit.point.x[-1] - x[-1]) < 3 * std


@pytest.mark.slow
def test_what_sticks_begins_nearer_where_a_step_misses() -> None:
    point, step, off = missing_step(CoulombFriction(link=0, torque=0.008))
    trial = _trial_point(point, step)
    unchanged = point.problem.simulated(point.x + step.change, [0 * off, 0 * off], point.states, [1.0, 1.0])
    assert trial is not None
    for run, begun in zip(trial.runs, unchanged.runs, strict=True):
        assert run.cost <= begun.cost * (1 + 1e-12)


def test_a_state_is_refined_where_it_alone_spoils_a_step() -> None:
    """All of what the step in its own state costs comes back in a few trials."""
    point, step, off = missing_step(ViscousFriction(link=0, coefficient=0.02))
    step = replace(step, state_changes=[off, 0 * off], predicted_decreases=[10.0, 0.0])
    trial = _trial_point(point, step)
    missed = point.problem.simulated(point.x + step.change, [off, 0 * off], point.states, [1.0, 1.0])
    assert trial is not None
    assert trial.cost < point.cost + 0.01 * (missed.cost - point.cost)


def test_states_are_not_refined_where_all_of_them_fall_short() -> None:
    """The coordinates' step is then wrong, and is shortened: searches for all states would take most of the time."""
    point, step, off = missing_step(ViscousFriction(link=0, coefficient=0.02))
    trial = _trial_point(point, step)
    assert trial is not None
    for run in trial.runs:
        assert run.state == pytest.approx(off)


@pytest.mark.slow
def test_a_step_is_kept_where_a_nearer_beginning_cannot_be_simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    def diverge(*anything: object) -> list[Run]:
        raise SimulationDivergedError(0.1, 1e-3, "")

    monkeypatch.setattr(trajectory_fit, "backtrack", diverge)
    point, step, off = missing_step(CoulombFriction(link=0, torque=0.008))
    trial = _trial_point(point, step)
    assert trial is not None
    for run in trial.runs:
        assert run.state == pytest.approx(off)


def test_a_start_that_cannot_be_simulated_is_taken_nearer_to_the_null() -> None:
    """So strong a softening takes all stiffness from a link that is bent as far."""
    truth = CubicStiffness(link=0, coefficient=-0.3)
    start = in_segments(recorded(Arm.of(chain_of(), (truth,)), 1, duration=4.0))
    far = replace(truth, coefficient=-4.0)
    with pytest.raises(SimulationDivergedError):
        replace(start.point.problem, effects=(far,)).point(np.r_[start.point.x, far.coordinates], start.point.states)
    found = refit(start, [far])
    assert found is not None
    assert found.effects[0].values["coefficient"] == pytest.approx(-0.3, rel=0.05)


def missing_step(effect: Effect) -> tuple[Point, _TrajectoryStep, Array]:
    """A right model, a step of its initial states alone that promises much, and that change of a state."""
    arm = Arm.of(chain_of(), [effect])
    point = point_of(chain_of(), [effect], recorded(arm, 1))
    problem = replace(point.problem, effects=(effect,))
    point = replace(point, problem=problem, x=np.concatenate([point.x, effect.coordinates]))
    off = np.zeros(2 * arm.chain.size)
    off[arm.chain.size] = 0.1
    return point, _TrajectoryStep(20.0, 1.0, np.zeros(point.x.size), [off, off], [off, off], [10.0, 10.0], 0.0), off


@pytest.mark.parametrize(
    ("effect", "decrease", "promised", "ended"),
    [
        (CoulombFriction(link=0, torque=0.008), 9.0, 0.09, True),  # its states alone promise more, and do not keep it
        (CoulombFriction(link=0, torque=0.008), 9.0, 0.11, False),
        (CoulombFriction(link=0, torque=0.008), 11.0, 0.09, False),
        (ViscousFriction(link=0, coefficient=0.01), 9.0, 0.09, False),  # derivatives lead on
    ],
)
def test_a_fit_beside_sticking_ends_once_its_parameters_promise_little(
    effect: Effect, decrease: float, promised: float, ended: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    point, step, _ = missing_step(effect)
    search = trajectory_fit._TrajectorySearch(point, True, None, lambda *_: None)
    search.step, search.decreases = step, [decrease]
    monkeypatch.setattr(search, "step_at", lambda damping: replace(step, coordinate_decrease=promised))
    assert search.is_nonsmooth_minimum(point) is ended


@pytest.mark.parametrize(
    ("effect", "multiple"),
    [
        (GearElasticity(link=0, stiffness=200.0, damping=0.01), 1.0),
        (ViscousFriction(link=0, coefficient=5e-3), 4.0),
        pytest.param(Backlash(link=0, gap=0.01), 4.0, marks=pytest.mark.slow),  # has short steps of its own
    ],
)
def test_long_steps_are_not_taken_over_to_a_model_with_a_joint_more(effect: Effect, multiple: float) -> None:
    """The joint may vibrate far faster than the arm without it, for which they were found short enough."""
    start = in_segments(recorded(Arm.of(chain_of(), (effect,)), 1))
    problem = replace(start.point.problem, step_multiple=4.0)
    found = refit(replace(start, point=replace(start.point, problem=problem)), [effect], StoppingRule(max_steps=0))
    assert found is not None
    assert found.point.problem.step_multiple == multiple


@pytest.mark.parametrize(
    ("effect", "excess", "promised", "by_coordinates", "ended"),
    [
        (CoulombFriction(link=0, torque=0.008), 400.0, 100.0, 0.09, True),
        (CoulombFriction(link=0, torque=0.008), 400.0, 100.0, 0.5, False),  # its parameters have not settled
        (CoulombFriction(link=0, torque=0.008), 200.0, 100.0, 0.09, False),  # its states may bring it down to noise
        (ViscousFriction(link=0, coefficient=0.01), 400.0, 100.0, 0.09, False),  # derivatives keep what they promise
    ],
)
def test_a_wrong_model_beside_sticking_ends_once_only_initial_states_are_left(
    effect: Effect, excess: float, promised: float, by_coordinates: float, ended: bool
) -> None:
    step = _TrajectoryStep(promised, 1.0, np.zeros(1), [], [], [], by_coordinates)
    problem = SimpleNamespace(effects=(effect,))
    point = SimpleNamespace(problem=problem, misfit=1.5, chi2=2000.0 + excess, noise_limit=2000.0)
    search = trajectory_fit._TrajectorySearch(point, True, None, lambda *_: None)  # type: ignore[arg-type]
    search.step = step
    assert search.stopping_rule() == ("converged" if ended else "running")


@pytest.mark.slow
def test_no_multistart_is_repeated_where_the_steps_since_have_hardly_gained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside friction of a wrong model: a payload is missing."""
    friction, payload = CoulombFriction(link=0, torque=0.008), TipPayload(mass=0.02)
    start = in_segments(recorded(Arm.of(chain_of(), (friction, payload)), 1))
    calls: list[float] = []

    def counted(point: Point, only_at_kinks: bool, deadline: float) -> tuple[Run, ...]:
        if not only_at_kinks:
            calls.append(point.chi2)
        return _multistart(point, only_at_kinks, deadline)

    monkeypatch.setattr(candidate_fit, "_multistart", counted)
    fit = refit(start, [friction])
    assert fit is not None
    assert fit.misfit > 1.5
    assert len(calls) == 1


@pytest.mark.slow
def test_friction_that_explains_all_is_fitted_before_a_slow_candidate() -> None:
    truth = CoulombFriction(link=0, torque=0.008)
    start = TrajectoryFit(point_of(chain_of(), (), recorded(Arm.of(chain_of(), (truth,)), 1)))
    steps: list[str] = []
    effects = [BaseCompliance(), CoulombFriction()]
    (found,) = selection.Search(RIG, start, effects, SearchOptions(), steps.append).run().best.effects
    assert found.values["torque"] == pytest.approx(0.008, rel=0.01)
    assert [step for step in steps if step.startswith("fitting coulomb_friction")]
    assert not [step for step in steps if "base_compliance" in step]


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_a_small_effect_beside_the_discretization_error_is_that_of_a_beam(seed: int) -> None:
    """By itself a chain of four joints needs one of 40 standard errors; its own parameters stay shifted."""
    start = TrajectoryFit(point_of(chain_of(4), (), recorded(Arm(chain_of(36)), seed, factor=3.0)))
    base = corrected_for_discretization(fit_trajectory(start.point.problem, start.point.x), RIG)
    assert base is not None
    assert base.shift is not None
    effect = CubicStiffness().placed(RIG, 0)
    fit = refit(base, [effect.at(np.array([0.3]))])
    assert fit is not None
    assert fit.shift is not None
    assert np.array_equal(fit.shift[:-1], base.shift)
    assert abs(fit.estimate[-1]) < 3 * np.sqrt(information_of(fit).covariance[-1, -1])


@pytest.mark.slow
@pytest.mark.parametrize(("size", "in_segments"), [(0.00125, False), (0.0, False), (0.5, True)])
def test_what_is_small_is_looked_for_in_whole_recordings_at_once(size: float, in_segments: bool) -> None:
    """Segments show less of it; but a model that lacks much may lose whole recordings."""
    truth = [CubicStiffness(link=0, coefficient=size)] if size else []
    start = TrajectoryFit(point_of(chain_of(4), (), recorded(Arm.of(chain_of(36), truth), 1, factor=3.0)))
    base = corrected_for_discretization(fit_trajectory(start.point.problem, start.point.x), RIG)
    assert base is not None
    steps: list[str] = []
    best = selection.Search(RIG, base, [CubicStiffness()], SearchOptions(), steps.append).run().best
    assert ("fitting segments" in steps) is in_segments
    assert best.misfit == pytest.approx(1.0, abs=0.05)
    assert len(best.effects) == len(truth)
    for effect in truth:
        std = float(np.sqrt(information_of(best).covariance[-1, -1]))
        assert abs(best.estimate[-1] - effect.coordinates[0]) < 3 * std < effect.coordinates[0]


@pytest.mark.slow
def test_a_table_that_was_recentred_is_lengthened_about_its_new_direction() -> None:
    truth = BaseCompliance(stiffness=500.0, mass=1.0, direction=1.3).placed(RIG, None)
    point = point_of(chain_of(), (truth,), recorded(Arm.of(chain_of(), (truth,)), 1, factor=3.0))
    off = replace(truth, direction=truth.direction + 1.1)
    problem = replace(point.problem, effects=(off,))
    start = TrajectoryFit(problem.point(np.concatenate([point.x, off.coordinates])))
    fit = fit_segments(start, point.problem.observed, np.inf, StoppingRule())
    (found,) = fit.effects
    assert found.values["direction"] == pytest.approx(truth.direction, abs=0.1)
    assert fit.point.problem.point(fit.point.x, fit.point.states).chi2 == pytest.approx(fit.chi2, rel=1e-6)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
@pytest.mark.parametrize("friction", [0.0, 5e-3])
def test_longer_segments_lose_a_model_that_lacks_something_and_no_other(friction: float, seed: int) -> None:
    """The initial states that there are fewer of take noise with them, which is not to be taken for a loss."""
    hidden = (ViscousFriction(link=0, coefficient=friction),) if friction else ()
    shorter = in_segments(recorded(Arm.of(chain_of(), hidden), seed))
    observed = point_of(chain_of(), (), recorded(Arm.of(chain_of(), hidden), seed)).problem.observed
    longer = fit_segments(shorter, observed, np.inf, StoppingRule())
    assert longer.chi2 > shorter.chi2 + len(shorter.point.runs) - len(longer.point.runs)
    assert (longer.chi2 > largest_chi2_in_longer(shorter, observed, np.inf)) == bool(friction)


@pytest.mark.parametrize("known", [True, False])
def test_after_the_deadline_a_cause_is_not_kept_that_a_known_fit_does_without(known: bool) -> None:
    """Nothing more is fitted for that."""
    hidden = ViscousFriction(link=0, coefficient=5e-3)
    start = TrajectoryFit(point_of(chain_of(), (), recorded(Arm.of(chain_of(), (hidden,)), 1)))
    right = refit(start, [hidden])
    assert right is not None
    both = refit(right, [*right.effects, JointSpring(link=0, stiffness=1e-6)])
    assert both is not None
    options = selection.SearchOptions(deadline=-np.inf)
    search = selection.Search(RIG, start, [], options, lambda text: None)
    fits = {fit.effect_keys: fit for fit in ((right, both) if known else (both,))}
    kept = search._justified(both, fits)
    assert kept is (right if known else both)
    assert search.unjustified == (["joint_spring"] if known else [])
    assert len(fits) == 1 + known
    assert search.stopped


def test_a_search_keeps_the_time_that_its_last_tests_of_candidates_take(monkeypatch: pytest.MonkeyPatch) -> None:
    start = TrajectoryFit(point_of(chain_of(), (), recorded(Arm.of(chain_of(), ()), 1)))
    now, taken = 1000.0, iter([30.0, 20.0, 40.0])
    monkeypatch.setattr(selection, "monotonic", lambda: now)
    screened = selection.Screen.of

    def slow(*arguments: Any) -> selection.Screen:
        nonlocal now
        now += next(taken)
        return screened(*arguments)

    monkeypatch.setattr(selection.Screen, "of", slow)
    search = selection.Search(RIG, start, [JointSpring()], selection.SearchOptions(deadline=1100.0), lambda text: None)
    left = []
    for _ in range(3):
        search.screen(start)
        left.append(search.deadline)
    assert left == [1070.0, 1070.0, 1060.0]
    part = replace(start, point=replace(start.point, runs=start.point.runs[:1]))  # half of the values
    taken = iter([30.0])
    search.screen(part)
    assert search.deadline == 1040.0
    assert search.out_of_time
    assert search.stopped


@pytest.mark.parametrize("effect", [TipPayload(mass=0.01), Backlash(gap=0.01)])
def test_with_play_a_fit_ends_by_what_its_last_step_has_brought(effect: Effect) -> None:
    """A smooth one by what the next step promises."""
    ended = []
    for promise in (40.0, 1.0):
        stop = StoppingRule(max_chi2=900.0)
        chi2 = iter([1100.0, 1000.0, 990.0])
        points = (
            SimpleNamespace(chi2=each, expected_chi2=100.0, problem=SimpleNamespace(effects=(effect,))) for each in chi2
        )
        ended.append([stop(point, predicted) for point, predicted in zip(points, (80.0, 50.0, promise), strict=True)])
    assert ended == [[False, False, effect.nonsmooth], [False, False, True]]


@pytest.mark.slow
@pytest.mark.parametrize("lost", [False, True])
def test_friction_is_followed_over_whole_recordings_unless_segments_lose_it(
    lost: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = CoulombFriction(link=0, torque=0.008)
    start = TrajectoryFit(point_of(chain_of(), (), recorded(Arm.of(chain_of(), (truth,)), 1, duration=4.0)))
    if lost:
        monkeypatch.setattr(selection, "largest_chi2_in_longer", lambda shorter, whole, duration: shorter.chi2)
    search = selection.Search(RIG, start, [CoulombFriction()], SearchOptions(), lambda text: None)
    best = search.run().best
    assert [effect.id for effect in best.effects] == ["coulomb_friction"]
    assert (len(best.point.runs) > 2) == lost


@pytest.mark.parametrize("effects", [(), (CoulombFriction(link=0, torque=0.008),)], ids=["smooth", "sticking"])
@pytest.mark.parametrize("deadline", [-np.inf, np.inf])
def test_no_multistart_begins_after_the_deadline(
    deadline: float, effects: tuple[Effect, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    point = point_of(chain_of(), effects, recorded(Arm.of(chain_of(), effects), 1, duration=0.5))
    begun = []
    multistart = candidate_fit._multistart
    monkeypatch.setattr(
        candidate_fit, "_multistart", lambda *args, **options: begun.append(1) or multistart(*args, **options)
    )
    candidate_fit._fit_multistart(point.problem, point.x, point.states, StoppingRule(deadline=deadline))
    assert bool(begun) == (deadline > 0)


@pytest.mark.parametrize("gy", [0.4, 30.0])
def test_one_of_two_sizes_may_be_at_its_bound_on_the_way_but_not_in_the_end(
    gy: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gravity along a clamped link, which hardly shows, stands in for what later effects explain."""
    start = TrajectoryFit(point_of(chain_of(), (), recorded(Arm(chain_of()), 1)))
    gravity = InPlaneGravity(gx=-30.0, gy=gy)
    fit = SimpleNamespace(new_effects=(gravity,), effects=(gravity,), chi2=0.9 * start.chi2)
    monkeypatch.setattr(candidate_fit, "refit", lambda *_, **__: fit)
    found = candidate_fit.refit_within_bounds(start, np.inf, np.inf, [gravity])
    assert found is (None if gy == 30.0 else fit)
    for name in ("is_determined", "predicts_better"):
        monkeypatch.setattr(selection, name, lambda *_: True)
    search = selection.Search(RIG, start, [], SearchOptions(), lambda text: None)
    monkeypatch.setattr(search, "refit_without", lambda *_: start)
    for sizes, kept in (({"gx": -30.0}, False), ({"gx": 3.0, "gy": 0.4}, True)):
        ended = SimpleNamespace(new_effects=(replace(gravity, **sizes),))
        assert search._justified(ended, {}) is (ended if kept else start)  # type: ignore[arg-type]


@pytest.mark.slow
def test_friction_whose_fit_comes_out_worse_than_none_is_fitted_from_better_states() -> None:
    """Its first step corrects initial states that suit a motion without it, and leads astray."""
    truth = Stribeck(link=0, torque=0.012, speed=0.03)
    start = in_segments(recorded(Arm.of(chain_of(), (truth,)), 1))
    fit = candidate_fit.refit_within_bounds(start, np.inf, np.inf, [truth])
    assert fit is not None
    assert fit.misfit == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(
    ("misfit", "max_chi2"),
    [(0.9, np.inf), (1.1, 0.95)],  # of the model without it; a rival is better
    ids=["better", "given up"],
)
def test_friction_is_not_fitted_again_where_nothing_is_to_be_had(
    misfit: float, max_chi2: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = TrajectoryFit(point_of(chain_of(), (), recorded(Arm(chain_of()), 1)))
    truth = Stribeck(link=0, torque=0.008, speed=0.05)
    fits: list[object] = []

    def refitted(start: TrajectoryFit, *_: object, **__: object) -> object:
        fits.append(SimpleNamespace(new_effects=(truth,), chi2=misfit * start.chi2))
        return fits[-1]

    monkeypatch.setattr(candidate_fit, "refit", refitted)
    fit = candidate_fit.refit_within_bounds(start, np.inf, max_chi2 * start.chi2, [truth])
    assert [fit] == fits


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_initial_states_may_be_estimated_before_all_parameters(seed: int) -> None:
    truth = Stribeck(link=0, torque=0.008, speed=0.08)
    start = in_segments(recorded(Arm.of(chain_of(), (truth,)), seed))
    far = replace(truth, torque=0.004, speed=0.05)
    fit = refit(start, [far], StoppingRule(max_steps=1), states_first=True)
    plain = refit(start, [far], StoppingRule(max_steps=1))
    assert fit is not None
    assert plain is not None
    assert fit.chi2 < plain.chi2


@pytest.mark.parametrize("seed", [1, 2])
def test_a_lag_is_right_in_recordings_that_begin_in_motion(seed: int) -> None:
    """What the torque was before is not known; initial states, which are estimated, take over what that does."""
    truth = ActuatorLag(link=0, time_constant=0.012)
    begun = []
    for recording in recorded(Arm.of(chain_of(), (truth,)), seed, duration=3.0):
        later = slice(int(np.searchsorted(recording.time, 0.7)), None)
        columns = {name: getattr(recording, name)[later] for name in ("time", "theta", "tau", "markers")}
        begun.append(replace(recording, **columns))
    assert all(np.abs(recording.tau[0]) > 0.01 for recording in begun)
    point = point_of(chain_of(), (), begun)
    problem = replace(point.problem, effects=(truth,))
    fit = fit_trajectory(problem, np.r_[point.x, replace(truth, time_constant=0.004).coordinates])
    lag = fit.effects[0].coordinates[0]
    std = float(np.sqrt(information_of(fit).covariance[-1, -1]))
    assert fit.misfit == pytest.approx(1.0, abs=0.03)
    assert abs(lag - truth.coordinates[0]) < 3 * std
    assert std < 0.01 * lag


def test_without_an_effect_the_linear_model_predicts_what_a_fit_leaves() -> None:
    truth = (CubicStiffness(link=0, coefficient=0.2), ViscousFriction(link=0, coefficient=0.01))
    fit = refit(in_segments(recorded(Arm.of(chain_of(), truth), 1)), truth)
    assert fit is not None
    for effect in fit.effects:
        fewer = refit(fit, [one for one in fit.effects if one is not effect])
        assert fewer is not None
        assert predicted_increase(fit, effect) == pytest.approx(fewer.chi2 - fit.chi2, rel=0.2)
        assert fewer.chi2 - fit.chi2 > 100


def test_a_known_model_is_fitted_again_only_if_it_may_be_in_another_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = CubicStiffness(link=0, coefficient=0.2)
    start = in_segments(recorded(Arm.of(chain_of(), (truth,)), 1))
    fit = refit(start, [truth])
    assert fit is not None
    search = selection.Search(RIG, start, [], SearchOptions(), lambda text: None)
    refits: list[object] = []
    monkeypatch.setattr(selection, "refit", lambda *arguments: refits.append(arguments) or refit(*arguments))
    assert search.refit_without(fit, fit.effects[0], {start.effect_keys: start}) is start
    assert search.refit_without(fit, fit.effects[0], {}) is start  # the search's own start, if nothing else is known
    assert not refits
    lost = TrajectoryFit(start.point.problem.point(1.3 * start.point.x, start.point.states))
    assert lost.chi2 > 10 * start.chi2
    again = search.refit_without(fit, fit.effects[0], {start.effect_keys: lost})
    assert len(refits) == 1
    assert again is not None
    assert again.chi2 == pytest.approx(start.chi2, rel=0.01)


def test_a_further_parameter_must_bring_its_share() -> None:
    """Unless it is at a bound, where it has brought nothing."""
    recordings = recorded(Arm(chain_of()), 1)
    point = point_of(chain_of(), (), recordings)
    one, two, held = (
        TrajectoryFit(replace(point.problem, effects=(effect,)).point(np.r_[point.x, effect.coordinates]))
        for effect in (
            ViscousFriction(link=0, coefficient=1e-6),
            ViscoelasticCreep(link=0, ratio=1e-6),
            TipPayload(link=0, mass=1e-6, radius_of_gyration=0.0),
        )
    )
    assert two.chi2 == pytest.approx(one.chi2, rel=1e-3)
    plain, strict = SearchOptions(), selection.SearchOptions(parameter_share=1.0)
    assert plain.criterion(two) == two.chi2
    assert strict.criterion(two) == pytest.approx(2 * strict.criterion(one), rel=1e-3)
    assert strict.criterion(held) == pytest.approx(2 * strict.criterion(one), rel=1e-3)  # mass and offset


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "off"), [(1, 1.1), (2, -0.9), (3, 0.9)])  # rad
def test_a_table_that_slides_across_its_start_is_found(seed: int, off: float) -> None:
    """In coordinates about its start its direction ends 45 degrees away."""
    truth = BaseCompliance(stiffness=500.0, mass=1.0, direction=1.3).placed(RIG, None)
    start = TrajectoryFit(point_of(chain_of(), (), recorded(Arm.of(chain_of(), (truth,)), seed, factor=3.0)))
    fit = refit(start, [replace(truth, direction=truth.direction + off)])
    assert fit is not None
    assert fit.misfit == pytest.approx(1.0, abs=0.05)
    (found,) = fit.effects
    assert found.values["direction"] == pytest.approx(truth.direction, abs=0.1)
    assert found.values["stiffness"] == pytest.approx(truth.stiffness, rel=0.1)


def test_a_fit_that_was_stopped_is_continued() -> None:
    truth = BaseCompliance(stiffness=500.0, mass=1.0, direction=1.3).placed(RIG, None)
    recordings = recorded(Arm.of(chain_of(), (truth,)), 1, factor=3.0)
    start = TrajectoryFit(point_of(chain_of(), (), recordings))
    off = truth.at(truth.coordinates + np.array([0.1, 0.02, 0.2, 0.1]))
    stopped = refit(start, [off], StoppingRule(max_steps=1))
    assert stopped is not None
    assert not stopped.converged
    found = continued(stopped, np.inf)
    assert found.converged
    assert found.chi2 < stopped.chi2 - 5
    assert found.misfit == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("misfit", "converged", "predicted", "runs", "shown"),
    [
        (1.1, True, 0.0, 2, (1.1, None)),
        (1.1, True, 0.0, 6, (1.1, "lower")),  # of segments, each with an initial state of its own
        (1.1, False, 0.001, 2, (1.1, None)),  # nothing more would be seen of the rest
        (5.0, False, np.inf, 2, (5.0, "upper")),  # given up on its way down
        (60.0, False, np.inf, 2, (None, None)),  # and on its way from above what there is without it
        (5.0, False, np.inf, 6, (None, None)),
    ],
)
def test_a_candidate_shows_the_residual_of_its_fit_as_far_as_that_says_something(
    misfit: float, converged: bool, predicted: float, runs: int, shown: tuple[float | None, str | None]
) -> None:
    def fit(misfit: float, runs: int) -> SimpleNamespace:
        chi2 = 100 * misfit**2
        point = SimpleNamespace(runs=[None] * runs)
        decrease = predicted * chi2
        return SimpleNamespace(point=point, misfit=misfit, chi2=chi2, converged=converged, predicted_decrease=decrease)

    candidate = Candidate(ViscousFriction(link=0), 9.0, 0.0, {}, {})
    found = _with_residual(candidate, fit(misfit, runs), fit(9.0, 2))  # type: ignore[arg-type]
    assert (found.misfit, found.bound) == shown


@pytest.mark.parametrize("coefficient", [0.0, 0.02])
def test_what_a_finer_chain_explains_calls_for_no_effect(coefficient: float) -> None:
    """Large bends of a beam, and of a chain whose stiffness grows with them, by a chain of few joints."""
    truth = (
        Arm.of(chain_of(3), (CubicStiffness(link=0, coefficient=coefficient),)) if coefficient else Arm(chain_of(30))
    )
    fit = in_segments(recorded(truth, 1, factor=2.5))
    search = selection.Search(RIG, fit, [], SearchOptions(), lambda text: None)
    assert fit.point.noise_limit < fit.chi2 < 4 * fit.point.expected_chi2
    assert search._leaves_only_noise(fit) == (not coefficient)


@pytest.mark.parametrize("coefficient", [0.0, 0.02])
def test_a_single_effect_is_dropped_where_a_linear_model_says_that_it_is_not_needed(coefficient: float) -> None:
    cubic = CubicStiffness(link=0, coefficient=coefficient)
    start = TrajectoryFit(point_of(chain_of(), (), recorded(Arm.of(chain_of(), (cubic,)), 1, factor=2.0)))
    fit = refit(start, [replace(cubic, coefficient=0.01)])
    assert fit is not None
    search = selection.Search(RIG, start, [cubic], SearchOptions(), lambda text: None)
    fits = {fit.effect_keys: fit}
    assert search._backward_elimination(fit, fits) is fit
    assert len(search._backward_elimination(fit, fits, doubtful=True).effects) == bool(coefficient)


def test_without_causes_the_best_minimum_found_is_the_model_of_the_report() -> None:
    """And the deadline is the given one again when the last tests of candidates are made."""
    start = TrajectoryFit(point_of(chain_of(4), (), recorded(Arm(chain_of(24)), 1)))
    options = selection.SearchOptions(deadline=1e9)
    search = selection.Search(RIG, start, [JointSpring()], options, lambda text: None)
    best = search.run().best
    assert not best.effects
    assert best.chi2 < start.chi2 - 1
    assert search.start is best
    assert search.deadline == pytest.approx(options.deadline, abs=1e-3)
    assert not search.stopped


@pytest.mark.slow
def test_no_effect_is_found_in_bends_so_large_that_eight_joints_leave_ten_times_the_noise() -> None:
    start = TrajectoryFit(point_of(chain_of(8), (), recorded(Arm(chain_of(64)), 1, duration=4.0, factor=4.0)))
    search = selection.Search(RIG, start, [CubicStiffness()], SearchOptions(), lambda text: None)
    result = search.run()
    assert not result.best.effects
    assert result.best.misfit == pytest.approx(1.0, abs=0.03)
    assert not search.still_needed(result)


def test_another_frequency_is_beside_the_same_discretization_error() -> None:
    truth = GearElasticity(link=0, stiffness=30.0, motor_share=0.5, damping=0.01)
    segments = in_segments(recorded(Arm.of(chain_of(), (truth,)), 1))
    stiff = refit(segments, [replace(truth, stiffness=4 * truth.stiffness)], StoppingRule(max_steps=0))
    assert stiff is not None
    known = replace(stiff, shift=np.arange(stiff.point.x.size, dtype=float))
    found = refit_other_frequencies(known)
    assert found.chi2 < known.chi2
    assert found.shift is known.shift


def test_an_effect_at_another_joint_is_not_the_one_that_is_there() -> None:
    """Its fit was wanted when the deadline came, and is missing."""
    start = TrajectoryFit(point_of(chain_of(), (), recorded(Arm(chain_of()), 1)))
    here, there = (CoulombFriction(link=k, torque=0.1) for k in (0, 1))
    search = selection.Search(RIG, start, [here, there], selection.SearchOptions(deadline=0.0), lambda text: None)
    present = SimpleNamespace(effects=(here,), effect_keys=frozenset({here.key}), misfit=1.0)
    assert search.fit_models(present, [(here, there)], np.inf, {}) == []  # type: ignore[arg-type]
    assert search.unfinished == {there.key}


def test_what_was_there_before_a_change_is_known_in_whole_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search for it may have ended in segments."""
    recordings = [replace(each, condition="reference") for each in recorded(Arm(chain_of()), 1)]
    whole = TrajectoryFit(point_of(chain_of(), (), recordings))
    segments = refit(in_segments(recordings), [ViscousFriction(link=0, coefficient=0.01)], StoppingRule(max_steps=0))
    assert segments is not None
    assert len(segments.point.runs) > len(recordings)

    class Found:
        whole = tuple(run.observed for run in TrajectoryFit(point_of(chain_of(), (), recordings)).point.runs)
        stopped = False

        def __init__(self, *_: object) -> None: ...

        def run(self) -> SimpleNamespace:
            return SimpleNamespace(best=segments)

    monkeypatch.setattr(reference, "Search", Found)
    monkeypatch.setattr(reference, "INCOMPLETE_MISFIT", 0.0)
    baseline = SimpleNamespace(fit=whole, changed=(None,))
    known, warning = find_preexisting_effects(baseline, [], RIG, lambda text: None, SERIAL)  # type: ignore[arg-type]
    assert [run.observed.recording.file for run in known.point.runs] == [each.file for each in recordings]
    assert "viscous friction (coefficient" in warning
    assert "N m s/rad) reduces it" in warning
