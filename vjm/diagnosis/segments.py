"""Fits to segments of recordings, each with an initial state of its own (multiple shooting without continuity).

Over one or two periods even a wrong model stays in phase: gradients lead to the minimum from far away (Bock, Recent
advances in parameter identification techniques for O.D.E., 1983; Ribeiro et al., Automatica 121, 2020). Segments tell
less of frequencies than whole recordings do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from vjm.chain.curve import transfer_state
from vjm.diagnosis.candidate_fit import StoppingRule, fit_accurately, likely_runs, transferred_shift
from vjm.identification.trajectory_fit import Point, TrajectoryFit, TrajectoryProblem
from vjm.records import Array
from vjm.simulation.measurement import Observations, PrecedingMotions
from vjm.simulation.run import Run, by_recording, state_at
from vjm.simulation.system import Trajectory


def segments(observed: Observations, duration: float) -> tuple[Observations, ...]:
    """Cut a recording into segments of a duration [s].

    A quiet recording of a clamped arm stays whole: it cannot get out of phase. With active joints it is cut, as an
    error of the torque lets a joint that stood still turn ever faster in the simulation.
    """
    cannot_drift = observed.recording.kind == "quiet" and not observed.recording.theta.shape[1]
    if cannot_drift or not np.isfinite(duration):
        return (observed,)
    return observed.segments(duration, 0.1 * duration)  # overlap, for sensors that are early or late


def simulate_segments(fit: TrajectoryFit, whole: Sequence[Observations], duration: float) -> Point:
    """Return a model in all segments of recordings, each from its most likely initial state.

    Args:
        fit: a fit to the whole recordings.
        whole: the recordings.
        duration: duration of a segment [s].

    Raises:
        SimulationDivergedError: the model cannot be simulated.
    """
    observed = [part for recording in whole for part in segments(recording, duration)]
    problem, x = replace(fit.point.problem, observed=tuple(observed)), fit.point.x
    return Point(problem, x, tuple(likely_runs(problem, x, [state_at(fit.point.runs, part) for part in observed])))


def draw_segments(runs: Sequence[Run], values: float, seed: int) -> tuple[int, ...]:
    """Draw so many of the segments that they hold about a number of measured values; all if these are few.

    Of each recording they are the first one and others, one drawn from each of equal parts of it: what grows with time
    shows, and what is periodic has no alias.

    Args:
        runs: of all segments.
        values: number of measured values that the segments hold, as far as all are of one size.
        seed: of random numbers.
    """
    random, chosen = np.random.default_rng(seed), list[int]()
    share = values / max(sum(run.observed.count for run in runs), 1)
    indices: dict[str, list[int]] = {}
    for k, run in enumerate(runs):
        indices.setdefault(run.observed.recording.file, []).append(k)
    for of_recording in indices.values():
        count = min(max(int(np.ceil(share * len(of_recording))), 2), len(of_recording))
        edges = np.linspace(1, len(of_recording), count).astype(int) if count > 1 else [1]
        drawn = [int(random.integers(first, last)) for first, last in pairwise(edges)]
        chosen += [of_recording[k] for k in (0, *drawn)]
    return tuple(chosen) if 2 * len(chosen) <= len(runs) else tuple(range(len(runs)))


def fit_some(all_segments: Point, chosen: Sequence[int], stop: StoppingRule) -> tuple[TrajectoryFit, Point]:
    """Fit a model to some segments; return also all of them, which then remember the motion before each.

    Args:
        all_segments: the model in all segments.
        chosen: indices of those to fit.
        stop: stopping rule.

    Raises:
        SimulationDivergedError, InsufficientDataError: the model cannot be simulated.
    """
    runs = [all_segments.runs[k] for k in chosen]
    problem = replace(all_segments.problem, observed=tuple(run.observed for run in runs))
    fit = fit_accurately(problem, all_segments.x, [run.state for run in runs], stop)
    fitted = dict(zip(chosen, fit.point.runs, strict=True))
    everywhere = tuple(fitted.get(k, run) for k, run in enumerate(all_segments.runs))
    fit = replace(fit, point=_point_with_preceding_motion(fit.point, everywhere))
    return fit, _point_with_preceding_motion(replace(all_segments, runs=everywhere), everywhere)


def fit_all(fit: TrajectoryFit, all_segments: Point, stop: StoppingRule) -> TrajectoryFit:
    """Fit a model of some segments to all of them.

    Args:
        fit: the fit to some segments.
        all_segments: a model, such as one without effects, in all segments; from its states those of the others start.
        stop: stopping rule.

    Raises:
        SimulationDivergedError, InsufficientDataError: the model cannot be simulated.
    """
    known = {_segment(run): run for run in fit.point.runs}
    others = [run for run in all_segments.runs if _segment(run) not in known]
    added = replace(fit.point.problem, observed=tuple(run.observed for run in others))
    pairs = zip(others, added.arms(fit.point.x), strict=True)
    guessed = [transfer_state(run.chain, arm.chain, run.state) for run, arm in pairs]
    known |= {_segment(run): run for run in likely_runs(added, fit.point.x, guessed, stop.deadline)}
    runs = [known[_segment(run)] for run in all_segments.runs]
    problem = replace(added, observed=tuple(_with_preceding_motion(all_segments.problem.observed, runs)))
    return _refitted(fit, problem, [run.state for run in runs], stop)


def _segment(run: Run) -> tuple[str, float]:
    """Return what a segment is known by: its recording and where in it it begins [s]."""
    return run.observed.recording.file, float(run.observed.recording.time[0])


def fit_segments(
    fit: TrajectoryFit, whole: Sequence[Observations], duration: float, stop: StoppingRule
) -> TrajectoryFit:
    """Fit a model to all segments of recordings.

    Args:
        fit: a fit to other segments of the same recordings, or to the whole recordings, to start from.
        whole: the recordings.
        duration: duration of a segment [s]; infinite: whole recordings.
        stop: stopping rule.

    Raises:
        SimulationDivergedError, InsufficientDataError: the model cannot be simulated.
    """
    if len(fit.point.runs) == len(whole):
        all_segments = simulate_segments(fit, whole, duration)
        fitted, _ = fit_some(all_segments, range(len(all_segments.runs)), stop)
        return replace(fitted, shift=transferred_shift(fit, fitted))
    observed = [part for recording in whole for part in segments(recording, duration)]
    observed = _with_preceding_motion(observed, fit.point.runs)
    problem = replace(fit.point.problem, observed=tuple(observed))
    return _refitted(fit, problem, [state_at(fit.point.runs, part) for part in observed], stop)


def _refitted(
    start: TrajectoryFit, problem: TrajectoryProblem, states: Sequence[Array], stop: StoppingRule
) -> TrajectoryFit:
    """Fit a model to other segments from given states (2 nv,); in later fits these remember the motion fitted here."""
    fitted = fit_accurately(problem, start.point.x, states, stop)
    fitted = replace(fitted, point=_point_with_preceding_motion(fitted.point, fitted.point.runs))
    return replace(fitted, shift=transferred_shift(start, fitted))


def _point_with_preceding_motion(point: Point, runs: Sequence[Run]) -> Point:
    """Return a point whose segments remember the motion before them, as in runs of all segments.

    Internal states of effects with memory follow it up to each segment.
    """
    observed = _with_preceding_motion([run.observed for run in point.runs], runs)
    changed = tuple(replace(run, observed=part) for run, part in zip(point.runs, observed, strict=True))
    return replace(point, problem=replace(point.problem, observed=tuple(observed)), runs=changed)


def largest_chi2_in_longer(shorter: TrajectoryFit, whole: Sequence[Observations], duration: float) -> float:
    """Return the largest chi^2 in longer segments that noise explains, arguments as of `fit_segments`.

    Longer segments have fewer initial states, which took up noise: a chi^2 of as many degrees of freedom at most, and
    five standard deviations of it. Beyond, with stick-slip or play, the search has missed the best minimum.
    """
    unknowns = np.mean([run.basis.states.shape[1] for run in shorter.point.runs])  # of a segment's initial state
    freedom = unknowns * max(0, len(shorter.point.runs) - sum(len(segments(each, duration)) for each in whole))
    return float(shorter.chi2 + freedom + 5 * np.sqrt(2 * freedom))


def largest_chi2_in_all(fit: TrajectoryFit, all_segments: Point) -> float:
    """Return the largest chi^2 in all segments that the misfit in some of them explains, arguments as of `fit_all`.

    It is that of an equal misfit and five standard deviations; noise in some segments and in the others is independent.
    """
    some, every = fit.point.expected_chi2, all_segments.expected_chi2
    std = np.sqrt(2 * some * (every / some - 1) ** 2 + 2 * (every - some))
    return float(fit.misfit**2 * (every + 5 * std))


def _with_preceding_motion(observed: Sequence[Observations], runs: Sequence[Run]) -> list[Observations]:
    """Return segments with the motion of their recordings before them, as last simulated segment by segment."""
    in_order = sorted(runs, key=lambda run: float(run.trajectory.time[0]))
    recordings = by_recording(in_order)
    # Where an effect is absent from some recordings, so are the joints that it adds.
    by_size = {parts[0].chain.size: parts[0].chain for parts in recordings.values()}
    preceding: dict[str, PrecedingMotions] = {}
    for size, chain in by_size.items():
        together = {file: parts for file, parts in recordings.items() if parts[0].chain.size == size}
        motions = {file: _concatenate([run.trajectory for run in parts]) for file, parts in together.items()}
        preceding |= dict.fromkeys(motions, PrecedingMotions.of(chain, motions))
    return [
        part if part.start is None else replace(part, preceding=preceding[part.recording.file]) for part in observed
    ]


def _concatenate(paths: Sequence[Trajectory]) -> tuple[Array, Array, Array]:
    """Concatenate the trajectories of a recording's segments, each up to where the next begins: times, q and v."""
    ends = [*(float(path.time[0]) for path in paths[1:]), np.inf]
    shown = [(path, path.time < end) for path, end in zip(paths, ends, strict=True)]
    time = np.concatenate([path.elapsed(path.time)[shown_part] for path, shown_part in shown])
    q, v = (np.concatenate([getattr(path, name)[shown_part] for path, shown_part in shown]) for name in ("q", "v"))
    return time, q, v
