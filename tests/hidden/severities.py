"""Sizes of hidden effects as one meets them, and how many standard deviations of the noise they amount to.

Print the table, from the repository's root: python -m tests.hidden.severities
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tests.hidden.settings import Rig, Units, setting_of


@dataclass(frozen=True)
class Planted:
    """An effect that is hidden in recordings, with its parameters' true values."""

    effect: str
    parameters: Mapping[str, float]


@dataclass(frozen=True)
class Size:
    """An everyday size of a parameter.

    Attributes:
        usual: how far the value lies from `null`; of a reciprocal parameter, the value itself.
        signed: whether it may lie on either side.
        null: value at which the effect is absent.
        reciprocal: whether a smaller value is a larger effect.
    """

    typical_magnitude: float
    signed: bool = False
    null: float = 0.0
    reciprocal: bool = False


SIZES: Mapping[str, Mapping[str, Size]] = {
    "tip_payload": {"mass": Size(0.010)},
    "coulomb_friction": {"torque": Size(0.008)},
    "viscous_friction": {"coefficient": Size(0.004)},
    "joint_spring": {"stiffness": Size(0.05)},
    "torque_gain": {"gain": Size(0.05, True, 1.0)},
    "torque_offset": {"offset": Size(0.005, True)},
    "gear_elasticity": {"stiffness": Size(60.0, reciprocal=True)},
    "backlash": {"gap": Size(0.004)},
    "clamp_compliance": {"compliance": Size(5e-3)},
    "linear_drag": {"coefficient": Size(0.02)},
    "quadratic_drag": {"coefficient": Size(0.05)},
    "structural_damping": {"loss_factor": Size(0.01)},
    "viscoelastic_creep": {"ratio": Size(0.03)},
    "hysteresis": {"ratio": Size(0.05)},
    "cubic_stiffness": {"coefficient": Size(0.1, True)},
    "stiffness_drift": {"rate": Size(0.002, True)},
    "rest_curvature": {"curvature": Size(0.02, True)},
    "external_tone": {"amplitude": Size(0.010)},
    "time_offset": {"delay": Size(0.015, True)},
    "clock_scale": {"scale": Size(0.002, True, 1.0)},
    "camera_scale": {"scale": Size(0.008, True, 1.0)},
    "camera_rotation": {"angle": Size(np.deg2rad(0.5), True)},
    "encoder_offset": {"offset": Size(0.005, True)},
    "lens_distortion": {"k1": Size(0.01, True)},
    "rolling_shutter": {"readout": Size(0.005, True)},
    "marker_offset": {"along": Size(0.005, True), "across": Size(0.001, True)},
    "actuator_lag": {"time_constant": Size(0.005)},
    "torque_saturation": {"limit": Size(0.2, reciprocal=True)},
    "cogging": {"amplitude": Size(0.006)},
    "stribeck": {"torque": Size(0.006)},
    "taper": {"taper": Size(0.04, True)},
    "stiffness_asymmetry": {"ratio": Size(0.02, True)},
    "base_compliance": {"stiffness": Size(2000.0, reciprocal=True)},
    "camera_vibration": {"amplitude": Size(0.0004)},
    "timestamp_jitter": {"jitter": Size(0.002)},
    "payload_body": {"offset": Size(0.02, True)},
    "hub_radius": {"radius": Size(0.005)},
    "marker_mass": {"mass": Size(0.004)},
    "marker_datum": {"along": Size(0.005, True), "across": Size(0.001, True)},
}
TILT = 9.81 * np.sin(np.deg2rad(1.5))  # m/s^2
OBLIQUITY = np.sin(np.deg2rad(1.0)) / 2.0  # 1/m, of a camera tilted by a degree 2 m above the plane
# Everyday size of vectors, whose two components come from one length and one direction.
VECTORS: Mapping[str, tuple[tuple[str, str], float]] = {
    "in_plane_gravity": (("gx", "gy"), TILT),
    "camera_translation": (("dx", "dy"), 0.003),
    "camera_tilt": (("px", "py"), OBLIQUITY),
    "encoder_eccentricity": (("sine", "cosine"), 0.005),
}

# What a clamped arm, slow and slightly bent, hardly shows at the size that is plain on a turning one.
CLAMPED_FACTORS: Mapping[str, float] = {
    "external_tone": 8.0,
    "rolling_shutter": 4.0,
    "cubic_stiffness": 2.0,
    "stiffness_drift": 2.0,
}

# Powers of length, mass and time in the units of parameters that have any.
POWERS: Mapping[tuple[str, str], tuple[int, int, int]] = {
    ("tip_payload", "mass"): (0, 1, 0),
    ("tip_payload", "radius_of_gyration"): (1, 0, 0),
    ("tip_payload", "offset"): (1, 0, 0),
    ("payload_body", "offset"): (1, 0, 0),
    ("hub_radius", "radius"): (1, 0, 0),
    ("payload_body", "radius_of_gyration"): (1, 0, 0),
    ("in_plane_gravity", "gx"): (1, 0, -2),
    ("in_plane_gravity", "gy"): (1, 0, -2),
    ("coulomb_friction", "torque"): (2, 1, -2),
    ("stribeck", "torque"): (2, 1, -2),
    ("stribeck", "speed"): (0, 0, -1),
    ("viscous_friction", "coefficient"): (2, 1, -1),
    ("joint_spring", "stiffness"): (2, 1, -2),
    ("backlash", "contact_stiffness"): (2, 1, -2),
    ("torque_offset", "offset"): (2, 1, -2),
    ("torque_saturation", "limit"): (2, 1, -2),
    ("cogging", "amplitude"): (2, 1, -2),
    ("actuator_lag", "time_constant"): (0, 0, 1),
    ("gear_elasticity", "stiffness"): (2, 1, -2),
    ("gear_elasticity", "damping"): (2, 1, -1),
    ("clamp_compliance", "compliance"): (-2, -1, 2),
    ("clamp_compliance", "damping"): (2, 1, -1),
    ("base_compliance", "stiffness"): (0, 1, -2),
    ("base_compliance", "mass"): (0, 1, 0),
    ("linear_drag", "coefficient"): (-1, 1, -1),
    ("quadratic_drag", "coefficient"): (-2, 1, 0),
    ("viscoelastic_creep", "time_constant"): (0, 0, 1),
    ("cubic_stiffness", "coefficient"): (2, 0, 0),
    ("stiffness_drift", "rate"): (0, 0, -1),
    ("rest_curvature", "curvature"): (-1, 0, 0),
    ("external_tone", "amplitude"): (1, 1, -2),
    ("external_tone", "frequency"): (0, 0, -1),
    ("time_offset", "delay"): (0, 0, 1),
    ("lens_distortion", "k1"): (-2, 0, 0),
    ("lens_distortion", "centre_x"): (1, 0, 0),
    ("lens_distortion", "centre_y"): (1, 0, 0),
    ("camera_tilt", "px"): (-1, 0, 0),
    ("camera_tilt", "py"): (-1, 0, 0),
    ("camera_tilt", "centre_x"): (1, 0, 0),
    ("camera_tilt", "centre_y"): (1, 0, 0),
    ("camera_tilt", "height"): (1, 0, 0),
    ("rolling_shutter", "readout"): (-1, 0, 1),
    ("timestamp_jitter", "jitter"): (0, 0, 1),
    ("marker_offset", "along"): (1, 0, 0),
    ("marker_offset", "across"): (1, 0, 0),
    ("marker_mass", "mass"): (0, 1, 0),
    ("marker_datum", "along"): (1, 0, 0),
    ("marker_datum", "across"): (1, 0, 0),
    ("camera_translation", "dx"): (1, 0, 0),
    ("camera_translation", "dy"): (1, 0, 0),
    ("camera_vibration", "amplitude"): (1, 0, 0),
    ("camera_vibration", "frequency"): (0, 0, -1),
}

EFFECTS: tuple[str, ...] = ("in_plane_gravity", *SIZES, "camera_translation", "camera_tilt", "encoder_eccentricity")
_ACTUATOR = ("torque_gain", "torque_offset", "actuator_lag", "torque_saturation", "cogging")
_JOINT = ("coulomb_friction", "stribeck", "viscous_friction", "joint_spring", *_ACTUATOR)
# Free decays of a clamped link say nothing of a joint, nor of a clock without a second one; none has a known payload.
ONLY_WITH_HUB = (
    "payload_body",
    "hub_radius",
    *_JOINT,
    "gear_elasticity",
    "backlash",
    "time_offset",
    "clock_scale",
    "encoder_offset",
    "encoder_eccentricity",
)

# What no recording of the rig, or next to none, can tell apart.
_ALWAYS = (("camera_rotation", "rest_curvature", "encoder_offset"),)
TWINS: Mapping[str, tuple[tuple[str, ...], ...]] = {
    "hub": _ALWAYS,
    "clamped": (
        ("camera_rotation", "rest_curvature", "in_plane_gravity"),
        ("tip_payload", "clamp_compliance"),
        ("cubic_stiffness", "stiffness_drift"),
    ),
}


def kind_of(rig: Rig) -> str:
    """Whether a rig is one with a hub or a clamped one."""
    return "clamped" if rig in ("clamped", "clamped_arm") else "hub"


def effects_of(rig: Rig) -> tuple[str, ...]:
    """Effects that recordings of a rig can show."""
    return EFFECTS if kind_of(rig) == "hub" else tuple(each for each in EFFECTS if each not in ONLY_WITH_HUB)


def twins(rig: Rig, effect: str) -> frozenset[str]:
    """An effect and what is known to look like it on a rig."""
    return frozenset({effect}.union(*(each for each in TWINS[kind_of(rig)] if effect in each)))


def draw(effect: str, seed: int, rig: Rig = "hub", multiple: float = 1.0) -> Planted:
    """An effect near its everyday size on a rig, on a side drawn from the seed; `multiple` times as large."""
    random = np.random.default_rng([seed, 2, EFFECTS.index(effect)])
    typical_magnitude = CLAMPED_FACTORS.get(effect, 1.0) if kind_of(rig) == "clamped" else 1.0
    factor = multiple * typical_magnitude * 0.7 * 2.0 ** random.uniform()
    if effect in VECTORS:
        names, length = VECTORS[effect]
        angle, size = random.uniform(0.0, 2.0 * np.pi), factor * length
        components = float(size * np.cos(angle)), float(size * np.sin(angle))
        return Planted(effect, dict(zip(names, components, strict=True)) | _inner(effect, random, 0))
    values = {name: _value(size, factor, random) for name, size in SIZES[effect].items()}
    inner = _inner(effect, random, len(setting_of(rig, seed).markers))
    if effect == "base_compliance" and kind_of(rig) == "clamped":  # which hardly pushes a table along the link
        inner["direction"] = 0.25 * np.pi + 0.5 * inner["direction"]
    return Planted(effect, values | inner)


def written(planted: Planted, units: Units) -> Planted:
    """An effect in the units in which its recordings are written."""
    powers = {name: POWERS.get((planted.effect, name), (0, 0, 0)) for name in planted.parameters}
    return Planted(planted.effect, {name: units.of(*powers[name]) * x for name, x in planted.parameters.items()})


def of_size(effect: str, seed: int, smallest: Mapping[str, float], multiple: float) -> Planted:
    """An effect drawn from the seed, its sizes a multiple of the smallest ones that would have been detected.

    Args:
        effect: its id.
        seed: decides on signs, directions and what is not a size.
        smallest: by parameter; of a reciprocal one, the largest value that would have been detected.
        multiple: of them.
    """
    drawn = dict(draw(effect, seed).parameters)
    sizes = SIZES.get(effect) or {name: Size(VECTORS[effect][1], True) for name in VECTORS[effect][0]}
    known = {name: float(smallest[name]) for name in sizes if name in smallest}
    if not known:
        raise ValueError(f"{effect}: no smallest detectable size among {sorted(smallest)}")
    shares = [_size(sizes[name], drawn[name]) / _size_of_smallest(sizes[name], value) for name, value in known.items()]
    factor = multiple / float(np.hypot.reduce(shares))
    return Planted(effect, {name: _scaled(sizes.get(name), value, factor) for name, value in drawn.items()})


def _value(size: Size, factor: float, random: np.random.Generator) -> float:
    """A parameter's value, `factor` times its everyday size from the null."""
    if size.reciprocal:
        return size.typical_magnitude / factor
    side = random.choice([-1.0, 1.0]) if size.signed else 1.0
    return float(size.null + side * factor * size.typical_magnitude)


def _size(size: Size, value: float) -> float:
    """How large an effect a value is."""
    return 1.0 / value if size.reciprocal else abs(value - size.null)


def _size_of_smallest(size: Size, smallest: float) -> float:
    """How large an effect a smallest detectable size is: a distance from the null, or a value near a null of one."""
    if size.reciprocal:
        return 1.0 / smallest
    return abs(smallest - size.null) if smallest > 0.5 * size.null > 0.0 else abs(smallest)


def _scaled(size: Size | None, value: float, factor: float) -> float:
    """A value whose effect is `factor` times as large; what is no size stays."""
    if size is None:
        return value
    return value / factor if size.reciprocal else size.null + factor * (value - size.null)


def _inner(effect: str, random: np.random.Generator, markers: int) -> dict[str, float]:
    """Parameters that say how an effect is, not how large."""
    spread = float(2.0 ** random.uniform(-0.7, 0.7))
    match effect:
        case "tip_payload":  # from a point to a body a third as long as the link, held anywhere along it
            radius = 0.1 * random.uniform()
            return {"radius_of_gyration": radius, "offset": 12**0.5 / 2 * radius * random.uniform(-1.0, 1.0)}
        case "payload_body":  # from a point to a body a third as long as the link
            return {"radius_of_gyration": 0.1 * random.uniform()}
        case "backlash":
            share = random.uniform(0.2, 0.8)
            # What flanks do is not the model's law: their stiffness and damping have names of their own. From those of
            # an elastic gear to hard ones.
            stiffness, ratio = 28.0 * 100.0 ** random.uniform(), 0.5 * 2.0 ** random.uniform(-1.0, 1.0)
            return {"motor_share": share, "contact_stiffness": stiffness, "contact_damping_ratio": ratio}
        case "gear_elasticity":
            # Motor and hub swing against each other by about 110 rad/s, with 0.1 % to 10 % of critical damping.
            return {"motor_share": random.uniform(0.2, 0.8), "damping": 0.001 * 100.0 ** random.uniform()}
        case "clamp_compliance":
            # Loss factors of the spring from 0.001 to 0.1 in the slowest mode, 7.4 rad/s.
            return {"damping": 0.027 * 100.0 ** random.uniform()}
        case "structural_damping":  # its memory and how evenly it loses have names of their own
            memory, spacing = 10.0 ** random.uniform(1.5, 2.5), random.uniform(0.3, 0.7)
            return {"dispersion": random.uniform(), "memory": memory, "spacing": spacing}
        case "viscoelastic_creep":
            return {"time_constant": 0.1 * spread}
        case "hysteresis":
            return {"yield_angle": 0.05 * spread}
        case "external_tone":
            return {"frequency": random.uniform(1.5, 12.0), "phase": random.uniform(0.0, 2.0 * np.pi)}
        case "stribeck":
            return {"speed": 0.1 * spread}
        case "cogging":
            count = round(12.0 * 8.0 ** random.uniform())  # slots times poles, up to 96
            return {"count": float(count), "phase": random.uniform(0.0, 2.0 * np.pi)}
        case "camera_vibration":
            return {
                "frequency": random.uniform(2.0, 25.0),
                "direction": random.uniform(-0.5 * np.pi, 0.5 * np.pi),
                "phase": random.uniform(0.0, 2.0 * np.pi),
                "ellipticity": random.uniform(-0.6, 0.6),
            }
        case "lens_distortion":
            return _centre(random)
        case "camera_tilt":
            return _centre(random) | {"height": random.uniform(1.5, 4.0)}
        case "rolling_shutter":
            return {"direction": random.uniform(-0.5 * np.pi, 0.5 * np.pi)}
        case "timestamp_jitter":
            return {"seed": float(random.integers(2**31))}
        case "marker_offset":
            return {"marker": float(random.integers(1, markers + 1))}
        case "base_compliance":
            damping = 0.03 * float(2.0 ** random.uniform(-0.7, 0.7))
            return {"mass": 4.0 * spread, "direction": random.uniform(0.0, np.pi), "damping_ratio": damping}
    return {}


def _centre(random: np.random.Generator) -> dict[str, float]:
    """Where a camera's axis meets the plane: within the picture of an arm that turns by a radian to either side."""
    return {"centre_x": random.uniform(-0.25, 0.75), "centre_y": random.uniform(-0.5, 0.5)}


if __name__ == "__main__":
    from tests.hidden.visibility import main

    main()
