"""How a simulated motion depends on its initial state and on the chain's parameters.

The variational equations along a trajectory are linear: over an interval their matrix is replaced by its mean and their
forcing by a quadratic, whose motion is exact (phi functions) however stiff the chain. The coefficients at all instants
come from a few batched calls of RNEA, so all derivatives together cost about as much as the simulation itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vjm import dynamics
from vjm.chain.records import Chain
from vjm.experiment.records import Recording
from vjm.simulate.arm import Arm
from vjm.simulate.basis import Basis
from vjm.simulate.drive import measured_torque
from vjm.simulate.guide import shown
from vjm.simulate.phi import phi_functions, rate_scale
from vjm.simulate.steps import Steps

Array = NDArray[np.float64]

_RIGID = ("lengths", "masses", "mass_centers", "inertias")
_RIGID_NUMBERS = ("hub_inertia", "root_inertia", "payload", "rest_curvature")
_ANGLE = 1e-6  # rad, largest perturbation of a joint
_RATE = 1e-6  # rad/s
_NUMBERS_A_CHUNK = 400_000  # of coefficients held at once


class Moved(NamedTuple):
    """The arm with one parameter moved.

    Attributes:
        arm: with the same coordinates.
        by: how far the parameter was moved, in its unit.
    """

    arm: Arm
    by: float


@dataclass(frozen=True)
class Path:
    """A trajectory of one copy at I instants.

    Attributes:
        time: (I,) since the recording's start [s].
        q, v, a: (I, nv) angles [rad], rates [rad/s], accelerations [rad/s^2].
        z: (I, nz) internal states of the effects.
    """

    time: Array
    q: Array
    v: Array
    a: Array
    z: Array


@dataclass(frozen=True)
class Coefficients:
    """The variational equations at several instants: d/dt of small changes of modal rates and internal states.

    The unknowns are m modal coordinates, m modal rates and nz internal states.

    Attributes:
        state: (I, m + nz, 2 m + nz) by the unknowns.
        forcing: (I, m + nz, p) by the parameters.
    """

    state: Array
    forcing: Array


class _Balance:
    """An arm's equations of motion along a path: what its bodies, springs and effects ask for, less what drives it."""

    def __init__(self, arm: Arm, recording: Recording) -> None:
        self.arm = arm
        self.driven = arm.inputs(recording)
        self.mechanism = dynamics.build(arm.chain, self.driven.payload, self.driven.gravity)
        self.force = arm.forces(self.driven.payload)

    def bodies(self, path: Path) -> Array:
        """M a + h (I, nv)."""
        return dynamics.inverse_dynamics(self.mechanism, path.q, path.v, path.a)

    @property
    def pushed(self) -> bool:
        """Whether effects or a guide exert forces."""
        return self.force is not None or self.arm.guide is not None

    def effects(self, path: Path) -> Array:
        """Less the forces of effects and guide (I, nv)."""
        found = -self.force(path.time, path.q, path.v, path.z) if self.force else np.zeros(path.q.shape)
        if self.arm.guide is not None:
            active = self.arm.chain.active
            theta, rate = shown(self.arm.sensors, path.q[:, active], path.v[:, active])
            found[:, active] -= self.arm.guide.torque(path.time, theta, rate)
        return found

    def rates(self, path: Path) -> Array:
        """Of the internal states (I, nz)."""
        return np.zeros(path.z.shape) if self.arm.rates is None else self.arm.rates(path.time, path.q, path.v, path.z)

    def torque(self, path: Path) -> Array:
        """Measured torques (I, n_a)."""
        knots, torque = measured_torque(self.driven)
        at = self.driven.time[0] + path.time
        columns = [np.interp(at, knots, column) for column in torque.T]
        return np.stack(columns, axis=-1) if columns else np.zeros((path.time.size, 0))


# What grows without bounds is noticed by `Run.triangle`, which refuses derivatives that are not finite.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def coefficients(arm: Arm, basis: Basis, moved: Sequence[Moved], recording: Recording, path: Path) -> Coefficients:
    """The variational equations' coefficients along a trajectory."""
    here, chain = _Balance(arm, recording), arm.chain
    at = here.bodies(path), here.effects(path), here.rates(path)
    m, nz = basis.shapes.shape[1], path.z.shape[1]
    forces = np.zeros((len(path.q), chain.size, 2 * m + nz + len(moved)))
    rates = np.zeros((len(path.q), nz, 2 * m + nz + len(moved)))
    inertia = np.empty((len(path.q), chain.size, m))
    for j, shape in enumerate(basis.shapes.T):
        # Small at every joint: what turns over with a rate's sign must not see the fast modes' large angles otherwise.
        angle, rate = _ANGLE / np.abs(shape).max(), _RATE / np.abs(shape).max()
        turned, sped = replace(path, q=path.q + angle * shape), replace(path, v=path.v + rate * shape)
        forces[:, :, j] = (here.bodies(turned) - at[0]) / angle + chain.stiffness * shape
        forces[:, :, m + j] = (here.bodies(sped) - at[0]) / rate + chain.damping * shape
        for column, other, by in ((j, turned, angle), (m + j, sped, rate)):
            if here.pushed:
                forces[:, :, column] += (here.effects(other) - at[1]) / by
            if nz:
                rates[:, :, column] = (here.rates(other) - at[2]) / by
        inertia[:, :, j] = here.bodies(replace(path, a=path.a + shape)) - at[0]
    for k, unit in enumerate(_ANGLE * np.eye(nz)):
        other = replace(path, z=path.z + unit)
        forces[:, :, 2 * m + k] = (here.effects(other) - at[1]) / _ANGLE
        rates[:, :, 2 * m + k] = (here.rates(other) - at[2]) / _ANGLE
    for k, each in enumerate(moved):
        forces[:, :, 2 * m + nz + k], rates[:, :, 2 * m + nz + k] = _change(here, each, recording, path, at)
    modal = basis.shapes.T @ forces
    solved = -np.linalg.solve(basis.shapes.T @ inertia, modal)
    lower = np.concatenate([solved, rates], axis=1)
    return Coefficients(lower[:, :, : 2 * m + nz], lower[:, :, 2 * m + nz :])


def _change(
    here: _Balance, moved: Moved, recording: Recording, path: Path, at: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """By a moved parameter, what the equations ask for (I, nv) and the internal states' rates (I, nz)."""
    chain, other, by = here.arm.chain, moved.arm.chain, moved.by
    forces = path.q * (other.stiffness - chain.stiffness) + path.v * (other.damping - chain.damping)
    rates = np.zeros(path.z.shape)
    if moved.arm.effects == here.arm.effects and _same_bodies(chain, other):
        if here.pushed and not np.array_equal(other.stiffness, chain.stiffness):
            forces = forces + _Balance(moved.arm, recording).effects(path) - at[1]
        return forces / by, rates
    there, nz = _Balance(moved.arm, recording), path.z.shape[1]
    if there.driven.gravity != here.driven.gravity or not _same_bodies(chain, other):
        forces = forces + there.bodies(path) - at[0]
    # What the arm has no internal states for yet follows the path as it is.
    wide = replace(path, z=followed(there.arm, path)) if sum(there.arm.states) > nz else path
    if here.pushed or there.pushed:
        forces = forces + there.effects(wide) - at[1]
    if nz:
        rates = there.rates(wide)[:, :nz] - at[2]
    if not np.array_equal(there.driven.tau, here.driven.tau, equal_nan=True):
        forces[:, chain.active] -= there.torque(path) - here.torque(path)
    return forces / by, rates / by


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def followed(arm: Arm, path: Path) -> Array:
    """(I, nz) internal states of an arm's effects along a path; those that have rates by Heun's method."""
    z = np.empty((len(path.q), sum(arm.states)))
    z[:] = arm.rest(path.q[0])
    for k, step in enumerate(np.diff(path.time) if z.size else ()):
        z[k + 1] = z[k]
        if arm.rates is not None:
            now, later = ((path.time[i], path.q[i], path.v[i]) for i in (k, k + 1))
            first = arm.rates(*now, z[k])
            z[k + 1] += step / 2 * (first + arm.rates(*later, z[k] + step * first))
        if arm.way is not None:
            z[k + 1] = arm.way(path.q[k], z[k + 1], path.q[k + 1])
    return z


def _same_bodies(chain: Chain, other: Chain) -> bool:
    """Whether two chains differ in springs and dampers at most."""
    return all(
        all(getattr(one, field) == getattr(two, field) for field in _RIGID_NUMBERS)
        and all(np.array_equal(getattr(one, field), getattr(two, field)) for field in _RIGID)
        for one, two in zip(chain.links, other.links, strict=True)
    )


def sensitivities(
    arm: Arm, basis: Basis, moved: Sequence[Moved], recording: Recording, steps: Steps, stride: int
) -> Iterator[Steps]:
    """Derivatives of a trajectory in modal coordinates, one stretch of time after another.

    Args:
        arm: what was simulated.
        basis: m modes.
        moved: p arms, each with one parameter moved.
        recording: what drove the trajectory.
        steps: the trajectory, of one copy.
        stride: steps in half an interval; their number is a multiple of two strides.

    Yields:
        For each stretch, trajectories of 2 slow + p copies with m coordinates: the derivatives by the slow modes'
        initial coordinates, initial rates, and by the parameters.
    """
    size, slow, nz = basis.shapes.shape[1], 2 * basis.slow, steps.z.shape[2]
    count = slow + len(moved)
    rows = np.arange(0, len(steps.time), stride)
    state = np.zeros((2 * size + nz, count))
    state[: basis.slow, : basis.slow] = state[size : size + basis.slow, basis.slow : slow] = np.eye(basis.slow)
    if nz:
        state[2 * size :] = _first_states(arm, basis, moved, steps.q[0, 0])
    interval = 2 * stride * steps.step
    most = 2 * max(20, _NUMBERS_A_CHUNK // (2 * size + nz) ** 2)
    if any(sum(each.arm.states) > nz for each in moved):
        most = rows.size  # internal states that only these have are followed from the start
    for first in range(0, rows.size - 1, most):
        part = rows[first : first + most + 1]
        path = Path(steps.time[part] - steps.time[0], *(x[part, 0] for x in (steps.q, steps.v, steps.a, steps.z)))
        found = coefficients(arm, basis, moved, recording, path)
        flow, pushed = _propagators(found, interval)
        states = np.empty((len(flow) + 1, 2 * size + nz, count))
        states[0] = state
        for k in range(len(flow)):
            state = flow[k] @ state
            state[:, slow:] += pushed[k]
            states[k + 1] = state
        a = found.state[::2, :size] @ states
        a[:, :, slow:] += found.forcing[::2, :size]
        told = (states[:, :size], states[:, size : 2 * size], a, states[:, 2 * size :])
        yield Steps(steps.time[part[::2]], *(np.ascontiguousarray(np.swapaxes(x, 1, 2)) for x in told))


def _first_states(arm: Arm, basis: Basis, moved: Sequence[Moved], q: Array) -> Array:
    """(nz, 2 slow + p) derivatives of the internal states at the start."""
    at = arm.rest(q)
    by_angles = [(arm.rest(q + _ANGLE * shape) - at) / _ANGLE for shape in basis.shapes[:, : basis.slow].T]
    by_rates = [np.zeros(at.size)] * basis.slow
    by_parameters = [(each.arm.rest(q)[: at.size] - at) / each.by for each in moved]
    return np.stack([*by_angles, *by_rates, *by_parameters], axis=1)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _propagators(found: Coefficients, interval: float) -> tuple[Array, Array]:
    """Over K intervals of three instants each, the flow (K, d, d) and what the forcing adds (K, d, p)."""
    lower, size = found.state.shape[1:]
    upper = size - lower  # coordinates, whose rates are unknowns themselves
    scale = rate_scale(found.state[:, :upper, : 2 * upper])  # rates in units of this
    units = np.r_[np.ones(upper), np.full(upper, scale), np.ones(lower - upper)]
    L = np.zeros((len(found.state), size, size))
    L[:, :upper, upper : 2 * upper] = np.eye(upper)
    L[:, upper:] = found.state
    L *= units / units[:, None]
    F = np.zeros((len(L), size, found.forcing.shape[2]))
    F[:, upper:] = found.forcing / units[upper:, None]
    L1, L2, L3 = (L[k : len(L) - 2 + k : 2] for k in (0, 1, 2))
    F1, F2, F3 = (F[k : len(F) - 2 + k : 2] for k in (0, 1, 2))
    flow, phi1, phi2, phi3 = phi_functions(interval / 6 * (L1 + 4 * L2 + L3))
    added = phi1 @ F1 + phi2 @ (4 * F2 - 3 * F1 - F3) + 4 * phi3 @ (F1 - 2 * F2 + F3)
    return flow * units[:, None] / units, interval * added * units[:, None]
