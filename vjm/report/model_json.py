"""Models as model.json: every number comes back exactly, and faults are told by file and key."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from vjm.chain.virtual_links import Chain, Distal, LinkChain
from vjm.effects import BUILTIN
from vjm.effects.effect import Effect, Parameter
from vjm.errors import ExperimentError, ModelFileError, ShapeError
from vjm.experiment.spectrum import sensor_noise
from vjm.files import json_text
from vjm.records import Array, Estimate, Experiment, Recording, Rig
from vjm.simulation.model import Model

_MOST_SHOWN = 60  # characters of a wrong value in a message

_NotNegative = Annotated[float, Field(ge=0)]
_Positive = Annotated[float, Field(gt=0)]
_Numbers = Annotated[list[float], BeforeValidator(lambda value: getattr(value, "tolist", lambda: value)())]


class _Entry(BaseModel):
    """A JSON object: no key but those listed, no type coercion, finite numbers."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True, from_attributes=True)


class _LinkEntry(_Entry):
    """A `LinkChain`, which itself checks sizes and ranges of the arrays."""

    name: str
    joint: Literal["revolute", "clamped"]
    lengths: _Numbers
    masses: _Numbers
    mass_centers: _Numbers
    inertias: _Numbers
    stiffness: _Numbers
    damping: _Numbers
    cells: _Numbers
    hub_inertia: _NotNegative
    payload: _NotNegative
    distal: Distal
    joint_stiffness: _NotNegative
    joint_damping: _NotNegative
    root_stiffness: _NotNegative | None
    root_damping: _NotNegative
    root_inertia: _NotNegative
    rest_curvature: float
    width: _Positive | None
    thickness: _Positive | None


class _ChainEntry(_Entry):
    name: str
    gravity: tuple[float, float]
    links: Annotated[tuple[_LinkEntry, ...], Field(min_length=1)]


class _EffectEntry(_Entry):
    """An effect by its id; `None` stands for an infinite value of a parameter."""

    effect: str
    link: str | None
    parameters: dict[str, float | None]
    in_reference: bool  # it acts in recordings of condition "reference" too


class _ModelEntry(_Entry):
    """The whole file."""

    schema_version: Literal[1] = Field(alias="schema")
    kind: Literal["vjm-model"]
    vjm: str
    rig: Rig
    marker_noise: _Positive
    encoder_noise: _Positive
    chain: _ChainEntry
    effects: tuple[_EffectEntry, ...]
    estimates: tuple[Estimate, ...]
    covariance: list[_Numbers]


def model_text(model: Model, covariance: Array | None = None) -> str:
    """Return the content of model.json; every number comes back exactly.

    Args:
        model: chain, effects, estimates, and the rig with its sensors' noise.
        covariance: (p, p) of the estimates that have a standard error; None or empty where unknown.

    Raises:
        ShapeError: a number that is not finite, or a value out of range.
    """
    estimates = tuple(_storable(estimate) for estimate in model.estimates if math.isfinite(estimate.value))
    known = covariance is not None and np.isfinite(covariance).all()
    try:
        entry = _ModelEntry(
            schema=1,
            kind="vjm-model",
            vjm=version("vjm"),
            rig=model.rig,
            marker_noise=model.marker_noise,
            encoder_noise=model.encoder_noise,
            chain=_ChainEntry.model_validate(model.chain),
            effects=tuple(_effect_entry(model, k) for k in range(len(model.effects))),
            estimates=estimates,
            covariance=covariance.tolist() if covariance is not None and known else [],
        )
        _check(entry)
    except ValidationError as error:
        place, problem, expected = _fault(error)
        raise ShapeError(place, problem.removeprefix("got "), expected) from None
    return json_text(entry.model_dump(by_alias=True))


def _effect_entry(model: Model, k: int) -> _EffectEntry:
    effect = model.effects[k]
    link = None if effect.link is None else model.chain.links[effect.link].name
    values = {name: value if math.isfinite(value) else None for name, value in effect.values.items()}
    return _EffectEntry(effect=effect.id, link=link, parameters=values, in_reference=k < model.reference_effects)


def _storable(estimate: Estimate) -> Estimate:
    known = estimate.std is not None and math.isfinite(estimate.std)
    return replace(estimate, value=float(estimate.value), std=estimate.std if known else None)


def load_model(path: Path | str) -> Model:
    """Read the model in a model.json that vjm wrote.

    Args:
        path: the file.

    Raises:
        ModelFileError: no such file, no JSON, or a key that is missing, unknown or wrong; names the key.
    """
    return read_model(path)[0]


def read_model(
    path: Path | str, experiment: Experiment | None = None, effects: Sequence[Effect] = BUILTIN
) -> tuple[Model, Array]:
    """Read a model.json, for the rig that it was written with or for that of another experiment.

    Args:
        path: the file.
        experiment: gives the rig and its sensors' noise; None: those in the file.
        effects: those that the file may name, absent; beside the built-in ones for instance a user's own.

    Returns:
        The model, and the covariance of its estimates (empty where unknown).

    Raises:
        ModelFileError: no such file, no JSON, or a key that is missing, unknown or wrong; names the key.
        ShapeError: a model of another arm than the experiment's.
    """
    try:
        entry = _ModelEntry.model_validate_json(Path(path).read_bytes())
        _check(entry)
        chain = _chain(entry.chain)
    except OSError as error:
        raise ModelFileError(path, error.strerror or str(error), "a readable model.json") from error
    except ValidationError as error:
        place, problem, expected = _fault(error)
        raise ModelFileError(path, f"key '{place}': {problem}" if place else problem, expected) from None
    except ShapeError as error:
        raise ModelFileError(path, f"key '{error.name}': {error.given}", error.expected) from error
    except ExperimentError as error:
        raise ModelFileError(path, f"rig, {error.table}, key '{error.key}': {error.problem}", error.expected) from error
    rig = experiment.rig if experiment else entry.rig
    recordings = experiment.cleaned_recordings if experiment else ()
    noise = sensor_noise(rig, recordings) if experiment else (entry.marker_noise, entry.encoder_noise)
    ordered = sorted(enumerate(entry.effects), key=lambda item: not item[1].in_reference)
    catalogue = {effect.id: effect for effect in effects}
    known = [(f"effects[{k}]", _valued(path, f"effects[{k}]", item, chain, catalogue)) for k, item in ordered]
    model = Model(chain, rig, *noise, entry.estimates, (), sum(item.in_reference for item in entry.effects))
    placed = tuple(_placed(path, key, effect, rig, recordings) for key, effect in known)
    covariance = np.array(entry.covariance, dtype=float).reshape(len(entry.covariance), len(entry.covariance))
    return replace(model, effects=placed), covariance


def _check(entry: _ModelEntry) -> None:
    """Check what concerns several keys: links that differ in name, and are the rig's; a covariance that fits."""
    links = [(link.name, link.joint) for link in entry.chain.links]
    if len({name for name, _ in links}) < len(links):
        raise ShapeError("chain.links", f"names {[name for name, _ in links]}", "names that differ")
    if links != [(link.name, link.joint) for link in entry.rig.links]:
        raise ShapeError("rig.links", [(link.name, link.joint) for link in entry.rig.links], f"the chain's {links}")
    count = sum(estimate.std is not None for estimate in entry.estimates)
    sizes = [len(row) for row in entry.covariance]
    if sizes and sizes != [count] * count:
        raise ShapeError("covariance", f"rows of {sizes}", f"{count} rows of {count}, or none")


def _chain(entry: _ChainEntry) -> Chain:
    try:
        return Chain(entry.name, tuple(LinkChain(**link.model_dump()) for link in entry.links), entry.gravity)
    except ShapeError as error:
        raise ShapeError("chain", f"{error.name}: {error.given}", error.expected) from error


def _fault(error: ValidationError) -> tuple[str, str, str]:
    """Return place, problem and expectation of the first fault; unknown keys first: they may explain missing ones."""
    detail = min(error.errors(include_url=False), key=lambda detail: detail["type"] != "extra_forbidden")
    parts = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in detail["loc"]]
    place = "".join(parts).removeprefix(".")
    if detail["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return place, "unknown key", "only the keys of model.json, schema 1"
    if detail["type"] == "missing":
        return place, "missing", "this key"
    if detail["type"] == "json_invalid":
        return place, f"no usable JSON ({detail['ctx']['error']})", "a model.json written by vjm"
    text = repr(detail["input"])
    shown = text if len(text) <= _MOST_SHOWN else f"{text[: _MOST_SHOWN - 3]}..."
    return place, f"got {shown}", detail["msg"].removeprefix("Input should be ")


def _valued(path: Path | str, key: str, entry: _EffectEntry, chain: Chain, catalogue: Mapping[str, Effect]) -> Effect:
    """Return an effect with its link and with the values of its parameters, all given and within their bounds."""
    names = [link.name for link in chain.links]
    if entry.effect not in catalogue:
        expected = f"one of {', '.join(catalogue)}"
        raise ModelFileError(path, f"key '{key}.effect': got {entry.effect!r}", expected)
    if entry.link is not None and entry.link not in names:
        raise ModelFileError(path, f"key '{key}.link': got {entry.link!r}", f"null or one of {names}")
    effect = catalogue[entry.effect]
    parameters = {parameter.name: parameter for parameter in effect.parameters}
    values: dict[str, Any] = {}
    for name, value in {**dict.fromkeys(parameters), **entry.parameters}.items():
        fault = f"key '{key}.parameters.{name}'"
        if name not in parameters:
            raise ModelFileError(path, f"{fault}: unknown key", f"only {', '.join(parameters) or 'no parameter'}")
        if name not in entry.parameters:
            raise ModelFileError(path, f"{fault}: missing", "this key")
        expected = _expected(parameters[name], value)
        if expected:
            raise ModelFileError(path, f"{fault}: got {'null' if value is None else f'{value:g}'}", expected)
        number = math.inf if value is None else value
        values[name] = int(number) if parameters[name].integer else number
    return replace(effect, link=None if entry.link is None else names.index(entry.link), **values)


def _expected(parameter: Parameter, value: float | None) -> str:
    """Return in words which values a parameter may have; empty if this is one of them, but for rounding."""
    if value is None:
        return "" if math.isinf(parameter.null) else f"a number {parameter.unit}".rstrip()
    bounds = parameter.lower, parameter.upper
    if not bounds[0] <= value <= bounds[1] and not any(math.isclose(value, bound, rel_tol=1e-9) for bound in bounds):
        return f"{bounds[0]:g} to {bounds[1]:g} {parameter.unit}".rstrip()
    return "a whole number" if parameter.integer and value != int(value) else ""


def _placed(path: Path | str, key: str, effect: Effect, rig: Rig, recordings: Sequence[Recording]) -> Effect:
    """Return an effect with all that it must know of the rig, which its `variants` there know."""
    places = effect.places(rig)
    if effect.link is None and None not in places:
        return effect
    name = "null" if effect.link is None else repr(rig.links[effect.link].name)
    if effect.link not in places:
        names = [rig.links[place].name for place in places if place is not None]
        raise ModelFileError(path, f"key '{key}.link': got {name}", f"one of {names}" if names else "null")
    whole = [parameter.name for parameter in effect.parameters if parameter.integer]
    there = [variant for variant in effect.variants(rig, recordings) if variant.link == effect.link]
    for variant in there:
        if all(getattr(variant, name) == getattr(effect, name) for name in whole):
            values: dict[str, Any] = {**effect.values}
            return replace(variant, **values)
    choices = sorted({getattr(variant, whole[0]) for variant in there}) if whole else []
    problem = f"key '{key}.parameters.{whole[0]}': got {getattr(effect, whole[0])}" if whole else f"key '{key}'"
    raise ModelFileError(path, problem, f"one of {choices}, on link {name}")
