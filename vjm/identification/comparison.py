"""Models beside the recordings of an experiment: open-loop simulations of every recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from vjm.chain.layout import nominal_chain
from vjm.errors import (
    InsufficientDataError,
    ShapeError,
    SimulationDivergedError,
    require,
    require_kind,
    require_progress,
)
from vjm.experiment.arrays import number_array
from vjm.experiment.records import require_experiment
from vjm.identification.check import fit_warnings
from vjm.identification.mistakes import refuse_mistakes
from vjm.identification.outliers import trimmed
from vjm.identification.records import Comparison
from vjm.records import Array, Experiment, Progress, Recording, RecordingComparison, SimulatedRecording
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.measurement import Observations
from vjm.simulation.model import Model
from vjm.simulation.run import Run
from vjm.threads import on_one_thread

Replay = Callable[[Sequence[Observations], Sequence[Array | None] | None], list[tuple[Run, bool]]]


@on_one_thread
def compare(
    experiment: Experiment, model: Model, covariance: Array | None = None, progress: Progress | None = None
) -> Comparison:
    """Simulate every recording of an experiment with a model, and with the nominal one.

    Args:
        experiment: the recordings.
        model: of the same rig.
        covariance: (p, p) of the model's estimated parameters; None where unknown.
        progress: called with (text, done, total) while it runs.

    Raises:
        ExperimentError: no experiment.
        ShapeError: no model, no covariance, or a model whose links have other names, joints or lengths than the rig's.
        MistakeError: recordings that a mistake explains far better than the experiment file does.
    """
    require_experiment(experiment)
    require_kind("model", model, Model, "a vjm.Model, such as `fit.model`, or of `vjm.load_model(file)`")
    known = np.empty((0, 0)) if covariance is None else number_array("covariance", covariance)
    require("covariance", known, known.ndim == 2 and len(set(known.shape)) == 1, "(p, p) numbers, or None")
    require_progress(progress)
    given, expected = (
        ", ".join(f"{link.name} ({link.joint})" for link in links)
        for links in (model.chain.links, experiment.rig.links)
    )
    if given != expected:
        raise ShapeError("model", f"links {given}", f"the experiment's links {expected}")
    for link, rig_link in zip(model.chain.links, experiment.rig.links, strict=True):
        if abs(link.length - rig_link.length) > 1e-3 * rig_link.length:  # more than rounding in either file
            raise ShapeError(
                f"model, link {link.name}", f"length {link.length:.6g} m", f"the rig's {rig_link.length:.6g} m"
            )
    likely = refuse_mistakes(experiment)
    nominal = replace(model, chain=nominal_chain(experiment.rig, model.chain.links), estimates=(), effects=())
    recordings = compare_recordings(experiment, model, (nominal, None), progress)
    warnings = (*likely, *experiment.warnings, *fit_warnings(recordings))
    return Comparison(experiment, model, nominal, known, recordings, warnings)


def compare_recordings(
    experiment: Experiment,
    model: Model,
    others: Sequence[Model | None],
    progress: Progress | None = None,
    states: Mapping[str, Array] | None = None,
    step_multiple: float = 1.0,
) -> tuple[RecordingComparison, ...]:
    """Simulate every recording open loop with a model and with two others: the nominal and the torque method's, if any.

    Coordinates that cannot be right, and outliers, are left out of the recordings and counted. Most likely initial
    states (2 nv,) may be given, as far as they are known, by recording file, and the multiple of the default step that
    follows the recordings as far as their noise tells.
    """
    report, known, noise = progress or (lambda *_: None), states or {}, (model.marker_noise, model.encoder_noise)
    report("replaying recordings", 0, 2)
    measured = [Observations.of(experiment.rig, recording, noise) for recording in experiment.cleaned_recordings]
    starts = [known.get(observations.recording.file) for observations in measured]
    measured, results = replay_without_outliers(partial(_replay, model, step_multiple), measured, starts)
    report("replaying recordings", 2, 2)
    # Others miss by more than the error of steps twice as long.
    replays = [other and replay_each(partial(_replay, other, 2 * step_multiple), measured) for other in others]
    columns = [[_simulated(result) for result in column or [""] * len(measured)] for column in (results, *replays)]
    return tuple(
        RecordingComparison(
            recording=observations.recording,
            noise=noise,
            simulated=simulated,
            reference=reference,
            alternative=alternative,
            left_out=_left_out(raw, observations.recording),
            problem=result if isinstance(result, str) else "",
        )
        for raw, observations, result, simulated, reference, alternative in zip(
            experiment.recordings, measured, results, *columns, strict=True
        )
    )


def _left_out(raw: Recording, used: Recording) -> int:
    """Return the number of marker coordinates that are missing in the part of a recording that is used."""
    rows = (raw.time >= used.time[0]) & (raw.time <= used.time[-1])
    return int(np.isfinite(raw.markers[rows]).sum() - np.isfinite(used.markers).sum())


def _replay(
    model: Model, step_multiple: float, observed: Sequence[Observations], states: Sequence[Array | None] | None
) -> list[tuple[Run, bool]]:
    return fit_initial_states(
        [model.arm_in(observations.recording) for observations in observed], observed, states, step_multiple
    )


def _simulated(result: tuple[Run, bool] | str) -> SimulatedRecording | None:
    return None if isinstance(result, str) else result[0].simulated_recording(result[1])


def replay_each(
    replay: Replay, observed: Sequence[Observations], states: Sequence[Array | None] | None = None
) -> list[tuple[Run, bool] | str]:
    """Simulate recordings together, or each alone where that fails; return the reason for one that cannot be.

    `replay` simulates recordings from given initial states (2 nv,), None where not known, and returns for each whether
    its state converged, as `fit_initial_states` does.
    """
    if not observed:
        return []
    try:
        return [*replay(observed, states)]
    except (InsufficientDataError, SimulationDivergedError) as error:
        if len(observed) == 1:
            return [str(error)]
    return [replay_each(replay, [observations], states and [states[k]])[0] for k, observations in enumerate(observed)]


def replay_without_outliers(
    replay: Replay, observed: Sequence[Observations], states: Sequence[Array | None] | None = None
) -> tuple[list[Observations], list[tuple[Run, bool] | str]]:
    """Simulate recordings as `replay_each`, and those with outliers again without them.

    Initial states are looked for again near those given; without any, near those found. Also return the recordings.
    """
    cleaned, results, outlying = [*observed], replay_each(replay, observed, states), dict[int, Array | None]()
    for k, result in enumerate(results):
        if not isinstance(result, str) and (clean := trimmed(result[0])) is not observed[k]:
            given = states[k] if states else None
            cleaned[k], outlying[k] = clean, result[0].state if given is None else given
    repeated = replay_each(replay, [cleaned[k] for k in outlying], [*outlying.values()])
    for k, result in zip(outlying, repeated, strict=True):
        results[k] = result
    return cleaned, results
