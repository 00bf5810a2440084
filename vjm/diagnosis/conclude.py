"""From where a search ended to what is said of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.base import Base
from vjm.diagnosis.causes import found_causes
from vjm.diagnosis.gain import gain
from vjm.diagnosis.leftover import Leftover, leftover
from vjm.diagnosis.menu import Proposal, proposals
from vjm.diagnosis.probes import described
from vjm.diagnosis.propose import next_experiment
from vjm.diagnosis.race import OFF
from vjm.diagnosis.records import Candidate, Cause, Diagnosis, Remaining, Verdict
from vjm.diagnosis.refit import Explanation
from vjm.diagnosis.repeats import Repeated, noise_told, remains_told, repeated
from vjm.diagnosis.replays import follow, found_symptoms
from vjm.diagnosis.rivals import alternatives
from vjm.diagnosis.search import Found, Search
from vjm.experiment.records import REFERENCE, Experiment
from vjm.identification.information import Information, of_trajectory
from vjm.identification.uncertainty import covariance, estimates, to_physical
from vjm.model import Model
from vjm.parameters import Estimate

Array = NDArray[np.float64]

_UNLIKELY = 1e-3  # that noise alone leaves so much
_NIL = 0.002  # reduction of the held-out error that is none
_LITTLE = 0.02  # share of chi^2; what explains more is real, whether the recordings held out show it or not
_CLEARLY = 2.0  # times the misfit before the change


def conclude(
    experiment: Experiment,
    base: Base,
    search: Search,
    found: Found,
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
    new = best.effects[best.everywhere :]
    scale = max(1.0, best.point.misfit**2)
    search.tell("asking what cannot be told apart")
    # What does not follow the recordings is no explanation that others could equal.
    asked = new if best.point.misfit < OFF else ()
    rivals = alternatives(found, search, asked, scale)
    information, _ = of_trajectory(best.fit, True)
    causes = found_causes(search, found, rivals, covariance(information))
    search.tell("replaying the recordings")
    model, plain = _model(experiment, base, best, information), _model(experiment, base, search.begun.before, None)
    runner_up = search.trials.runner_up(best) or found.runner_up
    followed = follow(experiment, base, search.begun.before, best, runner_up)
    gained = gain(followed, search.rules.seed)
    left, again = leftover(best.point.runs), repeated(best.point.runs)
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
        runner_up=runner_up.effects[runner_up.everywhere :] if runner_up else (),
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
    followed = tuple(replace(each, after=each.before, runner_up=None) for each in diagnosis.recordings)
    return replace(
        diagnosis,
        verdict="none",
        causes=(),
        model=diagnosis.base,
        runner_up=(),
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
    return "set" if any(cause.rivals for cause in causes) else "named"


def _still_needed(best: Explanation, search: Search, found: Found) -> list[int]:
    """Candidates of the last screen that are certain and matter."""
    certain = (found.last.p_values < search.rules.alpha) & (found.last.seen.statistics > search.matters(best))
    return [int(k) for k in np.flatnonzero(certain)]


def _remains(best: Explanation, base: Base, search: Search, left: Leftover, needed: Sequence[int]) -> bool:
    """Whether the explanation leaves more than noise; more than before the change, where that was more than noise."""
    if search.begun.lacking > 1:
        return _changed_misfit(best, search) > _CLEARLY * base.point.misfit
    unlikely = left.p_value < _UNLIKELY and left.excess > search.matters(best)
    return unlikely or bool(needed)


def _changed_misfit(best: Explanation, search: Search) -> float:
    """By how many times the noise the changed recordings are missed."""
    changed = [run for run in best.point.runs if run.observed.recording.condition != REFERENCE]
    squares, count = sum(run.chi2 for run in changed), sum(run.observed.count for run in changed)
    return float(search.begun.lacking * np.sqrt(squares / max(count, 1)))


def _usual(best: Explanation, base: Base, search: Search) -> str:
    """What is left where as much was missing before a change; empty where noise is all that is usual."""
    if search.begun.lacking <= 1:
        return ""
    return (
        f"the changed recordings are missed by {_changed_misfit(best, search):.2g} times the noise; the reference ones "
        f"were by {base.point.misfit:.2g}, by a model without effects: about what was missing before the change"
    )


def _model(experiment: Experiment, base: Base, explanation: Explanation, information: Information | None) -> Model:
    """The model of an explanation, with its parameters' estimates."""
    parametrisation = explanation.point.problem.parametrisation
    own = len(parametrisation.coordinates)
    x, estimate = explanation.point.x[:own], explanation.estimate[:own]
    if information is None:
        information, _ = of_trajectory(explanation.fit, True)
    inside = covariance(information)[:own, :own]
    kept = Information(information.normal[:own, :own], information.spread[:own, :own])
    found: tuple[Estimate, ...] = estimates(
        parametrisation, estimate, kept, to_physical(parametrisation, estimate, inside)
    )
    noise = base.fit.point.runs[0].observed.noise
    return Model(parametrisation.chain(x), experiment.rig, *noise, found, explanation.effects, explanation.everywhere)


def _worth(search: Search, best: Explanation, cause: Cause) -> Sequence[Proposal]:
    """Recordings by how well they would tell a cause from its rivals."""
    others = best.names - {cause.effect.key}
    rivals = [search.trials.tried.get(others | {rival.effect.key}) for rival in cause.rivals]
    return proposals(best, [each for each in rivals if each is not None])


def _described(
    experiment: Experiment,
    best: Explanation,
    left: Leftover,
    again: Repeated | None,
    found: Found,
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


def _notes(search: Search, base: Base, best: Explanation, left: Leftover, remains: bool) -> tuple[str, ...]:
    joints = ", ".join(f"{link.name} {link.virtual_joints}" for link in base.point.chain.links)
    known = "is measured against a finer chain" if best.shift is not None else "was not measured"
    notes = [f"virtual joints of the search's chain: {joints}; what so few of them get wrong {known}"]
    if search.begun.lost:
        notes.append(
            "without a change the model follows so little of the changed recordings that the table of candidates, "
            "which is linear, is no guide: each was fitted"
        )
    if not remains and search.begun.lacking == 1 and left.p_value < _UNLIKELY:
        notes.append("what is left is a little more than noise, and too little to matter")
    if best.is_held:
        notes.append(
            "dry friction or play: while fitting, a weak spring and damper held the simulated joint near its encoder's "
            "angles; misfits and parameters are those of such simulations, replays and the gain are open loop"
        )
    if best.effects and not best.fit.converged:
        notes.append("the last fit was ended once further steps no longer mattered")
    return tuple(notes)
