"""Diagnosis of an experiment: the steps from its recordings to the verdict, one call each.

baseline -> screen -> selection of effects -> alternatives and causes -> simulations -> residual tests
-> next experiment -> verdict.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import inf
from time import monotonic

import numpy as np

from vjm.diagnosis.alternatives import estimate_causes, find_alternatives, find_next_best, ranked
from vjm.diagnosis.baseline import Baseline, fit_baseline
from vjm.diagnosis.candidate_fit import SearchOptions, model_of
from vjm.diagnosis.next_experiment import propose_recordings
from vjm.diagnosis.records import Budget, Candidate, Cause, Diagnosis
from vjm.diagnosis.reference import add_changed_recordings, find_preexisting_effects
from vjm.diagnosis.residual_tests import compare_repeats, describe_residual, residual_test
from vjm.diagnosis.selection import Search, SearchResult
from vjm.diagnosis.simulations import (
    open_loop,
    simulate_recordings,
    simulate_without_each_cause,
    with_holdout_gains,
)
from vjm.diagnosis.symptoms import Symptoms
from vjm.diagnosis.verdict import conclude, is_unexplained, why_insufficient
from vjm.diagnosis.workers import Workers
from vjm.effects import BUILTIN, Effect
from vjm.errors import ChoiceError, ShapeError, is_number, is_whole, require, require_kind, require_progress, shown
from vjm.experiment.records import require_experiment
from vjm.identification.mistakes import refuse_mistakes
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.model.modes import modes
from vjm.records import REFERENCE, VISIBLE_SHARE, Experiment, Progress, RecordingComparison, Stages
from vjm.simulation.integrate import locked_joint_frequencies
from vjm.simulation.model import Model
from vjm.simulation.run import all_followed
from vjm.text import number
from vjm.threads import on_one_thread


@on_one_thread
def diagnose(
    experiment: Experiment,
    effects: Sequence[str | Effect] | str | Effect | None = None,
    max_effects: int = 3,
    jobs: int = 1,
    seed: int = 0,
    budget: float | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Find what a model of an arm lacks: which physical effects or sensor faults, how large, and what is gained.

    Args:
        experiment: the rig and its recordings; some held out.
        effects: what to look for, ids of built-in effects or instances of `vjm.effects.Effect`, or a single one; None:
            all built in.
        max_effects: number of causes at most.
        jobs: processes. More than one needs a script whose top level is guarded by `if __name__ == "__main__"`.
        seed: of all random numbers.
        budget: time that it may take [s], after which it returns the best it has and says what it has not tried;
            infinite: as long as it needs. None: for two processes 120 s, if the training recordings have up to 40
            periods of the slowest vibration and 3,500 frames; in proportion more for more, up to 240 s. An arm with an
            elbow has 240 s. One process has twice as much.
        progress: called with (text, done, total) while it runs.

    Returns:
        The diagnosis. Data that cannot support a statement give the verdict `insufficient`.

    Raises:
        ExperimentError: no experiment.
        ChoiceError: an unknown effect id.
        ShapeError: an option out of range.
        MistakeError: recordings that a mistake explains far better than the experiment file does.
        InsufficientDataError: recordings that not even a model without effects can be fitted to.
        SimulationDivergedError: no start can be simulated.
    """
    require_experiment(experiment)
    chosen = _chosen_effects(effects)
    _check_options(max_effects, jobs, seed, budget, progress)
    likely = refuse_mistakes(experiment)
    began, seconds = monotonic(), _default_budget(experiment, jobs) if budget is None else float(budget)
    report = Stages(progress, 0.15, seconds)  # each of about twelve stages takes so much of what is left
    insufficient = why_insufficient(experiment)
    report("fitting the reference model")
    baseline = fit_baseline(experiment, report.inside)
    with Workers.start(jobs) as workers:
        # An eighth is kept for alternatives, and another for simulations and tests of the residuals.
        deadline = began + 0.75 * seconds
        fit, warning = baseline.fit, ""
        if not insufficient:
            fit, warning = find_preexisting_effects(baseline, chosen, experiment.rig, report, workers, seed, deadline)
        reference, reference_misfit = add_changed_recordings(baseline, fit)
        # Where something is missing in the reference recordings already, an effect of the change must explain as much
        # of the others as it leaves: what was missing before may be that much larger in another motion. The same holds
        # for each further parameter, by which an effect may stand in for what was missing: a payload's centre would.
        options = SearchOptions(max_effects=max_effects, seed=seed, deadline=deadline)
        if reference_misfit > 1:
            options = replace(options, least_share=1.0, parameter_share=1.0)
            chosen = tuple(effect.nested() for effect in chosen)
        search = Search(experiment.rig, reference, chosen, options, report, workers)
        result = search.without_effects() if insufficient else search.run()
        stopped = search.stopped
        search.deadline = began + 0.875 * seconds
        # Both are tests beside the model without effects: in segments where it lacks something, since it loses whole
        # recordings, and otherwise in these, which show more.
        tested = result.first_tests if result.best.new_effects else result.last_tests
        table = tested.table(options.alpha, options.negligible(min(search.start.chi2, search.start.point.count)))
        findings = replace(
            _findings(experiment, baseline, reference_misfit, search, result, began + seconds),
            # Last, since the search for alternatives fits single candidates too.
            candidates=_with_residuals(table, search.start, result),
            insufficient=insufficient,
            warnings=(*likely, *experiment.warnings, *baseline.problems, warning),
        )
        if not insufficient and is_unexplained(findings):
            resemblance = describe_residual(result.best.point, result.best.effects, experiment.rig)
            findings = replace(findings, resemblance=resemblance)
        missed = {name for name, _ in search.unfinished - result.best.effect_keys}
        spent = Budget(seconds, monotonic() - began, stopped or bool(missed), tuple(sorted(missed)))
        return conclude(replace(findings, budget=spent))


def _with_residuals(table: Sequence[Candidate], start: TrajectoryFit, result: SearchResult) -> tuple[Candidate, ...]:
    """Add the residuals of candidates that were fitted alone, beside the effects that the search started from."""
    candidates = []
    for candidate in table:
        keys = start.effect_keys | {candidate.effect.key}
        fit = result.fits.get(keys) or result.segment_fits.get(keys)
        candidates.append(candidate if fit is None else _with_residual(candidate, fit, start))
    return tuple(candidates)


def _with_residual(candidate: Candidate, fit: TrajectoryFit, start: TrajectoryFit) -> Candidate:
    """Add the residual of a candidate's fit, as far as it says how well the candidate alone can do."""
    segmented = len(fit.point.runs) > len(start.point.runs)
    if fit.converged or fit.predicted_decrease < VISIBLE_SHARE * fit.chi2:
        return replace(candidate, misfit=fit.misfit, bound="lower" if segmented else None)
    if segmented or fit.misfit > start.misfit:  # the start is the candidate at no size at all
        return candidate
    return replace(candidate, misfit=fit.misfit, bound="upper")


def _default_budget(experiment: Experiment, jobs: int) -> float:
    """Return the time [s] that a diagnosis may take unless another is given."""
    train = experiment.with_role("train")
    chain = Model.nominal(experiment.rig).chain
    periods = sum(
        locked_joint_frequencies(chain, recording.payload_body)[0] * float(np.ptp(recording.time))
        for recording in train
    )
    frames = sum(recording.frames.size for recording in train)
    # A policy: 240 s of processor time, shared by two processes at most, for what a link of 1.2 Hz swings in seven
    # recordings of 5 s at 100 frames/s. Steps of simulations grow with the periods, and values to be fitted with the
    # frames. With an elbow steps are several times shorter (`default_step`). With two processes an answer takes five
    # minutes at most, with what starts and ends it, and six with an elbow.
    longer = 2.0 if experiment.rig.has_elbow else 1.0
    return 240.0 / min(jobs, 2) * min(max(longer, periods / 40.0, frames / 3500.0), 2.0)


def _findings(
    experiment: Experiment,
    baseline: Baseline,
    reference_misfit: float,
    search: Search,
    result: SearchResult,
    deadline: float,
) -> Diagnosis:
    """Take the steps that follow the search, and collect what they and those before have found.

    Simulations of recordings are improved until the deadline, a reading of `time.monotonic` [s].
    """
    best, rig, noise = result.best, experiment.rig, baseline.fit.point.runs[0].observed.noise
    after, before = (open_loop(fit, search.whole, search.deadline) for fit in (best, search.start))
    search.report("testing alternatives")
    alternatives = find_alternatives(result, search)
    causes = estimate_causes(result, search, alternatives, reference_misfit)
    search.report("simulating the recordings")
    next_best = find_next_best(result, search)
    recordings = simulate_recordings(experiment, noise, before, after, next_best, deadline)
    model, reference = model_of(best, rig, noise), model_of(search.start, rig, noise)
    causes = ranked(with_holdout_gains(rig, causes, recordings, best, result.fits))
    changed = [run for run in best.point.runs if run.observed.recording.condition != REFERENCE]
    chi2, count = sum(run.chi2 for run in changed), sum(run.expected_chi2 for run in changed)
    ambiguous = next((cause for cause in causes if cause.alternatives), None)
    findings = Diagnosis(
        experiment=experiment,
        causes=causes,
        needed=search.still_needed(result),
        next_best=next_best.new_effects if next_best else (),
        model=model,
        reference=reference,
        recordings=recordings,
        residuals=residual_test(best.point.runs),
        repeats=compare_repeats(best.point.runs),
        baseline_misfit=baseline.fit.misfit,
        reference_misfit=reference_misfit,
        changed_misfit=reference_misfit * float(np.sqrt(chi2 / max(count, 1))),
        decrease=(_without_effects(result, search).misfit / best.misfit) ** 2 - 1,
        negligible=search.options.negligible(best.chi2),
        proposals=propose_recordings(after, _with_alternatives(result, search, ambiguous)) if ambiguous else (),
        symptoms=_find_symptoms(reference, recordings),
        noise=baseline.noise.source,
        notes=_notes(baseline, result, search),
        seed=search.options.seed,
    )
    return simulate_without_each_cause(findings)


def _without_effects(result: SearchResult, search: Search) -> TrajectoryFit:
    """Return the model without new effects, fitted to the recordings or segments of the best one if that was done."""
    segments = len(result.best.point.runs) != len(search.whole)
    return (result.segment_fits if segments else result.fits).get(search.start.effect_keys, search.start)


def _with_alternatives(result: SearchResult, search: Search, cause: Cause) -> list[TrajectoryFit]:
    """Return the fits with alternatives in a cause's place, in whole recordings."""
    other_keys = result.best.effect_keys - {cause.effect.key}
    models = [other_keys | {alternative.effect.key} for alternative in cause.alternatives]
    return [open_loop(result.fits[keys], search.whole, search.deadline) for keys in models if keys in result.fits]


def _find_symptoms(reference: Model, recordings: Sequence[RecordingComparison]) -> Symptoms | None:
    """Describe what the model before any change gets wrong; None where it cannot simulate any recording."""
    count = 4  # more modes are hardly ever seen by a camera
    simulated = [comparison.reference for comparison in recordings if comparison.reference is not None]
    frequencies = {
        payload: modes(reference.chain, *reference.arm.loads(payload)).frequencies[:count].tolist()
        for payload in {run.recording.payload_body for run in simulated}
    }
    return Symptoms.of(reference.rig, simulated, frequencies) if simulated else None


def _notes(baseline: Baseline, result: SearchResult, search: Search) -> tuple[str, ...]:
    """Say how the chain and the recordings were treated, and what was decided about effects that are not causes."""
    joints = ", ".join(f"{link.name} {link.virtual_joints}" for link in result.best.point.chain.links)
    best = result.best
    known = "not measured" if best.shift is None else "measured against a finer chain and corrected"
    notes = [f"virtual joints in the search: {joints}; discretization error {known}"]
    longest = max(float(np.ptp(run.observed.recording.time)) for run in best.point.runs)
    if longest < max(float(np.ptp(run.observed.recording.time)) for run in search.start.point.runs):
        reason = "out of time" if search.stopped else search.kept_in_segments
        notes.append(
            f"{reason}: fitted to {len(best.point.runs)} segments of {number(longest, 2)} s, each with its own initial "
            "state; "
            "residuals and parameters are of segments, simulated recordings and gain are open loop over whole "
            "recordings"
        )
    if not all_followed(result.segment_fits.get(search.start.effect_keys, search.start).point.runs):
        notes.append(
            "the model without effects diverges from the recordings even over segments, so the linearised candidate "
            "table is unreliable: each candidate was fitted"
        )
    if search.unjustified:
        notes.append(
            f"{', '.join(search.unjustified)}: significant, but not determined by these recordings, or without gain in "
            "cross-validation; not kept"
        )
    if best.new_effects and not best.converged:
        notes.append("the last fit was stopped when further steps no longer changed the result")
    return tuple(notes)


def _check_options(max_effects: int, jobs: int, seed: int, budget: float | None, progress: Progress | None) -> None:
    for name, value, minimum in (("max_effects", max_effects, 1), ("jobs", jobs, 1), ("seed", seed, 0)):
        require(name, value, is_whole(value, minimum), f"a whole number of at least {minimum}")
    endless = isinstance(budget, float) and budget == inf
    valid = budget is None or endless or (is_number(budget) and budget > 0)
    require("budget", budget, valid, "a positive number of seconds, or None")
    require_progress(progress)


def _chosen_effects(effects: Sequence[str | Effect] | str | Effect | None) -> tuple[Effect, ...]:
    """Return effects by their ids; by default all that are built in."""
    known = {effect.id: effect for effect in BUILTIN}
    chosen: list[Effect] = []
    choices = BUILTIN if effects is None else [effects] if isinstance(effects, str | Effect) else effects
    require_kind("effects", choices, Iterable, "ids, or instances of vjm.effects.Effect")
    for choice in choices:
        if isinstance(choice, str) and choice not in known:
            raise ChoiceError("effect", choice, known)
        effect = known[choice] if isinstance(choice, str) else choice
        if not isinstance(effect, Effect):
            raise ShapeError("effects", shown(effect), "ids, or instances of vjm.effects.Effect")
        chosen.append(effect)
    ids = [effect.id for effect in chosen]
    if len(set(ids)) < len(ids) or not ids:
        raise ShapeError("effects", ", ".join(ids) or "none", "at least one, each once")
    return tuple(chosen)
