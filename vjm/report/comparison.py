"""A given model against the recordings of an experiment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vjm.chain.layout import Layout, uniform_chain
from vjm.chain.records import Chain
from vjm.errors import ShapeError, VjmError
from vjm.experiment.records import Experiment, Recording, Rig
from vjm.identify.records import RecordingFit
from vjm.model import Model
from vjm.simulate.initial_state import Replay

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

_SAME_LENGTH = 1e-3  # relative


@dataclass(frozen=True)
class Comparison:
    """How well a model follows recordings that it may never have seen.

    Attributes:
        experiment: the recordings.
        model: the given model.
        nominal: what the experiment file's nominal values give, cut at the same places.
        covariance: (p, p) of the model's estimated parameters, as far as its file holds it; else empty.
        recordings: fit of every recording, in the experiment's order.
        warnings: what a user should know.
    """

    experiment: Experiment
    model: Model
    nominal: Model
    covariance: Array
    recordings: tuple[RecordingFit, ...]
    warnings: tuple[str, ...]


def compare(experiment: Experiment, model: Model, covariance: Array, progress: Progress | None = None) -> Comparison:
    """Replay every recording with a model, and with the nominal one.

    Args:
        experiment: the recordings.
        model: of the same rig.
        covariance: (p, p) of the model's estimated parameters; empty where unknown.
        progress: told what is done, how many recordings are done, and of how many.

    Raises:
        ShapeError: a model whose links are longer or shorter than the rig's.
    """
    for link, own in zip(model.chain.links, experiment.rig.links, strict=True):
        if abs(link.length - own.length) > _SAME_LENGTH * own.length:
            raise ShapeError(f"model, link {link.name}", f"length {link.length:.6g} m", f"the rig's {own.length:.6g} m")
    nominal = replace(model, chain=nominal_chain(experiment.rig, model.chain), estimates=())
    fits = []
    for k, recording in enumerate(experiment.recordings):
        if progress is not None:
            progress(f"replaying {recording.file}", k, len(experiment.recordings))
        fits.append(_fit(model, nominal, recording))
    return Comparison(experiment, model, nominal, covariance, tuple(fits), (*experiment.warnings, *_warnings(fits)))


def nominal_chain(rig: Rig, like: Chain) -> Chain:
    """The rig with its nominal values, cut where another chain of it is cut."""
    links = [
        uniform_chain(link, Layout(other.lengths, other.cells), distal=other.distal)
        for link, other in zip(rig.links, like.links, strict=True)
    ]
    return Chain(rig.name, tuple(links), rig.gravity)


def _fit(model: Model, nominal: Model, recording: Recording) -> RecordingFit:
    problem, replays = "", []
    for each in (model, nominal):
        replay: Replay | None = None
        try:
            replay = each.replay(recording)
        except VjmError as error:
            problem = problem or str(error)
        replays.append(replay)
    problem = "" if replays[0] is not None else problem
    return RecordingFit(recording, replays[0], replays[1], model.marker_noise, model.encoder_noise, problem)


def _warnings(fits: list[RecordingFit]) -> list[str]:
    return [f"{fit.recording.file}: not simulated: {fit.problem}" for fit in fits if fit.replay is None]
