"""Rigid-body dynamics of virtual-joint chains and their torque errors: the only module that knows Pinocchio.

Equation of motion (eq. 8), split into active (a) and passive (p) coordinates:

    [tau_a]   [M11 M12] [theta'']   [h1]   [0            ]
    [  0  ] = [M21 M22] [ phi'' ] + [h2] + [K phi + D phi']
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property, lru_cache

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vjm.chain.virtual_links import Chain
from vjm.errors import ShapeError
from vjm.records import NO_PAYLOAD, Array, Payload

_THREADS = 2
_PARALLEL_FROM = 20_000  # samples below which starting threads costs more than it saves


class RigidBodies:
    """Rigid-body terms of a Pinocchio model in batches, without springs and dampers.

    Attributes:
        model: the `pin.Model`.
        base_weight: along the first coordinate [N]; a moving base's spring carries it where its displacement is zero.
    """

    base_weight = 0.0

    def __init__(self, model: pin.Model) -> None:
        self.model = model

    @cached_property
    def _data(self) -> pin.Data:
        return self.model.createData()

    @cached_property
    def _pool(self) -> pin.ModelPool:
        return pin.ModelPool(self.model, _THREADS)

    def inverse_dynamics(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Array:
        """Return joint torques without springs and dampers, M a + h (T, nv) [N m], for a whole batch (RNEA).

        The batch is of positions q (T, nq) [rad], rates v [rad/s] and accelerations a [rad/s^2], each (T, nv).

        Raises:
            ShapeError: arrays that are not (T, nv).
        """
        sizes = self.model.nq, self.model.nv, self.model.nv
        batches = [self._batch(*arguments) for arguments in zip(("q", "v", "a"), (q, v, a), sizes, strict=True)]
        count = len(batches[0])
        if any(len(batch) != count for batch in batches):
            raise ShapeError("q, v, a", [batch.shape for batch in batches], "the same number of samples")
        torque = np.empty((count, self.model.nv))
        if count:
            threads = _THREADS if count >= _PARALLEL_FROM else 1
            # Time-first C arrays are the joint-first Fortran arrays Pinocchio wants: transposing copies nothing.
            pin.rneaInParallel(threads, self._pool, *(batch.T for batch in batches), torque.T)
        if self.base_weight:
            torque[:, 0] += self.base_weight
        return torque

    @staticmethod
    def _batch(name: str, values: ArrayLike, size: int) -> Array:
        array = np.ascontiguousarray(values, dtype=float)
        if array.ndim != 2 or array.shape[1] != size:
            raise ShapeError(name, f"shape {array.shape}", f"shape (T, {size})")
        return array

    def derivatives(self, q: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        """Return the derivatives of M a + h by q, v and a, each (T, nv, nv), for a batch of q (T, nq), v and a (T, nv).

        Source: J. Carpentier and N. Mansard, Analytical derivatives of rigid body dynamics algorithms, RSS 2018.
        """
        by_angle, by_rate, inertia = np.empty((3, *v.shape, v.shape[1]))
        model, data = self.model, self._data
        for k, state in enumerate(zip(q, v, a, strict=True)):
            by_angle[k], by_rate[k], inertia[k] = pin.computeRNEADerivatives(model, data, *state)
        return by_angle, by_rate, _symmetric(inertia)

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Return M(q), (T, nv, nv) [kg m^2], at q (T, nq) (CRBA)."""
        angles = self._batch("q", q, self.model.nq)
        matrix = np.empty((len(angles), self.model.nv, self.model.nv))
        for k, state in enumerate(angles):
            matrix[k] = pin.crba(self.model, self._data, state)
        return _symmetric(matrix)

    def forward_dynamics(self, q: Array, v: Array, torque: Array, out: Array | None = None) -> Array:
        """Return accelerations (T, nv) [rad/s^2] of a batch (ABA), from q (T, nq), v and torque (T, nv).

        They are in `out` if it is given.
        """
        acceleration = np.empty(v.shape) if out is None else out
        if self.base_weight:
            torque = torque - self.base_weight * (np.arange(v.shape[1]) == 0)
        pin.abaInParallel(1, self._pool, q.T, v.T, torque.T, acceleration.T)
        return acceleration

    def gravity_stiffness(self, q: ArrayLike) -> Array:
        """Return the derivative of the static torque by the angles, (nv, nv) [N m/rad], at q (nq,)."""
        angles, zero = np.asarray(q, dtype=float), np.zeros(self.model.nv)
        pin.computeRNEADerivatives(self.model, self._data, angles, zero, zero)
        return np.array(self._data.dtau_dq)


def _symmetric(matrices: Array) -> Array:
    """Return the symmetric matrices (T, n, n) of their upper triangles, which are all that Pinocchio fills."""
    upper = np.triu(matrices)
    return upper + np.swapaxes(np.triu(upper, 1), 1, 2)


class Mechanism(RigidBodies):
    """A chain as a Pinocchio model: its rigid-body terms, without springs and dampers.

    Args:
        chain: the chain.
        payload: extra body on the last link's tip.
        gravity: in the plane, (x, y) of the base frame [m/s^2]; the chain's when None.

    Attributes:
        model: the `pin.Model`; its joints are `Chain.joint_names`.
    """

    def __init__(self, chain: Chain, payload: Payload = NO_PAYLOAD, gravity: tuple[float, float] | None = None) -> None:
        super().__init__(pin.Model())
        self.model.gravity = pin.Motion(np.r_[chain.gravity if gravity is None else gravity, 0.0], np.zeros(3))
        _add_chain(self.model, chain, payload)
        if chain.armature:
            armature = np.zeros(self.model.nv)
            armature[chain.active] = chain.armature
            self.model.armature = armature
        if chain.base is not None:
            self.base_weight = float(pin.computeTotalMass(self.model) * self.model.gravity.linear[:2] @ chain.base.axis)


@lru_cache(maxsize=256)
def mechanism_of(chain: Chain, payload: Payload = NO_PAYLOAD, gravity: tuple[float, float] | None = None) -> Mechanism:
    """Return the mechanism of a chain; the last ones are remembered."""
    return Mechanism(chain, payload, gravity)


def _add_chain(model: pin.Model, chain: Chain, payload: Payload) -> None:
    """Add a chain's joints and bodies; what stands still has no body."""
    joint, offset, angle = 0, 0.0, 0.0  # the joint that carries the next body, its distance and heading from there
    names = iter(chain.joint_names)

    def add_joint(kind: pin.JointModel | None = None) -> int:
        return int(model.addJoint(joint, kind or pin.JointModelRZ(), _placement(offset, angle), next(names)))

    def add_body(mass: float, center: float, inertia: float) -> None:
        if joint:
            body = pin.Inertia(mass, np.array([center, 0.0, 0.0]), np.diag([0.0, 0.0, inertia]))
            model.appendBodyToJoint(joint, body, _placement(offset))

    if chain.base is not None:
        joint = add_joint(pin.JointModelPrismaticUnaligned(np.r_[chain.base.axis, 0.0]))
        add_body(chain.base.mass, 0.0, 0.0)
    for i, link in enumerate(chain.links):
        before, after = link.radii
        if link.joint == "revolute":
            joint, offset, angle = add_joint(), before, 0.0
        if link.root_stiffness is not None:
            add_body(0.0, 0.0, link.hub_inertia)
            joint, offset, angle = add_joint(), after, 0.0
        for j, length in enumerate(link.lengths.tolist()):
            if j > 0:
                angle = link.rest_curvature * float(link.cells[j - 1])
                joint, offset, angle = add_joint(), 0.0, 0.0
            carried_inertia = link.carried_inertia if j == 0 else 0.0
            add_body(float(link.masses[j]), float(link.mass_centers[j]), float(link.inertias[j]) + carried_inertia)
            offset += length
        add_body(*link.payload_body)
        add_body(*(payload if i == len(chain.links) - 1 else NO_PAYLOAD))


def _placement(x: float, angle: float = 0.0) -> pin.SE3:
    return pin.SE3(pin.utils.rotate("z", angle), np.array([x, 0.0, 0.0]))


def torque_errors(
    chain: Chain,
    q: ArrayLike,
    v: ArrayLike,
    a: ArrayLike,
    torque: ArrayLike,
    payload: Payload = NO_PAYLOAD,
    gravity: tuple[float, float] | None = None,
) -> Array:
    """Return active and passive torque errors (eq. 14), (T, nv) in the chain's order [N m], from one batched RNEA.

    tau_ea = tau_a - M11 theta'' - M12 phi'' - h1 and tau_ep = -(M21 theta'' + M22 phi'' + h2 + K phi + D phi').

    Args:
        chain: the arm.
        q, v, a: (T, nv) angles [rad], rates [rad/s], accelerations [rad/s^2].
        torque: (T, n_a) active joint torques [N m]; NaN where not measured, as errors of these rows are.
        payload: extra body on the tip.
        gravity: in the plane [m/s^2]; the chain's when None.

    Raises:
        ShapeError: arrays that do not fit the chain.
    """
    applied = np.asarray(torque, dtype=float)
    if applied.ndim != 2 or applied.shape[1] != chain.active.size:
        raise ShapeError("torque", f"shape {applied.shape}", f"shape (T, {chain.active.size})")
    inertial = Mechanism(chain, payload, gravity).inverse_dynamics(q, v, a)
    errors: Array = -(inertial + chain.stiffness * np.asarray(q) + chain.damping * np.asarray(v))
    errors[:, chain.active] += applied
    return errors


def objective(weighted_errors: Iterable[ArrayLike]) -> float:
    """Return J of eq. (15), here as a mean: of the squares of all weighted torque errors.

    Args:
        weighted_errors: for each recording, (T, m) errors times F^T, where the weight W = F^T F is the inverse of their
            noise covariance, so in units of the noise; NaN where no torque is measured, which counts nothing.
    """
    values = np.concatenate([np.ravel(errors) for errors in weighted_errors])
    return float(np.mean(values[np.isfinite(values)] ** 2))
