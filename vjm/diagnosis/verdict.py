"""From where a search ended to what is said of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from vjm.diagnosis.alternatives import find_alternatives
from vjm.diagnosis.baseline import Base
from vjm.diagnosis.candidate_fit import CandidateFit
from vjm.diagnosis.fit_cache import OFF
from vjm.diagnosis.next_experiment import Proposal, next_experiment, proposals
from vjm.diagnosis.records import Alternative, Candidate, Cause, Diagnosis, Gain, Remaining, Size, Verdict
from vjm.diagnosis.replays import follow, found_symptoms, without_cause
from vjm.diagnosis.residual_tests import (
    Repeated,
    ResidualTest,
    described,
    noise_told,
    remains_told,
    repeated,
    residual_test,
)
from vjm.diagnosis.selection import Search, SearchResult
from vjm.effects import Effect
from vjm.effects.effect import Key
from vjm.identification.uncertainty import Information, covariance, estimates, of_trajectory, to_physical
from vjm.records import REFERENCE, Array, Estimate, Experiment, Recording, RecordingComparison
from vjm.simulation.model import Model

_SLOPE_STEP = 1e-5


def found_causes(
    search: Search, found: SearchResult, alternatives: Mapping[Key, tuple[Alternative, ...]], spread: Array
) -> tuple[Cause, ...]:
    """The best explanation's new effects as causes, the one without which most is missed first.

    Args:
        search: can fit more.
        found: where it ended.
        alternatives: what explains the recordings as well, by the cause in whose place.
        spread: (p, p) covariance of the best explanation's coordinates.
    """
    best, family, causes = found.best, found.first, []
    scale = max(1.0, best.point.misfit**2)
    estimated = best.extension.present(best.estimate)
    for effect, beam, part in [*zip(best.effects, estimated, best.extension.parts, strict=True)][
        best.reference_effects :
    ]:
        fewer = search.trials.tried.get(best.names - {effect.key}) or search.trials.without(best, effect, np.inf)
        without = fewer or search.start
        drop = without.chi2 - best.chi2
        before, after = without.point.misfit, best.point.misfit
        unit = "the noise" if search.search_start.reference_misfit == 1 else "what was missing before the change"
        evidence = (
            f"without it the model misses the training recordings by {before:.3g} times {unit}, with it by "
            f"{after:.3g}; chi^2 falls by {drop:.3g}"
        )
        causes.append(
            Cause(
                effect,
                _sizes(beam, spread[part, part]),
                max(min(found.p_values.get(effect.key, 1.0), family.p_of_fit(effect, drop / scale)), 1e-300),
                drop,
                alternatives.get(effect.key, ()),
                evidence,
            )
        )
    return tuple(sorted(causes, key=lambda cause: -cause.gain))


def _sizes(effect: Effect, spread: Array) -> dict[str, Size]:
    """Parameters with standard errors, from the covariance (p, p) of the effect's coordinates."""
    at, values = effect.coordinates, effect.values
    slopes = {name: np.zeros(at.size) for name in values}
    for k in range(at.size):
        step = _SLOPE_STEP * max(abs(at[k]), 1.0)
        moved = effect.at(at + step * np.eye(at.size)[k]).values
        for name, value in values.items():
            slopes[name][k] = (moved[name] - value) / step
    found = {}
    for each in effect.parameters():
        slope = slopes[each.name]
        with np.errstate(invalid="ignore"):  # of an explanation that the recordings do not determine
            variance = float(slope @ spread @ slope)
        std = float(np.sqrt(max(variance, 0.0))) if np.isfinite(variance) and not each.integer else None
        found[each.name] = Size(float(values[each.name]), std, each.unit)
    return found


_BLOCK = 0.25  # s; residuals farther apart are taken to be independent
_DRAWS = 2000


def gain(followed: Sequence[RecordingComparison], seed: int) -> Gain | None:
    """On the held-out ones among the recordings; None where none can be simulated by both models.

    Args:
        followed: recordings, replayed before and after.
        seed: of the block bootstrap.
    """
    held_out = [each for each in followed if each.recording.role == "holdout" and each.reference and each.simulated]
    changed = [each for each in held_out if each.recording.condition != REFERENCE]
    held_out = changed or held_out  # nothing is to be gained where nothing has changed
    if not held_out:
        return None
    blocks = np.concatenate([_blocks(each) for each in held_out])
    before, after, count, next_best = blocks.sum(axis=0)
    draws = np.random.default_rng(seed).integers(0, len(blocks), (_DRAWS, len(blocks)))
    sums = blocks[draws].sum(axis=1)
    reductions = 1 - np.sqrt(sums[:, 1] / np.maximum(sums[:, 0], 1e-300))
    low, high = np.quantile(reductions, (0.025, 0.975)).tolist()
    return Gain(
        before=float(np.sqrt(before / count)),
        after=float(np.sqrt(after / count)),
        noise=held_out[0].noise[0],
        reduction=float(1 - np.sqrt(after / before)),
        interval=(low, high),
        next_best=float(np.sqrt(next_best / count)) if np.isfinite(next_best) else None,
    )


def _blocks(each: RecordingComparison) -> Array:
    """(B, 4) sums over stretches of time: squares before, after [m^2], number of values, squares of the runner-up."""
    recording = each.recording
    known = np.isfinite(recording.markers)
    columns = []
    for replay in (each.reference, each.simulated, each.alternative):
        if replay is None:
            columns.append(np.full(len(known), np.nan))
            continue
        off = np.where(known, recording.markers - replay.simulation.markers, 0.0)
        columns.append(np.sum(off**2, axis=(1, 2)))
    rows = np.column_stack([columns[0], columns[1], known.sum(axis=(1, 2)), columns[2]])
    numbers = ((recording.time - recording.time[0]) / _BLOCK).astype(int)
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    found: Array = np.add.reduceat(rows, starts, axis=0)
    return found[found[:, 2] > 0]


_LEAST_FRAMES = 30


def why_insufficient(experiment: Experiment) -> tuple[str, ...]:
    """Why an experiment's recordings cannot support a diagnosis, a sentence each; none where they can."""
    train, held_out = experiment.with_role("train"), experiment.with_role("holdout")
    found = []
    if not held_out:
        found.append(
            "no recording is held out, so that nothing could confirm a cause: give one of another kind or amplitude "
            'role = "holdout"'
        )
    moving = [each for each in train if each.kind in ("driven", "decay")]
    if len(moving) < 2 and not _referenced(experiment):
        found.append(
            "only one training recording moves: what is wrong in one recording looks like another initial state or "
            "another stiffness; record at least one more, with another amplitude or drive"
        )
    if _referenced(experiment):
        found += _contradictory(experiment)
    if any(_blind(each) for each in held_out) and all(_blind(each) for each in held_out):
        found.append("the held-out recordings show next to no marker: nothing could confirm a cause")
    return tuple(found)


def _referenced(experiment: Experiment) -> bool:
    return any(each.condition == REFERENCE for each in experiment.recordings)


def _contradictory(experiment: Experiment) -> list[str]:
    """What is wrong with recordings in the reference condition."""
    train = experiment.with_role("train")
    found = []
    if not any(each.condition == REFERENCE for each in train):
        found.append('recordings with condition = "reference" are held out only: none is there to train on')
    if all(each.condition == REFERENCE for each in train):
        found.append(
            'every training recording has condition = "reference", in which the effect sought is absent: none is left '
            "that could show it"
        )
    labels: dict[str, set[str | None]] = {}
    for each in experiment.recordings:
        if each.repeat is not None:
            labels.setdefault(each.repeat, set()).add(each.condition)
    found += [
        f'repeats "{label}" are said to be one experiment, and differ in their condition'
        for label, conditions in labels.items()
        if len(conditions) > 1
    ]
    return found


def _blind(recording: Recording) -> bool:
    return int(np.isfinite(recording.markers).any(axis=(1, 2)).sum()) < _LEAST_FRAMES


_UNLIKELY = 1e-3  # that noise alone leaves so much
_NIL = 0.002  # reduction of the held-out error that is none
_LITTLE = 0.02  # share of chi^2; what explains more is real, whether the recordings held out show it or not
_CLEARLY = 2.0  # times the misfit before the change


def conclude(
    experiment: Experiment,
    base: Base,
    search: Search,
    found: SearchResult,
    table: tuple[Candidate, ...],
    already: str = "",
) -> Diagnosis:
    """What is missing, how sure that is, and what is gained.

    Args:
        experiment: what was diagnosed.
        base: the model without effects.
        search: can fit more.
        found: where it ended.
        table: the candidates.
        already: what was missing before any change, as a sentence.
    """
    best = found.best
    new = best.effects[best.reference_effects :]
    scale = max(1.0, best.point.misfit**2)
    search.tell("asking what cannot be told apart")
    # What does not follow the recordings is no explanation that others could equal.
    asked = new if best.point.misfit < OFF else ()
    alternatives = find_alternatives(found, search, asked, scale)
    information, _ = of_trajectory(best.fit, True)
    causes = found_causes(search, found, alternatives, covariance(information))
    search.tell("replaying the recordings")
    model, plain = (
        _model(experiment, base, best, information),
        _model(experiment, base, search.search_start.before, None),
    )
    next_best = search.trials.next_best(best) or found.next_best
    followed = follow(experiment, base, search.search_start.before, best, next_best)
    effects = [cause.effect for cause in causes]
    causes = tuple(replace(cause, without=without_cause(model, cause.effect, effects, followed)) for cause in causes)
    gained = gain(followed, search.rules.seed)
    left, again = residual_test(best.point.runs), repeated(best.point.runs)
    needed = _still_needed(best, search, found)
    remains = _remains(best, base, search, left, needed)
    description = _described(experiment, best, left, again, found, needed) if remains else _usual(best, base, search)
    verdict = _verdict(causes, remains)
    diagnosis = Diagnosis(
        experiment=experiment,
        verdict=verdict,
        causes=causes,
        candidates=table,
        model=model,
        base=plain,
        parameters=model.estimates,
        recordings=followed,
        gain=gained,
        remaining=Remaining(left.p_value, description),
        symptoms=found_symptoms(experiment, plain, followed, base),
        next_experiment=next_experiment(experiment, verdict, causes, partial(_worth, search, best)),
        noise=f"{base.noise.source}; {noise_told(again)}",
        next_best=next_best.effects[next_best.reference_effects :] if next_best else (),
        warnings=tuple(dict.fromkeys(each for each in (*experiment.warnings, *base.problems, already) if each)),
        notes=_notes(search, base, best, left, remains),
    )
    little = search.start.chi2 - best.chi2 < _LITTLE * best.chi2
    useless = bool(causes) and little and (gained is None or gained.reduction < _NIL)
    return _without_causes(diagnosis, search.rules.seed) if useless and not remains else diagnosis


def _without_causes(diagnosis: Diagnosis, seed: int) -> Diagnosis:
    """The diagnosis where what is significant is small, and of no use."""
    named = ", ".join(cause.effect.id for cause in diagnosis.causes)
    warning = f"{named} would explain a little of the training recordings and nothing of those held out: not a cause"
    followed = tuple(replace(each, simulated=each.reference, alternative=None) for each in diagnosis.recordings)
    return replace(
        diagnosis,
        verdict="none",
        causes=(),
        model=diagnosis.base,
        next_best=(),
        parameters=diagnosis.base.estimates,
        recordings=followed,
        gain=gain(followed, seed),
        next_experiment=None,
        warnings=(*diagnosis.warnings, warning),
    )


def insufficient(experiment: Experiment, base: Base, table: tuple[Candidate, ...], reasons: Sequence[str]) -> Diagnosis:
    """What can be said where the recordings support no statement."""
    plain = _model(experiment, base, base.plain, None)
    followed = follow(experiment, base, base.plain, base.plain, None)
    return Diagnosis(
        experiment=experiment,
        verdict="insufficient",
        causes=(),
        candidates=table,
        model=plain,
        base=plain,
        parameters=plain.estimates,
        recordings=followed,
        gain=None,
        remaining=Remaining(None),
        symptoms=found_symptoms(experiment, plain, followed, base),
        next_experiment=reasons[0],
        noise=f"{base.noise.source}; {noise_told(repeated(base.point.runs))}",
        warnings=tuple(dict.fromkeys([*reasons, *experiment.warnings, *base.problems])),
    )


def _verdict(causes: Sequence[Cause], remains: bool) -> Verdict:
    if remains:
        return "unknown"
    if not causes:
        return "none"
    return "set" if any(cause.alternatives for cause in causes) else "named"


def _still_needed(best: CandidateFit, search: Search, found: SearchResult) -> list[int]:
    """Candidates of the last screen that are certain and matter."""
    certain = (found.last.p_values < search.rules.alpha) & (found.last.seen.statistics > search.matters(best))
    return [int(k) for k in np.flatnonzero(certain)]


def _remains(best: CandidateFit, base: Base, search: Search, left: ResidualTest, needed: Sequence[int]) -> bool:
    """Whether the explanation leaves more than noise; more than before the change, where that was more than noise."""
    if search.search_start.reference_misfit > 1:
        return _changed_misfit(best, search) > _CLEARLY * base.point.misfit
    unlikely = left.p_value < _UNLIKELY and left.excess > search.matters(best)
    return unlikely or bool(needed)


def _changed_misfit(best: CandidateFit, search: Search) -> float:
    """By how many times the noise the changed recordings are missed."""
    changed = [run for run in best.point.runs if run.observed.recording.condition != REFERENCE]
    squares, count = sum(run.chi2 for run in changed), sum(run.observed.count for run in changed)
    return float(search.search_start.reference_misfit * np.sqrt(squares / max(count, 1)))


def _usual(best: CandidateFit, base: Base, search: Search) -> str:
    """What is left where as much was missing before a change; empty where noise is all that is usual."""
    if search.search_start.reference_misfit <= 1:
        return ""
    return (
        f"the changed recordings are missed by {_changed_misfit(best, search):.2g} times the noise; the reference ones "
        f"were by {base.point.misfit:.2g}, by a model without effects: about what was missing before the change"
    )


def _model(experiment: Experiment, base: Base, candidate_fit: CandidateFit, information: Information | None) -> Model:
    """The model of an explanation, with its parameters' estimates."""
    parametrisation = candidate_fit.point.problem.parametrisation
    own = len(parametrisation.coordinates)
    x, estimate = candidate_fit.point.x[:own], candidate_fit.estimate[:own]
    if information is None:
        information, _ = of_trajectory(candidate_fit.fit, True)
    inside = covariance(information)[:own, :own]
    kept = Information(information.normal[:own, :own], information.spread[:own, :own])
    found: tuple[Estimate, ...] = estimates(
        parametrisation, estimate, kept, to_physical(parametrisation, estimate, inside)
    )
    noise = base.fit.point.runs[0].observed.noise
    return Model(
        parametrisation.chain(x), experiment.rig, *noise, found, candidate_fit.effects, candidate_fit.reference_effects
    )


def _worth(search: Search, best: CandidateFit, cause: Cause) -> Sequence[Proposal]:
    """Recordings by how well they would tell a cause from its rivals."""
    others = best.names - {cause.effect.key}
    alternatives = [search.trials.tried.get(others | {alternative.effect.key}) for alternative in cause.alternatives]
    return proposals(best, [each for each in alternatives if each is not None])


def _described(
    experiment: Experiment,
    best: CandidateFit,
    left: ResidualTest,
    again: Repeated | None,
    found: SearchResult,
    needed: Sequence[int],
) -> str:
    """Where something remains and what it looks like."""
    parts = []
    if left.bands and left.p_value < _UNLIKELY:
        worst = left.bands[0]
        low, high = worst.band
        parts.append(f"most of it in the {worst.sensor} of {worst.file}, between {low:.3g} and {high:.3g} Hz")
    looks = described(best.point, best.effects, experiment.rig)
    parts += [each for each in (looks, remains_told(again)) if each]
    if needed:
        most = max(needed, key=lambda k: float(found.last.seen.statistics[k]))
        parts.append(f"a further effect, {found.last.seen.effects[most].id}, would explain part of it")
    return "; ".join(parts)


def _notes(search: Search, base: Base, best: CandidateFit, left: ResidualTest, remains: bool) -> tuple[str, ...]:
    joints = ", ".join(f"{link.name} {link.virtual_joints}" for link in base.point.chain.links)
    known = "is measured against a finer chain" if best.shift is not None else "was not measured"
    notes = [f"virtual joints of the search's chain: {joints}; what so few of them get wrong {known}"]
    if search.search_start.diverges_from_data:
        notes.append(
            "without a change the model follows so little of the changed recordings that the table of candidates, "
            "which is linear, is no guide: each was fitted"
        )
    if not remains and search.search_start.reference_misfit == 1 and left.p_value < _UNLIKELY:
        notes.append("what is left is a little more than noise, and too little to matter")
    if best.uses_feedback:
        notes.append(
            "dry friction or play: while fitting, a weak spring and damper held the simulated joint near its encoder's "
            "angles; misfits and parameters are those of such simulations, replays and the gain are open loop"
        )
    if best.effects and not best.fit.converged:
        notes.append("the last fit was ended once further steps no longer mattered")
    return tuple(notes)
