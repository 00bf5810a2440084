"""What model.json holds beside the chain, and the model it gives back."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from vjm.errors import ModelFileError
from vjm.experiment.records import Experiment
from vjm.identification.records import Identification
from vjm.model import Model
from vjm.model_file import read_model
from vjm.noise import sensor_noise
from vjm.parameters import Estimate
from vjm.result import finite

Array = NDArray[np.float64]


def identification_extra(fit: Identification) -> dict[str, Any]:
    """How the model was found: method, estimates and their covariance."""
    covariance = fit.covariance if np.isfinite(fit.covariance).all() else np.empty((0, 0))
    return {
        "method": fit.method,
        "parameters": fit.parametrisation,
        "status": fit.status,
        "estimates": [
            {**asdict(each), "value": finite(each.value), "std": finite(each.std)}
            for each in fit.parameters
            if finite(each.value) is not None
        ],
        "covariance": covariance,
    }


def stored_model(path: Path | str, experiment: Experiment) -> tuple[Model, Array, dict[str, Any]]:
    """The model in a model.json, for an experiment's rig.

    Args:
        path: the file.
        experiment: gives the rig and the sensors' noise.

    Returns:
        The model, the covariance of its estimates (empty if unknown), and all that the file holds beside the chain.

    Raises:
        ModelFileError: no usable model.json.
        ShapeError: a model of another arm.
    """
    chain, extra = read_model(path)
    try:
        estimates = TypeAdapter(tuple[Estimate, ...]).validate_python(extra.get("estimates", ()))
        rows = TypeAdapter(list[list[float]]).validate_python(extra.get("covariance", []))
        covariance = np.array(rows, dtype=float) if rows else np.empty((0, 0))
    except (ValidationError, ValueError) as error:
        raise ModelFileError(path, "key 'extra' holds no usable estimates", "a model.json written by vjm") from error
    noise = sensor_noise(experiment.rig, experiment.recordings)
    return Model(chain, experiment.rig, *noise, estimates), covariance, extra
