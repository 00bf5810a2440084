"""Every built-in effect keeps the contract, and what does not is caught at the clause that it breaks."""

from __future__ import annotations

import re

import pytest

from tests.diagnosis import broken
from vjm.diagnosis import check_effect as contract
from vjm.diagnosis.check_effect import check_effect
from vjm.effects import BUILTIN, Effect
from vjm.errors import EffectError

# Fits, of the clause `recovery`, take ten times as long as all other clauses: one effect of each kind of hooks has them
# here (forces, a chain, a joint, internal states, a recorded torque, a camera's image), the others in the slow suite.
_RECOVERED = (
    *("cubic_stiffness", "tip_payload", "clamp_compliance", "viscoelastic_creep"),
    *("actuator_lag", "camera_rotation"),
)
EVERY = [pytest.param(each, id=each.id, marks=[] if each.id in _RECOVERED else [pytest.mark.slow]) for each in BUILTIN]

# Each with the clause it breaks and a part of what is said of it.
BROKEN = [
    (broken.Undecorated(), "form", "not a dataclass"),
    (broken.Nameless(), "form", "'cubic friction!'; expected letters, digits and _"),
    (broken.Unreferenced(), "form", "no `reference`"),
    (broken.Unassuming(), "form", "no `assumptions`; expected .* or 'none'"),
    (broken.Undeclared(), "form", "`exponent` is neither"),
    (broken.PresentByDefault(), "form", "`coefficient` is 0.004 by default"),
    (broken.WithoutSize(), "form", "defines `force` but no size"),
    (broken.LosesValue(), "coordinates", "expected the same"),
    (broken.NotNothing(), "null", "`chain` changes what it is given"),
    (broken.PushesWhenAbsent(), "null", "a force at the null"),
    (broken.RoundsWhenAbsent(), "null", "`marker_positions` changes what it is given"),
    (broken.WrongShape(), "hooks", r"is \(1,\); expected shape \(4,\)"),
    (broken.OneInstantOnly(), "hooks", "at many instants is not what it is at each alone"),
    (broken.NotANumber(), "hooks", "not finite"),
    (broken.OnlySmall(), "hooks", "ValueError: too much friction"),
    (broken.StateWithoutRates(), "hooks", "1 states, `state_rates` None"),
    (broken.FrictionWithoutSlope(), "hooks", "`smooth` leaves it dry friction"),
    (broken.FrictionThatPushes(), "hooks", "`dry_friction` of -0.* N m; expected a torque that is not negative"),
    (broken.FrictionOfALink(), "hooks", "`dry_friction` of coordinate 3; expected an active joint"),
    (broken.GapWithoutFlanks(), "hooks", "expected flanks among the springs of `chain`"),
    (broken.GapOfNoJoint(), "hooks", "`contact` of coordinate 4; expected one of the 4 joints"),
    (broken.SmoothedAway(), "hooks", "expected the same parameters and the same chain"),
    (broken.SmoothWithStates(), "hooks", "an effect with 1 states; expected 0"),
    (broken.WritesIntoArrays(), "inputs", "`marker_positions` of WritesIntoArrays.* writes into an array"),
    (broken.WritesIntoRecords(), "inputs", "changes what `true_inputs` is given"),
    (broken.Idle(), "action", "no marker and no encoder shows anything"),
    (broken.Modest(), "action", "nobody will ever see it"),
    (broken.Explosive(), "action", "diverges"),
    (broken.Motor(), "energy", "at a random state its forces give the arm"),
    (broken.Spring(), "energy", "at a random state its forces give the arm"),
    (broken.TakesDampingAway(), "energy", "at a random state its forces give the arm"),
    (broken.TakesDampingAwayBehindAJoint(), "energy", "at a random state its forces give the arm"),
    (broken.HiddenMotor(), "energy", "at a random state its forces give the arm"),
    (broken.Constant(), "recovery", "nothing that is measured depends on `coefficient`"),
    (broken.ConstantWave(), "recovery", "nothing that is measured depends on `amplitude`; expected"),
    (broken.Folded(), "recovery", "with coefficient 0.004 .* finds coefficient 0.001"),
    (broken.Stiffer(), "recovery", "can stand in for all but"),
]


@pytest.mark.parametrize("effect", BUILTIN, ids=lambda effect: effect.id)
def test_every_built_in_effect_keeps_what_no_fit_tells(effect: Effect, monkeypatch: pytest.MonkeyPatch) -> None:
    *others, recovery = contract._CLAUSES
    assert recovery.__name__ == "_recovery"
    monkeypatch.setattr(contract, "_CLAUSES", others)
    check_effect(effect)


@pytest.mark.parametrize("effect", EVERY)
def test_every_built_in_effect_keeps_the_contract(effect: Effect) -> None:
    check_effect(effect)


@pytest.mark.parametrize("effect", [broken.CubicFriction(), broken.Camera()], ids=lambda effect: effect.id)
def test_a_new_effect_may_keep_it_too(effect: Effect) -> None:
    check_effect(effect, seed=1)


@pytest.mark.parametrize(
    ("effect", "clause", "message"), BROKEN, ids=[type(effect).__name__ for effect, _, _ in BROKEN]
)
def test_a_broken_clause_is_named(effect: Effect, clause: str, message: str) -> None:
    with pytest.raises(EffectError, match=message) as caught:
        check_effect(effect)
    error = caught.value
    assert error.clause == clause
    assert error.effect == effect.id
    assert all(part in str(error) for part in (effect.id, clause, error.found, error.expected))


def test_there_is_a_broken_effect_for_every_clause() -> None:
    documented = re.findall("`([a-z]+)`", str(check_effect.__doc__))
    assert list(dict.fromkeys(clause for _, clause, _ in BROKEN)) == documented


def test_an_error_in_a_hook_is_kept_as_the_cause() -> None:
    with pytest.raises(EffectError) as caught:
        check_effect(broken.OnlySmall())
    assert isinstance(caught.value.__cause__, ValueError)


@pytest.mark.parametrize("other", [3, "tip_payload", broken.CubicFriction])
def test_what_is_no_effect_is_refused(other: object) -> None:
    with pytest.raises(EffectError, match=r"derived from vjm\.effects\.Effect"):
        check_effect(other)  # type: ignore[arg-type]
