"""Experiments with something hidden on arms of two flexible links, shoulder and elbow driven; mechanics by MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from tests.fine_beam import (
    Camera,
    Encoder,
    Faults,
    LinkRecord,
    RecordingEntry,
    film,
    shown_markers,
    write_arm_recording,
    write_experiment,
)
from tests.hidden.rigs import Truth, physics_of
from tests.hidden.settings import CAMERA, ENCODER
from tests.hidden.severities import Planted, draw
from tests.mujoco_arm.chain import Arm, Link
from tests.mujoco_arm.simulate import Motion, simulate
from tests.mujoco_arm.two_links import Sine, slews, swing

Array = NDArray[np.float64]

# What MuJoCo's arm can have, and all that sensors can.
MECHANICAL = ("in_plane_gravity", "tip_payload", "coulomb_friction", "viscous_friction", "joint_spring")
EFFECTS = (
    *MECHANICAL,
    *("torque_gain", "torque_offset", "encoder_offset", "marker_offset"),
    *("time_offset", "clock_scale", "camera_scale", "camera_rotation", "camera_translation", "lens_distortion"),
    *("rolling_shutter", "camera_vibration", "timestamp_jitter", "camera_tilt"),
)
# Where the elbow whips, at up to 27 rad/s, tips are within 0.04 mm of the converged motion in time and 0.13 mm in the
# number of segments after 5 s; half the segments and twice the step are 0.5 and 0.17 mm off, as much as cameras' noise.
# Elsewhere errors are a tenth of these.
_MAX_STEP, _SEGMENTS = 2e-4, 64  # s
_TANGENT = 1e-5  # m, on one rod


@dataclass(frozen=True)
class TwoLinkSetting:
    """An arm of two links, its sensors and how it is driven.

    Attributes:
        arm: the true links, of fine chains.
        nominal: what the experiment file says of the links' stiffness and hub inertia.
        markers: fractions of a link's length.
        camera, encoder: the sensors; torques are sampled with the encoders.
        duration: of every recording, s.
        place: link or joint of what is hidden, 0 or 1.
    """

    arm: Arm
    nominal: tuple[dict[str, float], ...]
    markers: tuple[float, ...]
    camera: Camera
    encoder: Encoder
    duration: float
    place: int


def two_link_setting(seed: int) -> TwoLinkSetting:
    """The setting that a seed draws."""
    random = np.random.default_rng([seed, 8])

    def between(low: float, high: float) -> float:
        return float(low * (high / low) ** random.uniform())

    def link(name: str, mass: float, stiffness: float, hub: float) -> Link:
        damping = between(5e-4, 2e-3)
        size = between(0.4, 0.6), mass * between(0.7, 1.4), stiffness * between(0.7, 1.4)
        return Link(name, *size, kelvin_voigt_time=damping, hub_inertia=hub * between(0.7, 1.4))

    arm = Arm((link("upper", 0.22, 1.6, 0.02), link("fore", 0.18, 1.0, 0.008)), segments=_SEGMENTS)
    nominal = tuple(
        {
            "bending_stiffness": each.bending_stiffness * (1.0 + 0.05 * float(random.standard_normal())),
            "hub_inertia": each.hub_inertia * (1.0 + 0.05 * float(random.standard_normal())),
        }
        for each in arm.links
    )
    markers = ((0.25, 0.5, 0.75, 1.0), (0.5, 0.75, 1.0))[int(random.integers(2))]
    camera = replace(CAMERA, rate=(100.0, 125.0)[int(random.integers(2))], noise=between(1.5e-4, 5e-4))
    encoder = replace(ENCODER, noise=between(5e-5, 2e-4))
    duration = float(random.integers(4, 7))
    return TwoLinkSetting(arm, nominal, markers, camera, encoder, duration, int(random.integers(2)))


def drawn(effect: str, seed: int, factor: float) -> Planted:
    """An effect near `factor` times its everyday size on the hub-driven rig; that of one link."""
    planted = draw(effect, seed, "hub", factor)
    if effect != "marker_offset":
        return planted
    count = len(two_link_setting(seed).markers)
    parameters = dict(planted.parameters)
    return Planted(effect, parameters | {"marker": 1.0 + (parameters["marker"] - 1.0) % count})


class _At(NamedTuple):
    """One link at some instants."""

    motion: Motion
    link: int
    coordinates: Array

    @property
    def theta(self) -> Array:
        return np.asarray(self.coordinates[:, self.motion.arm.active[self.link]])

    def positions(self, arcs: Sequence[float] | Array, across: Sequence[float] | Array) -> Array:
        """Points (T, k, 2) at arc lengths (k,) of the link, straight on beyond its end, and to the left by (k,), m."""
        arm, asked = self.motion.arm, np.asarray(arcs, dtype=float)
        inside = np.minimum(asked, arm.links[self.link].length)
        points, behind = (
            arm.positions(self.coordinates, self.link, (inside - back).tolist()) for back in (0.0, _TANGENT)
        )
        tangents = (points - behind) / _TANGENT
        normals = np.stack([-tangents[..., 1], tangents[..., 0]], axis=-1)
        left = np.asarray(across, dtype=float)
        return np.asarray(points + (asked - inside)[:, None] * tangents + left[:, None] * normals)


class _LinkMotion(NamedTuple):
    """Motion of one link between the simulated instants."""

    motion: Motion
    link: int
    spline: CubicSpline

    def at(self, time: Array) -> _At:
        return _At(self.motion, self.link, np.asarray(self.spline(time)))


def _with_hidden(setting: TwoLinkSetting, effects: Sequence[Planted]) -> Arm:
    """The arm with what is hidden in its mechanics."""
    arm, place = setting.arm, setting.place
    links = list(arm.links)
    for each in effects:
        value = dict(each.parameters)
        match each.effect:
            case "in_plane_gravity":
                arm = replace(arm, gravity=(value["gx"], value["gy"]))
            case "tip_payload":
                inertia = value["mass"] * value["radius_of_gyration"] ** 2
                body = {"payload": value["mass"], "payload_offset": value["offset"], "payload_inertia": inertia}
                links[-1] = replace(links[-1], **body)
            case "coulomb_friction":
                links[place] = replace(links[place], joint_friction=value["torque"])
            case "viscous_friction":
                links[place] = replace(links[place], joint_damping=value["coefficient"])
            case "joint_spring":
                links[place] = replace(links[place], joint_stiffness=value["stiffness"])
    return replace(arm, links=tuple(links))


def _accelerations(setting: TwoLinkSetting, seed: int, time: Array) -> list[tuple[RecordingEntry, Array]]:
    """The recordings, and by what accelerations (T, 2), rad/s^2, a rigid arm would be turned in each."""
    random = np.random.default_rng([seed, 9])
    plans = []
    for k in range(6):
        joints = []
        for _ in range(2):
            sizes = random.uniform(0.7, 1.3, 3) * random.choice([-1.0, 1.0], 3) * (0.4, 0.02, 1.5e-3)
            speeds = random.uniform(0.8, 1.25, 3) * (0.4, 1.5, 5.5)
            joints.append([Sine(*pair) for pair in zip(sizes.tolist(), speeds.tolist(), strict=True)])
        role = "train" if k < 5 else "holdout"
        plans.append((RecordingEntry(f"drive_{k + 1}.csv", "driven", role), swing(time, joints)))
    turns = random.uniform(0.3, 0.6), -random.uniform(0.3, 0.6)
    return [*plans, (RecordingEntry("slew.csv", "driven", "holdout"), slews(time, turns))]


def write_two_links(folder: Path, effects: Sequence[Planted], seed: int) -> Truth:
    """Write an experiment with two links into a folder; the truth is in nothing but what is returned."""
    folder.mkdir(parents=True, exist_ok=True)
    setting = two_link_setting(seed)
    arm, place = _with_hidden(setting, effects), setting.place
    physics, faults = physics_of([each for each in effects if each.effect not in MECHANICAL])
    gain, offset = np.ones(2), np.zeros(2)
    gain[place], offset[place] = physics.torque_gain_gain, physics.torque_offset_offset
    straight = setting.arm.straight_mass_matrix()[np.ix_(setting.arm.active, setting.arm.active)]
    rate, reach = setting.encoder.rate, sum(link.length for link in arm.links)
    margin = int(np.ceil(faults.margin(setting.duration, reach) * rate - 1e-9))
    time = np.arange(round(setting.duration * rate) + 2 * margin + 1) / rate - margin / rate
    kept = slice(margin, time.size - margin)
    noise: dict[str, float] = {}
    entries = []
    for k, (entry, accelerations) in enumerate(_accelerations(setting, seed, np.maximum(time, 0.0))):
        torque = accelerations @ straight * (time >= 0.0)[:, None]
        motion = simulate(arm, time, gain * torque + offset * (time >= 0.0)[:, None], max_step=_MAX_STEP)
        records, errors = _measured(setting, motion, torque, faults, kept, [seed, k])
        write_arm_recording(folder / entry.file, records)
        noise[entry.file] = float(np.sqrt(np.mean(errors**2)))
        entries.append(entry)
    links: list[dict[str, str | float | list[float]]] = [
        {
            "name": link.name,
            "joint": link.joint,
            "length": link.length,
            "mass": link.mass,
            "markers": [link.length * share for share in setting.markers],
            **nominal,
        }
        for link, nominal in zip(setting.arm.links, setting.nominal, strict=True)
    ]
    sensors = {"marker_noise": setting.camera.noise, "encoder_noise": setting.encoder.noise}
    write_experiment(folder / "experiment.toml", "two links", links, sensors, entries)
    return Truth("two_links", seed, tuple(effects), setting, noise, noise)


def _measured(
    setting: TwoLinkSetting, motion: Motion, torque: Array, faults: Faults, kept: slice, seed: list[int]
) -> tuple[list[LinkRecord], Array]:
    """What the sensors see of each link, and the errors of the markers by noise alone, m."""
    samples, spline = motion.time[kept], CubicSpline(motion.time, motion.coordinates)
    stamps = np.arange(round(setting.duration * setting.camera.rate) + 1) / setting.camera.rate
    records, errors = [], []
    for i, link in enumerate(setting.arm.links):
        here = i == setting.place
        own = faults if here else replace(faults, marker_offset_marker=0, encoder_offset_offset=0.0)
        arcs = [link.length * share for share in setting.markers]
        points = shown_markers(_LinkMotion(motion, i, spline), stamps, arcs, own, seed[-1])
        frames = film(stamps, points, setting.camera, 1000 * seed[0] + 10 * seed[1] + i)
        errors.append(frames.markers - points)
        random = np.random.default_rng([*seed, i, 5])
        angle = motion.angles[kept, i] + own.encoder_offset_offset
        angle = angle + setting.encoder.noise * random.standard_normal(samples.size)
        records.append(LinkRecord(link.name, frames, (samples, angle), (samples, torque[kept, i])))
    return records, np.concatenate([each.ravel() for each in errors])
