"""What a diagnosis says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from vjm.effects.effect import Effect
from vjm.records import Estimate, Experiment, RecordingComparison, SimulatedRecording
from vjm.simulation.model import Model
from vjm.symptoms.find import Symptoms

Verdict = Literal["none", "named", "set", "unknown", "insufficient"]


@dataclass(frozen=True)
class Size:
    """One parameter of an effect, as estimated.

    Attributes:
        value: in `unit`.
        std: standard error; None for what was not estimated, as an index, or is not determined.
        unit: SI; empty where it has none.
    """

    value: float
    std: float | None
    unit: str


@dataclass(frozen=True)
class Alternative:
    """Another effect that explains the recordings as well as the one named, or nearly.

    Attributes:
        effect: with its estimated parameters.
        worse: chi^2 beyond that of the effect named.
    """

    effect: Effect
    worse: float


@dataclass(frozen=True)
class Cause:
    """An effect that the recordings need.

    Attributes:
        effect: with the parameters with which the model's chain follows the recordings.
        parameters: those of a beam, whose joints have no end, with standard errors, by name.
        p_value: probability that noise alone makes any of the candidates look as needed as this.
        gain: by how much chi^2 of the training recordings falls with it.
        alternatives: effects that cannot be told from it.
        evidence: in words.
        without: the recording in which the causes gain most, simulated with all effects but this one; None where it
            cannot be simulated.
    """

    effect: Effect
    parameters: Mapping[str, Size]
    p_value: float
    gain: float
    alternatives: tuple[Alternative, ...]
    evidence: str
    without: SimulatedRecording | None = None


@dataclass(frozen=True)
class Candidate:
    """One effect at one place, as the search judged it beside the model without any effect.

    Attributes:
        effect: the absent effect; an inner parameter has the value at which it would explain most.
        z: how many standard errors its size is off the null, all other parameters being free; None where not testable.
        p_value: of the whole search: that noise alone makes any candidate look as needed as this.
        sizes: its sizes as a score test guesses them, by parameter.
        smallest_detectable: size that would be found nine times in ten, by parameter.
        reason: why it cannot be tested, as a clause; empty where it can.
    """

    effect: Effect
    z: float | None
    p_value: float | None
    sizes: Mapping[str, float]
    smallest_detectable: Mapping[str, float]
    reason: str = ""

    @property
    def testable(self) -> bool:
        """Whether the recordings can show it."""
        return not self.reason


@dataclass(frozen=True)
class Gain:
    """What the extended model gains on held-out recordings.

    Attributes:
        before, after: RMS of the marker residuals [m].
        noise: of a marker coordinate [m].
        reduction: 1 - after / before.
        interval: of the reduction, 95 %, by a block bootstrap.
        next_best: RMS of the markers with the next best explanation [m]; None where there is none.
    """

    before: float
    after: float
    noise: float
    reduction: float
    interval: tuple[float, float]
    next_best: float | None = None


@dataclass(frozen=True)
class Remaining:
    """Whether what the extended model leaves is noise.

    Attributes:
        p_value: that noise alone leaves as much; None where it cannot be judged.
        description: where it acts and what it looks like; empty where nothing remains.
    """

    p_value: float | None
    description: str = ""


@dataclass(frozen=True)
class Diagnosis:
    """What a model gets wrong, why, and what is gained by adding the cause.

    Attributes:
        experiment: what was diagnosed.
        verdict: `none`, `named`, `set`, `unknown` or `insufficient`.
        causes: what was found, the one that explains most first.
        candidates: every effect that was looked for.
        model: with the causes found.
        base: without them.
        parameters: of the extended model's chain.
        recordings: replayed without and with the causes.
        gain: on held-out recordings; None where there are none.
        remaining: whether what is left is noise.
        symptoms: what the model without effects gets wrong, before any cause is named.
        next_experiment: the recording that would tell what these cannot; None where there is nothing to tell.
        noise: in words, how the sensors' noise was judged.
        next_best: effects of the next best explanation; empty where nothing else was fitted.
        warnings: what a user should know before trusting the result.
        notes: what was decided on the way, and why.
    """

    experiment: Experiment
    verdict: Verdict
    causes: tuple[Cause, ...]
    candidates: tuple[Candidate, ...]
    model: Model
    base: Model
    parameters: tuple[Estimate, ...]
    recordings: tuple[RecordingComparison, ...]
    gain: Gain | None
    remaining: Remaining
    symptoms: Symptoms | None
    next_experiment: str | None
    noise: str = ""
    next_best: tuple[Effect, ...] = ()
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default=())
