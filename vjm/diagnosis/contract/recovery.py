"""Whether an effect's value comes back from recordings that were simulated with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.candidates import looked_for
from vjm.diagnosis.contract.bench import Bench
from vjm.diagnosis.contract.faults import Clause
from vjm.diagnosis.directions import screen
from vjm.diagnosis.extension import Extension, adds_joint
from vjm.effects.effect import Effect
from vjm.errors import SimulationDivergedError
from vjm.identification.parametrisation import Parametrisation
from vjm.identification.trajectory_fit import fit_trajectory
from vjm.identification.trajectory_problem import Point, TrajectoryProblem
from vjm.simulate.arm import Arm
from vjm.simulate.observation import Observed
from vjm.simulate.run import Start, run_all, transferred

Array = NDArray[np.float64]

_NOISE = (5e-5, 5e-5)  # m of a marker coordinate, rad of an encoder
_RUN_UP = 0.1  # s at either end in which a late camera would show the arm outside of the recording
_OFF = 1.03  # what the chain's parameters are off at the start of the search

# The recordings are made with the very chain that is fitted, so noise is all that may keep a size from coming back: it
# does so by less than four standard errors, once in 16,000 times. Where the noise is next to nothing the search's own
# tolerance counts, and five hundredths of an everyday size are as close as anyone needs; what sticks and slips leaves
# searches among small bumps, and ten.
_STANDARD_ERRORS = 4.0
_CLOSE = 0.05
_CLOSE_IF_ABRUPT = 0.10
_LARGEST_ERROR = 0.1  # standard error, everyday sizes: with more, nothing said of the size would mean much
_ABRUPT = 1.5  # s of the first recording are enough for what takes short steps
_ABSORBED = 3e-4  # share of what an effect does, left when all else has made up for it, below which it is rounding
_NOTHING = 1e-12
_ENOUGH = 0.1  # fall of chi^2 that is not worth another step
_FIRST_STEPS = 4  # of the fit without the effect, which is only a start
_WRONG, _LITTLE = 1.5, 1e-2  # a misfit that is no noise, and a share of chi^2 that is no progress
_NOISY = 5.0  # standard deviations of chi^2 that noise explains


@dataclass(frozen=True)
class _Case:
    """Recordings made with an effect, and what is to come back from them.

    Attributes:
        clause: for messages.
        bench: the rig.
        true: the effect that they were made with.
        problem: the recordings, without the effect.
    """

    clause: Clause
    bench: Bench
    true: Effect
    problem: TrajectoryProblem

    @property
    def free(self) -> int:
        """Number of the chain's own coordinates."""
        return len(self.problem.parametrisation.coordinates)


def check_recovery(bench: Bench, true: Effect, seed: int) -> None:
    """Clause `recovery`: a fit that starts without the effect finds its sizes, the chain's parameters being free.

    Args:
        bench: a rig that shows it.
        true: the effect there, at an everyday size.
        seed: of the sensors' noise.

    Raises:
        EffectError: it finds others, or nothing can.
    """
    clause = Clause(true.id, "recovery")
    with clause.running(f"a fit of recordings with {true!r}"):
        if true.abrupt:
            bench = bench.beginning(_ABRUPT)
        case = _Case(clause, bench, true, _problem(bench, true, seed))
        errors = _standard_errors(case)
        found = _fitted(case)
    off = np.abs(found.coordinates - true.coordinates)[: true.sizes]
    close = _CLOSE_IF_ABRUPT if true.abrupt else _CLOSE
    allowed = np.maximum(close, _STANDARD_ERRORS * errors)
    worst = int(np.argmax(off / allowed))
    clause.holds(
        (off <= allowed).all(),
        f"a fit of recordings that were simulated with {_told(true)} finds {_told(found)}",
        f"no more than {allowed[worst]:.2g} everyday sizes between them ({off[worst]:.2g} found)",
    )


def _told(effect: Effect) -> str:
    units = {each.name: each.unit for each in effect.parameters()}
    return ", ".join(f"{name} {value:.4g} {units[name]}".rstrip() for name, value in effect.values.items())


def _problem(bench: Bench, true: Effect, seed: int) -> TrajectoryProblem:
    """What is measured with the effect present."""
    random = np.random.default_rng(seed)
    observed = []
    for recording, shown in zip(bench.recordings, bench.simulate(Arm.of(bench.chain, (true,))), strict=True):
        time = recording.time
        inside = (time >= time[0] + _RUN_UP) & (time <= time[-1] - _RUN_UP)
        markers = shown.markers + _NOISE[0] * random.normal(size=shown.markers.shape)
        theta = shown.theta + _NOISE[1] * random.normal(size=shown.theta.shape)
        made = replace(recording, markers=np.where(inside[:, None, None], markers, np.nan), theta=theta)
        observed.append(Observed.of(bench.rig, made, _NOISE))
    return TrajectoryProblem(Parametrisation(bench.chain, "uniform", bench.rig.active_links), tuple(observed))


def _standard_errors(case: _Case) -> Array:
    """(s,) of the sizes at their true values, everything else being free."""
    true, base = case.true, case.problem.parametrisation
    problem = replace(case.problem, extension=Extension(base, (true,)))
    x = np.concatenate([base.start, true.coordinates])
    arms = problem.arms(x)
    starts = [Start.of(arm, seen.recording) for arm, seen in zip(arms, problem.observed, strict=True)]
    states = case.bench.states(arms[0])
    point = Point(problem, x, tuple(run_all(arms, problem.observed, starts, states, problem.coarse)))
    return _known(case, point.gathered()[0].R[:, :-1])


def _known(case: _Case, R: Array) -> Array:
    """Standard errors (s,) that follow from the linearised problem's triangle R (p, p); none of them large."""
    lengths = np.maximum(np.linalg.norm(R, axis=0), 1e-300)
    silent = np.flatnonzero(lengths[case.free :] <= _NOTHING * lengths.max()).tolist()
    case.clause.holds(
        not silent, f"nothing that is measured depends on {_named(case.true, silent)}", "something that does"
    )
    _, sizes, directions = np.linalg.svd(R / lengths)
    spread = directions.T / np.maximum(sizes, _NOTHING * sizes[0])
    shares = 1 / np.linalg.norm(spread, axis=1)[case.free :][: case.true.sizes]  # what nothing else can stand in for
    errors: Array = 1 / (shares * lengths[case.free :][: case.true.sizes])
    case.clause.holds(
        (errors < _LARGEST_ERROR).all() and (shares > _ABSORBED).all(),
        f"on the {case.bench.rig.name} link the chain's own parameters can stand in for all but {shares.min():.1g} of "
        f"what it does, so that its size has a standard error of {errors.max():.2g} everyday ones",
        f"a standard error below {_LARGEST_ERROR:g}: a larger everyday size, or something that is no other stiffness, "
        "damping, hub inertia or initial state",
    )
    return errors


def _named(effect: Effect, coordinates: Sequence[int]) -> str:
    """Parameters by their coordinates' numbers, which stand for themselves where the effect has its own coordinates."""
    if type(effect).coordinates is not Effect.coordinates:
        return ", ".join(f"coordinate {k}" for k in coordinates)
    varied = sorted((each for each in effect.parameters() if not each.whole), key=lambda each: each.inner)
    return ", ".join(f"`{varied[k].name}`" for k in coordinates)


def _fitted(case: _Case) -> Effect:
    """The effect that the recordings tell, searched for from its absence."""
    start, states = case.problem.parametrisation.start, [trial.state for trial in case.bench.trials]
    base = fit_trajectory(case.problem, _OFF * start, None, states, hopeless=_Patience(_FIRST_STEPS))
    best: Point | None = None
    for variant, sizes in _starts(case, base.point):
        extension = Extension(case.problem.parametrisation, (variant,))
        problem = replace(case.problem, extension=extension)
        x = np.concatenate([base.point.x, sizes, variant.coordinates[variant.sizes :]])
        x = np.clip(x, *extension.bounds)
        arms = zip(base.point.runs, problem.arms(x), strict=True)
        states = [transferred(run.chain, arm.chain, run.state) for run, arm in arms]
        try:
            point = fit_trajectory(problem, x, None, states, hopeless=_Patience(abrupt=case.true.abrupt)).point
        except SimulationDivergedError:
            continue
        if best is None or point.chi2 < best.chi2:
            best = point
        if _is_noise(best):
            break
    if best is None:
        case.clause.broken("no fit that starts with one of its variants can be simulated", "finite motion")
    return case.true.at(best.x[case.free :])


def _starts(case: _Case, point: Point) -> Iterator[tuple[Effect, Array]]:
    """Variants at the true place, the most promising first, with sizes to start from."""
    true, whole = case.true, [each.name for each in case.true.parameters() if each.whole]
    variants = [
        each
        for each in looked_for([true], case.bench.rig, point).variants
        if each.link == true.link and all(each.values[name] == true.values[name] for name in whole)
    ]
    case.clause.holds(variants, f"no variant like {true!r}", "one at each of its `places`")
    seen = screen(point, (), variants)
    order: Sequence[int] = np.argsort(-seen.statistics, kind="stable").tolist()
    # A joint of its own, infinitely stiff at the null, has no slope there that could tell a size.
    if not adds_joint(true, point.chain):
        yield from ((variants[k], seen.guess([k])) for k in order[:2])
    yield from ((variants[k], np.full(true.sizes, size)) for k in order[:1] for size in (2.0, 0.5))


def _is_noise(point: Point) -> bool:
    """Whether noise explains all that is left."""
    return point.chi2 < point.count + _NOISY * float(np.sqrt(2 * point.count))


class _Patience:
    """Ends a fit after some steps, when it has found what there is, or when it is stuck far from there."""

    def __init__(self, steps: float = np.inf, abrupt: bool = False) -> None:
        self.left = steps
        self.abrupt = abrupt

    def __call__(self, point: Point, predicted: float) -> bool:
        self.left -= 1
        done = predicted < _ENOUGH or (self.abrupt and _is_noise(point))
        stuck = point.misfit > _WRONG and predicted < _LITTLE * point.chi2
        return self.left < 0 or done or stuck
