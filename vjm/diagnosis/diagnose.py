"""The diagnosis, from an experiment to what is missing."""

from __future__ import annotations

from collections.abc import Sequence

from vjm.diagnosis.baseline import base_fit, begin_search
from vjm.diagnosis.records import Diagnosis
from vjm.diagnosis.screen import candidates, chosen_effects
from vjm.diagnosis.selection import (
    Rules,
    Search,
    SearchResult,
    preexisting_effects,
    reference_warning,
    search_stick_slip,
)
from vjm.diagnosis.verdict import conclude, insufficient, why_insufficient
from vjm.diagnosis.workers import workers
from vjm.effects import Effect
from vjm.errors import ShapeError
from vjm.records import Experiment, Progress

_CHANGE = 1.0  # times what it leaves


def diagnose(
    experiment: Experiment,
    effects: Sequence[str | Effect] | None = None,
    max_effects: int = 3,
    jobs: int = 1,
    seed: int = 0,
    progress: Progress | None = None,
) -> Diagnosis:
    """Find what a model of an arm lacks: which physical effects or sensor faults, how large, and what is gained.

    Args:
        experiment: the rig and its recordings; some held out.
        effects: what to look for, ids of built-in effects or instances of `vjm.effects.Effect`; None: all built in.
        max_effects: number of causes at most.
        jobs: processes. More than one needs a script whose top level is guarded by `if __name__ == "__main__"`.
        seed: of all that is drawn.
        progress: told (text, done, total) while it runs.

    Returns:
        The diagnosis. Data that cannot support a statement give the verdict `insufficient`.

    Raises:
        ChoiceError: an unknown effect id.
        ShapeError: an option out of range.
        InsufficientDataError: recordings that not even a model without effects can be fitted to.
        SimulationDivergedError: no start can be simulated.
    """
    chosen = chosen_effects(effects)
    for name, value, least in (("max_effects", max_effects, 1), ("jobs", jobs, 1), ("seed", seed, 0)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ShapeError(name, value, f"a whole number of at least {least}")
    tell = _Stages(progress)
    reasons = why_insufficient(experiment)
    tell("fitting the model without effects")
    base = base_fit(experiment, tell.inside)
    with workers(jobs) as shared:
        known = preexisting_effects(base, chosen, experiment.rig, tell, shared)
        search_start = begin_search(base, known)
        # What a model lacks before a change is no noise: only what explains much of the rest is a change.
        rules = Rules(
            matters=_CHANGE if search_start.reference_misfit > 1 else Rules.matters, most=max_effects, seed=seed
        )
        search = Search(experiment.rig, search_start, chosen, rules, tell, shared)
        first = search.judged(search_start.start)
        table = candidates(search.candidate_set, first, rules.alpha, search.matters(search_start.start))
        if reasons:
            return insufficient(experiment, base, table, reasons)
        said = reference_warning(base, known, search_start.reference_misfit)
        search, found = search_stick_slip(search, SearchResult.nothing(search_start.start, first))
        return conclude(experiment, base, search, found, table, said)


class _Stages:
    """Tells how far a diagnosis has come; how many stages there will be is not known before."""

    def __init__(self, progress: Progress | None) -> None:
        self.progress = progress
        self.stage = 0

    def __call__(self, text: str) -> None:
        self.stage += 1
        if self.progress is not None:
            self.progress(text, int(100 * (1 - 0.85**self.stage)), 100)

    def inside(self, text: str, done: int, total: int) -> None:
        """A stage's own progress."""
        if self.progress is not None:
            share = 1 - 0.85 ** (self.stage + done / max(total, 1))
            self.progress(text, int(100 * share), 100)
