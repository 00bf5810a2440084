"""model.json: a chain, and what is known about it, as a versioned file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from vjm.chain.records import Chain, Distal, LinkChain
from vjm.errors import ModelFileError, ShapeError
from vjm.files import json_text, write_text_atomic

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
    everywhere: bool = False


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
        everywhere: whether it acts in recordings of the reference condition too.
    """

    effect: str
    link: str | None
    parameters: Mapping[str, float | None]
    everywhere: bool = False


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
