"""What model.json holds beside the chain, and the model it gives back."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from vjm.chain.virtual_links import Chain, Distal, LinkChain
from vjm.effects import BUILTIN
from vjm.effects.effect import Effect, Parameter
from vjm.errors import ModelFileError, ShapeError
from vjm.experiment.noise import sensor_noise
from vjm.files import json_text, write_text_atomic
from vjm.identification.records import Identification
from vjm.records import Array, Estimate, Experiment
from vjm.report.result_json import finite
from vjm.simulation.model import Model

if TYPE_CHECKING:
    from vjm.diagnosis.records import Diagnosis


SCHEMA = 1
KIND = "vjm-model"

_NotNegative = Annotated[float, Field(ge=0)]
_Positive = Annotated[float, Field(gt=0)]


class _Entry(BaseModel):
    """A JSON object: no key but those listed, no type coercion, finite numbers."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)


class LinkEntry(_Entry):
    """One `LinkChain`, field by field; LinkChain itself checks sizes and ranges of the arrays."""

    name: str
    joint: Literal["revolute", "clamped"]
    lengths: list[float]
    masses: list[float]
    mass_centers: list[float]
    inertias: list[float]
    stiffness: list[float]
    damping: list[float]
    cells: list[float]
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


class ChainEntry(_Entry):
    """One `Chain`."""

    name: str
    gravity: Annotated[list[float], Field(min_length=2, max_length=2)]
    links: Annotated[list[LinkEntry], Field(min_length=1)]


class EffectEntry(_Entry):
    """One effect on a chain; which effects and parameters there are is not this module's business."""

    effect: str
    link: str | None
    parameters: dict[str, float | None]
    reference_effects: bool = False


class ModelEntry(_Entry):
    """The whole file."""

    schema_version: Literal[1] = Field(alias="schema")
    kind: Literal["vjm-model"]
    vjm: str
    chain: ChainEntry
    effects: list[EffectEntry] = []
    extra: dict[str, Any]


@dataclass(frozen=True)
class StoredEffect:
    """An effect as model.json holds it.

    Attributes:
        effect: its id.
        link: name of the link, or of the joint at its proximal end, where it acts; None for what is camera-wide.
        parameters: by name, SI; None for a value that is infinite.
        reference_effects: whether it acts in recordings of the reference condition too.
    """

    effect: str
    link: str | None
    parameters: Mapping[str, float | None]
    reference_effects: bool = False


@dataclass(frozen=True)
class Stored:
    """All that a model.json holds.

    Attributes:
        chain: without the effects.
        effects: what acts on it, in order.
        extra: what else is known.
    """

    chain: Chain
    effects: tuple[StoredEffect, ...]
    extra: dict[str, Any]


def write_model(
    chain: Chain,
    path: Path | str,
    extra: Mapping[str, object] | None = None,
    effects: Sequence[StoredEffect] = (),
) -> None:
    """Write a chain as model.json, whole or not at all; every number comes back exactly.

    Args:
        chain: the chain, without its effects.
        path: the file.
        extra: what else is known, such as standard errors: mappings, lists, arrays, text, finite numbers, None.
            Tuples and arrays come back as lists.
        effects: what acts on the chain and on its sensors; a file without any has no such key.

    Raises:
        ShapeError: a number that is not finite, or a value that is out of range or that JSON cannot hold.
        OSError: the file cannot be written.
    """
    content = {
        "schema": SCHEMA,
        "kind": KIND,
        "vjm": version("vjm"),
        "chain": {
            "name": chain.name,
            "gravity": chain.gravity,
            "links": [{field.name: getattr(link, field.name) for field in fields(link)} for link in chain.links],
        },
        **({"effects": [vars(each) for each in effects]} if effects else {}),
        "extra": dict(extra or {}),
    }
    text = json_text(content)
    try:
        _stored(ModelEntry.model_validate(json.loads(text)))
    except ValidationError as error:
        place, problem, expected = _fault(error)
        raise ShapeError(place, problem.removeprefix("got "), expected) from None
    write_text_atomic(path, text)


def read_model(path: Path | str) -> tuple[Chain, dict[str, Any]]:
    """Read the chain in a model.json, without effects.

    Args:
        path: the file.

    Returns:
        The chain, and `extra` as it was written.

    Raises:
        ModelFileError: no such file, no JSON, or a key that is missing, unknown or wrong; names the key.
    """
    found = read_stored(path)
    return found.chain, found.extra


def read_stored(path: Path | str) -> Stored:
    """Read all that a model.json holds.

    Args:
        path: the file.

    Raises:
        ModelFileError: no such file, no JSON, or a key that is missing, unknown or wrong; names the key.
    """
    try:
        content = json.loads(
            Path(path).read_bytes(),
            parse_float=_finite,
            parse_constant=_finite,
            object_pairs_hook=_unique,
        )
    except OSError as error:
        raise ModelFileError(path, error.strerror or str(error), "a readable model.json") from error
    except (ValueError, RecursionError) as error:
        raise ModelFileError(path, f"no usable JSON: {error}", "a model.json written by vjm") from error
    try:
        return _stored(ModelEntry.model_validate(content))
    except ValidationError as error:
        place, problem, expected = _fault(error)
        raise ModelFileError(path, f"key '{place}': {problem}" if place else problem, expected) from None
    except ShapeError as error:
        raise ModelFileError(path, f"key 'chain': {error.name}: {error.given}", error.expected) from error


def _stored(entry: ModelEntry) -> Stored:
    chain = _chain(entry.chain)
    names = [None, *(link.name for link in chain.links)]
    for k, effect in enumerate(entry.effects):
        if effect.link not in names:
            raise ShapeError(f"effects[{k}].link", f"got {effect.link!r}", f"null or one of {names[1:]}")
    return Stored(chain, tuple(StoredEffect(**effect.model_dump()) for effect in entry.effects), entry.extra)


def _chain(entry: ChainEntry) -> Chain:
    links = tuple(LinkChain(**link.model_dump()) for link in entry.links)
    names = [link.name for link in links]
    if len(set(names)) < len(names):
        raise ShapeError("links", f"names {names}", "names that differ")
    return Chain(entry.name, links, (entry.gravity[0], entry.gravity[1]))


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text} is not finite")
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the key '{next(name for name in names if names.count(name) > 1)}' occurs twice")
    return found


def _fault(error: ValidationError) -> tuple[str, str, str]:
    """Place, problem and what was expected, of the first fault; unknown keys first: they may explain missing ones."""
    detail = min(error.errors(include_url=False), key=lambda each: each["type"] != "extra_forbidden")
    return _place(detail), *_explained(detail)


def _place(detail: ErrorDetails) -> str:
    parts = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in detail["loc"]]
    return "".join(parts).removeprefix(".")


def _explained(detail: ErrorDetails) -> tuple[str, str]:
    if detail["type"] == "extra_forbidden":
        return "unknown key", f"only the keys of model.json, schema {SCHEMA}"
    if detail["type"] == "missing":
        return "missing", "this key"
    shown = repr(detail["input"])
    return f"got {shown if len(shown) <= 60 else shown[:57] + '...'}", detail["msg"].removeprefix("Input should be ")


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
            k < model.reference_effects,
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
    ordered = sorted(stored.effects, key=lambda each: not each.reference_effects)
    read = _read_effects(path, stored.chain, ordered, effects)
    placed = tuple(_placed(path, k, effect, experiment) for k, effect in enumerate(read))
    reference_effects = sum(each.reference_effects for each in ordered)
    return replace(model, effects=placed, reference_effects=reference_effects), covariance, stored.extra


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
        if value is not None and each.integer:
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
    whole = [each.name for each in effect.parameters() if each.integer]
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
