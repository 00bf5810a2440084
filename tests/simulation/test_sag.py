"""Rest and vibration under gravity against the elastica and the independent beam."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from scipy.interpolate import make_interp_spline
from scipy.linalg import eigh

from tests.fine_beam import Beam, static_state
from tests.fine_beam import simulate as simulate_beam
from tests.fine_beam.beam import DEFAULT_NUMERICS
from tests.fine_beam.mechanics import Mechanics
from tests.simulation.integrators import simulate
from tests.simulation.setups import DOWN, arm_of, recording_of, rig_of, steel_link
from vjm.chain.curve import marker_poses
from vjm.chain.virtual_links import Chain
from vjm.model.modes import linearise, modes
from vjm.records import Payload

Array = NDArray[np.float64]
MARKERS = np.array([0.2, 0.4, 0.6, 0.8, 1.0])


def elastica(bending_stiffness: float, payload: float, gravity: tuple[float, float]) -> Array:
    """A clamped beam's markers under its weight and a payload's.

    EI psi'' = n_x sin psi - n_y cos psi, where n(s) = (p + m (L - s) / L) g is the load beyond s.
    """
    gx, gy = gravity

    def slope(s: Array, y: Array) -> Array:
        load = payload + 0.44 * (1 - s)
        moment_slope = load * (gx * np.sin(y[0]) - gy * np.cos(y[0])) / bending_stiffness
        return np.stack([y[1], moment_slope, np.cos(y[0]), np.sin(y[0])])

    def ends(start: Array, end: Array) -> Array:
        return np.array([start[0], end[1], start[2], start[3]])

    mesh = np.linspace(0.0, 1.0, 41)
    solution = solve_bvp(slope, ends, mesh, np.stack([0 * mesh, 0 * mesh, mesh, 0 * mesh]), tol=1e-9)
    assert solution.success
    return np.asarray(solution.sol(MARKERS)[2:].T)


def sagged(n: int, payload: float, gravity: tuple[float, float], stiffness: float = 1.97) -> tuple[Chain, Array]:
    chain = arm_of(steel_link(n, bending_stiffness=stiffness))
    q = linearise(chain, Payload(payload), gravity)[3]
    return chain, marker_poses(chain, q, (MARKERS,), (False,))[0]


@pytest.mark.parametrize(
    ("payload", "gravity", "sag", "bound"),
    [
        (0.0, (0.0, -2.0), 0.055, 2e-6),
        (0.0, DOWN, 0.25, 2e-4),
        (0.05, DOWN, 0.32, 3e-4),
        (0.05, (3.0, -9.0), 0.25, 5e-4),
    ],
    ids=str,
)
def test_a_horizontal_beam_sags_as_the_elastica(
    payload: float, gravity: tuple[float, float], sag: float, bound: float
) -> None:
    """Six joints; the error is the rigid links' lever arms, a fraction of the sag that falls with its square."""
    expected = elastica(1.97, payload, gravity)
    assert -expected[-1, 1] > sag
    assert np.abs(sagged(6, payload, gravity)[1] - expected).max() < bound


def test_sag_converges_at_second_order() -> None:
    expected = elastica(1.97, 0.05, DOWN)
    errors = [np.abs(sagged(n, 0.05, DOWN)[1] - expected).max() for n in (4, 8, 16)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 1.9).all()


def test_a_sagged_beam_stays_where_it_rests() -> None:
    chain, markers = sagged(6, 0.05, DOWN)
    recording = recording_of(chain, np.arange(101) / 50.0, payload=0.05, gravity=DOWN)
    q = linearise(chain, Payload(0.05), DOWN)[3]
    found = simulate(chain, rig_of(chain), recording, q, 0 * q)
    np.testing.assert_allclose(found.markers, np.broadcast_to(markers, (101, 5, 2)), atol=1e-9)


def beam_frequencies(beam: Beam, count: int) -> Array:
    """Hz, of the independent beam about its position of rest: its static residual's slope is its stiffness."""
    mechanics = Mechanics(beam, DEFAULT_NUMERICS)
    rest, step = static_state(beam).bending, 1e-6
    slopes = [
        mechanics.static_residual(rest + step * unit, np.zeros(2))
        - mechanics.static_residual(rest - step * unit, np.zeros(2))
        for unit in np.eye(rest.size)
    ]
    stiffness = -np.array(slopes) / (2 * step)
    heading = np.zeros(len(mechanics.basis.nodes)) + mechanics.heading @ rest
    jacobian, _ = mechanics._inertia_terms(heading, 0 * heading)
    flat = jacobian.reshape(-1, rest.size)
    squares = eigh((stiffness + stiffness.T) / 2, flat.T @ flat, eigvals_only=True)
    return np.asarray(np.sqrt(squares[:count]) / (2 * np.pi))


@pytest.mark.parametrize("gravity", [DOWN, (9.81, 0.0), (3.0, -9.0)], ids=str)
def test_vibration_about_the_sag_is_the_beam_s(gravity: tuple[float, float]) -> None:
    beam = Beam(1.0, 0.44, 1.97, gravity=gravity)
    expected = beam_frequencies(beam, 3)
    still = beam_frequencies(replace(beam, gravity=(0.0, 0.0)), 3)
    chain = arm_of(steel_link(8))
    found = modes(chain, gravity=gravity).frequencies[:3]
    assert np.abs(expected / still - 1).max() > 0.004  # gravity is felt
    np.testing.assert_allclose(found, expected, rtol=1.5e-3)


@pytest.mark.parametrize("swing", [pytest.param(0.05, marks=pytest.mark.slow), 0.15])
def test_a_decay_follows_the_independent_beam(swing: float) -> None:
    """Let go from a static pull: eight joints follow the beam for five seconds within 0.3 % of the swing."""
    beam = Beam(1.0, 0.44, 1.97, kelvin_voigt_time=3e-4)
    time = np.arange(501) / 100.0
    state = static_state(beam, (0.0, 3 * 1.97 * swing))
    motion = simulate_beam(beam, time, state=state)
    curvature = make_interp_spline(motion.mechanics.basis.nodes, motion.mechanics.curvature @ state.bending, 5)
    chain = arm_of(steel_link(8))
    link = chain.links[0]
    start = link.cells * curvature(link.joint_arcs)
    found = simulate(chain, rig_of(chain), recording_of(chain, time), start, 0 * start)
    assert np.abs(found.markers - motion.positions(MARKERS)).max() < 0.003 * swing
