"""Recordings and effects in words."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import numpy as np

from vjm.effects.effect import Effect
from vjm.records import Estimate, Recording
from vjm.simulation.model import Model
from vjm.text import UNKNOWN, everyday_unit, in_sentence, number, quantity, short

ROLES = {"train": "train", "holdout": "held out"}  # of recordings, in words

_OPTIONAL, _NAME = re.compile(r"\[(.*?)\]"), re.compile(r"\{(\w+)\}")  # part of a clause; a parameter in it
_KNOWN = 3.0  # standard errors from zero: noise alone exceeds them with a probability of 0.001 (NOT_NOISE)


def recording_label(recording: Recording, most: int = 36) -> str:
    """Return a recording's file name, shortened to so many characters, with its role."""
    return f"{short(recording.file, most)} ({ROLES[recording.role]})"


def place(effect: Effect, model: Model) -> str:
    """Return the name of the link, or of the joint at its proximal end, where an effect acts; empty if camera-wide."""
    return "" if effect.link is None else model.chain.links[effect.link].name


def title_and_place(effect: Effect, model: Model) -> str:
    """Return an effect as in a list: `tip payload (beam)`."""
    return f"{in_sentence(effect.title)} ({place(effect, model)})".removesuffix(" ()")


def clause(effect: Effect, model: Model, sizes: Mapping[str, Estimate] | None = None) -> str:
    """Return an effect with its numbers, as in "the data need: ...": `sizes` with errors, or else its own values."""
    texts, known = {}, set[str]()
    for parameter in effect.parameters:
        value, size = effect.values[parameter.name], (sizes or {}).get(parameter.name)
        if parameter.integer:
            texts[parameter.name] = str(int(value))
        elif size is None:
            texts[parameter.name] = quantity(value, None, parameter.unit, 3)
        else:
            texts[parameter.name] = quantity(size.value, size.std, size.unit, 4)
            if size.std is not None and abs(size.value) > _KNOWN * size.std:
                known.add(parameter.name)
    if effect.clause:
        phrase = _OPTIONAL.sub(lambda part: part[1] if known.issuperset(_NAME.findall(part[1])) else "", effect.clause)
        return phrase.format(link=place(effect, model) or model.chain.links[0].name, **texts)
    values = ", ".join(f"{name} {text}" for name, text in texts.items())
    location = f" ({place(effect, model)})" if effect.link is not None else ""
    return f"{effect.description or effect.id}{location}{': ' if values else ''}{values}"


def sizes_text(effect: Effect, sizes: Mapping[str, float], from_null: bool = False) -> str:
    """Return sizes of an effect's parameters, without errors: `13 g`, or `gx 0.10, gy 0.02 m/s²`.

    A dimensionless parameter whose null is not zero, such as a scale, is given as the difference: `+0.04 %`, or
    `0.04 %` where `sizes` are themselves differences `from_null`.
    """
    for parameter in effect.parameters:
        scale = bool(parameter.null) and math.isfinite(parameter.null) and not parameter.unit
        if scale and list(sizes) == [parameter.name]:
            size = sizes[parameter.name]
            if from_null:
                return f"{number(100 * size, 2)} %"
            if math.isfinite(size):
                return f"{'+' if size >= parameter.null else '−'}{number(100 * abs(size - parameter.null), 2)} %"
    return _together(effect, sizes)


def _together(effect: Effect, sizes: Mapping[str, float]) -> str:
    """Return values by name; those of one unit share it: `along 4.0, across -6.0 mm`."""
    units = {parameter.name: parameter.unit for parameter in effect.parameters}
    if len(sizes) > 1 and len({units.get(name, "") for name in sizes}) == 1 and np.isfinite([*sizes.values()]).all():
        largest = max(abs(value) for value in sizes.values())
        factor, name = everyday_unit(largest, units.get(next(iter(sizes)), ""))
        last = max(1 - math.floor(math.log10(largest / factor)), 0) if largest > 0 else 0
        values = (f"{key} {round(value / factor, last) + 0.0:.{last}f}" for key, value in sizes.items())
        return f"{', '.join(values)} {name}".rstrip().replace("-", "\N{MINUS SIGN}")
    texts = [(name, quantity(value, None, units.get(name, ""))) for name, value in sizes.items()]
    return texts[0][1] if len(texts) == 1 else ", ".join(f"{name} {text}" for name, text in texts) or UNKNOWN
