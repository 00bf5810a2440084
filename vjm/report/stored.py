"""What model.json holds beside the chain, and the model it gives back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from vjm.chain.records import Chain
from vjm.effects import BUILTIN
from vjm.effects.effect import Effect, Parameter
from vjm.errors import ModelFileError
from vjm.experiment.records import Experiment
from vjm.identification.records import Identification
from vjm.model import Model
from vjm.model_file import StoredEffect, read_stored
from vjm.noise import sensor_noise
from vjm.parameters import Estimate
from vjm.result import finite

if TYPE_CHECKING:
    from vjm.diagnosis.records import Diagnosis

Array = NDArray[np.float64]


def identification_extra(fit: Identification) -> dict[str, Any]:
    """How the model was found: method, estimates and their covariance."""
    covariance = fit.covariance if np.isfinite(fit.covariance).all() else np.empty((0, 0))
    return {
        "method": fit.method,
        "parameters": fit.parametrisation,
        "status": fit.status,
        "estimates": _estimates(fit.parameters),
        "covariance": covariance,
    }


def diagnosis_extra(diagnosis: Diagnosis) -> dict[str, Any]:
    """How the extended model was found: the verdict, the chain's estimates, and the effects' standard errors."""
    return {
        "method": "diagnosis",
        "verdict": diagnosis.verdict,
        "estimates": _estimates(diagnosis.parameters),
        "causes": [
            {
                "effect": cause.effect.id,
                "std": {name: finite(size.std) for name, size in cause.parameters.items()},
            }
            for cause in diagnosis.causes
        ],
    }


def _estimates(estimates: Sequence[Estimate]) -> list[dict[str, Any]]:
    return [
        {**asdict(each), "value": finite(each.value), "std": finite(each.std)}
        for each in estimates
        if finite(each.value) is not None
    ]


def stored_effects(model: Model) -> list[StoredEffect]:
    """A model's effects as model.json holds them."""
    names = [link.name for link in model.chain.links]
    return [
        StoredEffect(
            effect.id,
            None if effect.link is None else names[effect.link],
            {name: value if math.isfinite(value) else None for name, value in effect.values.items()},
            k < model.everywhere,
        )
        for k, effect in enumerate(model.effects)
    ]


def stored_model(
    path: Path | str, experiment: Experiment, effects: Sequence[Effect] = BUILTIN
) -> tuple[Model, Array, dict[str, Any]]:
    """The model in a model.json, for an experiment's rig.

    Args:
        path: the file.
        experiment: gives the rig and the sensors' noise.
        effects: those that the file may name, absent; beside the built-in ones for instance a user's own.

    Returns:
        The model, the covariance of its estimates (empty if unknown), and all that the file holds beside the model.

    Raises:
        ModelFileError: no usable model.json; names the key.
        ShapeError: a model of another arm.
    """
    stored = read_stored(path)
    try:
        estimates = TypeAdapter(tuple[Estimate, ...]).validate_python(stored.extra.get("estimates", ()))
        rows = TypeAdapter(list[list[float]]).validate_python(stored.extra.get("covariance", []))
        covariance = np.array(rows, dtype=float) if rows else np.empty((0, 0))
    except (ValidationError, ValueError) as error:
        raise ModelFileError(path, "key 'extra' holds no usable estimates", "a model.json written by vjm") from error
    noise = sensor_noise(experiment.rig, experiment.recordings)
    model = Model(stored.chain, experiment.rig, *noise, estimates)
    # Those that act everywhere come first.
    ordered = sorted(stored.effects, key=lambda each: not each.everywhere)
    read = _read_effects(path, stored.chain, ordered, effects)
    placed = tuple(_placed(path, k, effect, experiment) for k, effect in enumerate(read))
    everywhere = sum(each.everywhere for each in ordered)
    return replace(model, effects=placed, everywhere=everywhere), covariance, stored.extra


def stored_chain(path: Path | str, effects: Sequence[Effect] = BUILTIN) -> tuple[Chain, tuple[Effect, ...]]:
    """The chain in a model.json and the effects on it, where there is no rig to place sensors' effects.

    Args:
        path: the file.
        effects: those that the file may name, absent.

    Raises:
        ModelFileError: no usable model.json; names the key.
    """
    stored = read_stored(path)
    return stored.chain, _read_effects(path, stored.chain, stored.effects, effects)


def _read_effects(
    path: Path | str, chain: Chain, stored: Sequence[StoredEffect], effects: Sequence[Effect]
) -> tuple[Effect, ...]:
    known = {effect.id: effect for effect in effects}
    names = [link.name for link in chain.links]
    found = []
    for k, each in enumerate(stored):
        if each.effect not in known:
            expected = f"one of {', '.join(known)}"
            raise ModelFileError(path, f"key 'effects[{k}].effect': got {each.effect!r}", expected)
        link = None if each.link is None else names.index(each.link)
        values = _values(path, f"effects[{k}].parameters", known[each.effect].parameters(), each.parameters)
        found.append(replace(known[each.effect], link=link, **values))
    return tuple(found)


def _values(
    path: Path | str, key: str, parameters: Sequence[Parameter], given: Mapping[str, float | None]
) -> dict[str, float]:
    """Values of an effect's parameters, every one of them given and within its bounds."""
    names = [each.name for each in parameters]
    for name in given:
        if name not in names:
            raise ModelFileError(path, f"key '{key}.{name}': unknown key", f"only {', '.join(names) or 'no parameter'}")
    found: dict[str, float] = {}
    for each in parameters:
        if each.name not in given:
            raise ModelFileError(path, f"key '{key}.{each.name}': missing", "this key")
        value = given[each.name]
        found[each.name] = math.inf if value is None else value
        if value is None and not math.isinf(each.null):
            raise ModelFileError(path, f"key '{key}.{each.name}': got null", f"a number {each.unit}".rstrip())
        if value is not None and not _within(each, value):
            expected = f"{each.lower:g} to {each.upper:g} {each.unit}".rstrip()
            raise ModelFileError(path, f"key '{key}.{each.name}': got {value:g}", expected)
        if value is not None and each.whole:
            if value != int(value):
                raise ModelFileError(path, f"key '{key}.{each.name}': got {value:g}", "a whole number")
            found[each.name] = int(value)
    return found


def _within(parameter: Parameter, value: float) -> bool:
    """Whether a value is within its bounds, but for rounding."""
    bounds = parameter.lower, parameter.upper
    return bounds[0] <= value <= bounds[1] or any(math.isclose(value, each, rel_tol=1e-9) for each in bounds)


def _placed(path: Path | str, k: int, effect: Effect, experiment: Experiment) -> Effect:
    """An effect with all that it must know of the rig, as its own `variants` do."""
    rig = experiment.rig
    places = effect.places(rig)
    whole = [each.name for each in effect.parameters() if each.whole]
    variants = [each for each in effect.variants(rig, experiment.recordings) if each.link == effect.link]
    alike = [each for each in variants if all(getattr(each, name) == getattr(effect, name) for name in whole)]
    if alike:
        values: dict[str, Any] = {**effect.values}
        return replace(alike[0], **values)
    named = "null" if effect.link is None else repr(rig.links[effect.link].name)
    if effect.link not in places and effect.link is not None:
        names = [rig.links[place].name for place in places if place is not None]
        raise ModelFileError(path, f"key 'effects[{k}].link': got {named}", f"one of {names}" if names else "null")
    if variants and whole:
        name = whole[0]
        there = sorted({getattr(each, name) for each in variants})
        problem = f"key 'effects[{k}].parameters.{name}': got {getattr(effect, name)}"
        raise ModelFileError(path, problem, f"one of {there}, on link {named}")
    return effect
