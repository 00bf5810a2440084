"""Arms whose numbers all differ, and random ones."""

from __future__ import annotations

from typing import Literal

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from vjm.chain.virtual_links import Chain, LinkChain

Array = NDArray[np.float64]
GRAVITY = (1.7, -9.81)


def one_joint_link(joint: Literal["revolute", "clamped"], **changes: object) -> LinkChain:
    """A link with one virtual joint: everything differs from body to body, no centre is in the middle."""
    values: dict[str, object] = {
        "lengths": [0.37, 0.59],
        "masses": [0.31, 0.23],
        "mass_centers": [0.13, 0.41],
        "inertias": [0.0041, 0.0067],
        "stiffness": [3.7],
        "damping": [0.019],
        "cells": [0.9],
        "hub_inertia": 0.053,
        "hub_radius": 0.047 if joint == "revolute" else 0.0,
        "payload": 0.071,
        "payload_offset": 0.11,
        "payload_inertia": 0.0023,
    }
    return LinkChain(name="beam", joint=joint, **{**values, **changes})  # type: ignore[arg-type]


def one_joint_arm(joint: Literal["revolute", "clamped"], **changes: object) -> Chain:
    return Chain("arm", (one_joint_link(joint, **changes),), GRAVITY)


@st.composite
def arms(draw: st.DrawFn, point_masses: bool = True) -> Chain:
    """One to three links, clamped or revolute, of one to four virtual joints each."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    links = []
    for i in range(draw(st.integers(1, 3))):
        n, joint = draw(st.integers(1, 4)), draw(st.sampled_from(["revolute", "clamped"]))
        links.append(
            LinkChain(
                name=f"link_{i}",
                joint=joint,
                lengths=rng.uniform(0.1, 0.6, n + 1),
                masses=rng.uniform(0.05, 0.9, n + 1),
                mass_centers=rng.uniform(0.0, 0.6, n + 1),
                inertias=rng.uniform(1e-4, 1e-2, n + 1),
                stiffness=rng.uniform(1.0, 9.0, n),
                damping=rng.uniform(0.01, 0.1, n),
                cells=rng.uniform(0.1, 0.5, n),
                hub_inertia=rng.uniform(0.01, 0.1) * point_masses,
                payload=rng.uniform(0.01, 0.3) * point_masses,
                payload_offset=rng.uniform(-0.2, 0.2) * point_masses,
                payload_inertia=rng.uniform(0.0, 0.02) * point_masses,
                hub_radius=draw(st.sampled_from([0.0, 0.05])) if joint == "revolute" else 0.0,
            )
        )
    return Chain("arm", tuple(links), (float(rng.uniform(-9, 9)), float(rng.uniform(-9, 9))))


def random_motion(chain: Chain, samples: int, seed: int) -> tuple[Array, Array, Array]:
    """Angles, rates and accelerations (T, nv) with nothing small about them."""
    rng = np.random.default_rng(seed)
    shape = (samples, chain.size)
    return rng.uniform(-2, 2, shape), rng.uniform(-3, 3, shape), rng.uniform(-9, 9, shape)


def smooth_motion(chain: Chain, time: Array) -> tuple[Array, Array, Array]:
    """Sums of two sines for each joint, with their exact derivatives, (T, nv)."""
    k = np.arange(chain.size)
    t = time[:, None]
    q, v, a = (np.zeros((time.size, chain.size)) for _ in range(3))
    for amplitude, pulsation, phase in ((0.5 / (1 + k), 2.1 + 0.7 * k, 0.3 * k), (0.2, 5.3 - 0.4 * k, 1.0 + k)):
        angle = pulsation * t + phase
        q += amplitude * np.sin(angle)
        v += amplitude * pulsation * np.cos(angle)
        a -= amplitude * pulsation**2 * np.sin(angle)
    return q, v, a
