"""A given model against the recordings of an experiment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vjm.chain.layout import chain_layouts, nominal_chain
from vjm.errors import ShapeError
from vjm.identification.assess import fit_recordings
from vjm.identification.warn import result_warnings
from vjm.records import Array, Experiment, Progress, RecordingComparison, SimulatedResult
from vjm.simulation.model import Model

_SAME_LENGTH = 1e-3  # relative


@dataclass(frozen=True, repr=False)
class Comparison(SimulatedResult):
    """How well a model follows recordings that it may never have seen.

    Attributes:
        experiment: the recordings.
        model: the given model.
        nominal: what the experiment file's nominal values give, cut at the same places.
        covariance: (p, p) of the model's estimated parameters; empty where unknown.
        recordings: fit of every recording, in the experiment's order.
        warnings: what a user should know.
    """

    experiment: Experiment
    model: Model
    nominal: Model
    covariance: Array
    recordings: tuple[RecordingComparison, ...]
    warnings: tuple[str, ...]


def compare(
    experiment: Experiment,
    model: Model,
    covariance: Array | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Simulate every recording with a model, and with the nominal one.

    Args:
        experiment: the recordings.
        model: of the same rig.
        covariance: (p, p) of the model's estimated parameters; None where unknown.
        progress: told (text, done, total) while it runs.

    Raises:
        ShapeError: a model whose links are longer or shorter than the rig's.
    """
    for link, own in zip(model.chain.links, experiment.rig.links, strict=True):
        if abs(link.length - own.length) > _SAME_LENGTH * own.length:
            raise ShapeError(f"model, link {link.name}", f"length {link.length:.6g} m", f"the rig's {own.length:.6g} m")
    nominal = replace(model, chain=nominal_chain(experiment.rig, chain_layouts(model.chain)), estimates=(), effects=())
    fits = fit_recordings(experiment, model, (nominal, None), progress)
    known = np.empty((0, 0)) if covariance is None else covariance
    warnings = (*experiment.warnings, *result_warnings(fits, ()))
    return Comparison(experiment, model, nominal, known, fits, warnings)
