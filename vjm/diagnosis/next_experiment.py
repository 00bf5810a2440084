"""The recording to make next."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from vjm.diagnosis.candidate_fit import CandidateFit
from vjm.diagnosis.records import Cause, Verdict
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.uncertainty import of_trajectory
from vjm.records import REFERENCE, Array, Experiment, Recording
from vjm.simulation.run import Run, Start, run_all

_SHARE = 0.1  # of the arm's mass, for a mass on the tip
_TURN = np.pi / 2


@dataclass(frozen=True)
class Proposal:
    """A recording to make, and what it would be worth.

    Attributes:
        text: as in "repeat slew.csv at twice its size".
        evidence: chi^2 that will lie between the explanation and the nearest of the others.
    """

    text: str
    evidence: float


@dataclass(frozen=True)
class _Item:
    """A change of a recording (and of its initial state, (2 nv,), of the arm with these active coordinates)."""

    text: str
    recording: Callable[[Recording], Recording]
    state: Callable[[Array, NDArray[np.intp]], Array]


def proposals(best: CandidateFit, others: Sequence[CandidateFit]) -> list[Proposal]:
    """What would tell an explanation from all of some others, the most telling first.

    Args:
        best: the explanation.
        others: as good ones.
    """
    found = []
    for item in _menu(best):
        for k in _liveliest(best):
            evidence = min((_evidence(best, other, k, item) for other in others), default=0.0)
            file = best.point.runs[k].observed.recording.file
            found.append(Proposal(f"repeat {file} {item.text}", evidence))
    return sorted(found, key=lambda each: -each.evidence)


def _menu(best: CandidateFit) -> Iterator[_Item]:
    chain = best.point.chain
    mass = float(f"{_SHARE * sum(link.masses.sum() for link in chain.links):.1g}")
    yield _Item(
        f"with a weighed mass of {1e3 * mass:.3g} g on the tip",
        lambda recording: replace(recording, payload=recording.payload + mass),
        lambda state, active: state,
    )
    for text, factor in (("at twice its size", 2.0), ("at half its size", 0.5)):
        yield _Item(text, _driven(factor), _bent(factor))
    if chain.active.size:
        yield _Item("from a position a quarter turn away", _turned, _turned_state)


def _driven(factor: float) -> Callable[[Recording], Recording]:
    return lambda recording: replace(recording, tau=factor * recording.tau)


def _bent(factor: float) -> Callable[[Array, NDArray[np.intp]], Array]:
    """All but the active joints' angles so many times as large."""

    def state(state: Array, active: NDArray[np.intp]) -> Array:
        found = factor * state
        found[active] = state[active]
        return found

    return state


def _turned(recording: Recording) -> Recording:
    theta = recording.theta.copy()
    theta[:, 0] += _TURN
    return replace(recording, theta=theta)


def _turned_state(state: Array, active: NDArray[np.intp]) -> Array:
    found = state.copy()
    found[active[0]] += _TURN
    return found


def _liveliest(best: CandidateFit) -> list[int]:
    """Of each kind of moving recording that may have changed, the one that moves most."""
    most: dict[str, tuple[float, int]] = {}
    for k, run in enumerate(best.point.runs):
        recording = run.observed.recording
        if recording.kind in ("driven", "decay") and recording.condition != REFERENCE:
            motion = float(np.nansum(np.nanvar(recording.markers, axis=0)))
            most[recording.kind] = max(most.get(recording.kind, (0.0, k)), (motion, k))
    return [k for _, k in most.values()]


def _evidence(true: CandidateFit, other: CandidateFit, k: int, item: _Item) -> float:
    """What another explanation would leave of a changed recording of an arm of which the first is true.

    Zero where one of them cannot be simulated.
    """
    try:
        shown, run = (_imagined(each, k, item) for each in (true, other))
        moved = replace(other.point.problem, observed=(run.observed,)).moved(other.point.x)[0]
        slopes = np.zeros((run.residual.size, 2 * run.basis.slow + len(moved)))
        for measured, part in run.slopes(moved):
            slopes[measured] = part
    except (SimulationDivergedError, InsufficientDataError):
        return 0.0
    information, _ = of_trajectory(other.fit, True)
    values, vectors = linalg.eigh(information.normal)
    known = np.zeros((len(moved), slopes.shape[1]))
    known[:, 2 * run.basis.slow :] = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    rows = np.vstack([slopes, known])
    wanted = np.concatenate([run.residual - shown.residual, np.zeros(len(moved))])
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    change = np.linalg.lstsq(rows / scale, wanted, rcond=1e-10)[0]
    return float(np.sum((wanted - (rows / scale) @ change) ** 2))


def _imagined(candidate_fit: CandidateFit, k: int, item: _Item) -> Run:
    """What an explanation would show in a changed recording."""
    point = candidate_fit.point
    run = point.runs[k]
    observed = run.observed.again(item.recording(run.observed.recording))
    (arm,) = point.problem.varied.arms(point.x, [observed.recording])
    state = item.state(run.state, arm.chain.active)
    return run_all([arm], [observed], [Start.of(arm, observed.recording)], [state], 1.0)[0]


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
    split = [cause for cause in causes if cause.alternatives]
    if split:
        cause = split[0]
        names = [cause.effect.id, *(alternative.effect.id for alternative in cause.alternatives)]
        worth = [each for each in ask(cause) if each.evidence > _TELLING]
        if worth:
            best = worth[0]
            return (
                f"to tell {' from '.join(names)}: {best.text}; chi^2 of the two will then differ by about "
                f"{best.evidence:.2g}"
            )
        effects = (cause.effect, *(alternative.effect for alternative in cause.alternatives))
        means = dict.fromkeys(part for effect in effects for part in effect.distinguishing_experiment.split("; "))
        told = "; or ".join(each for each in means if each)
        return f"to tell {' from '.join(names)}: record {told}"
    if verdict == "unknown":
        kinds = {each.kind for each in experiment.recordings}
        if "quiet" not in kinds:
            return 'record the arm at rest (kind = "quiet"): what is there without motion comes from outside'
        return "record the same drive at half and at twice its size: what then grows otherwise is not linear"
    return None
