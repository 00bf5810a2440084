"""Constraints (17)-(20) hold by construction, and coordinates say what the chain is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vjm.chain.layout import layout, layout_of_lengths, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.identification.parameters import PARAMETRISATIONS, Parametrisation
from vjm.records import Link


def template(joint: str = "revolute", n: int = 3) -> Chain:
    inner = Link("inner", joint, 1.0, 0.4, 1.9, (1.0,), hub_inertia=0.02 if joint == "revolute" else 0.0)  # type: ignore[arg-type]
    outer = Link("outer", "revolute", 0.6, 0.2, 0.8, (0.6,), hub_inertia=0.01, payload=0.1)
    cuts = layout_of_lengths(layout(1.0, n, "end-corrected", "joined").lengths, "joined")
    first = uniform_chain(inner, cuts, kelvin_voigt=2e-3)
    return Chain("arm", (first, uniform_chain(outer, layout_of_lengths(layout(0.6, 2).lengths), kelvin_voigt=1e-3)))


@pytest.mark.parametrize("kind", PARAMETRISATIONS)
@pytest.mark.parametrize("joint", ["revolute", "clamped"])
def test_the_start_is_the_template(kind: str, joint: str) -> None:
    chain = template(joint)
    hubs = (0, 1) if joint == "revolute" else (1,)
    parametrisation = Parametrisation(chain, kind, hubs)
    found = parametrisation.chain(parametrisation.start)
    for before, after in zip(chain.links, found.links, strict=True):
        for field in ("lengths", "masses", "mass_centers", "inertias", "stiffness", "damping", "cells"):
            assert getattr(after, field) == pytest.approx(getattr(before, field), rel=1e-9), field
        assert after.hub_inertia == pytest.approx(before.hub_inertia)


@pytest.mark.parametrize("kind", PARAMETRISATIONS)
@given(seed=st.integers(0, 2**31), size=st.floats(0.1, 6.0))
@settings(max_examples=25, deadline=None)
def test_every_point_is_a_chain_that_can_exist(kind: str, seed: int, size: float) -> None:
    parametrisation = Parametrisation(template(), kind, (0, 1))
    lower, upper = parametrisation.bounds
    x = parametrisation.start + size * np.random.default_rng(seed).normal(size=parametrisation.start.size)
    chain = parametrisation.chain(np.clip(x, lower, upper))
    for link, before in zip(chain.links, parametrisation.template.links, strict=True):
        assert (link.lengths > 0).all()
        assert (link.masses > 0).all()  # (17)
        assert (link.mass_centers >= 0).all()
        assert (link.mass_centers <= link.lengths).all()  # (18)
        assert (link.inertias >= 0).all()
        # no mass distribution along a rod has more inertia about its centre than one at its two ends
        largest = link.masses * link.mass_centers * (link.lengths - link.mass_centers)
        assert (link.inertias <= largest * (1 + 1e-12)).all()
        assert (link.stiffness > 0).all()
        assert (link.damping >= 0).all()  # (19)
        assert link.lengths.sum() == pytest.approx(before.lengths.sum())
        assert link.masses.sum() == pytest.approx(before.masses.sum())  # (20)


@pytest.mark.parametrize("kind", PARAMETRISATIONS)
def test_physical_values_are_the_chains(kind: str) -> None:
    parametrisation = Parametrisation(template(), kind, (0, 1))
    rng = np.random.default_rng(2)
    x = parametrisation.start * rng.uniform(0.7, 1.3, parametrisation.start.size)
    chain = parametrisation.chain(x)
    fields = {
        "stiffness": "stiffness",
        "damping": "damping",
        "length": "lengths",
        "mass": "masses",
        "mass_center": "mass_centers",
        "inertia": "inertias",
    }
    for coordinate, value in zip(parametrisation.coordinates, parametrisation.physical(x), strict=True):
        link = chain.links[coordinate.link]
        quantity = coordinate.name.split(".")[1]
        if quantity == "bending_stiffness":
            expected = float(link.stiffness[0] * link.cells[0])
        elif quantity == "kelvin_voigt_time":
            expected = float(link.damping[-1] / link.stiffness[-1])
        elif quantity == "hub_inertia":
            expected = link.hub_inertia
        else:
            stem, number = quantity.rsplit("_", 1)
            first = 1 if stem in ("stiffness", "damping") else 0
            expected = float(getattr(link, fields[stem])[int(number) - first])
        assert value == pytest.approx(expected), coordinate.name
