"""The recording to make next."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from vjm.diagnosis.menu import Proposal
from vjm.diagnosis.records import Cause, Verdict
from vjm.experiment.records import Experiment

_TELLING = 30.0  # chi^2 that tells two explanations apart, also where it was predicted a little too large


def next_experiment(
    experiment: Experiment,
    verdict: Verdict,
    causes: Sequence[Cause],
    ask: Callable[[Cause], Sequence[Proposal]],
) -> str | None:
    """Which recording would tell what these cannot; None where there is nothing to tell.

    Args:
        experiment: what was recorded.
        verdict: of the diagnosis.
        causes: what was found.
        ask: told a cause, gives recordings by what they would be worth in telling it from its rivals.
    """
    split = [cause for cause in causes if cause.rivals]
    if split:
        cause = split[0]
        names = [cause.effect.id, *(rival.effect.id for rival in cause.rivals)]
        worth = [each for each in ask(cause) if each.evidence > _TELLING]
        if worth:
            best = worth[0]
            return (
                f"to tell {' from '.join(names)}: {best.text}; chi^2 of the two will then differ by about "
                f"{best.evidence:.2g}"
            )
        effects = (cause.effect, *(rival.effect for rival in cause.rivals))
        means = dict.fromkeys(part for effect in effects for part in effect.apart_by.split("; "))
        told = "; or ".join(each for each in means if each)
        return f"to tell {' from '.join(names)}: record {told}"
    if verdict == "unknown":
        kinds = {each.kind for each in experiment.recordings}
        if "quiet" not in kinds:
            return 'record the arm at rest (kind = "quiet"): what is there without motion comes from outside'
        return "record the same drive at half and at twice its size: what then grows otherwise is not linear"
    return None
