"""Effects as a mechanical engineer names them: one sentence with its numbers, quantities in everyday units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from vjm.effects.effect import Effect
from vjm.model import Model
from vjm.report.tables import unit
from vjm.report.wording import UNKNOWN, number, with_error

if TYPE_CHECKING:
    from vjm.diagnosis.records import Size

# Everyday units, the largest first; each is used from a tenth of it on.
_SCALES: Mapping[str, tuple[tuple[float, str], ...]] = {
    "kg": ((1.0, "kg"), (1e-3, "g")),
    "N": ((1.0, "N"), (1e-3, "mN")),
    "N m": ((1.0, "N m"), (1e-3, "mN m")),
    "N m s/rad": ((1.0, "N m s/rad"), (1e-3, "mN m s/rad")),
    "s": ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")),
    "s/m": ((1.0, "s/m"), (1e-3, "ms/m")),
    "m": ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm")),
    "rad": ((math.pi / 180, "°"),),
    "rad/(N m)": ((math.pi / 180, "°/(N m)"),),
    "1/s": ((1e-2, "%/s"),),
}
# A clause for each effect; a user's own ones are named by what they say themselves.
_CLAUSES: Mapping[str, str] = {
    "tip_payload": "an unknown mass of {mass} on the tip of {link}",
    "in_plane_gravity": "gravity of {gx} along x and {gy} along y in the plane of motion: the base is tilted",
    "coulomb_friction": "dry friction of {torque} at the joint of {link}",
    "viscous_friction": "viscous friction of {coefficient} at the joint of {link}",
    "joint_spring": "a cable or hose of {stiffness} that pulls the joint of {link} back to zero",
    "torque_gain": "a true torque at the joint of {link} that is {gain} times the recorded one",
    "torque_offset": "a constant torque of {offset} beside the recorded one at the joint of {link}",
    "gear_elasticity": "an elastic gear or shaft of {stiffness} between motor and hub of {link}",
    "backlash": "play of {gap} between motor and hub of {link}",
    "clamp_compliance": "a clamp of {link} that gives way, by {compliance}",
    "linear_drag": "air drag of {coefficient} on {link}, in proportion to the velocity",
    "quadratic_drag": "air drag of {coefficient} on {link}, in proportion to the square of the velocity",
    "structural_damping": "structural damping in {link}, with a loss factor of {loss_factor}",
    "viscoelastic_creep": "creep in {link}: a part {ratio} of its bending stiffness relaxes within {time_constant}",
    "hysteresis": "hysteresis in {link}: a part {ratio} of its bending stiffness slips beyond {yield_angle}",
    "cubic_stiffness": "a bending stiffness of {link} that changes with the curvature, by {coefficient}",
    "stiffness_drift": "a bending stiffness of {link} that drifts by {rate} during each recording",
    "rest_curvature": "a curvature of {curvature} of {link} at rest",
    "external_tone": "a sinusoidal force of {amplitude} at {frequency} on the tip of {link} from outside",
    "time_offset": "a camera that lags {delay} behind its time stamps",
    "clock_scale": "a camera whose clock runs {scale} times as fast as the encoder's",
    "camera_scale": "a camera that shows everything {scale} times as large as it is",
    "camera_rotation": "a camera that is turned by {angle} against the base",
    "encoder_offset": "an encoder at {link} whose zero is off by {offset}",
    "lens_distortion": "a lens that distorts with the distance from the middle, by {k1}",
    "rolling_shutter": "a camera that reads its rows one after another, in {readout}",
    "marker_offset": "marker {marker} of {link} off by {along} along and {across} across the link",
}


def quantity(value: float, std: float | None, unit_name: str, digits: int = 2) -> str:
    """A value with its standard error, if it has one, in an everyday unit: `13.30 ± 0.10 g`."""
    if not math.isfinite(value):
        return UNKNOWN
    factor, name = _scale(value, unit_name)
    text = number(value / factor, digits) if std is None else with_error(value / factor, std / factor)
    between = "" if name.startswith("°") and "±" not in text and "×" not in text else " "
    return f"{text}{between}{name}".rstrip()


def place(effect: Effect, model: Model) -> str:
    """Name of the link, or of the joint at its proximal end, where an effect acts; empty for what is camera-wide."""
    return "" if effect.link is None else model.chain.links[effect.link].name


def clause(effect: Effect, model: Model, sizes: Mapping[str, Size] | None = None) -> str:
    """An effect with its numbers, as in "the data need: ...".

    Args:
        effect: with its parameters.
        model: names the links.
        sizes: with standard errors; None: the effect's own values, without.
    """
    units = {each.name: each for each in effect.parameters()}
    texts = {}
    for name, value in effect.values.items():
        size = None if sizes is None else sizes.get(name)
        if units[name].whole:
            texts[name] = str(int(value))
        elif size is None:
            texts[name] = quantity(value, None, units[name].unit, 3)
        else:
            texts[name] = quantity(size.value, size.std, size.unit, 4)
    link = place(effect, model) or model.chain.links[0].name
    if effect.id in _CLAUSES:
        return _CLAUSES[effect.id].format(link=link, **texts)
    values = ", ".join(f"{name} {text}" for name, text in texts.items())
    where = f" ({link})" if effect.link is not None else ""
    return f"{effect.says or effect.id}{where}{': ' if values else ''}{values}"


def capital(text: str) -> str:
    """With a capital letter first."""
    return text[:1].upper() + text[1:]


def sizes_text(effect: Effect, sizes: Mapping[str, float]) -> str:
    """Sizes of an effect's parameters by name, without errors: `13 g`, or `gx 0.10, gy 0.02 m/s²`.

    Of a parameter whose null is no zero, as a scale, it is the difference: `+0.04 %`.
    """
    off = {each.name: each.null for each in effect.parameters() if each.null and math.isfinite(each.null)}
    units = {each.name: each.unit for each in effect.parameters()}
    if len(sizes) == 1:
        (name, value) = next(iter(sizes.items()))
        if name in off and not units[name] and math.isfinite(value):
            return f"{'+' if value >= off[name] else '-'}{number(100 * abs(value - off[name]), 2)} %"
    return _together([(name, value, units.get(name, "")) for name, value in sizes.items()])


def _together(sizes: list[tuple[str, float, str]]) -> str:
    """Values by name; those of one unit share it: `along 4.0, across -6.0 mm`."""
    if len(sizes) == 1:
        return quantity(sizes[0][1], None, sizes[0][2])
    if len({unit_name for *_, unit_name in sizes}) == 1 and all(math.isfinite(value) for _, value, _ in sizes):
        largest = max(abs(value) for _, value, _ in sizes)
        factor, name = _scale(largest, sizes[0][2])
        last = max(1 - math.floor(math.log10(largest / factor)), 0) if largest > 0 else 0
        values = ", ".join(f"{own} {round(value / factor, last) + 0.0:.{last}f}" for own, value, _ in sizes)
        return f"{values} {name}".rstrip()
    return ", ".join(f"{own} {quantity(value, None, unit_name)}" for own, value, unit_name in sizes) or UNKNOWN


def _scale(value: float, unit_name: str) -> tuple[float, str]:
    """The everyday unit in which a value is best read, in SI units, and its name."""
    scales = _SCALES.get(unit_name, ((1.0, unit(unit_name)),))
    return next((each for each in scales if abs(value) >= 0.1 * each[0]), scales[-1])


def differences_text(effect: Effect, sizes: Mapping[str, float]) -> str:
    """The same of sizes given as differences from the null: `off by 0.04 %` where that is no zero."""
    for each in effect.parameters():
        off = bool(each.null) and math.isfinite(each.null)
        if off and not each.unit and list(sizes) == [each.name]:
            return f"off by {number(100 * sizes[each.name], 2)} %"
    units = {each.name: each.unit for each in effect.parameters()}
    return _together([(name, value, units.get(name, "")) for name, value in sizes.items()])


def named(identifier: str) -> str:
    """An effect's id as words: `Tip payload`."""
    return capital(identifier.replace("_", " "))


def carried_points(effects: Sequence[Effect], model: Model) -> tuple[str, ...]:
    """Which effects the URDF carries and which only model.json has, a sentence each; none without effects."""
    points = []
    for carried, words in (
        (True, "model.urdf and model.json hold"),
        (False, "Only model.json holds, as URDF has no word for it"),
    ):
        chosen = [each for each in effects if each.in_urdf is carried]
        names = [f"{named(each.id).lower()}{_at(each, model)}" for each in chosen]
        if names:
            points.append(f"{words}: {', '.join(names)}.")
    return tuple(points)


def _at(effect: Effect, model: Model) -> str:
    where = place(effect, model)
    return f" ({where})" if where else ""
