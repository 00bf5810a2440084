"""Records of a diagnosis: what its steps find, and what it concludes from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Self

from vjm.effects.effect import Effect, Key
from vjm.records import REFERENCE, Estimate, Experiment, RecordingComparison, SimulatedRecording, SimulatedResult

if TYPE_CHECKING:
    from vjm.diagnosis.symptoms import Symptoms
    from vjm.simulation.model import Model

Verdict = Literal["none", "named", "set", "unknown", "insufficient"]
EQUIVALENT = (
    10.0  # difference of chi^2 below which models count as equal: a likelihood ratio of e^5, Jeffreys' decisive
)


@dataclass(frozen=True)
class Alternative:
    """Another effect that explains the recordings as well as the one named, or nearly."""

    effect: Effect  # with its estimated parameters
    chi2_increase: float  # chi^2 beyond that of the effect named


@dataclass(frozen=True)
class Cause:
    """An effect that the recordings need."""

    effect: Effect  # with the parameters at which the model's chain follows the recordings
    parameters: Mapping[str, Estimate]  # those of a beam, free of the chain's discretization error, by name
    p_value: float  # probability that noise alone makes any of the candidates look as needed as this
    decrease: float  # decrease of the training recordings' chi^2 by it
    alternatives: tuple[Alternative, ...]  # effects that explain the recordings as well in its place
    evidence: str  # in words
    role: Literal["main", "minor"] = "main"  # minor: significant, but explains next to nothing beside another cause
    holdout_gain: float | None = None  # reduction of the held-out marker RMS by it [m]; None where it is not known
    # The recording in which the causes gain most, simulated with all effects but this; None where it cannot be.
    without: SimulatedRecording | None = None


@dataclass(frozen=True)
class Candidate:
    """An effect at one place, as tested beside the model without effects; z and p-value are None if not testable."""

    effect: Effect  # absent; a shape parameter has the value at which the effect would explain most
    z: float | None  # root of the score statistic: of one size, standard errors off the null, all else being free
    p_value: float | None  # probability that noise alone makes any candidate look as needed as this
    sizes: Mapping[str, float]  # as the score test guesses them, by parameter
    smallest_detectable: Mapping[str, float]  # size that is found with a probability of 90 %, by parameter
    reason: str = ""  # why it cannot be tested, as a clause; empty where it can
    misfit: float | None = None  # RMS weighted residual with it alone, all other parameters fitted; None: not fitted
    # Whether `misfit` is only a bound of that over whole recordings: `lower` if the fit was to segments, each with
    # its own initial state; `upper` if the fit was stopped early, as it could not become the best.
    bound: Literal["lower", "upper"] | None = None

    @classmethod
    def untestable(cls, effect: Effect, reason: str) -> Self:
        """Return a candidate that the recordings cannot show."""
        return cls(effect, None, None, {}, {}, reason)

    @property
    def testable(self) -> bool:
        """True if the recordings can show it."""
        return not self.reason


@dataclass(frozen=True)
class ResidualBand:
    """Residuals of one kind of sensor of one recording in one band of frequencies."""

    file: str  # the recording's
    sensor: str  # `markers` or `encoder`
    frequencies: tuple[float, float]  # lowest and highest [Hz]
    count: int  # number of spectral coefficients
    excess: float  # sum of squares beyond that of noise, in units of the noise
    p_value: float  # probability of as large a sum under noise alone


@dataclass(frozen=True)
class ResidualTest:
    """Test of whether the residuals of all recordings are noise."""

    bands: tuple[ResidualBand, ...]  # the least likely first
    p_value: float  # probability that noise alone gives as much in any band, or in all together
    excess: float  # sum of squares of all bands beyond that of noise, in units of the noise


@dataclass(frozen=True)
class RepeatComparison:
    """Marker residuals of recordings that repeat each other, in units of the noise.

    Noise alone gives one for both, since no two recordings share it. A model error that recurs is in the first only,
    one that differs from recording to recording in both.
    """

    common: float  # RMS of the sum of two recordings' residuals over the square root of two
    individual: float  # RMS of their difference over the square root of two
    noise: float  # standard deviation of a marker coordinate [m]

    @property
    def recurring_share(self) -> float:
        """Share of the mean square beyond noise that recurs; NaN where there is none.

        An error m that recurs and errors d that do not make 2 m^2 + d^2 of the first mean square, d^2 of the second.
        """
        common, individual = (max(rms**2 - 1.0, 0.0) for rms in (self.common, self.individual))
        beyond_noise = common + individual
        return max(common - individual, 0.0) / beyond_noise if beyond_noise > 0 else float("nan")


@dataclass(frozen=True)
class Proposal:
    """A recording to make."""

    text: str  # as in "repeat slew.csv with twice the torque"
    difference: float  # of chi^2 that it will make between the best fit and the nearest alternative


@dataclass(frozen=True)
class Gain:
    """Improvement of held-out recordings by the causes, as RMS of the marker residuals [m]."""

    before: float
    after: float
    noise: float  # of a marker coordinate [m]
    reduction: float  # 1 - after / before
    interval: tuple[float, float]  # of the reduction, 95 %, by a block bootstrap
    next_best: float | None = None  # of the next best model; None where there is none

    @property
    def harmful(self) -> bool:
        """True if held-out recordings are certainly predicted worse with the causes than without."""
        return self.interval[1] < 0


@dataclass(frozen=True)
class Budget:
    """Time that a diagnosis may take and took [s]."""

    seconds: float  # that the search and its conclusions may take; infinite: as long as they need
    spent: float = 0.0
    exhausted: bool = False  # the search was ended before it was done
    not_tried: tuple[str, ...] = ()  # ids of effects that may be needed and were not fitted to the end


@dataclass(frozen=True)
class Remaining:
    """Residuals of the best model."""

    p_value: float | None  # probability that noise alone leaves as much; None where it cannot be judged
    description: str = ""  # where it acts and what it looks like; empty where nothing remains


@dataclass(frozen=True, kw_only=True, repr=False)
class Diagnosis(SimulatedResult):
    """Findings of a diagnosis and its conclusions: what a model gets wrong, why, and what adding the cause gains.

    Misfits are RMS weighted residuals, one where they are noise. The conclusions follow from all else.

    Attributes:
        experiment: what was diagnosed.
        causes: new effects of the best model: main ones, the one that explains most first, then minor ones.
        candidates: table of the effects that were looked for.
        model: the best model, with the causes.
        reference: the model before any change, without them.
        recordings: simulated by both models.
        symptoms: what the model before any change gets wrong.
        next_best: effects of the next best model; empty where no other was fitted.
        noise: in words, how the sensors' noise was estimated.
        warnings: what a user should know before trusting the result.
        notes: what was decided on the way, and why.
        insufficient: why the recordings support no statement, a sentence each; empty where they do.
        needed: candidates that are still significant beside the best model, the most needed first.
        residuals: test of the best model's residuals.
        resemblance: in words, the generic force that the residuals resemble; empty where none was looked for.
        repeats: residuals of recordings that repeat each other; None where there are none.
        proposals: recordings that would distinguish the first ambiguous cause from its alternatives, the best first.
        decrease: of chi^2 by the causes, as a share of what they leave.
        negligible: chi^2 that the best model may leave beyond noise.
        baseline_misfit: of the reference recordings (of all, where none is), by the model without effects.
        reference_misfit: of the reference recordings, as far as it counts as noise; at least one.
        changed_misfit: of the other recordings, by the best model.
        seed: of random numbers.
        budget: the time that it might take, and what it left undone.
        verdict: `none`, `named`, `set`, `unknown` or `insufficient`.
        gain: on held-out recordings; None where there are none.
        remaining: residuals of the best model.
        next_experiment: the recording that would settle what these cannot; None where there is nothing to settle.
    """

    experiment: Experiment
    causes: tuple[Cause, ...]
    model: Model
    reference: Model
    recordings: tuple[RecordingComparison, ...]
    candidates: tuple[Candidate, ...] = ()
    symptoms: Symptoms | None = None
    next_best: tuple[Effect, ...] = ()
    noise: str = ""
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    insufficient: tuple[str, ...] = ()
    needed: tuple[Effect, ...] = ()
    residuals: ResidualTest = ResidualTest((), 1.0, 0.0)
    resemblance: str = ""
    repeats: RepeatComparison | None = None
    proposals: tuple[Proposal, ...] = ()
    decrease: float = 0.0
    negligible: float = 0.0
    baseline_misfit: float = 1.0
    reference_misfit: float = 1.0
    changed_misfit: float = 1.0
    seed: int = 0
    budget: Budget = Budget(float("inf"))
    verdict: Verdict = "insufficient"
    gain: Gain | None = None
    remaining: Remaining = Remaining(None)
    next_experiment: str | None = None

    @property
    def main_causes(self) -> tuple[Cause, ...]:
        """Causes that explain what is wrong."""
        return tuple(cause for cause in self.causes if cause.role == "main")

    @property
    def minor_causes(self) -> tuple[Cause, ...]:
        """Causes that are real and explain next to nothing beside the main ones, the most useful first."""
        return tuple(cause for cause in self.causes if cause.role == "minor")

    @property
    def recommended(self) -> Model:
        """The model to use: the best one, or the reference where held-out recordings are predicted worse with it."""
        return self.reference if self.gain is not None and self.gain.harmful else self.model

    @property
    def held_out_alone(self) -> dict[Key, float]:
        """Held-out marker residuals [m] by effect that was simulated alone: the only cause, and the next best one."""
        if self.gain is None:
            return {}
        models = (([cause.effect for cause in self.causes], self.gain.after), (self.next_best, self.gain.next_best))
        return {effects[0].key: rms for effects, rms in models if len(effects) == 1 and rms is not None}

    @property
    def parameters(self) -> tuple[Estimate, ...]:
        """Parameters of the best model's chain."""
        return self.model.estimates

    @property
    def most_improved(self) -> RecordingComparison | None:
        """Recording in which the causes gain most; held-out ones count twice. None where none can be simulated."""
        usable = [pair for pair in self.recordings if pair.reference is not None and pair.simulated is not None]
        # Fewer frames than 40 show little of a motion.
        moving = [pair for pair in usable if pair.recording.kind != "quiet" and pair.recording.frames.size >= 40]
        return max(moving or usable, key=_improvement, default=None)


def _improvement(comparison: RecordingComparison) -> float:
    before, after = (0.0 if run is None else run.marker_rms for run in (comparison.reference, comparison.simulated))
    weight = 2.0 if comparison.recording.role == "holdout" else 1.0
    return weight * (before**2 - after**2) / comparison.noise[0] ** 2


def held_out(recordings: Sequence[RecordingComparison]) -> list[RecordingComparison]:
    """Return the held-out recordings that judge the causes: those in which something may have changed, if there are."""
    usable = [pair for pair in recordings if pair.recording.role == "holdout" and pair.reference and pair.simulated]
    usable = [pair for pair in usable if pair.recording.frames.size]
    return [pair for pair in usable if pair.recording.condition != REFERENCE] or usable
