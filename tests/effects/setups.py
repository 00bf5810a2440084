"""Rigs, recordings and chains to try effects on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from tests.model.arms import arms
from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.effects import BUILTIN, Effect
from vjm.records import Array, Link, Recording, Rig

Draw = Callable[[tuple[int, ...]], Array]

LINK = Link("beam", "revolute", 1.0, 0.44, 1.9, (0.3, 0.6, 1.0), hub_inertia=0.02)
FORE = replace(LINK, name="fore", length=0.7, mass=0.2, markers=(0.4, 0.7), hub_inertia=0.004)
POST = replace(LINK, name="post", joint="clamped", hub_inertia=0.0, markers=(1.0,))
# A clamped first link makes the numbers of links and of active joints differ.
RIG = Rig("arm", (POST, LINK, FORE))
PRESENT = [each for each in BUILTIN if each.parameters]  # those that can be present at all


def chain_of(*links: Link, n: int = 4, kelvin_voigt: float = 1e-3) -> Chain:
    """A chain of uniform links."""
    parts = []
    for i, link in enumerate(links):
        distal = "free" if i == len(links) - 1 else "joined"
        cuts = layout(link.length, n, distal=distal)
        parts.append(uniform_chain(link, cuts, kelvin_voigt=kelvin_voigt))
    return Chain("arm", tuple(parts))


def recording_of(rig: Rig, count: int = 12, measured: bool = True) -> Recording:
    """A recording of some motion; without measured torque and angles if asked for."""
    rng = np.random.default_rng(1)
    joints, markers = len(rig.active_links), sum(len(link.markers) for link in rig.links)
    theta, tau = rng.normal(size=(2, count, joints)) if measured else np.full((2, count, joints), np.nan)
    shown = rng.normal(size=(count, markers, 2))
    return Recording(
        0.1 + 0.01 * np.arange(count),
        shown,
        theta,
        tau,
        kind="driven",
        role="train",
        file="drive.csv",
        gravity=(0.3, -0.1),
        payload=0.02,
    )


def typical_magnitude(effect: Effect, rig: Rig = RIG, factor: float = 1.0) -> Effect:
    """The effect at its last place on the rig, with everyday sizes."""
    absent = effect.variants(rig, [])[-1]
    coordinates = absent.coordinates
    coordinates[: absent.magnitude_count] = factor
    return absent.at(coordinates)


def placed_first(effect: Effect) -> Effect:
    """The effect on the first link of any arm, with everyday sizes."""
    found = effect.at((np.arange(effect.coordinates.size) < effect.magnitude_count).astype(float))
    return replace(found, link=0)


def draw_from(seed: int, scale: float = 1.0) -> Draw:
    """Random arrays."""
    rng = np.random.default_rng(seed)
    return lambda shape: scale * rng.normal(size=shape)


@st.composite
def revolute_arms(draw: st.DrawFn) -> Chain:
    """Arms whose first joint is active and that are bent at rest."""
    chain = draw(arms())
    first = replace(chain.links[0], joint="revolute", rest_curvature=draw(st.floats(-1, 1)))
    return replace(chain, links=(first, *chain.links[1:]))
