"""Rigid-body dynamics of virtual-joint chains: the only module that knows Pinocchio.

Equation of motion (eq. 8), split into active (a) and passive (p) coordinates:

    [tau_a]   [M11 M12] [theta'']   [h1]   [0            ]
    [  0  ] = [M21 M22] [ phi'' ] + [h2] + [K phi + D phi']
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vjm.chain.virtual_links import Chain, LinkChain
from vjm.errors import ShapeError
from vjm.records import Array

_THREADS = 2
_PARALLEL_FROM = 2000  # samples below which starting threads costs more than it saves


class Mechanism:
    """One or more copies of a chain as branches of a single Pinocchio model.

    A copy is a chain of its own: many of them, perturbed or with other payloads, advance in one call.

    Attributes:
        model: the `pin.Model`; its joints are `Chain.joint_names`, suffixed `@C` for copy C when there are several.
        copies: number of chains.
        size: coordinates nv of one chain.
    """

    def __init__(self, model: pin.Model, copies: int) -> None:
        self.model = model
        self.copies = copies
        self.size = model.nv // copies

    @cached_property
    def data(self) -> pin.Data:
        """Scratch memory of single calls."""
        return self.model.createData()

    @cached_property
    def pool(self) -> pin.ModelPool:
        """Scratch memory of batched calls."""
        return pin.ModelPool(self.model, _THREADS)


def build(
    chains: Chain | Sequence[Chain],
    payload: float | Sequence[float] = 0.0,
    gravity: tuple[float, float] | None = None,
) -> Mechanism:
    """Build the Pinocchio model of one chain, or of several as separate branches.

    Args:
        chains: the chain, or copies with the same coordinates.
        payload: extra point mass on the last link's tip [kg]; for all, or one a copy.
        gravity: in the plane, (x, y) of the base frame [m/s^2]; the (first) chain's when None.

    Raises:
        ShapeError: copies whose coordinates differ, or not as many payloads as copies.
    """
    several = [chains] if isinstance(chains, Chain) else list(chains)
    sizes = {chain.size for chain in several}
    if len(sizes) != 1:
        raise ShapeError("chains", f"sizes {sorted(sizes)}", "copies with the same number of coordinates")
    model = pin.Model()
    model.gravity = pin.Motion(np.r_[several[0].gravity if gravity is None else gravity, 0.0], np.zeros(3))
    payloads = [payload] * len(several) if isinstance(payload, (int, float)) else list(payload)
    if len(payloads) != len(several):
        raise ShapeError("payload", f"{len(payloads)} of them", f"one for each of {len(several)} copies")
    for c, (chain, extra) in enumerate(zip(several, payloads, strict=True)):
        _add_chain(model, chain, extra, "" if len(several) == 1 else f"@{c}")
    return Mechanism(model, len(several))


def _virtual_links(model: pin.Model, chain: Chain, suffix: str = "") -> Iterator[tuple[int, int, int, float]]:
    """Add the chain's joints to the model, and tell where each virtual link hangs.

    Yields:
        For each virtual link in turn, and as number -1 for each hub before a root joint: its flexible link, its number
        there, the Pinocchio joint that carries it (0 where it stands still) and its distance from that joint [m].
    """
    joint, offset, turn = 0, 0.0, 0.0
    names = iter(chain.joint_names)

    def added() -> int:
        return int(model.addJoint(joint, pin.JointModelRZ(), _shift(offset, turn), next(names) + suffix))

    for i, link in enumerate(chain.links):
        if link.joint == "revolute":
            joint, offset, turn = added(), 0.0, 0.0
        if link.root_stiffness is not None:
            yield i, -1, joint, offset
            joint, offset, turn = added(), 0.0, 0.0
        for j, length in enumerate(link.lengths.tolist()):
            if j > 0:
                turn = link.rest_curvature * float(link.cells[j - 1])
                joint, offset, turn = added(), 0.0, 0.0
            yield i, j, joint, offset
            offset += length


def _add_chain(model: pin.Model, chain: Chain, payload: float, suffix: str) -> None:
    for i, j, joint, offset in _virtual_links(model, chain, suffix):
        link = chain.links[i]
        if joint == 0:
            continue
        if j < 0:
            hub = pin.Inertia(0.0, np.zeros(3), np.diag([0.0, 0.0, link.hub_inertia]))
            model.appendBodyToJoint(joint, hub, _shift(offset))
            continue
        model.appendBodyToJoint(joint, _rod(link, j, link.carried_inertia if j == 0 else 0.0), _shift(offset))
        if j == link.virtual_joints:
            tip_mass = link.payload + (payload if i == len(chain.links) - 1 else 0.0)
            tip = pin.Inertia(tip_mass, np.zeros(3), np.zeros((3, 3)))
            model.appendBodyToJoint(joint, tip, _shift(offset + float(link.lengths[j])))


def _shift(x: float, turn: float = 0.0) -> pin.SE3:
    return pin.SE3(pin.utils.rotate("z", turn), np.array([x, 0.0, 0.0]))


def _rod(link: LinkChain, j: int, hub_inertia: float) -> pin.Inertia:
    center = np.array([link.mass_centers[j], 0.0, 0.0])
    turning = float(link.inertias[j]) + hub_inertia
    return pin.Inertia(float(link.masses[j]), center, np.diag([0.0, 0.0, turning]))


def inverse_dynamics(mechanism: Mechanism, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Array:
    """Joint torques without springs and dampers, M a + h, for a whole batch (RNEA).

    Args:
        mechanism: the model.
        q, v, a: (T, nv) angles [rad], rates [rad/s], accelerations [rad/s^2].

    Returns:
        (T, nv) torques [N m].

    Raises:
        ShapeError: arrays that are not (T, nv).
    """
    rows = [_batch(name, values, mechanism.model.nv) for name, values in (("q", q), ("v", v), ("a", a))]
    count = rows[0].shape[0]
    if any(row.shape[0] != count for row in rows):
        raise ShapeError("q, v, a", [row.shape for row in rows], "the same number of samples")
    torque = np.empty((count, mechanism.model.nv))
    if count:
        threads = _THREADS if count >= _PARALLEL_FROM else 1
        # Time-first C arrays are the joint-first Fortran arrays Pinocchio wants: transposing copies nothing.
        pin.rneaInParallel(threads, mechanism.pool, rows[0].T, rows[1].T, rows[2].T, torque.T)
    return torque


def _batch(name: str, values: ArrayLike, size: int) -> Array:
    array = np.ascontiguousarray(values, dtype=float)
    if array.ndim != 2 or array.shape[1] != size:
        raise ShapeError(name, f"shape {array.shape}", f"shape (T, {size})")
    return array


def bias(mechanism: Mechanism, q: ArrayLike, v: ArrayLike) -> Array:
    """h(q, v): centrifugal, Coriolis and gravity torques (T, nv) [N m] of q, v (T, nv)."""
    return inverse_dynamics(mechanism, q, v, np.zeros_like(np.asarray(v, dtype=float)))


def mass_matrix(mechanism: Mechanism, q: ArrayLike) -> Array:
    """M(q), (T, nv, nv) [kg m^2] of q (T, nv): one batched RNEA a column."""
    angles = _batch("q", q, mechanism.model.nv)
    rest = np.zeros_like(angles)
    at_rest = inverse_dynamics(mechanism, angles, rest, rest)
    matrix = np.empty((*angles.shape, angles.shape[1]))
    for column in range(angles.shape[1]):
        unit = rest.copy()
        unit[:, column] = 1.0
        matrix[:, :, column] = inverse_dynamics(mechanism, angles, rest, unit) - at_rest
    return (matrix + np.swapaxes(matrix, 1, 2)) / 2


@dataclass(frozen=True)
class Blocks:
    """The terms of eq. (8), T samples of an arm with n_a active and n_p passive coordinates.

    Attributes:
        M11, M12, M21, M22: (T, n_a, n_a), (T, n_a, n_p), (T, n_p, n_a), (T, n_p, n_p) [kg m^2].
        h1, h2: (T, n_a), (T, n_p) [N m].
    """

    M11: Array
    M12: Array
    M21: Array
    M22: Array
    h1: Array
    h2: Array


def blocks(chain: Chain, q: ArrayLike, v: ArrayLike, payload: float = 0.0) -> Blocks:
    """M11, M12, M21, M22, h1, h2 of eq. (8) at q, v (T, nv)."""
    mechanism = build(chain, payload)
    a, p = chain.active, chain.passive
    matrix, torque = mass_matrix(mechanism, q), bias(mechanism, q, v)
    return Blocks(
        M11=matrix[:, a[:, None], a],
        M12=matrix[:, a[:, None], p],
        M21=matrix[:, p[:, None], a],
        M22=matrix[:, p[:, None], p],
        h1=torque[:, a],
        h2=torque[:, p],
    )


def mass_regressor(chain: Chain, q: ArrayLike, v: ArrayLike, a: ArrayLike, gravity: tuple[float, float]) -> Array:
    """Torques' derivative by the virtual links' masses: M a + h = regressor @ parameters.

    The planar parameters of virtual link k are its mass, first moment m c and moment of inertia about its proximal
    end, in this order, links from the base outwards; hub inertias and payloads are not among them.

    Args:
        chain: gives the lengths and the order of the joints.
        q, v, a: (T, nv) angles [rad], rates [rad/s], accelerations [rad/s^2].
        gravity: in the plane [m/s^2].

    Returns:
        (T, nv, 3 B) for B virtual links in all [N m per kg, per kg m, per kg m^2].
    """
    columns = []
    for i, link in enumerate(chain.links):
        for k in range(link.virtual_joints + 1):
            # A first moment alone is no body: it is the unit mass at 1 m, less the unit mass at 0 and the unit inertia.
            at_zero, at_one, turning = (
                inverse_dynamics(_single_body(chain, i, k, body, gravity), q, v, a) for body in _UNIT_BODIES
            )
            columns += [at_zero, at_one - at_zero - turning, turning]
    return np.stack(columns, axis=-1)


# (mass [kg], centre [m], inertia about the centre [kg m^2])
_UNIT_BODIES = ((1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _single_body(
    chain: Chain, at_link: int, at_body: int, body: tuple[float, float, float], gravity: tuple[float, float]
) -> Mechanism:
    """The chain with one virtual link replaced by `body` and all others without mass."""
    model = pin.Model()
    model.gravity = pin.Motion(np.r_[gravity, 0.0], np.zeros(3))
    mass, center, turning = body
    inertia = pin.Inertia(mass, np.array([center, 0.0, 0.0]), np.diag([0.0, 0.0, turning]))
    for i, j, joint, offset in _virtual_links(model, chain):
        if joint and (i, j) == (at_link, at_body):
            model.appendBodyToJoint(joint, inertia, _shift(offset))
    return Mechanism(model, 1)


def forward_dynamics(mechanism: Mechanism, q: Array, v: Array, torque: Array) -> Array:
    """Accelerations (C nv,) of all copies at one instant (ABA); q, v, torque (C nv,) as Pinocchio orders them."""
    result: Array = pin.aba(mechanism.model, mechanism.data, q, v, torque)
    return result


def gravity_stiffness(mechanism: Mechanism, q: ArrayLike) -> Array:
    """Derivative of the static torque by the angles, (nv, nv) [N m/rad], at q (nv,)."""
    angles = np.asarray(q, dtype=float)
    rest = np.zeros_like(angles)
    pin.computeRNEADerivatives(mechanism.model, mechanism.data, angles, rest, rest)
    return np.array(mechanism.data.dtau_dq)
