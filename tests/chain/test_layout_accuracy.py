"""How near the chains' natural frequencies and deflections come to a uniform beam's, and how fast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import eigh

from tests.chain.beams import beam_chain, clamped_frequencies, hub_frequencies
from vjm.chain.curve import curve_map
from vjm.chain.layout import layout, nominal_chain, rig_layouts, uniform_chain
from vjm.chain.virtual_links import Chain, Distal
from vjm.model.modes import modes
from vjm.records import NO_PAYLOAD, Link, Payload, Rig

Array = NDArray[np.float64]


def errors(n: int, name: str, payload: float = 0.0) -> Array:
    """Relative errors of f1..f3, as many as there are, of a clamped chain."""
    found = modes(beam_chain(n, name, payload=payload)).frequencies[:3]
    return np.asarray(found / clamped_frequencies(3, payload)[: found.size] - 1)


def hub_errors(n: int, name: str, hub_inertia: float) -> Array:
    found = modes(beam_chain(n, name, joint="revolute", hub_inertia=hub_inertia)).frequencies[:3]
    return np.asarray(found / hub_frequencies(3, hub_inertia)[: found.size] - 1)


def orders(name: str, coarse: int, fine: int) -> Array:
    """Observed orders of convergence of f1..f3 between two numbers of joints."""
    return np.asarray(np.log(np.abs(errors(coarse, name) / errors(fine, name))) / np.log(fine / coarse))


def test_reference_frequencies_are_the_tabulated_ones() -> None:
    tabulated = np.array([1.8751040687119611, 4.694091132974175, 7.854757438237613])
    np.testing.assert_allclose(clamped_frequencies(3), tabulated**2 / (2 * np.pi), rtol=1e-12)
    pinned = np.array([3.9266023120479, 7.0685827456287, 10.2101761228130])  # tan z = tanh z: no hub at all
    np.testing.assert_allclose(hub_frequencies(3, 0.0), pinned**2 / (2 * np.pi), rtol=1e-10)
    np.testing.assert_allclose(hub_frequencies(3, 1e4), clamped_frequencies(3), rtol=1e-4)


# Per cent, f1..f3 of a clamped link against Euler-Bernoulli.
TABLE = {
    ("equal", 2): (49.45, 58.65),
    ("equal", 3): (33.10, 39.07, 33.44),
    ("equal", 5): (19.92, 22.18, 23.64),
    ("half-ends", 2): (6.08, 40.87),
    ("half-ends", 3): (2.61, 9.71, 25.93),
    ("half-ends", 5): (0.93, 3.27, 5.08),
    ("half-ends", 8): (0.36, 1.26, 2.03),
    ("end-corrected", 2): (-0.26, -1.55),
    ("end-corrected", 3): (-0.09, 0.18, -6.28),
    ("end-corrected", 5): (-0.03, 0.08, -0.20),
    ("end-corrected", 8): (0.00, 0.00, 0.02),
    ("fourth-order", 2): (-0.07, -0.01),
    ("fourth-order", 3): (-0.02, 0.10, -4.20),
    ("fourth-order", 5): (0.00, -0.03, -0.12),
    ("fourth-order", 8): (0.00, -0.01, -0.05),
}


@pytest.mark.parametrize(("name", "n"), TABLE)
def test_frequency_errors_are_the_documented_ones(name: str, n: int) -> None:
    np.testing.assert_allclose(100 * errors(n, name), TABLE[name, n], atol=0.0055)


def test_correction_keeps_most_of_its_gain_under_a_payload() -> None:
    np.testing.assert_allclose(100 * errors(5, "end-corrected", 1.0), (-0.06, -0.41, -0.84), atol=0.0055)
    np.testing.assert_allclose(100 * errors(5, "half-ends", 1.0), (0.58, 2.71, 4.56), atol=0.0055)


@pytest.mark.parametrize("hub_inertia", [0.05, 0.1, 0.2, 0.3])
def test_correction_holds_on_a_free_hub(hub_inertia: float) -> None:
    assert (np.abs(hub_errors(5, "end-corrected", hub_inertia)) < (3e-4, 7e-4, 3e-3)).all()
    assert (np.abs(hub_errors(8, "end-corrected", hub_inertia)) < (1.5e-4, 4e-4, 2e-4)).all()
    for n in (4, 5, 6, 8):
        gain = np.abs(hub_errors(n, "half-ends", hub_inertia) / hub_errors(n, "end-corrected", hub_inertia))
        assert gain[0] > 2
        assert (gain[1:] > 5).all()


def test_equal_links_converge_at_first_order() -> None:
    np.testing.assert_allclose(orders("equal", 16, 32), 1.0, atol=0.08)


def test_half_ends_converge_at_second_order() -> None:
    np.testing.assert_allclose(orders("half-ends", 8, 16), 2.0, atol=0.02)
    np.testing.assert_allclose(orders("half-ends", 16, 32), 2.0, atol=0.01)


def test_exact_ends_converge_at_fourth_order() -> None:
    np.testing.assert_allclose(orders("fourth-order", 16, 32), 4.0, atol=0.3)
    assert (np.abs(errors(32, "fourth-order")) < 4e-6).all()


@pytest.mark.parametrize("payload", [0.0, 0.1, 1.0])
def test_exact_ends_hold_under_a_payload(payload: float) -> None:
    assert (np.abs(errors(5, "fourth-order", payload)) < (4e-5, 6e-4, 2.2e-3)).all()


@pytest.mark.parametrize("in_recording", [False, True])
def test_ends_that_a_body_bends_converge_at_fourth_order(in_recording: bool) -> None:
    """Cut as free ends they do at first order: the second frequency is 2 % off with 16 joints."""
    body, link = Payload(0.3, 0.0, 0.3 * 0.25**2), Link("beam", "clamped", 1.0, 1.0, 1.0, (1.0,))
    if not in_recording:
        link = replace(link, payload=body.mass, payload_inertia=body.inertia)
    off = []
    for n in (8, 16):
        rig = Rig("arm", (link,))
        chain = nominal_chain(rig, rig_layouts(rig, [n], payloads=[body] if in_recording else ()))
        found = modes(chain, body if in_recording else NO_PAYLOAD).frequencies[:3]
        off.append(np.abs(found / clamped_frequencies(3, body.mass, body.inertia) - 1))
    assert (off[0] < 1e-3).all()
    assert (off[1] < off[0] / 2**3.5).all()


@pytest.mark.parametrize(
    ("distal", "n", "percent"),
    [("joined", 8, 0.086), ("joined", 32, -1.45e-4), ("free", 8, 0.887), ("free", 32, 0.188)],
)
def test_third_frequency_beside_a_body_is_off_as_documented(distal: Distal, n: int, percent: float) -> None:
    body = Payload(0.3, 0.0, 0.3 * 0.05**2)
    found = modes(beam_chain(n, "fourth-order", distal=distal), body).frequencies[2]
    off = found / clamped_frequencies(3, body.mass, body.inertia)[2] - 1
    assert 100 * off == pytest.approx(percent, rel=0.05)


@pytest.mark.parametrize("hub_inertia", [0.05, 0.1, 0.2, 0.3])
def test_exact_ends_hold_on_a_free_hub(hub_inertia: float) -> None:
    assert (np.abs(hub_errors(5, "fourth-order", hub_inertia)) < (2e-4, 1e-3, 2.5e-3)).all()
    gain = np.abs(hub_errors(16, "end-corrected", hub_inertia) / hub_errors(16, "fourth-order", hub_inertia))
    assert (gain > (30, 10, 1.5)).all()


@pytest.mark.parametrize("n", [2, 3, 5, 8])
def test_exact_ends_give_the_static_deflection_exactly(n: int) -> None:
    assert static_tip_deflection(n, "fourth-order") == pytest.approx(1.0, abs=1e-12)


def test_end_correction_converges_faster_where_it_is_used() -> None:
    """Nearly fourth order up to n = 8; constants of three digits then leave 2e-4, far below any measurement."""
    assert (orders("end-corrected", 3, 8) > 3.5).all()
    for n in range(8, 33, 4):
        assert (np.abs(errors(n, "end-corrected")) < 2e-4).all()


@pytest.mark.parametrize("n", range(2, 17))
def test_end_correction_is_far_better_than_half_ends(n: int) -> None:
    assert (np.abs(errors(n, "end-corrected")) < np.abs(errors(n, "half-ends")) / 4).all()


def test_a_few_corrected_joints_do_what_sixteen_did() -> None:
    assert (np.abs(errors(4, "end-corrected"))[:2] < np.abs(errors(16, "half-ends"))[:2]).all()
    assert (np.abs(errors(5, "end-corrected")) < np.abs(errors(16, "half-ends"))).all()


def static_tip_deflection(n: int, name: str) -> float:
    """Of the chain's curve under a unit end load, times 3 EI / F L^3: one for a beam."""
    chain = beam_chain(n, name, payload=1.0)
    link = chain.links[0]
    arms = link.length - link.joint_arcs
    phi = 1e-6 * arms / link.stiffness
    return float(3e6 * curve_map(link, [link.length]).positions(phi)[0, 1])


@pytest.mark.parametrize(("n", "bound"), [(1, 1e-9), (2, 0.004), (3, 0.002), (5, 0.001), (8, 0.001)])
def test_static_end_load_deflection(n: int, bound: float) -> None:
    assert static_tip_deflection(n, "end-corrected") == pytest.approx(1.0, abs=bound)


@pytest.mark.parametrize(("length", "mass", "stiffness"), [(1.0, 1.0, 1.0), (0.7, 0.31, 1.97)])
def test_one_joint_has_the_beam_s_first_frequency_and_compliance(length: float, mass: float, stiffness: float) -> None:
    chain = beam_chain(1, length=length, mass=mass, bending_stiffness=stiffness)
    scale = np.sqrt(stiffness / (mass * length**3))
    np.testing.assert_allclose(modes(chain).frequencies, clamped_frequencies(1) * scale, rtol=1e-12)
    link = chain.links[0]
    np.testing.assert_allclose(link.lengths[1] ** 2 / link.stiffness, length**3 / (3 * stiffness), rtol=1e-12)


@pytest.mark.parametrize("name", ["fourth-order", "end-corrected", "half-ends", "equal"])
def test_frequencies_scale_as_a_beam_s(name: str) -> None:
    unit = modes(beam_chain(5, name)).frequencies
    scaled = modes(beam_chain(5, name, length=0.7, mass=0.31, bending_stiffness=1.97)).frequencies
    np.testing.assert_allclose(scaled, unit * np.sqrt(1.97 / (0.31 * 0.7**3)), rtol=1e-9)


def test_kelvin_voigt_damping_ratio_is_half_the_pulsation_times_the_time() -> None:
    found = modes(beam_chain(6, kelvin_voigt=1e-3))
    np.testing.assert_allclose(found.damping_ratios, np.pi * found.frequencies * 1e-3, rtol=1e-10)


def test_a_link_joined_on_both_sides_bends_alike_from_either_end() -> None:
    """Two revolute joints on a joined link: turned end for end, it is the same beam."""
    link = beam_chain(5, distal="joined", joint="revolute").links[0]
    turned = replace(
        link,
        lengths=link.lengths[::-1],
        masses=link.masses[::-1],
        mass_centers=(link.lengths - link.mass_centers)[::-1],
        inertias=link.inertias[::-1],
        stiffness=link.stiffness[::-1],
        damping=link.damping[::-1],
        cells=link.cells[::-1],
    )
    for field in ("lengths", "masses", "mass_centers", "inertias", "stiffness", "cells"):
        np.testing.assert_allclose(getattr(link, field), getattr(turned, field), rtol=1e-12)


def rayleigh_frequencies(thickness: float, count: int) -> Array:
    """Frequencies [Hz] of a clamped bar of unit length, mass and stiffness with rotary inertia (Ritz, powers of x)."""
    powers = np.arange(2, 10)
    both = powers[:, None] + powers
    slopes = np.outer(powers, powers) / (both - 1)
    bending = np.outer(powers * (powers - 1), powers * (powers - 1)) / (both - 3)
    squares = eigh(bending, 1 / (both + 1) + thickness**2 / 12 * slopes, eigvals_only=True)
    return np.asarray(np.sqrt(squares[:count]) / (2 * np.pi))


@pytest.mark.parametrize("thickness", [0.02, 0.1, 0.3])
def test_a_thick_link_has_the_rotary_inertia_of_its_section(thickness: float) -> None:
    np.testing.assert_allclose(rayleigh_frequencies(0.0, 2), clamped_frequencies(2), rtol=1e-4)
    stiffness = {"width": 1.0, "thickness": thickness, "youngs_modulus": 12 / thickness**3}
    link = Link("bar", "clamped", 1.0, 1.0, markers=(1.0,), **stiffness)
    found = modes(Chain("bar", (uniform_chain(link, layout(1.0, 24)),))).frequencies[:2]
    np.testing.assert_allclose(found, rayleigh_frequencies(thickness, 2), rtol=2e-3 * (0.1 + thickness))
    assert found[1] < (1 - thickness**2) * clamped_frequencies(2)[1]
