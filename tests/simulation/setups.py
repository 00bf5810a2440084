"""Arms, rigs and recordings to simulate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tests.chain.beams import beam_chain
from tests.simulation.integrators import trajectories_of
from vjm.chain.virtual_links import Chain, Distal, LinkChain
from vjm.records import Link, Recording, Rig
from vjm.simulation.arm import Arm

Array = NDArray[np.float64]
DOWN = (0.0, -9.81)


def steel_link(
    n: int,
    joint: Literal["revolute", "clamped"] = "clamped",
    *,
    name: str = "beam",
    length: float = 1.0,
    kelvin_voigt: float = 3e-4,
    bending_stiffness: float = 1.97,
    hub_inertia: float = 0.02,
    distal: Distal = "free",
) -> LinkChain:
    """A steel ruler of 1 m and 0.44 kg, unless told otherwise."""
    chain = beam_chain(
        n,
        joint=joint,
        length=length,
        mass=0.44,
        bending_stiffness=bending_stiffness,
        hub_inertia=hub_inertia,
        kelvin_voigt=kelvin_voigt,
        distal=distal,
    )
    return replace(chain.links[0], name=name)


def arm_of(*links: LinkChain) -> Chain:
    return Chain("arm", links)


def two_link_arm(n: int = 3) -> Chain:
    """A shoulder and an elbow, both driven, n virtual joints in either link."""
    upper = steel_link(n, "revolute", name="upper", length=0.6, hub_inertia=0.05, distal="joined")
    return arm_of(upper, steel_link(n, "revolute", name="fore", length=0.5, bending_stiffness=1.0))


def rig_of(chain: Chain) -> Rig:
    """Five markers on every link."""
    links = []
    for link in chain.links:
        markers = tuple((link.length * np.array([0.2, 0.4, 0.6, 0.8, 1.0])).tolist())
        links.append(Link(link.name, link.joint, link.length, float(link.masses.sum()), 1.97, markers))
    return Rig("rig", tuple(links))


def recording_of(
    chain: Chain,
    time: Array,
    torque: Callable[[Array], Array] | None = None,
    payload: float = 0.0,
    gravity: tuple[float, float] = (0.0, 0.0),
) -> Recording:
    """A recording of nothing but time and torque (T, n_a); no torque given is none applied."""
    joints = chain.active.size
    return Recording(
        file="made.csv",
        kind="driven",
        role="train",
        time=time,
        theta=np.full((time.size, joints), np.nan),
        tau=np.zeros((time.size, joints)) if torque is None else torque(time),
        markers=np.full((time.size, 5 * len(chain.links), 2), np.nan),
        gravity=gravity,
        payload=payload,
    )


def rollout(
    chains: list[Chain],
    recording: Recording,
    q: ArrayLike,
    v: ArrayLike,
    integrator: str = "exponential",
    step: float | None = None,
) -> tuple[Array, Array]:
    """Angles and rates (T, C, nv) of copies of a chain, all driven by one recording's torque."""
    arms = [Arm(chain) for chain in chains]
    runs = trajectories_of(arms, [recording] * len(arms), [*np.atleast_2d(q)], [*np.atleast_2d(v)], integrator, step)
    angles, rates = zip(*(run.sample(recording.time) for run in runs), strict=True)
    return np.stack(angles, axis=1), np.stack(rates, axis=1)


def end_load_shape(chain: Chain, deflection: float) -> Array:
    """Joint angles of a clamped link, pulled aside by `deflection` [m] on its tip."""
    link = chain.links[0]
    return np.asarray(3 * deflection / link.length**3 * link.cells * (link.length - link.joint_arcs))


def jerky_torque(joints: int, seed: int, size: float = 0.15) -> Callable[[Array], Array]:
    """Torques (T, joints) that are linear between random values 50 ms apart."""

    def torque(time: Array) -> Array:
        rng = np.random.default_rng(seed)
        knots = time[0] + 0.05 * np.arange(int((time[-1] - time[0]) / 0.05) + 2)
        return np.stack([np.interp(time, knots, rng.normal(0.0, size, knots.size)) for _ in range(joints)], axis=-1)

    return torque
