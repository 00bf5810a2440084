"""Chains for tests, and their mechanics in the plane from first principles."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from vjm.chain.virtual_links import Array, Chain, LinkChain
from vjm.records import Link, Rig
from vjm.report.model_json import model_text
from vjm.simulation.model import Model

HOSTILE = "<a&\"b'>]]> é世\U0001f9be --"
NAMES = st.text(
    st.characters(exclude_categories=("Cc", "Cf", "Cs", "Zl", "Zp"), exclude_characters="\ufffe\uffff"),
    min_size=1,
    max_size=8,
)


def positive(least: float, most: float) -> st.SearchStrategy[float]:
    return st.floats(least, most, allow_nan=False)


def sizes(count: int, least: float, most: float) -> st.SearchStrategy[Array]:
    return st.lists(positive(least, most), min_size=count, max_size=count).map(np.array)


@st.composite
def link_chains(draw: st.DrawFn, name: str) -> LinkChain:
    n = draw(st.integers(1, 4))
    joint = draw(st.sampled_from(["revolute", "clamped"]))
    active = draw(st.booleans()) and joint == "revolute"
    rooted = draw(st.booleans())
    payload = draw(st.sampled_from([0.0, 0.015, 2.5]))
    return LinkChain(
        name=name,
        joint=joint,
        lengths=draw(sizes(n + 1, 0.05, 1.0)),
        masses=draw(sizes(n + 1, 0.01, 3.0)),
        mass_centers=draw(sizes(n + 1, 0.0, 1.0)),
        inertias=draw(sizes(n + 1, 1e-6, 0.1)),
        stiffness=draw(sizes(n, 0.0, 1e4)),
        damping=draw(sizes(n, 0.0, 2.0)),
        cells=draw(sizes(n, 1e-3, 1.0)),
        hub_inertia=draw(st.sampled_from([0.0, 0.02, 1.7])),
        payload=payload,
        payload_offset=draw(st.sampled_from([0.0, 0.03, -0.2])) if payload else 0.0,
        payload_inertia=draw(st.sampled_from([0.0, 3e-5, 0.07])) if payload else 0.0,
        distal=draw(st.sampled_from(["free", "joined"])),
        joint_stiffness=draw(positive(0.0, 2.0)) if active else 0.0,
        joint_damping=draw(positive(0.0, 0.1)) if active else 0.0,
        root_stiffness=draw(positive(0.0, 1e5)) if rooted else None,
        root_damping=draw(positive(0.0, 0.1)) if rooted else 0.0,
        root_inertia=draw(st.sampled_from([0.0, 0.003])),
        hub_radius=draw(st.sampled_from([0.0, 0.04])) if joint == "revolute" else 0.0,
        rest_curvature=draw(st.just(0.0) | positive(-2.0, 2.0)),
        width=draw(st.none() | positive(1e-3, 0.1)),
        thickness=draw(st.none() | positive(1e-4, 0.1)),
    )


@st.composite
def chains(draw: st.DrawFn, names: st.SearchStrategy[str] = NAMES) -> Chain:
    given_names = draw(st.lists(names, min_size=1, max_size=3, unique=True))
    gravity = draw(st.tuples(positive(-10, 10), positive(-10, 10)))
    return Chain(draw(names), tuple(draw(link_chains(name)) for name in given_names), gravity)


def plain_link(name: str = "beam", n: int = 2, **changes: object) -> LinkChain:
    """A link of round numbers, none equal to another."""
    j = np.arange(n + 1)
    values: dict[str, object] = {
        "joint": "revolute",
        "lengths": 0.3 + 0.05 * j,
        "masses": [0.1, 0.15, 0.19, 0.22][: n + 1],
        "mass_centers": 0.12 + 0.01 * j,
        "inertias": 1e-3 + 2e-4 * j,
        "stiffness": 7.0 + j[1:],
        "damping": [2e-3, 3e-3, 5e-3][:n],
        "cells": 0.31 + 0.02 * j[1:],
        "hub_inertia": 0.02,
        "payload": 0.05,
        "payload_offset": 0.02,
        "width": 0.035,
        "thickness": 0.0015,
    }
    return LinkChain(name=name, **{**values, **changes})  # type: ignore[arg-type]


def plain_chain() -> Chain:
    """Two links, one of them without width and thickness."""
    second = plain_link("fore", n=3, hub_inertia=1e-3, payload=0.0, payload_offset=0.0, width=None, thickness=None)
    return Chain("arm", (plain_link(distal="joined"), second), (0.0, -9.81))


def extended_chain() -> Chain:
    """Two links with everything that can be at a joint, the second one clamped."""
    root: dict[str, object] = {"root_stiffness": 60.0, "root_damping": 0.07, "root_inertia": 0.004}
    bent = plain_link(**root, hub_radius=0.03, joint_stiffness=0.05, joint_damping=0.006, rest_curvature=-0.2)
    clamped = plain_link("fore", joint="clamped", hub_inertia=0.0, root_stiffness=200.0, rest_curvature=0.3)
    return Chain("arm", (bent, clamped), (0.0, -9.81))


def contents(chain: Chain) -> dict[str, object]:
    """Everything a chain holds, comparable by == to the last bit."""
    links = [
        {
            field.name: value.tolist() if isinstance(value := getattr(link, field.name), np.ndarray) else value
            for field in fields(link)
        }
        for link in chain.links
    ]
    return {"name": chain.name, "gravity": chain.gravity, "links": links}


class Plane:
    """The chain drawn in the plane at one posture: every body's pose, and the joints that move it."""

    def __init__(self, chain: Chain, q: Array) -> None:
        self.q = q
        self.places: dict[str, tuple[Array, float]] = {}
        self.bodies: list[tuple[float, float, Array, int]] = []  # mass, inertia, centre, joints that move it
        self.pivots: list[Array] = []
        self.angle, self.point = 0.0, np.zeros(2)
        for link in chain.links:
            self._add_link(link)

    def _turn(self) -> None:
        self.angle += self.q[len(self.pivots)]
        self.pivots.append(self.point)

    def _ahead(self, distance: float) -> Array:
        return self.point + distance * np.array([np.cos(self.angle), np.sin(self.angle)])

    def _add_link(self, link: LinkChain) -> None:
        hub = link.hub_inertia
        if link.joint == "revolute":
            self._turn()
        before, start = 0.0, link.hub_radius
        if link.root_stiffness is not None and not link.root_inertia:
            before, start = link.hub_radius, 0.0  # a compliant clamp, at the hub's rim; a gear is in the hub
        if link.root_stiffness is not None:
            self.places[f"{link.name}_hub"] = (self.point, self.angle)
            self.bodies.append((0.0, hub, self.point, len(self.pivots)))
            hub = 0.0
            self.point = self._ahead(before)
            self._turn()
        for j in range(link.virtual_joints + 1):
            if j:
                self.angle += link.rest_curvature * link.cells[j - 1]
                self._turn()
            self.places[f"{link.name}_virtual_{j}_link"] = (self.point, self.angle)
            turning = link.inertias[j] + (hub + link.root_inertia if j == 0 else 0.0)
            start = start if j == 0 else 0.0
            center = self._ahead(start + link.mass_centers[j])
            self.bodies.append((link.masses[j], turning, center, len(self.pivots)))
            self.point = self._ahead(start + link.lengths[j])
        self.places[f"{link.name}_tip"] = (self.point, self.angle)
        self.bodies.append((link.payload, link.payload_inertia, self._ahead(link.payload_offset), len(self.pivots)))

    def mass_matrix(self) -> Array:
        """Sum over bodies of m J^T J + I w w^T."""
        total = np.zeros((self.q.size, self.q.size))
        for mass, turning, center, moved_by in self.bodies:
            jacobian, spin = np.zeros((2, self.q.size)), np.zeros(self.q.size)
            for k in range(moved_by):
                arm = center - self.pivots[k]
                jacobian[:, k], spin[k] = (-arm[1], arm[0]), 1.0
            total += mass * jacobian.T @ jacobian + turning * np.outer(spin, spin)
        return total


def model_of(chain: Chain) -> Model:
    """A model of an arm without markers that has this chain."""
    links = (Link(link.name, link.joint, link.length, float(link.masses.sum()), 1.9, ()) for link in chain.links)
    return Model(chain, Rig(chain.name, tuple(links), chain.gravity), 3e-4, 1e-4)


def write_model(model: Model, file: Path, covariance: Array | None = None) -> None:
    """Write a model.json."""
    file.write_text(model_text(model, covariance), encoding="utf-8")
