"""How a simulated motion depends on its initial state and on the chain's parameters.

The variational equations along a trajectory are linear: over an interval their matrix is replaced by its mean and their
forcing by a quadratic, whose motion is exact (phi functions) however stiff the chain. The coefficients at all instants
come from a few batched calls of RNEA, so all derivatives together cost about as much as the simulation itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from vjm import dynamics
from vjm.chain.records import Chain
from vjm.experiment.records import Recording
from vjm.modes import linearise
from vjm.simulate.observation import Observed
from vjm.simulate.phi import phi_functions, rate_scale
from vjm.simulate.steps import Steps, sample

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_RIGID = ("lengths", "masses", "mass_centers", "inertias")
_ANGLE = 1e-6  # rad, perturbation
_RATE = 1e-5  # rad/s
_NUMBERS_A_CHUNK = 400_000  # of coefficients held at once
_MOST_TURN = 3.2  # rad an interval; what lies inside it is interpolated, to three hundredths at this limit
_MOST_MODES = 16


class Moved(NamedTuple):
    """The chain with one parameter moved.

    Attributes:
        chain: with the same coordinates.
        by: how far the parameter was moved, in its unit.
    """

    chain: Chain
    by: float


@dataclass(frozen=True)
class Basis:
    """Natural modes of the arm at rest, in which derivatives are told.

    A camera does not show how the fastest of them start, so initial states are told in the slow ones.

    Attributes:
        shapes: (nv, m) joint angles of each mode, with modal mass one; slowest first.
        slow: number of slow modes.
    """

    shapes: Array
    slow: int

    @classmethod
    def of(cls, chain: Chain, recording: Recording, interval: float) -> Basis:
        """The modes of an arm, active joints free; slow are those that turn little in an interval [s]."""
        M, _, K, _ = linearise(chain, recording.payload, recording.gravity, first_angles(recording))
        squares, shapes = linalg.eigh(K, M)
        slow = int(np.count_nonzero(np.sqrt(np.maximum(squares, 0.0)) * interval < _MOST_TURN))
        return cls(shapes[:, :_MOST_MODES], min(max(slow, chain.active.size + 1), chain.size, _MOST_MODES))

    @property
    def states(self) -> Array:
        """(2 nv, 2 slow) initial angles and rates of a unit of each slow mode's coordinate and rate."""
        shapes = self.shapes[:, : self.slow]
        nothing = np.zeros_like(shapes)
        return np.block([[shapes, nothing], [nothing, shapes]])


def first_angles(recording: Recording) -> Array:
    """Active joints' angles (n_a,) first measured; zero where none was."""
    first = [column[np.isfinite(column)][:1] for column in recording.theta.T]
    return np.array([value[0] if value.size else 0.0 for value in first])


@dataclass(frozen=True)
class Coefficients:
    """d/dt of modal coordinates and rates (z, z') = state (z, z') + forcing, at several instants.

    Attributes:
        state: (I, m, 2 m) acceleration by coordinates and rates.
        forcing: (I, m, p) acceleration by the parameters.
    """

    state: Array
    forcing: Array


def coefficients(
    chain: Chain, basis: Basis, moved: Sequence[Moved], recording: Recording, q: Array, v: Array, a: Array
) -> Coefficients:
    """The variational equations' coefficients at instants q, v, a (I, nv) of a trajectory."""
    mechanism = dynamics.build(chain, recording.payload, recording.gravity)
    base = dynamics.inverse_dynamics(mechanism, q, v, a)
    count = basis.shapes.shape[1]
    columns = np.empty((len(q), chain.size, 3 * count + len(moved)))
    for j, shape in enumerate(basis.shapes.T):
        turned = dynamics.inverse_dynamics(mechanism, q + _ANGLE * shape, v, a)
        sped = dynamics.inverse_dynamics(mechanism, q, v + _RATE * shape, a)
        columns[:, :, j] = (turned - base) / _ANGLE + chain.stiffness * shape
        columns[:, :, count + j] = (sped - base) / _RATE + chain.damping * shape
        columns[:, :, 2 * count + j] = dynamics.inverse_dynamics(mechanism, q, v, a + shape) - base
    for k, (other, by) in enumerate(moved):
        change = q * (other.stiffness - chain.stiffness) + v * (other.damping - chain.damping)
        if not _same_bodies(chain, other):
            changed = dynamics.build(other, recording.payload, recording.gravity)
            change = change + dynamics.inverse_dynamics(changed, q, v, a) - base
        columns[:, :, 3 * count + k] = change / by
    modal = basis.shapes.T @ columns
    inertia = modal[:, :, 2 * count : 3 * count]
    forces = np.concatenate([modal[:, :, : 2 * count], modal[:, :, 3 * count :]], axis=2)
    solved = -np.linalg.solve(inertia, forces)
    return Coefficients(solved[:, :, : 2 * count], solved[:, :, 2 * count :])


def _same_bodies(chain: Chain, other: Chain) -> bool:
    """Whether two chains differ in springs and dampers only."""
    return all(
        one.hub_inertia == two.hub_inertia
        and all(np.array_equal(getattr(one, field), getattr(two, field)) for field in _RIGID)
        for one, two in zip(chain.links, other.links, strict=True)
    )


def sensitivities(
    chain: Chain, basis: Basis, moved: Sequence[Moved], recording: Recording, steps: Steps, stride: int
) -> Iterator[Steps]:
    """Derivatives of a trajectory in modal coordinates, one stretch of time after another.

    Args:
        chain: the arm.
        basis: m modes.
        moved: p chains, each with one parameter moved.
        recording: what drove the trajectory.
        steps: the trajectory, of one copy.
        stride: steps in half an interval; their number is a multiple of two strides.

    Yields:
        For each stretch, trajectories of 2 slow + p copies with m coordinates: the derivatives by the slow modes'
        initial coordinates, initial rates, and by the parameters.
    """
    size, slow = basis.shapes.shape[1], 2 * basis.slow
    count = slow + len(moved)
    rows = np.arange(0, len(steps.time), stride)
    state = np.zeros((2 * size, count))
    state[: basis.slow, : basis.slow] = state[size : size + basis.slow, basis.slow : slow] = np.eye(basis.slow)
    interval = 2 * stride * steps.step
    most = 2 * max(20, _NUMBERS_A_CHUNK // (2 * size) ** 2)
    for first in range(0, rows.size - 1, most):
        part = rows[first : first + most + 1]
        found = coefficients(chain, basis, moved, recording, *(x[part, 0] for x in (steps.q, steps.v, steps.a)))
        flow, pushed = _propagators(found, interval)
        states = np.empty((len(flow) + 1, 2 * size, count))
        states[0] = state
        for k in range(len(flow)):
            state = flow[k] @ state
            state[:, slow:] += pushed[k]
            states[k + 1] = state
        a = found.state[::2] @ states
        a[:, :, slow:] += found.forcing[::2]
        q, v = states[:, :size], states[:, size:]
        yield Steps(steps.time[part[::2]], *(np.ascontiguousarray(np.swapaxes(x, 1, 2)) for x in (q, v, a)))


def _propagators(found: Coefficients, interval: float) -> tuple[Array, Array]:
    """Over K intervals of three instants each, the flow (K, 2 m, 2 m) and what the forcing adds (K, 2 m, p)."""
    size = found.state.shape[1]
    scale = rate_scale(found.state)  # rates in units of this
    L = np.zeros((len(found.state), 2 * size, 2 * size))
    L[:, :size, size:] = scale * np.eye(size)
    L[:, size:, :size] = found.state[:, :, :size] / scale
    L[:, size:, size:] = found.state[:, :, size:]
    F = np.zeros((len(L), 2 * size, found.forcing.shape[2]))
    F[:, size:] = found.forcing / scale
    L1, L2, L3 = (L[k : len(L) - 2 + k : 2] for k in (0, 1, 2))
    F1, F2, F3 = (F[k : len(F) - 2 + k : 2] for k in (0, 1, 2))
    flow, phi1, phi2, phi3 = phi_functions(interval / 6 * (L1 + 4 * L2 + L3))
    added = phi1 @ F1 + phi2 @ (4 * F2 - 3 * F1 - F3) + 4 * phi3 @ (F1 - 2 * F2 + F3)
    units = np.r_[np.ones(size), np.full(size, scale)]
    return flow * units[:, None] / units, interval * added * units[:, None]


def jacobian(
    observed: Observed, chain: Chain, basis: Basis, moved: Sequence[Moved], steps: Steps, stride: int
) -> Iterator[tuple[Indices, Array]]:
    """Weighted derivatives of what was measured, one stretch of time after another.

    Args:
        observed: what was measured.
        chain, basis, moved, steps, stride: as in `sensitivities`.

    Yields:
        What was measured in the stretch, (r,) indices of `observed.values`, and the derivatives (r, 2 slow + p) of its
        predictions, times their weights.
    """
    recording, active = observed.recording, chain.active
    time = recording.time
    first = 0
    for part in sensitivities(chain, basis, moved, recording, steps, stride):
        ends_here = part.time[-1] >= steps.time[-1]
        last = time.size if ends_here else int(np.searchsorted(time, part.time[-1], side="left"))
        if last <= first:
            continue
        frames, markers, angles = observed.between(first, last)
        slope = sample(part, time[first:last])[0]
        rows, joints = np.divmod(observed.angles[_shifted(angles, observed.markers.size)], max(active.size, 1))
        by_angles = np.einsum("rcm,rm->rc", slope[rows - first], basis.shapes[active[joints]])
        path = sample(steps, time[frames])[0][:, 0]
        by_markers = observed.arcs.slope(chain, path, basis.shapes) @ np.swapaxes(slope[frames - first], 1, 2)
        _add_direct(by_markers[:, :, slope.shape[1] - len(moved) :], observed, chain, moved, path)
        begin = int(np.searchsorted(observed.frames, first)) * by_markers.shape[1]
        flat = by_markers.reshape(-1, slope.shape[1])
        derivatives = np.concatenate([flat[observed.markers[markers] - begin], by_angles])
        measured = np.r_[markers, angles]
        yield measured, observed.weights[measured, None] * derivatives
        first = last


def _shifted(part: slice, offset: int) -> slice:
    return slice(part.start - offset, part.stop - offset)


def _add_direct(by_markers: Array, observed: Observed, chain: Chain, moved: Sequence[Moved], path: Array) -> None:
    """Where a parameter moves the markers at the same angles, as lengths do."""
    base: Array | None = None
    for k, (other, by) in enumerate(moved):
        same = all(
            np.array_equal(one.lengths, two.lengths) and np.array_equal(one.cells, two.cells)
            for one, two in zip(chain.links, other.links, strict=True)
        )
        if same:
            continue
        if base is None:
            base = observed.arcs.markers(chain, path)
        change = (observed.arcs.markers(other, path) - base) / by
        by_markers[:, :, k] += change.reshape(len(path), -1)
