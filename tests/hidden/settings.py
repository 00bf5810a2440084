"""Arms and sensors on which effects are hidden: today's two rigs, and arms of any size, drawn from a seed.

Every arm is simulated at a length of 1 m, a mass of 0.44 kg and a stiffness near 1.97 N m^2, on which the simulator's
steps and stops were tried, and written in units of its own: scaling lengths, masses and times changes nothing in the
mathematics. What distinguishes a toy from a boom beyond that is drawn: the hub's share of the inertia, damping, frames
in a period, noise over length, markers, duration, size and speed of the drives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from tests.fine_beam import Beam, Camera, Encoder

Rig: TypeAlias = Literal["hub", "clamped", "arm", "clamped_arm", "two_links"]
MARKERS = (0.2, 0.4, 0.6, 0.8, 1.0)
CAMERA = Camera(rate=100.0, noise=3e-4)
ENCODER = Encoder(rate=500.0, noise=1e-4)


@dataclass(frozen=True)
class Units:
    """What lengths [m], masses [kg] and times [s] of a simulation are multiplied by where they are written."""

    length: float = 1.0
    mass: float = 1.0
    time: float = 1.0

    def of(self, length: float = 0.0, mass: float = 0.0, time: float = 0.0) -> float:
        """The factor of what has these powers of length, mass and time."""
        return float(self.length**length * self.mass**mass * self.time**time)

    @property
    def torque(self) -> float:
        """The factor of torques."""
        return self.of(2, 1, -2)


@dataclass(frozen=True)
class Setting:
    """An arm, its sensors and how it is driven.

    Attributes:
        beam: the true link, as it is simulated.
        nominal: what the experiment file says of its stiffness and hub inertia, in the same units.
        markers: their arc lengths, m.
        camera, encoder: the sensors; the torque is sampled with the encoder.
        duration: of every recording, s.
        drive: factor of torques and of vibrations' amplitudes.
        speed: factor of the drives' frequencies.
        units: in which it is written.
    """

    beam: Beam
    nominal: dict[str, float]
    markers: tuple[float, ...] = MARKERS
    camera: Camera = CAMERA
    encoder: Encoder = ENCODER
    duration: float = 5.0
    drive: float = 1.0
    speed: float = 1.0
    units: Units = Units()

    @property
    def turns(self) -> bool:
        """Whether a hub turns it."""
        return self.beam.joint == "revolute"


def setting_of(rig: Rig, seed: int) -> Setting:
    """The setting of a rig, its numbers drawn from the seed."""
    random = np.random.default_rng([seed, 3])
    stiffness = 1.97 * random.uniform(0.97, 1.03)
    damping, hub = 5e-4 * random.uniform(0.8, 1.25), 0.02 * random.uniform(0.95, 1.05)
    nominal = {"bending_stiffness": float(stiffness * (1.0 + 0.03 * random.standard_normal()))}
    hub_error = 1.0 + 0.05 * random.standard_normal()
    setting = Setting(Beam(1.0, 0.44, stiffness, damping), nominal)
    if rig in ("arm", "clamped_arm"):
        setting, hub = _any_arm(setting, np.random.default_rng([seed, 6]))
    if rig in ("clamped", "clamped_arm"):
        return setting
    radius = 0.1 * random.uniform() if rig == "arm" else 0.0
    beam = replace(setting.beam, joint="revolute", hub_inertia=float(hub), hub_radius=radius)
    return replace(setting, beam=beam, nominal=nominal | {"hub_inertia": float(hub * hub_error)})


def _any_arm(setting: Setting, random: np.random.Generator) -> tuple[Setting, float]:
    """The setting at another size, with other sensors and drives; and its hub's inertia."""

    def between(low: float, high: float) -> float:
        return float(low * (high / low) ** random.uniform())

    length = between(0.2, 4.0)
    # Links of one kind are about as slender: masses go with the cube of the length, stretched by a factor of its own.
    mass = 0.44 * length**3 * between(0.5, 2.0)
    beam = replace(setting.beam, kelvin_voigt_time=between(2e-4, 2e-3))
    units = Units(length, mass / beam.mass, between(0.5, 2.0) * length)  # frequencies go with the inverse length
    rate = float(round(between(35.0, 200.0)))
    camera = replace(CAMERA, rate=rate, noise=between(1e-4, 6e-4))
    encoder = Encoder(rate=rate * int(random.integers(1, 6)), noise=between(3e-5, 3e-4))
    count = int(random.integers(3, 8))
    markers = tuple(round(float(arc), 3) for arc in np.linspace(1.0 / count, 1.0, count))
    other = replace(setting, beam=beam, markers=markers, camera=camera, encoder=encoder, units=units)
    duration = round(between(3.0, 8.0) * rate) / rate
    return replace(other, duration=duration, drive=between(0.5, 1.3), speed=between(0.75, 1.3)), between(0.008, 0.08)
