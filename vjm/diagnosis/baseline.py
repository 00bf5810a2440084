"""The model without effects: fitted to everything, its chain's own coarseness measured and known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vjm.chain.layout import DEFAULT_LAYOUT
from vjm.diagnosis.candidate_fit import CandidateFit, refit
from vjm.diagnosis.discretization import CLOSE, DiscretizationBias, corrected, discretization_bias
from vjm.diagnosis.noise import Noise, camera_noise, whitened
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.outliers import trimmed
from vjm.identification.prepare import Options, read_data
from vjm.identification.trajectory_fit import Point, TrajectoryFit
from vjm.identification.trajectory_method import Search, first_fit, simulated
from vjm.records import REFERENCE, Experiment, Progress, Recording
from vjm.simulation.initial_state import most_likely
from vjm.simulation.measurement import Observed
from vjm.simulation.run import Run

LEAST_JOINTS = 8
_ROUGH = 1.5  # misfit from which the model lacks so much that its parameters need not be found exactly
_LARGER = 1.1  # times the noise given, from which the noise measured is believed instead
_RUN_UP = 0.1  # s at either end of a driven recording in which frames may show the arm outside of it, if delayed


@dataclass(frozen=True)
class Base:
    """The model without effects, beside the training recordings.

    Attributes:
        fit: of all training recordings; of those in the reference condition, where there are any.
        noise: the camera's.
        others: training recordings that are not in `fit`: those in which something may have changed.
        problems: why recordings are not used, a sentence each.
        discretization_bias: of the chain; None where the model lacks so much that it does not matter.
    """

    fit: TrajectoryFit
    noise: Noise
    others: tuple[Observed, ...]
    problems: tuple[str, ...]
    discretization_bias: DiscretizationBias | None = None

    @property
    def point(self) -> Point:
        """Where the fit is."""
        return self.fit.point

    @property
    def plain(self) -> CandidateFit:
        """The model without effects, as an explanation."""
        return CandidateFit(self.fit, None if self.discretization_bias is None else self.discretization_bias.shift)


def base_fit(experiment: Experiment, progress: Progress | None = None) -> Base:
    """Fit the model without effects.

    Args:
        experiment: the rig and its recordings.
        progress: told (text, done, total) now and then.

    Raises:
        InsufficientDataError: recordings that cannot determine a model.
        SimulationDivergedError: no start can be simulated.
    """
    data = read_data(experiment, Options("uniform", None, DEFAULT_LAYOUT, "cantilever", None, "smoothing"))
    search, fit, _, problems = first_fit(experiment, data, progress=progress, rough=True)
    resting, changed, more = _further(experiment, search)
    runs = [*fit.point.runs, *_followed(fit.point, resting)]
    noise = camera_noise(runs)
    size = search.observed[0].noise
    if noise.size is not None and (experiment.rig.marker_noise is None or noise.size > _LARGER * size[0]):
        size = (noise.size, size[1])
    joints = tuple(max(LEAST_JOINTS, link.virtual_joints) for link in fit.point.chain.links)
    observed = tuple(_prepared(trimmed(run), size, noise) for run in runs)
    fit = replace(fit, point=replace(fit.point, runs=tuple(runs)))
    search = replace(search, observed=observed, rough=fit.point.misfit > _ROUGH)
    fit = search.near(joints, fit)
    found = discretization_bias(fit.point, experiment.rig) if fit.point.misfit < CLOSE else None
    others = tuple(_prepared(_trimmed(fit.point, each), size, noise) for each in changed)
    return Base(corrected(fit, found), noise, others, (*problems, *more), found)


def _further(experiment: Experiment, search: Search) -> tuple[list[Observed], list[Observed], tuple[str, ...]]:
    """Training recordings that the first fit has not: those at rest, and those in which something may have changed."""
    known = {each.recording.file for each in search.observed}
    train = [each for each in experiment.cleaned_recordings if each.role == "train" and each.file not in known]
    usable: list[Recording] = []
    problems: list[str] = []
    for recording in train:
        try:
            usable += simulated([recording])[0]
        except InsufficientDataError as error:
            problems.append(str(error))
    referenced = any(each.condition == REFERENCE for each in experiment.with_role("train"))
    noise = search.observed[0].noise
    resting: list[Observed] = []
    others: list[Observed] = []
    for recording in usable:
        seen = Observed.of(experiment.rig, recording, noise)
        changed = referenced and recording.condition != REFERENCE
        (others if changed else resting).append(seen)
    return resting, others, tuple(problems)


def _followed(point: Point, observed: Sequence[Observed]) -> list[Run]:
    """Runs of further recordings, by the model of a fit."""
    found: list[Run] = []
    for each in observed:
        arm = point.problem.varied.arms(point.x, [each.recording])[0]
        try:
            found += [run for run, _ in most_likely([arm], [each], step_multiple=point.problem.step_multiple)]
        except SimulationDivergedError:
            continue
    return found


def _trimmed(point: Point, observed: Observed) -> Observed:
    """A further recording without outliers, as far as the model of a fit can be simulated there."""
    return next((trimmed(run) for run in _followed(point, [observed])), observed)


def _prepared(observed: Observed, size: tuple[float, float], noise: Noise) -> Observed:
    """With the noise that was found, and without frames that a delayed camera would have taken outside of it."""
    recording = observed.recording
    if recording.theta.shape[1]:
        inside = (recording.time >= recording.time[0] + _RUN_UP) & (recording.time <= recording.time[-1] - _RUN_UP)
        if inside.sum() > recording.time.size / 2:
            shown = np.where(inside[:, None, None], recording.markers, np.nan)
            recording = replace(recording, markers=shown)
    return whitened(observed.again(recording, size), noise)


LACKING = 1.5  # misfit of the reference recordings from which something was missing before the change


_LOST = 0.3  # share of the motion; a larger residual does not follow it


@dataclass(frozen=True)
class SearchStart:
    """Where the search begins.

    Attributes:
        before: the model as it was before any change, beside all training recordings.
        start: the best model without effects, from which effects are looked for.
        diverges_from_data: whether it does not follow what has changed: then no slope is a guide.
        reference_misfit: misfit of the reference recordings that is taken as noise, in units of it; one: it is noise.
    """

    before: CandidateFit
    start: CandidateFit
    diverges_from_data: bool = False
    reference_misfit: float = 1.0


def begin_search(base: Base, plain: CandidateFit) -> SearchStart:
    """From the model of the reference recordings, or of all where there are none.

    Args:
        base: the base fit, and the recordings that it has not.
        plain: the same fit, with what was there before any change.
    """
    if not base.others:
        return SearchStart(plain, plain)
    point = plain.point
    reference_misfit = point.misfit if point.misfit > LACKING else 1.0
    problem = point.problem
    known = [_scaled(run, reference_misfit) for run in point.runs]
    others = [
        replace(each, noise=(reference_misfit * each.noise[0], reference_misfit * each.noise[1]))
        for each in base.others
    ]
    arms = problem.varied.arms(point.x, [each.recording for each in others])
    new = [run for run, _ in most_likely(arms, others, step_multiple=problem.step_multiple)]
    runs = (*known, *new)
    problem = replace(problem, observed=tuple(run.observed for run in runs))
    before = CandidateFit(TrajectoryFit(Point(problem, point.x, runs), False, 0))
    if any(_lost(run) for run in new):
        return SearchStart(before, before, True, reference_misfit)
    start = refit(before, before.effects)
    return SearchStart(before, start or before, False, reference_misfit)


def _scaled(run: Run, factor: float) -> Run:
    """The same run with its noise so many times as large."""
    if factor == 1.0:
        return run
    noise = run.observed.noise
    return replace(run, observed=replace(run.observed, noise=(factor * noise[0], factor * noise[1])))


def _lost(run: Run) -> bool:
    """Whether a run does not follow its recording."""
    seen = run.observed
    markers, _ = seen.spread(seen.values - seen.predicted(run.arm, run.steps))
    measured, _ = seen.spread(seen.values)
    motion = np.nanstd(measured, axis=0)
    return bool(np.sqrt(np.nanmean(markers**2)) > _LOST * np.sqrt(np.mean(motion**2)))
