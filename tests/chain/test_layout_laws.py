"""What every way of cutting a link keeps to."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.chain.beams import beam_chain
from vjm.chain.layout import LAYOUTS, layout, layout_of_lengths
from vjm.chain.virtual_links import Chain, Distal, LinkChain
from vjm.errors import ChoiceError, InputError, ShapeError

COUNTS = st.integers(1, 40)
LENGTHS = st.floats(1e-2, 10.0)
NAMES = st.sampled_from(LAYOUTS)
DISTAL = st.sampled_from(["free", "joined"])


@given(LENGTHS, COUNTS, NAMES, DISTAL)
def test_lengths_sum_to_the_link_s(length: float, n: int, name: str, distal: Distal) -> None:
    cuts = layout(length, n, name, distal)
    assert (cuts.lengths.shape, cuts.cells.shape) == ((n + 1,), (n,))
    assert (cuts.lengths > 0).all()
    assert (cuts.cells > 0).all()
    np.testing.assert_allclose(cuts.lengths.sum(), length, rtol=1e-12)


@given(LENGTHS, COUNTS, NAMES, DISTAL)
def test_cuts_scale_with_the_link(length: float, n: int, name: str, distal: Distal) -> None:
    unit, cuts = layout(1.0, n, name, distal), layout(length, n, name, distal)
    np.testing.assert_allclose(cuts.lengths, length * unit.lengths, rtol=1e-12)
    np.testing.assert_allclose(cuts.cells, length * unit.cells, rtol=1e-12)


@given(COUNTS, NAMES)
def test_joined_links_are_cut_alike_from_either_end(n: int, name: str) -> None:
    cuts = layout(1.0, n, name, "joined")
    np.testing.assert_allclose(cuts.lengths, cuts.lengths[::-1], rtol=1e-12)
    np.testing.assert_allclose(cuts.cells, cuts.cells[::-1], rtol=1e-12)


@given(st.integers(2, 40))
def test_inner_links_and_joints_are_all_alike(n: int) -> None:
    cuts = layout(1.0, n, "end-corrected")
    np.testing.assert_allclose(cuts.lengths[1:-1], cuts.lengths[1], rtol=1e-12)
    np.testing.assert_allclose(cuts.cells[1:-1], cuts.lengths[1], rtol=1e-12)


@given(st.integers(2, 40), st.sampled_from(["free", "joined"]))
def test_free_layout_agrees_with_the_corrected_one(n: int, distal: Distal) -> None:
    cuts = layout(1.0, n, "fourth-order", distal)
    np.testing.assert_allclose(layout_of_lengths(cuts.lengths, distal).cells, cuts.cells, rtol=0.03)


@given(st.lists(st.floats(0.01, 1.0), min_size=2, max_size=9))
def test_free_cells_of_a_joined_link_cover_it(lengths: list[float]) -> None:
    cuts = layout_of_lengths(lengths, "joined")
    np.testing.assert_array_equal(cuts.lengths, lengths)
    np.testing.assert_allclose(cuts.cells.sum(), np.sum(lengths), rtol=1e-12)


@pytest.mark.parametrize("n", [0, -3])
def test_no_joints_are_refused(n: int) -> None:
    with pytest.raises(ShapeError):
        layout(1.0, n)


def test_unknown_layout_is_refused_with_the_choices() -> None:
    with pytest.raises(ChoiceError) as caught:
        layout(1.0, 3, "thirds")
    assert caught.value.choices == LAYOUTS
    assert all(name in str(caught.value) for name in LAYOUTS)


@given(COUNTS, NAMES, LENGTHS)
def test_uniform_chain_keeps_mass_centre_and_inertia(n: int, name: str, length: float) -> None:
    """Mass, first moment and moment of inertia about the root are the uniform rod's, however it is cut."""
    link = beam_chain(n, name, length=length, mass=0.44).links[0]
    starts = np.r_[0.0, link.joint_arcs]
    centers = starts + link.mass_centers
    np.testing.assert_allclose(link.masses.sum(), 0.44, rtol=1e-12)
    np.testing.assert_allclose(link.masses @ centers, 0.44 * length / 2, rtol=1e-12)
    np.testing.assert_allclose(link.inertias.sum() + link.masses @ centers**2, 0.44 * length**2 / 3, rtol=1e-12)


# The chain's coordinates


def two_links() -> Chain:
    first = beam_chain(2, joint="revolute", distal="joined", kelvin_voigt=0.1).links[0]
    second = beam_chain(3, joint="clamped", bending_stiffness=2.0).links[0]
    return Chain("arm", (first, second))


def test_coordinates_run_from_the_base_outwards() -> None:
    chain = two_links()
    assert chain.size == 6
    assert chain.passive_slices == (slice(1, 3), slice(3, 6))
    np.testing.assert_array_equal(chain.active, [0])
    np.testing.assert_array_equal(chain.passive, [1, 2, 3, 4, 5])
    assert chain.joint_names[0] == "beam_joint"
    assert len(chain.joint_names) == chain.size
    np.testing.assert_array_equal(chain.stiffness, np.r_[0.0, chain.links[0].stiffness, chain.links[1].stiffness])
    np.testing.assert_array_equal(chain.damping, np.r_[0.0, chain.links[0].damping, 0.0, 0.0, 0.0])


def values(**changes: object) -> dict[str, object]:
    fields: dict[str, object] = {
        "lengths": [0.5, 0.5],
        "masses": [1.0, 1.0],
        "mass_centers": [0.2, 0.2],
        "inertias": [0.1, 0.1],
        "stiffness": [1.0],
        "damping": [0.0],
        "cells": [1.0],
    }
    return {**fields, **changes}


@pytest.mark.parametrize(
    "changes",
    [
        {"lengths": [0.5]},
        {"masses": [1.0, 1.0, 1.0]},
        {"damping": []},
        {"stiffness": []},
        {"stiffness": [-1.0]},
        {"masses": [1.0, np.nan]},
        {"inertias": [0.1, np.inf]},
        {"lengths": [0.5, 0.0]},
        {"cells": [0.0]},
        {"mass_centers": [[0.2, 0.2]]},
    ],
    ids=str,
)
def test_links_that_do_not_fit_together_are_refused(changes: dict[str, object]) -> None:
    LinkChain(name="beam", joint="clamped", **values())  # type: ignore[arg-type]
    with pytest.raises(InputError):
        LinkChain(name="beam", joint="clamped", **values(**changes))  # type: ignore[arg-type]


def test_a_link_s_arrays_are_its_own_and_fixed() -> None:
    lengths = np.array([0.5, 0.5])
    link = LinkChain(name="beam", joint="clamped", **values(lengths=lengths))  # type: ignore[arg-type]
    lengths[0] = 9.0
    assert link.length == 1.0
    with pytest.raises(ValueError, match="read-only"):
        link.masses[0] = 2.0
