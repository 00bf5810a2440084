"""What an effect says of itself, and its parameters' coordinates."""

from __future__ import annotations

import re
from dataclasses import MISSING, Field, fields, is_dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.contract.faults import Clause
from vjm.effects.effect import Effect, Parameter

Array = NDArray[np.float64]

_SENSING = ("instants", "shown", "encoder")
_ACTING = ("chain", "inputs", "force")
_ROUNDING = 1e-9
_WIDEST = 3.0  # everyday sizes, or logarithms of an inner parameter, where there is no nearer bound
_INSIDE = 1e-3  # of the way from one bound to the other


def check_form(effect: Effect) -> None:
    """Clause `form`: a frozen dataclass whose parameters are declared and absent by default, and that says what it is.

    Raises:
        EffectError: it is not.
    """
    clause = Clause(name_of(effect), "form")
    _dataclass(clause, effect)
    kind = type(effect)
    named = isinstance(kind.id, str) and re.fullmatch(r"[A-Za-z0-9_]+", kind.id)
    clause.holds(named, f"the id {kind.id!r}", "letters, digits and _")
    clause.holds(kind.says, "nothing in `says`", "its meaning in a few words, as in 'friction at the joint'")
    clause.holds(kind.reference, "no `reference`", "where the model is described")
    for field in fields(effect):
        declared = any(each.name == field.name for each in effect.parameters())
        clause.holds(
            declared or field.kw_only,
            f"the field `{field.name}` is neither a parameter nor keyword-only",
            "size(...) or inner(...) for a parameter; field(kw_only=True) for what `variants` fills in",
        )
    for parameter in effect.parameters():
        _parameter(clause, parameter, next(field for field in fields(effect) if field.name == parameter.name))
    clause.holds(effect.is_null, f"{effect!r} is present", "an instance at its null, as the default values make it")
    _hooks(clause, effect)


def name_of(effect: object) -> str:
    """The effect's id; its class where it has none."""
    found = getattr(effect, "id", "")
    return found if isinstance(found, str) and found else type(effect).__name__


def overridden(effect: Effect, hooks: tuple[str, ...] = (*_ACTING, *_SENSING, "states", "rates", "way")) -> list[str]:
    """Hooks that the effect's class defines itself."""
    return [name for name in hooks if getattr(type(effect), name) is not getattr(Effect, name)]


def _dataclass(clause: Clause, effect: object) -> None:
    expected = "an instance of a class derived from vjm.effects.Effect"
    clause.holds(not isinstance(effect, type), f"the class {effect!r}", expected)
    clause.holds(isinstance(effect, Effect), f"an object of {type(effect)}", expected)
    # Without a decorator of its own, a subclass has its parent's fields only, whatever it declares.
    decorated = is_dataclass(effect) and "__dataclass_params__" in vars(type(effect))
    clause.holds(decorated, "the class is not a dataclass", "@dataclass(frozen=True) above it")


def _parameter(clause: Clause, parameter: Parameter, field: Field[object]) -> None:
    """One that is absent by default, and whose everyday value lies inside its bounds."""
    name, default = parameter.name, field.default
    clause.holds(default is not MISSING, f"`{name}` has no default", "its null value")
    if parameter.inner:
        inside = all(parameter.lower <= each <= parameter.upper for each in (parameter.usual, *parameter.grid))
        clause.holds(inside, f"everyday value or grid of `{name}` beyond its bounds", "values inside")
        return
    clause.holds(default == parameter.null, f"`{name}` is {default} by default", f"its null, {parameter.null}")
    wanted = np.isfinite(parameter.usual) and parameter.usual != 0
    clause.holds(wanted, f"an everyday size of {parameter.usual} for `{name}`", "a finite number other than zero")
    usual = parameter.value(1.0)
    inside = parameter.lower <= usual <= parameter.upper
    clause.holds(inside, f"the everyday value {usual:g} of `{name}` beyond its bounds", "one inside")


def _hooks(clause: Clause, effect: Effect) -> None:
    """Hooks that can ever be used."""
    own = overridden(effect)
    sizes = [each for each in effect.parameters() if not each.inner]
    clause.holds(
        sizes or not own,
        f"{_listed(own)} but no size, so that it is always absent",
        "a parameter declared with size(...)",
    )
    clause.holds(own or not sizes, "a size but no hook that uses it", f"one of {', '.join((*_ACTING, *_SENSING))}")
    sensing = overridden(effect, _SENSING)
    clause.holds(
        effect.sensor or not sensing, f"{_listed(sensing)} but `sensor` is False: it is never asked", "sensor = True"
    )


def _listed(names: list[str]) -> str:
    return "it defines " + ", ".join(f"`{name}`" for name in names)


def check_coordinates(effect: Effect) -> None:
    """Clause `coordinates`: zero at the null, one at an everyday size, and back to the values they came from.

    Raises:
        EffectError: they are not.
    """
    clause = Clause(effect.id, "coordinates")
    with clause.running("`coordinates`"):
        start = effect.coordinates
    with clause.running("`bounds`"):
        lower, upper = effect.bounds
    alike = start.shape == lower.shape == upper.shape and start.ndim == 1
    clause.holds(alike, f"shapes {start.shape}, {lower.shape}, {upper.shape}", "(p,) coordinates with as many bounds")
    clause.holds((lower < upper).all(), f"bounds {lower} and {upper}", "lower ones below upper ones")
    clause.holds(not start[: effect.sizes].any(), f"coordinates {start} at the null", "zeros for its sizes")
    for wanted in trial_coordinates(effect):
        with clause.running(f"`at({wanted})`"):
            there = effect.at(wanted)
            found = there.coordinates
            values: dict[str, Any] = {**there.values}
            again = replace(there, **values)
        clause.holds(type(there) is type(effect), f"`at` gives {there!r}", f"a {type(effect).__name__}")
        same = found.shape == wanted.shape and np.allclose(found, wanted, rtol=_ROUNDING, atol=_ROUNDING)
        clause.holds(same, f"coordinates {found} of the effect at {wanted}", "the same")
        clause.holds(again == there, f"{again!r} from the values of {there!r}", "the same")
    clause.holds(effect.at(start).is_null, f"at its own coordinates {start} it is present", "absent, as it was")


def trial_coordinates(effect: Effect) -> list[Array]:
    """Coordinates (p,) to try: everyday ones, and each near either of its bounds while the others are everyday ones."""
    lower, upper = effect.bounds
    # Without a bound, as far as a search may stray.
    low = np.where(np.isfinite(lower), lower, np.minimum(-_WIDEST, upper - _WIDEST))
    high = np.where(np.isfinite(upper), upper, np.maximum(_WIDEST, lower + _WIDEST))
    usual = np.where(np.arange(low.size) < effect.sizes, 1.0, effect.coordinates)
    usual = np.clip(usual, low + _INSIDE * (high - low), high - _INSIDE * (high - low))
    found = [usual]
    for k, share in product(range(low.size), (_INSIDE, 1 - _INSIDE)):
        moved = usual.copy()
        moved[k] = low[k] + share * (high[k] - low[k])
        found.append(moved)
    return found
