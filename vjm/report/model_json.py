"""Models as model.json: every number comes back exactly, and errors name the file and the key."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, Field, ValidationError, model_validator

from vjm.chain.virtual_links import Chain
from vjm.effects import BUILTIN
from vjm.effects.effect import Effect, Parameter
from vjm.errors import ExperimentError, ModelFileError, ShapeError, shown
from vjm.experiment.schema import STRICT, table_model
from vjm.experiment.spectrum import sensor_noise
from vjm.files import as_path, json_text, plain, read_file
from vjm.records import Array, Estimate, Experiment, Link, Recording, Rig
from vjm.report.text import place
from vjm.simulation.model import Model

_Positive = Annotated[float, Field(gt=0)]


class _EffectEntry(BaseModel):
    """An effect by its id; `None` stands for an infinite value of a parameter."""

    model_config = STRICT
    effect: str
    link: str | None
    parameters: dict[str, float | None]
    in_reference: bool  # it acts in recordings of condition "reference" too


class _ModelEntry(BaseModel):
    model_config = STRICT
    schema_version: Literal[1] = Field(alias="schema")
    kind: Literal["vjm-model"]
    vjm: str
    rig: Rig
    marker_noise: _Positive
    encoder_noise: _Positive
    chain: Chain
    effects: tuple[_EffectEntry, ...]
    estimates: tuple[Estimate, ...]
    covariance: list[list[float]]

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Check what concerns several keys: links that differ in name, and are the rig's; a covariance that fits."""
        links = [(link.name, link.joint) for link in self.chain.links]
        if len({name for name, _ in links}) < len(links):
            raise ShapeError("chain.links", f"names {[name for name, _ in links]}", "names that differ")
        if links != [(link.name, link.joint) for link in self.rig.links]:
            raise ShapeError("rig.links", [(link.name, link.joint) for link in self.rig.links], f"the chain's {links}")
        count = sum(estimate.std is not None for estimate in self.estimates)
        sizes = [len(row) for row in self.covariance]
        if sizes and sizes != [count] * count:
            raise ShapeError("covariance", f"rows of {sizes}", f"{count} rows of {count}, or none")
        return self


def model_text(model: Model, covariance: Array | None = None) -> str:
    """Return the content of model.json; every number comes back exactly.

    The covariance is (p, p), of the estimates that have a standard error; None or empty where unknown.

    Raises:
        ShapeError: a number that is not finite, or a value out of range.
    """
    known = covariance is not None and np.isfinite(covariance).all()
    effects = [
        {
            "effect": effect.id,
            "link": place(effect, model) or None,
            "parameters": effect.values,
            "in_reference": k < model.reference_effects,
        }
        for k, effect in enumerate(model.effects)
    ]
    content = {
        "schema": 1,
        "kind": "vjm-model",
        "vjm": version("vjm"),
        "rig": asdict(model.rig),
        "marker_noise": model.marker_noise,
        "encoder_noise": model.encoder_noise,
        "chain": asdict(model.chain),
        "effects": effects,
        "estimates": [asdict(estimate) for estimate in model.estimates if math.isfinite(estimate.value)],
        "covariance": covariance if known else [],
    }
    try:
        entry = _ModelEntry.model_validate_json(json_text(plain(content)))
    except ValidationError as error:
        key, problem, expected = _fault(error)
        raise ShapeError(key, problem.removeprefix("got "), expected) from None
    return json_text(plain(entry.model_dump(by_alias=True, warnings=False)))  # which would be of the arrays


def load_model(path: Path | str) -> Model:
    """Read the model in a model.json that vjm wrote.

    Raises:
        ModelFileError: no such file, no JSON, or a key that is missing, unknown or wrong; names the key.
        ShapeError: no path.
    """
    return read_model(path)[0]


def read_model(
    path: Path | str, experiment: Experiment | None = None, effects: Sequence[Effect] = BUILTIN
) -> tuple[Model, Array]:
    """Read a model, and the covariance of its estimates (empty where unknown).

    Args:
        path: a model.json.
        experiment: gives the rig and its sensors' noise; None: those in the file.
        effects: those that the file may name, absent; beside the built-in ones for instance a user's own.

    Raises:
        ModelFileError: no such file, no JSON, or a key that is missing, unknown or wrong; names the key.
        ShapeError: no path, or a model of another arm than the experiment's.
    """
    path = as_path("path", path, "the path of a model.json")
    with _faults_of(path):
        entry = _ModelEntry.model_validate_json(read_file(path))
    rig = experiment.rig if experiment else entry.rig
    recordings = experiment.cleaned_recordings if experiment else ()
    noise = sensor_noise(rig, recordings) if experiment else (entry.marker_noise, entry.encoder_noise)
    model = Model(
        entry.chain, rig, *noise, entry.estimates, (), sum(effect_entry.in_reference for effect_entry in entry.effects)
    )
    ordered = sorted(enumerate(entry.effects), key=lambda pair: not pair[1].in_reference)
    catalogue = {effect.id: effect for effect in effects}
    with _faults_of(path):
        placed = tuple(
            _effect(f"effects[{k}]", effect_entry, catalogue, rig, recordings) for k, effect_entry in ordered
        )
    covariance = np.array(entry.covariance, dtype=float).reshape(len(entry.covariance), len(entry.covariance))
    return replace(model, effects=placed), covariance


@contextmanager
def _faults_of(path: Path | str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ModelFileError(path, error.strerror or str(error), "a readable model.json") from error
    except ValidationError as error:
        key, problem, expected = _fault(error)
        raise ModelFileError(path, f"key '{key}': {problem}" if key else problem, expected) from None
    except ShapeError as error:
        raise ModelFileError(path, f"key '{error.name}': {error.given}", error.expected) from error
    except ExperimentError as error:
        raise ModelFileError(path, f"rig, {error.table}, key '{error.key}': {error.problem}", error.expected) from error


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
    expected, names = detail["msg"].removeprefix("Input should be "), [str(part) for part in detail["loc"]]
    if names[:1] == ["rig"]:  # whose fields say in words what they expect
        fields = table_model(Link if "links" in names else Rig).model_fields
        expected = next((fields[name].description or "" for name in reversed(names) if name in fields), expected)
    return place, f"got {shown(detail['input'])}", expected


def _effect(
    key: str, entry: _EffectEntry, catalogue: Mapping[str, Effect], rig: Rig, recordings: Sequence[Recording]
) -> Effect:
    """Return an effect with its values, from its variant at that place, which knows the rig and the recordings."""
    names = [link.name for link in rig.links]
    if entry.effect not in catalogue:
        raise ShapeError(f"{key}.effect", f"got {entry.effect!r}", f"one of {', '.join(catalogue)}")
    if entry.link is not None and entry.link not in names:
        raise ShapeError(f"{key}.link", f"got {entry.link!r}", f"null or one of {names}")
    effect = catalogue[entry.effect]
    parameters = {parameter.name: parameter for parameter in effect.parameters}
    values: dict[str, Any] = {}
    for name in dict.fromkeys([*parameters, *entry.parameters]):
        parameter_key = f"{key}.parameters.{name}"
        if name not in parameters:
            raise ShapeError(parameter_key, "unknown key", f"only {', '.join(parameters) or 'no parameter'}")
        if name not in entry.parameters:
            raise ShapeError(parameter_key, "missing", "this key")
        values[name] = _value(parameter_key, parameters[name], entry.parameters[name])
    places = effect.places(rig)
    link = None if entry.link is None else names.index(entry.link)
    if link is None and None not in places:  # on no link in particular, which is the first one
        return replace(effect, link=None, **values)
    if link not in places:
        known = [names[i] for i in places if i is not None]
        raise ShapeError(f"{key}.link", f"got {entry.link!r}", f"one of {known}" if known else "null")
    variants = [variant for variant in effect.variants(rig, recordings) if variant.link == link]
    for integer_name in (parameter.name for parameter in parameters.values() if parameter.integer):
        choices = sorted({getattr(variant, integer_name) for variant in variants})
        variants = [variant for variant in variants if getattr(variant, integer_name) == values[integer_name]]
        if not variants:
            expected = f"one of {choices}, on link {entry.link!r}"
            raise ShapeError(f"{key}.parameters.{integer_name}", f"got {values[integer_name]}", expected)
    return replace(variants[0], **values)


def _value(key: str, parameter: Parameter, value: float | None) -> float:
    """Return a parameter's value, which is within its bounds but for rounding; null stands for an infinite one."""
    low, high = parameter.lower, parameter.upper
    number, expected = math.inf if value is None else value, ""
    if value is None and not math.isinf(parameter.null):
        expected = f"a number {parameter.unit}".rstrip()
    elif value is not None and not low <= value <= high and not np.isclose(value, (low, high), rtol=1e-9, atol=0).any():
        expected = f"{low:g} to {high:g} {parameter.unit}".rstrip()
    elif parameter.integer and number != int(number):
        expected = "a whole number"
    if expected:
        raise ShapeError(key, f"got {'null' if value is None else f'{value:g}'}", expected)
    return int(number) if parameter.integer else number
