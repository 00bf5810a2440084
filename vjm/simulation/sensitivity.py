"""Derivatives of what was measured by initial states and parameters: of the motion, and of how sensors show it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import linalg

from vjm.chain.virtual_links import Chain
from vjm.model import dynamics
from vjm.model.modes import linearise
from vjm.records import Array, Indices, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.encoder_feedback import shown
from vjm.simulation.exponential import phi_functions, rate_scale
from vjm.simulation.integrators import Steps, measured_torque, sample
from vjm.simulation.measurement import Observed, instants, sampled, view

_MOST_TURN = 3.2  # rad an interval; what lies inside it is interpolated, to three hundredths at this limit
_MOST_MODES = 16


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
        return self.force is not None or self.arm.feedback is not None

    def effects(self, path: Path) -> Array:
        """Less the forces of effects and guide (I, nv)."""
        found = -self.force(path.time, path.q, path.v, path.z) if self.force else np.zeros(path.q.shape)
        if self.arm.feedback is not None:
            active = self.arm.chain.active
            theta, rate = shown(self.arm.sensors, path.q[:, active], path.v[:, active])
            found[:, active] -= self.arm.feedback.torque(path.time, theta, rate)
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
        if arm.rate_independent_update is not None:
            z[k + 1] = arm.rate_independent_update(path.q[k], z[k + 1], path.q[k + 1])
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


def jacobian(
    observed: Observed, arm: Arm, basis: Basis, moved: Sequence[Moved], steps: Steps, stride: int
) -> Iterator[tuple[Indices, Array]]:
    """Weighted derivatives of what was measured, one stretch of time after another.

    Args:
        observed: what was measured.
        arm, basis, moved, steps, stride: as in `sensitivities`.

    Yields:
        What was measured in the stretch, (r,) indices of `observed.values`, and the derivatives (r, 2 slow + p) of its
        predictions, times their weights.
    """
    recording = observed.recording
    time = recording.time
    # Frames show the arm at instants of their own: what they show may have been in the stretch before, or the next.
    seen = instants(arm, observed.arcs, steps, time[observed.frames])
    late = time[observed.frames] - seen
    behind, ahead = float(np.max(late, initial=0.0)), float(np.max(-late, initial=0.0))
    first = 0
    part: Steps | None = None
    for stretch in sensitivities(arm, basis, moved, recording, steps, stride):
        part = stretch if part is None else _joined(part, stretch, behind + ahead)
        ends_here = part.time[-1] >= steps.time[-1]
        last = time.size if ends_here else int(np.searchsorted(time, part.time[-1] - ahead, side="left"))
        if last <= first:
            continue
        frames, markers, angles = observed.between(first, last)
        by_angles = _encoder_slopes(observed, arm, basis, moved, steps, part, angles)
        camera = slice(*np.searchsorted(observed.frames, (first, last)).tolist())
        by_markers = _marker_slopes(observed, arm, basis, moved, steps, part, seen[..., camera], time[frames])
        flat = by_markers.reshape(-1, by_markers.shape[2])
        derivatives = np.concatenate([flat[observed.markers[markers] - camera.start * by_markers.shape[1]], by_angles])
        measured = np.r_[markers, angles]
        yield measured, observed.weights[measured, None] * derivatives
        first = last


def _joined(before: Steps, after: Steps, overlap: float) -> Steps:
    """A stretch with the end of the one before."""
    if overlap <= 0:
        return after
    kept = before.time < after.time[0] - 1e-12
    kept &= before.time >= after.time[0] - overlap - 2 * after.step
    parts = ((getattr(before, name)[kept], getattr(after, name)) for name in ("time", "q", "v", "a", "z"))
    return Steps(*(np.concatenate(pair) for pair in parts))


def _marker_slopes(
    observed: Observed,
    arm: Arm,
    basis: Basis,
    moved: Sequence[Moved],
    steps: Steps,
    part: Steps,
    seen: Array,
    stamps: Array,
) -> Array:
    """(F, 2 k, 2 slow + p) derivatives of the marker coordinates of frames seen at instants (F,) or (k, F)."""
    arcs, path = observed.arcs, sampled(steps, seen)
    by_state = arcs.slope(arm, path, basis.shapes)
    if seen.ndim == 1:
        found = by_state @ np.swapaxes(sample(part, seen)[0], 1, 2)
    else:
        rates = np.stack([np.swapaxes(sample(part, own)[0], 1, 2) for own in seen], axis=1)
        shaped = by_state.reshape(len(by_state), len(seen), 2, by_state.shape[2])
        found = (shaped @ rates).reshape(len(by_state), 2 * len(seen), rates.shape[-1])
    base: Array | None = None
    for k, (other, by) in enumerate(moved):
        if _sees_alike(arm, other):
            continue
        base = arcs.shown(arm, path) if base is None else base
        there = view(other, arcs, steps, stamps)
        found[:, :, found.shape[2] - len(moved) + k] += ((there - base) / by).reshape(len(base), 2 * base.shape[1])
    return found


def _encoder_slopes(
    observed: Observed,
    arm: Arm,
    basis: Basis,
    moved: Sequence[Moved],
    steps: Steps,
    part: Steps,
    angles: slice,
) -> Array:
    """(r, 2 slow + p) derivatives of the encoders' values `angles`."""
    active = arm.chain.active
    offset = observed.markers.size
    flat = observed.angles[angles.start - offset : angles.stop - offset]
    rows, joints = np.divmod(flat, max(active.size, 1))
    if not flat.size:
        return np.zeros((0, part.q.shape[1]))
    by_active = basis.shapes[active].T
    told = Steps(part.time, part.q @ by_active, part.v @ by_active, part.a @ by_active, part.z)
    slope = sample(told, observed.recording.time[rows])[0]
    found: Array = np.take_along_axis(slope, joints[:, None, None], axis=2)[:, :, 0]
    for k, (other, by) in enumerate(moved):
        if other.sensors != arm.sensors:
            change = (observed.encoders(other, steps) - observed.encoders(arm, steps)) / by
            found[:, found.shape[1] - len(moved) + k] += change[angles.start - offset : angles.stop - offset]
    return found


def _sees_alike(arm: Arm, other: Arm) -> bool:
    """Whether two arms' markers are seen at the same places where their joints have the same angles."""
    return arm.sensors == other.sensors and all(
        np.array_equal(one.lengths, two.lengths)
        and np.array_equal(one.cells, two.cells)
        and one.rest_curvature == two.rest_curvature
        for one, two in zip(arm.chain.links, other.chain.links, strict=True)
    )
