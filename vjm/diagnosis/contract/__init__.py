"""The contract of effects: what every one must keep, so that simulations, fits and searches may rely on it."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from vjm.diagnosis.contract.action import check_energy, shown_by
from vjm.diagnosis.contract.form import check_coordinates, check_form, overridden
from vjm.diagnosis.contract.hooks import check_hooks, check_null
from vjm.diagnosis.contract.recovery import check_recovery
from vjm.effects.effect import Effect

__all__ = ["CLAUSES", "check_effect"]

CLAUSES: Mapping[str, str] = MappingProxyType(
    {
        "form": "a frozen dataclass derived from Effect, with an id, what it says and a reference; its parameters are "
        "declared with size() and inner(), and null by default",
        "coordinates": "coordinates are zero at the null, and values that are made coordinates come back",
        "null": "at the null every hook returns what it was given, to the last bit, and no simulation changes",
        "hooks": "hooks return finite values of the right shape, for states with any leading axes, within all bounds",
        "inputs": "arrays and records that hooks are given stay as they were",
        "action": "at an everyday size, markers or encoders of a rig on which it is testable show it",
        "energy": "what is called dissipative takes energy at every state, and a free decay only loses some",
        "recovery": "its sizes come back from recordings simulated with it, the chain's parameters being free",
    }
)


def check_effect(effect: Effect, seed: int = 0) -> None:
    """Check whether an effect keeps the contract of effects, clause by clause; it takes a second or a few.

    The effect is tried on small simulated rigs: a driven link with torque and encoder and a clamped one, with five
    markers each; its hooks on a driven link upon a flexible post as well.

    Args:
        effect: absent, as its class makes it by default.
        seed: of random states and of the sensors' noise.

    Raises:
        EffectError: the first of `CLAUSES` that is broken, what was found and what was expected.
    """
    check_form(effect)
    if not overridden(effect):
        return  # a name for something that is no physics
    check_coordinates(effect)
    check_null(effect, seed)
    check_hooks(effect, seed)
    bench, present = shown_by(effect)
    if effect.dissipative:
        check_energy(effect, seed)
    check_recovery(bench, present, seed)
