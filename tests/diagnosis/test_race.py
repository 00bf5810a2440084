"""When a refit is ended, what it begins with, and what is tried at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import pytest

from tests.diagnosis.rigs import RIG, chain_of, point_of, recorded
from vjm.diagnosis.baseline import SearchStart
from vjm.diagnosis.candidate_fit import CandidateFit, refit, restart_from_nominal, sized
from vjm.diagnosis.encoder_feedback import nominal_with_feedback
from vjm.diagnosis.fit_cache import (
    COARSE,
    FitJob,
    StoppingRule,
    explains_nearly_all,
    finish_fit,
    near_noise,
    promising,
    start_fit,
)
from vjm.diagnosis.screen import Family
from vjm.diagnosis.selection import Rules, Search, SearchResult
from vjm.effects import (
    Backlash,
    CameraScale,
    CoulombFriction,
    Effect,
    InPlaneGravity,
    MarkerOffset,
    TorqueGain,
    TorqueOffset,
    ViscousFriction,
)
from vjm.identification.trajectory_fit import Point, TrajectoryFit
from vjm.simulation.arm import Arm

Step = tuple[object, list[int]]

EVERYDAY = 4e-3, 8e-3  # of play [rad] and of dry friction [N m]


@dataclass(frozen=True)
class Stop:
    chi2: float
    misfit: float = 1.2


def steps_taken(patience: StoppingRule, chi2: Sequence[float], share: float) -> int:
    """Of a fit that goes through values of chi^2, each next step promising a share of it."""
    for k, value in enumerate(chi2):
        if patience(cast(Point, Stop(value)), share * value):
            return k
    return len(chi2)


FALLING = [float(100 * 0.5**k) for k in range(12)]


@pytest.mark.parametrize(("share", "steps"), [(0.5, 6), (0.05, 2)])
def test_a_fit_that_still_falls_fast_goes_on_for_a_while(share: float, steps: int) -> None:
    assert steps_taken(StoppingRule(2, most=6), FALLING, share) == steps
    assert steps_taken(StoppingRule(2), FALLING, share) == 2


def test_what_sticks_is_left_once_steps_gain_less_than_enough() -> None:
    slow = [float(100 * 0.999**k) for k in range(20)]  # half a per cent in five steps
    assert steps_taken(StoppingRule(np.inf, nonsmooth=True), slow, 0.05) == 5
    assert steps_taken(StoppingRule(np.inf, nonsmooth=True, enough=0.998), slow, 0.05) == len(slow)
    assert steps_taken(StoppingRule(np.inf), slow, 0.05) == len(slow)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_fit_is_not_taken_up_again_once_it_is_known_to_lead_nowhere(seed: int) -> None:
    """What another search would first expect is known from where the one before it was left."""
    start = nominal_with_feedback(unfitted((InPlaneGravity(gx=0.0, gy=0.01),), seed))
    assert start is not None
    begun = refit(start, (InPlaneGravity(gx=0.0, gy=0.005),), StoppingRule(0))
    assert begun is not None
    asked: list[float] = []
    refit(begun, begun.effects, lambda point, predicted: bool(asked.append(predicted)) or True)
    assert begun.fit.promised == pytest.approx(asked[0], rel=1e-6)
    integer, promised = start.point.problem, begun.fit.promised
    reachable, beyond = begun.chi2 - promised, begun.chi2 - 10 * promised
    assert finish_fit(begun, beyond, integer) is begun
    assert finish_fit(begun, reachable, integer) is not begun
    unknown = replace(begun, fit=replace(begun.fit, promised=np.inf))
    assert finish_fit(unknown, beyond, integer) is not unknown


@dataclass(frozen=True)
class Tried:
    chi2: float
    follows: bool
    seconds: float = 5.0

    @property
    def point(self) -> Tried:
        return self

    problem = point

    @property
    def longest(self) -> float:
        return self.seconds

    @property
    def misfit(self) -> float:
        return float(np.sqrt(self.chi2))

    uses_feedback = False


@pytest.mark.parametrize(("follows", "kept"), [(True, 9), (False, 4)])
def test_where_nothing_follows_a_few_are_taken_to_their_end(follows: bool, kept: int) -> None:
    tried = [Tried(float(chi2), follows and chi2 == 20) for chi2 in (26, 25, 20, 21, 22, 24, 23, 27, 28)]
    found = promising(cast(list[CandidateFit], tried), 5.0)
    assert [each.chi2 for each in found] == [20.0 + k for k in range(kept)]


@pytest.mark.parametrize(
    ("lacked", "lacks", "nearly_all"),
    [(600.0, 1.3, True), (600.0, 2.1, False), (5.0, 1.3, False), (5.0, 1.005, True), (1.005, 1.0, True)],
)
def test_what_explains_nearly_all_is_taken_before_others_are_tried(
    lacked: float, lacks: float, nearly_all: bool
) -> None:
    fewer, found = (cast(CandidateFit, Tried(misfit**2, True)) for misfit in (lacked, lacks))
    assert explains_nearly_all(found, fewer) == nearly_all
    assert near_noise(found, 5.0, fewer) == (nearly_all or lacks < 2.0)  # open loop, less than that is ended anyway


@pytest.mark.parametrize("guess", [-3.0, 0.0, 0.2])
def test_play_and_dry_friction_begin_large_enough_to_be_felt(guess: float) -> None:
    play = sized(Backlash(link=0), np.array([guess]), chain_of())
    friction = sized(CoulombFriction(link=0), np.array([guess]), chain_of())
    assert (play.values["gap"], friction.values["torque"]) == pytest.approx(tuple(0.5 * size for size in EVERYDAY))
    viscous = sized(ViscousFriction(link=0), np.array([0.2]), chain_of())
    assert viscous.coordinates == pytest.approx([0.2])


def unfitted(effects: Sequence[Effect], seed: int, duration: float = 2.0) -> CandidateFit:
    recordings = recorded(Arm.of(chain_of(), effects), seed, duration=duration)
    return CandidateFit(TrajectoryFit(point_of(chain_of(), (), recordings), False, 0))


def test_held_play_and_dry_friction_are_tried_whatever_slopes_say(monkeypatch: pytest.MonkeyPatch) -> None:
    free = unfitted((), 1)
    start = nominal_with_feedback(free)
    assert start is not None
    tried: list[set[str]] = []

    def successive_halving(
        self: Search, best: CandidateFit, family: Family, first: Family, steps: Sequence[Step]
    ) -> None:
        tried[-1] |= {family.seen.effects[k].id for _, chosen in steps for k in chosen}

    monkeypatch.setattr(Search, "race", successive_halving)
    monkeypatch.setattr(Search, "needed", lambda self, best, family: [viscous_of(family)])
    effects = [ViscousFriction(), CoulombFriction(), Backlash(), TorqueOffset()]
    for candidate_fit in (free, start):
        tried.append(set())
        search = Search(RIG, SearchStart(candidate_fit, candidate_fit), effects, Rules(), lambda text: None)
        search.run(SearchResult.nothing(candidate_fit, search.judged(candidate_fit)))
    open_loop, held = tried
    assert open_loop == {"viscous_friction"}
    assert held == {"viscous_friction", "coulomb_friction", "backlash"}


@pytest.mark.parametrize("every", [False, True])
def test_beside_what_explains_nearly_all_no_others_are_tried_but_on_request(every: bool) -> None:
    """Gravity leaves 1.2 to 2 times the noise, where 57 were missing: the torque's gain, which comes after it."""
    truth = InPlaneGravity(gx=0.0, gy=1.0), TorqueGain(link=0, column=0, gain=0.85)
    start = nominal_with_feedback(unfitted(truth, 1))
    assert start is not None
    gravity, gain = replace(truth[0], gy=0.8), replace(truth[1], gain=0.95)
    trials = Search(RIG, SearchStart(start, start), [gravity, gain], Rules(), lambda text: None).trials
    trials.fit([FitJob(start, (gravity,)), FitJob(start, (gain,))], every)
    found = {name: each.point.misfit for names, each in trials.tried.items() for name, _ in names}
    assert COARSE < found["in_plane_gravity"] < 2.0
    assert ("torque_gain" in found) == every


@pytest.mark.parametrize("diverges_from_data", [True, False])
def test_from_afar_explanations_are_tried_on_the_recordings_beginnings(diverges_from_data: bool) -> None:
    start = unfitted((), 1, duration=5.0)
    refit_start = Search(
        RIG, SearchStart(start, start, diverges_from_data), [ViscousFriction()], Rules(), lambda text: None
    ).trials.refit_start
    assert (refit_start(start).point.problem.longest < start.point.problem.longest) == diverges_from_data
    assert refit_start(start).point.x == pytest.approx(start.point.x)
    assert refit_start(start).point.misfit == pytest.approx(1.0, abs=0.1)  # each from its most likely initial state


def viscous_of(family: Family) -> int:
    return next(k for k, effect in enumerate(family.seen.effects) if effect.id == "viscous_friction")


@pytest.mark.parametrize(
    ("gravity", "there", "nonsmooth", "restart_from_nominal"),
    [
        (0.3, (), False, True),
        (0.3, (ViscousFriction(link=0, coefficient=0.02),), False, True),
        (0.003, (), False, False),  # it lacks little
        (0.3, (), True, False),  # what sticks is found from wherever slopes lead
        (0.3, (CoulombFriction(link=0, torque=0.004),), False, False),
    ],
)
def test_beside_what_lacks_much_held_fits_begin_anew(
    gravity: float, there: tuple[Effect, ...], nonsmooth: bool, restart_from_nominal: bool
) -> None:
    """At the nominal chain and with the recordings' first periods: its own parameters may be any."""
    start = nominal_with_feedback(unfitted((InPlaneGravity(gx=0.0, gy=gravity),), 1))
    assert start is not None
    nominal, count = start.point.x, start.point.x.size
    with_effects = refit(start, there, StoppingRule(0))
    assert with_effects is not None
    x = np.concatenate([nominal + 0.01, with_effects.point.x[count:]])
    astray = replace(with_effects, fit=replace(with_effects.fit, point=replace(with_effects.point, x=x)))
    search = Search(RIG, SearchStart(start, start), [TorqueOffset()], Rules(), lambda text: None)
    refit_start = search.trials.refit_start(astray, nonsmooth).point
    assert refit_start.x[:count] == pytest.approx(nominal if restart_from_nominal else nominal + 0.01)
    assert refit_start.x[count:] == pytest.approx(x[count:])
    assert (refit_start.problem.longest < astray.point.problem.longest) == restart_from_nominal


def test_what_lacks_far_more_than_others_after_its_first_steps_is_given_up() -> None:
    tried = [Tried(float(misfit) ** 2, True) for misfit in (9, 280, 260)]
    found = promising(cast(list[CandidateFit], tried), 5.0)
    assert [each.misfit for each in cast(list[Tried], found)] == [9.0, 260.0]


@pytest.mark.parametrize(("best", "kept"), [(1.05, 6), (5.0, 4)])
def test_of_what_was_tried_beside_the_beginnings_the_near_best_go_on(best: float, kept: int) -> None:
    """All of them where the best explains the beginnings, a few where none does; none that is far from the best."""
    tried = [Tried((best * (1 + 0.05 * k)) ** 2, True, 1.0) for k in (5, 3, 4, 1, 2, 0)]
    found = promising(cast(list[CandidateFit], [*tried, Tried((2 * best) ** 2, True, 1.0)]), 5.0)
    assert [each.misfit for each in cast(list[Tried], found)] == pytest.approx(
        [best * (1 + 0.05 * k) for k in range(kept)]
    )


@pytest.mark.parametrize("rough", [False, True])
def test_what_is_held_is_not_fitted_to_its_very_end(rough: bool) -> None:
    noise = [Stop(1000.0, 1.0), Stop(999.5, 1.0)]
    asked = StoppingRule(np.inf, rough=rough)
    assert [asked(cast(Point, each), 0.5) for each in noise] == [rough, rough]
    assert not asked(cast(Point, noise[0]), 5.0)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_pair_begins_with_the_marker_that_explains_most_beside_the_other(seed: int) -> None:
    """Alone, the offset of another marker looks more like a camera's scale and a marker's offset together."""
    truth = CameraScale(scale=1.01), MarkerOffset(marker=2, along=-0.003)
    start = unfitted(truth, seed)
    search = Search(RIG, SearchStart(start, start), [CameraScale(), MarkerOffset()], Rules(), lambda text: None)
    first = search.judged(start)
    seen = first.seen
    ((_, pair),) = search._pairs(first, start)
    (marker,) = [seen.effects[k] for k in pair if seen.effects[k].id == "marker_offset"]
    alone = max(
        (k for k, each in enumerate(seen.effects) if each.id == "marker_offset"), key=lambda k: seen.statistics[k]
    )
    assert int(marker.values["marker"]) == 2
    assert int(seen.effects[alone].values["marker"]) != 2


@pytest.mark.parametrize("seed", [1, 2])
def test_beside_the_beginnings_what_is_far_from_the_best_is_not_fitted_further(seed: int) -> None:
    start = nominal_with_feedback(unfitted((InPlaneGravity(gx=0.0, gy=0.3),), seed))
    assert start is not None
    job = FitJob(restart_from_nominal(start), (InPlaneGravity(gx=0.0, gy=0.05),))
    integer = start.point.problem.longest
    first, near = start_fit(job, integer), start_fit(job, integer, record=job.start.chi2)
    far = start_fit(job, integer, record=1.0 - 1e6 * job.start.chi2)
    assert first is not None
    assert near is not None
    assert far is not None
    assert first.point.problem.longest < integer
    assert near.chi2 == first.chi2 < 0.01 * job.start.chi2
    assert far.fit.iterations == 1
