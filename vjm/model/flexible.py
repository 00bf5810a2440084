"""Any Pinocchio model with springs and dampers in some of its joints: dynamics, equilibrium, modes, linearisation.

    M(q) a + h(q, v) + K q + D v = tau + p + sum of J^T w        (eq. 8, for any tree of joints)

with the stiffness K, the damping D, the spring's torques p at zero displacement (mostly none) and loads w.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vjm.errors import (
    ChoiceError,
    MissingPackageError,
    ModelFileError,
    ShapeError,
    require,
    require_choice,
    require_kind,
)
from vjm.experiment.arrays import number_array
from vjm.model.dynamics import RigidBodies
from vjm.model.modes import EquilibriumStatus, Modes, balance, modes_of
from vjm.model.urdf_document import FlexibleLink, UrdfDocument, flexible_links_of, springs_of
from vjm.records import Array, Indices

if TYPE_CHECKING:
    import control

Loads = Mapping[str, ArrayLike]  # by frame: a force (3,) [N], or force and moment (6,) [N, N m], in the world's axes
Coordinates = str | Sequence[str]  # `all`, `active`, `passive`, or names


@dataclass(frozen=True)
class StaticEquilibrium:
    """A posture in which the passive joints rest, the active ones held.

    Attributes:
        q: (nq,) configuration.
        torque: (n_a,) that holds the active joints [N m].
        status: `converged`; `unstable`: in balance, but about to buckle or fall over; `stalled`, `iterations`: none.
        iterations: steps of Newton's method.
        residual: largest torque out of balance at a passive joint [N m].
    """

    q: Array
    torque: Array
    status: EquilibriumStatus
    iterations: int
    residual: float

    @property
    def converged(self) -> bool:
        """Return True if this is a stable position of rest."""
        return self.status == "converged"


@dataclass(frozen=True)
class StateSpace:
    """Linear model x' = A x + B u, y = C x of deviations from a posture, x = (q, v) of the chosen coordinates.

    Attributes:
        A: (2m, 2m).
        B: (2m, inputs).
        C: (outputs, 2m).
        states, inputs, outputs: their names.
        q: (nq,) the posture.
    """

    A: Array
    B: Array
    C: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    q: Array

    def control(self) -> control.StateSpace:
        """Return the same as a `control.StateSpace` of the package python-control.

        Raises:
            MissingPackageError: the package is not installed.
        """
        try:
            import control
        except ImportError as error:
            raise MissingPackageError("control", "a control.StateSpace", "pip install control") from error
        D = np.zeros((len(self.outputs), len(self.inputs)))
        names = {"states": list(self.states), "inputs": list(self.inputs), "outputs": list(self.outputs)}
        return control.ss(self.A, self.B, self.C, D, **names)


class CasadiFunctions(NamedTuple):
    """Dynamics as functions of CasADi, to be called with symbols or numbers.

    Attributes:
        inverse_dynamics: (q, v, a) to tau (nv,).
        forward_dynamics: (q, v, tau) to a (nv,).
        spring_torques: (q, v) to what springs and dampers exert (nv,).
    """

    inverse_dynamics: Any
    forward_dynamics: Any
    spring_torques: Any


class FlexibleModel:
    """A Pinocchio model with springs and dampers.

    Args:
        model: the `pin.Model`; it is copied. Its gravity and armature count.
        stiffness: K of each velocity coordinate (nv,) [N m/rad], or of each of `joints`; one value for all.
        damping: D [N m s/rad], likewise.
        joints: names of the joints that stiffness and damping are of; they are the passive ones.
        passive: names of the passive joints, which no motor drives (default: `joints`, else those with stiffness).
        preload: (nv,) torque of the springs at zero displacement [N m].
        cells: by joint, the length of link whose bending it stands for [m], for strains.
        links: flexible links, whose virtual joints share a material.

    Attributes:
        model: the `pin.Model`.
        stiffness, damping, preload: (nv,).
        active, passive: indices of velocity coordinates.
        names: of the velocity coordinates: their joints', with a number where a joint has several.
        cells: by joint [m].
        links: of `vjm flexify`.

    Raises:
        ShapeError: arrays that do not fit, a value below zero, a spring at a joint that has no angle.
        ChoiceError: no such joint.
    """

    def __init__(
        self,
        model: pin.Model,
        stiffness: ArrayLike,
        damping: ArrayLike = 0.0,
        joints: Sequence[str] | None = None,
        *,
        passive: Sequence[str] | None = None,
        preload: ArrayLike = 0.0,
        cells: Mapping[str, float] | None = None,
        links: Sequence[FlexibleLink] = (),
    ) -> None:
        require_kind("model", model, pin.Model, "a pin.Model")
        require_kind("cells", cells, (Mapping, NoneType), "lengths [m] by joint, in a dictionary")
        valid = isinstance(links, Sequence) and all(isinstance(link, FlexibleLink) for link in links)
        require("links", links, valid, "the links of another FlexibleModel")
        self.model = pin.Model(model)
        for number, name in enumerate(model.names):  # for loads and markers; models built in code may lack them
            if not self.model.existFrame(name):
                self.model.addJointFrame(number)
        self.names = tuple(
            name if joint.nv == 1 else f"{name}[{k}]"
            for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True)  # after the universe
            for k in range(joint.nv)
        )
        chosen = np.arange(model.nv) if joints is None else self._indices("joints", joints)
        self.stiffness = self._of_coordinates("stiffness", stiffness, chosen)
        self.damping = self._of_coordinates("damping", damping, chosen)
        self.preload = self._of_coordinates("preload", preload, np.arange(model.nv), low=-np.inf)
        if passive is None and joints is None:
            self.passive: Indices = np.flatnonzero(self.stiffness)
        else:
            self.passive = np.unique(self._indices("passive", joints or () if passive is None else passive))
        self.active: Indices = np.setdiff1d(np.arange(model.nv), self.passive)
        self.cells, self.links = dict(cells or {}), tuple(links)
        # Positions of coordinates in q: q itself, or the angle of a cosine and a sine; a free body has none.
        self._place = np.full(model.nv, -1)
        self._circular = np.zeros(model.nv, dtype=bool)
        for joint in list(model.joints)[1:]:
            if joint.nv == joint.nq:
                self._place[joint.idx_v : joint.idx_v + joint.nv] = np.arange(joint.idx_q, joint.idx_q + joint.nq)
            elif joint.nv == 1:
                self._place[joint.idx_v], self._circular[joint.idx_v] = joint.idx_q, True
        for k in np.flatnonzero(
            (self._place < 0) & ((self.stiffness != 0) | np.isin(np.arange(model.nv), self.passive))
        ):
            raise ShapeError(
                f"joint {self.names[k]}", "a spring", "none at a joint whose several angles do not form a vector"
            )

    @classmethod
    def from_urdf(
        cls, urdf: Path | str, root: pin.JointModel | None = None, gravity: ArrayLike | None = None
    ) -> FlexibleModel:
        """Read a URDF that `vjm flexify` or `vjm urdf` has written, or its text.

        Stiffness, rotor inertia and gravity are in its `vjm:model`, damping is at its joints. Joints with a spring are
        passive, but the motors of an identified arm.

        Args:
            urdf: the file, or its text.
            root: joint between world and robot, as `pin.JointModelFreeFlyer()` (default: fixed).
            gravity: (3,) in the world [m/s^2] (default: the identified arm's, else 9.81 against z).

        Raises:
            ModelFileError: no URDF, or one without springs.
            ShapeError: gravity that is no vector, or a root that is no joint.
        """
        valid = root is None or callable(getattr(root, "shortname", None))
        require("root", root, valid, "a joint such as pin.JointModelFreeFlyer()")
        document = UrdfDocument.read(urdf)
        springs = springs_of(document)
        extension = document.robot.first("vjm:model")
        if extension is None or not springs:
            raise document.fault("it has no springs (element vjm:model)", "a URDF of vjm flexify or vjm urdf")
        try:
            model = pin.buildModelFromXML(document.text, *(() if root is None else (root,)))
        except ValueError as error:
            raise ModelFileError(document.name, f"Pinocchio cannot read it ({error})", "a URDF") from error
        if gravity is None and "gravity" in extension.attributes:  # of an identified arm, in its plane
            gravity = np.r_[document.numbers(extension.attributes["gravity"], "gravity", 2), 0.0]
        if gravity is not None:
            vector = number_array("gravity", gravity)
            if vector.shape != (3,) or not np.isfinite(vector).all():
                raise ShapeError("gravity", gravity, "three finite numbers [m/s^2]")
            model.gravity = pin.Motion(vector, np.zeros(3))
        stiffness, armature, damping = np.zeros(model.nv), np.array(model.armature), np.array(model.damping)
        for spring in springs:
            stiffness[model.joints[model.getJointId(spring.joint)].idx_v] = spring.stiffness
        for element in extension.all("vjm:flexible_joint"):
            rotor = document.numbers(element.attributes.get("rotor_inertia", "0"), "rotor_inertia", 1)[0]
            armature[model.joints[model.getJointId(element.attributes["name"])].idx_v] += rotor
        model.armature = armature
        preload = np.zeros(model.nv)
        if extension.first("vjm:base_slide") is not None:  # its spring carries the weight at zero
            k = model.joints[model.getJointId("base_slide")].idx_v
            preload[k] = pin.computeGeneralizedGravity(model, model.createData(), pin.neutral(model))[k]
        passive = [spring.joint for spring in springs if not spring.driven]
        cells = {spring.joint: spring.cell for spring in springs if spring.cell is not None}
        links = flexible_links_of(document)
        return cls(model, stiffness, damping, passive=passive, preload=preload, cells=cells, links=links)

    def indices(self, coordinates: Coordinates) -> Indices:
        """Return indices of velocity coordinates: `all`, `active`, `passive`, or by names, those of whole joints too.

        Raises:
            ChoiceError: no such joint.
            ShapeError: neither text nor names.
        """
        return self._indices("coordinates", coordinates)

    def _indices(self, argument: str, coordinates: Coordinates) -> Indices:
        require_kind(argument, coordinates, Iterable, "all, active, passive, or a list of joints' names")
        if isinstance(coordinates, str):
            if coordinates not in ("all", "active", "passive"):
                raise ChoiceError(argument, coordinates, ("all", "active", "passive", "a list of names"))
            all_indices: Indices = np.arange(self.model.nv)
            return all_indices if coordinates == "all" else np.array(getattr(self, coordinates))
        selected: list[int] = []
        for name in coordinates:
            require_kind(argument, name, str, "names of joints")
            matches = [
                k for k, coordinate in enumerate(self.names) if name in (coordinate, coordinate.partition("[")[0])
            ]
            if not matches:
                raise ChoiceError("joint", name, self.names)
            selected += matches
        return np.array(selected, dtype=np.intp)

    def _of_coordinates(self, name: str, value: ArrayLike, chosen: Indices, low: float = 0.0) -> Array:
        values = number_array(name, value)
        if values.shape not in ((), (chosen.size,)):
            raise ShapeError(name, f"shape {values.shape}", f"one value, or shape ({chosen.size},)")
        if not np.isfinite(values).all() or (values < low).any():
            raise ShapeError(name, values.tolist(), "finite values, none negative")
        result = np.zeros(self.model.nv)
        result[chosen] = values
        return result

    @cached_property
    def _rigid(self) -> RigidBodies:
        return RigidBodies(self.model)

    @cached_property
    def _data(self) -> pin.Data:
        return self.model.createData()

    def _rows(self, **vectors: ArrayLike) -> tuple[bool, list[Array]]:
        """Return whether single vectors are given, and all as batches (T, n): q of nq numbers, others of nv."""
        arrays = {name: number_array(name, values) for name, values in vectors.items()}
        single = all(array.ndim == 1 for array in arrays.values())
        batches = []
        for name, array in arrays.items():
            size = self.model.nq if name == "q" else self.model.nv
            if name == "torque" and array.shape[-1:] == (self.active.size,) and self.active.size != size:
                array = self._spread(array)
            if array.ndim not in (1, 2) or array.shape[-1] != size:
                raise ShapeError(name, f"shape {array.shape}", f"shape ({size},) or (T, {size})")
            batches.append(np.ascontiguousarray(np.atleast_2d(array)))
        count = max(len(batch) for batch in batches)
        if any(len(batch) not in (1, count) for batch in batches):
            raise ShapeError(", ".join(vectors), [len(batch) for batch in batches], "the same number of samples")
        return single, [np.ascontiguousarray(np.broadcast_to(batch, (count, batch.shape[1]))) for batch in batches]

    def _spread(self, torque: Array) -> Array:
        """Return torques of all coordinates (..., nv) from those of the active ones (..., n_a)."""
        all_torques = np.zeros((*torque.shape[:-1], self.model.nv))
        all_torques[..., self.active] = torque
        return all_torques

    def displacements(self, q: ArrayLike) -> Array:
        """Return angles (nv,) or (T, nv) [rad] of the coordinates from zero; zero for joints that have none."""
        single, (batch,) = self._rows(q=q)
        angles = np.where(self._place >= 0, batch[:, self._place], 0.0)
        if self._circular.any():
            place = self._place[self._circular]
            angles[:, self._circular] = np.arctan2(batch[:, place + 1], batch[:, place])
        return np.asarray(angles[0] if single else angles)

    def configuration(self, displacements: ArrayLike) -> Array:
        """Return q (nq,) or (T, nq) at angles (nv,) or (T, nv) [rad] of the coordinates from zero: their inverse."""
        single, (angles,) = self._rows(displacements=displacements)
        q = np.tile(pin.neutral(self.model), (len(angles), 1))
        for k in np.flatnonzero(self._place >= 0):
            place, angle = self._place[k], angles[:, k]
            if self._circular[k]:
                q[:, place], q[:, place + 1] = np.cos(angle), np.sin(angle)
            else:
                q[:, place] = angle
        return q[0] if single else q

    def spring_torques(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return what springs and dampers exert, p - K q - D v (nv,) or (T, nv) [N m] (eq. 8).

        Args:
            q: (nq,) or (T, nq).
            v: (nv,) or (T, nv).
        """
        single, (positions, rates) = self._rows(q=q, v=v)
        torque = self.preload - self.stiffness * self.displacements(positions) - self.damping * rates
        return np.asarray(torque[0] if single else torque)

    def spring_torque_derivatives(self) -> tuple[Array, Array]:
        """Return the derivatives of `spring_torques` by q and v, -K and -D (nv, nv), the same everywhere (eq. 8)."""
        return -np.diag(self.stiffness), -np.diag(self.damping)

    def inverse_dynamics(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Array:
        """Return tau = M a + h + K q + D v - p (nv,) or (T, nv) [N m], zero at passive joints of a free motion (RNEA).

        Source: R. Featherstone, Rigid Body Dynamics Algorithms, 2008, section 5.3; eq. 8.

        Args:
            q: (nq,) or (T, nq).
            v, a: (nv,) or (T, nv).
        """
        single, batches = self._rows(q=q, v=v, a=a)
        torque = self._rigid.inverse_dynamics(*batches) - self.spring_torques(batches[0], batches[1])
        return np.asarray(torque[0] if single else torque)

    def forward_dynamics(self, q: ArrayLike, v: ArrayLike, torque: ArrayLike) -> Array:
        """Return a = M^-1 (tau + p - h - K q - D v) (nv,) or (T, nv) [rad/s^2] (ABA).

        Source: R. Featherstone, Rigid Body Dynamics Algorithms, 2008, section 7.3; eq. 8.

        Args:
            q: (nq,) or (T, nq).
            v: (nv,) or (T, nv).
            torque: of all coordinates (..., nv), or of the active ones (..., n_a) [N m].
        """
        single, (q, v, torque) = self._rows(q=q, v=v, torque=torque)
        acceleration = self._rigid.forward_dynamics(q, v, torque + self.spring_torques(q, v))
        return np.asarray(acceleration[0] if single else acceleration)

    def inverse_dynamics_derivatives(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> tuple[Array, Array, Array]:
        """Return the derivatives of tau by q, v and a, each (nv, nv) or (T, nv, nv): d(M a + h)/dq + K, dh/dv + D, M.

        By q means by a small turn of each coordinate (the tangent space, as in Pinocchio). Source: J. Carpentier and N.
        Mansard, Analytical derivatives of rigid body dynamics algorithms, RSS 2018.
        """
        single, batches = self._rows(q=q, v=v, a=a)
        by_q, by_v, M = self._rigid.derivatives(*batches)
        parts = by_q + np.diag(self.stiffness), by_v + np.diag(self.damping), M
        return tuple(part[0] if single else part for part in parts)  # type: ignore[return-value]

    def forward_dynamics_derivatives(self, q: ArrayLike, v: ArrayLike, torque: ArrayLike) -> tuple[Array, Array, Array]:
        """Return the derivatives of a by q, v and tau, each (nv, nv) or (T, nv, nv).

        They are -M^-1 dtau/dq, -M^-1 dtau/dv and M^-1, with those of `inverse_dynamics_derivatives` at the acceleration
        of the motion (J. Carpentier and N. Mansard, RSS 2018, section IV).
        """
        single, (q, v, torque) = self._rows(q=q, v=v, torque=torque)
        by_q, by_v, M = self.inverse_dynamics_derivatives(q, v, self.forward_dynamics(q, v, torque))
        inverse = np.linalg.inv(M)
        parts = -inverse @ by_q, -inverse @ by_v, inverse
        return tuple(part[0] if single else part for part in parts)  # type: ignore[return-value]

    def load_torques(self, q: ArrayLike, loads: Loads) -> tuple[Array, Array]:
        """Return the joint torques of loads, sum of J^T w (nv,) [N m], and their derivative by q (nv, nv) [N m/rad].

        Forces act at the frames' origins and keep their direction in the world. With S_k the screw of coordinate k in
        the world, dS_k/dq_i = S_i x S_k for a coordinate i before k, and the point of the force moves with its Jacobian
        (R. Featherstone, Rigid Body Dynamics Algorithms, 2008, section 2.9).

        Raises:
            ChoiceError: no such frame.
            ShapeError: no force (3,), or force and moment (6,).
        """
        require_kind("loads", loads, Mapping, "forces (3,) [N] by frame, in a dictionary")
        model, data = self.model, self._data
        torque, slope = np.zeros(model.nv), np.zeros((model.nv, model.nv))
        if not loads:
            return torque, slope
        pin.computeJointJacobians(model, data, self._rows(q=q)[1][0][0])
        pin.updateFramePlacements(model, data)
        for name, load in loads.items():
            wrench, frame = number_array(f"loads[{name!r}]", load), self._frame(name)
            if wrench.shape not in ((3,), (6,)) or not np.isfinite(wrench).all():
                raise ShapeError(f"loads[{name!r}]", wrench.tolist(), "force [N] (3,), or force and moment (6,)")
            force, moment = wrench[:3], wrench[3:] if wrench.size == 6 else np.zeros(3)
            chain = [model.joints[j] for j in model.supports[model.frames[frame].parentJoint] if j]
            k = np.concatenate([np.arange(j.idx_v, j.idx_v + j.nv) for j in chain]) if chain else np.empty(0, int)
            v, w = data.J[:3, k].T, data.J[3:, k].T  # (m, 3) of each screw, at the world's origin
            at_point = v + np.cross(w, data.oMf[frame].translation)
            torque[k] += at_point @ force + w @ moment
            # Of screw k by coordinate i, (i, k, 3), where i is nearer to the base; and of the force's point.
            before = np.triu(np.ones((k.size, k.size)), 1)[:, :, None]
            by_w = np.cross(w[:, None], w[None]) * before
            by_v = (np.cross(w[:, None], v[None]) + np.cross(v[:, None], w[None])) * before
            by_v = by_v + np.cross(by_w, data.oMf[frame].translation) + np.cross(w[None], at_point[:, None])
            slope[np.ix_(k, k)] += (by_v @ force + by_w @ moment).T
        return torque, slope

    def static_equilibrium(self, q: ArrayLike, loads: Loads | None = None) -> StaticEquilibrium:
        """Find where the passive joints rest under gravity and loads, the active ones held: g + K q - p = J^T w.

        Newton's method with a line search (`vjm.model.modes.balance`); where it does not converge, the status of the
        result says so, and nothing is raised.

        Args:
            q: (nq,) configuration: the active joints', and where the search starts.
            loads: by frame, a force (3,) [N] or force and moment (6,) [N, N m], constant in the world's axes.
        """
        start, passive, zero = self._rows(q=q)[1][0][0], self.passive, np.zeros(self.model.nv)

        def configuration(turns: Array) -> Array:
            step = zero.copy()
            step[passive] = turns
            return np.asarray(pin.integrate(self.model, start, step))

        def unbalanced(turns: Array) -> Array:
            posture = configuration(turns)
            return (
                self.inverse_dynamics(posture, zero, zero)
                - self.load_torques(posture, {} if loads is None else loads)[0]
            )

        def tangent(turns: Array) -> Array:
            return self._tangent_stiffness(configuration(turns), loads)[np.ix_(passive, passive)]

        solution = balance(lambda turns: unbalanced(turns)[passive], tangent, np.zeros(passive.size))
        torque = unbalanced(solution.position)[self.active]
        return StaticEquilibrium(
            configuration(solution.position), torque, solution.status, solution.iterations, solution.residual
        )

    def _tangent_stiffness(self, q: Array, loads: Loads | None) -> Array:
        """Return dg/dq + K - d(J^T w)/dq (nv, nv) [N m/rad]."""
        slope = self._rigid.gravity_stiffness(q) + np.diag(self.stiffness)
        return np.asarray(slope - self.load_torques(q, {} if loads is None else loads)[1])

    def linearise(
        self, q: ArrayLike, loads: Loads | None = None, coordinates: Coordinates = "all"
    ) -> tuple[Array, Array, Array]:
        """Return M, D and K (m, m) of M dq'' + D dq' + K dq = dtau about a posture at rest, of the chosen coordinates.

        K is the derivative of g + K q - J^T w: gravity and loads stiffen or soften. Where the posture is no
        `static_equilibrium`, further torques are taken to hold it; coordinates not chosen are held. Source: L.
        Meirovitch, Fundamentals of Vibrations, 2001, section 7.1.
        """
        (posture,), chosen = self._rows(q=q)[1][0], self.indices(coordinates)
        M = self._rigid.mass_matrix(posture[None])[0]
        block = np.ix_(chosen, chosen)
        return M[block], np.diag(self.damping)[block], self._tangent_stiffness(posture, loads)[block]

    def modes(self, q: ArrayLike, loads: Loads | None = None, coordinates: Coordinates = "passive") -> Modes:
        """Return natural modes about a posture: K u = omega^2 M u, of the chosen coordinates, the others held.

        With `coordinates="all"` motors turn freely. Source: L. Meirovitch, Fundamentals of Vibrations, 2001, chapter 7.
        """
        M, D, K = self.linearise(q, loads, coordinates)
        return modes_of(M, D, (K + K.T) / 2)

    def state_space(
        self,
        q: ArrayLike,
        *,
        loads: Loads | None = None,
        coordinates: Coordinates = "all",
        inputs: Coordinates = "active",
        markers: Mapping[str, str | tuple[str, ArrayLike]] | None = None,
        encoders: Coordinates = (),
        strains: Mapping[str, tuple[str, float]] | None = None,
        outputs: Mapping[str, ArrayLike] | None = None,
    ) -> StateSpace:
        """Return the linear model about a posture at rest, from torques to markers, encoders and strains.

        A = [0 1; -M^-1 K, -M^-1 D], B = [0; M^-1 S], C = [J 0] with M, D, K of `linearise` (B. Siciliano et al.,
        Robotics, 2009, appendix C; J is the frame's Jacobian). Strain at a distance d from the neutral axis is
        d kappa = d phi / cell.

        Args:
            q: (nq,) the posture; of a `static_equilibrium`, if deviations are to be from a rest.
            loads: as of `static_equilibrium`.
            coordinates: whose motion it has; the others are held.
            inputs: coordinates on which torques act.
            markers: by name, a frame, or a frame and a point in it (3,) [m]: outputs `NAME.x`, `.y`, `.z` [m].
            encoders: coordinates measured [rad].
            strains: by name, a joint with a cell and the gauge's distance d from the neutral axis [m].
            outputs: by name, the derivative (nv,) by q of anything else, such as an identified arm's markers
                (`Model.marker_slopes`).

        Raises:
            ChoiceError: no such joint or frame; a strain at a joint without a cell.
            ShapeError: an output that is no vector of nv numbers.
        """
        posture, chosen, driven = self._rows(q=q)[1][0][0], self.indices(coordinates), self._indices("inputs", inputs)
        M, D, K = self.linearise(posture, loads, coordinates)
        rows: dict[str, Array] = {}
        for argument, value in {"markers": markers, "strains": strains, "outputs": outputs}.items():
            require_kind(argument, value, (Mapping, NoneType), "a dictionary by the outputs' names")
        for name, place in (markers or {}).items():
            frame, point = (place, np.zeros(3)) if isinstance(place, str) else place
            for axis, row in zip("xyz", self.point_jacobian(posture, frame, point), strict=True):
                rows[f"{name}.{axis}"] = row
        unit = np.eye(self.model.nv)
        rows |= {self.names[k]: unit[k] for k in self._indices("encoders", encoders)}
        for name, (joint, distance) in (strains or {}).items():
            if joint not in self.cells:
                raise ChoiceError("joint with a cell", joint, self.cells or ["none"])
            rows[name] = distance / self.cells[joint] * unit[self.indices([joint])[0]]
        for name, coefficients in (outputs or {}).items():
            rows[name] = number_array(f"outputs[{name!r}]", coefficients)
            if rows[name].shape != (self.model.nv,):
                raise ShapeError(f"outputs[{name!r}]", f"shape {rows[name].shape}", f"shape ({self.model.nv},)")
        size = chosen.size
        inverse, zero = np.linalg.inv(M), np.zeros((size, size))
        C = np.array(list(rows.values())).reshape(-1, self.model.nv)[:, chosen]
        names = [self.names[k] for k in chosen]
        return StateSpace(
            A=np.block([[zero, np.eye(size)], [-inverse @ K, -inverse @ D]]),
            B=np.vstack([np.zeros((size, driven.size)), inverse @ unit[np.ix_(chosen, driven)]]),
            C=np.hstack([C, np.zeros_like(C)]),
            states=(*names, *(f"{name}'" for name in names)),
            inputs=tuple(self.names[k] for k in driven),
            outputs=tuple(rows),
            q=posture,
        )

    def point_jacobian(self, q: ArrayLike, frame: str, point: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Return the derivative of the position of a point of a frame, in the world, by q (3, nv) [m/rad]."""
        offset = number_array("point", point)
        if offset.shape != (3,):
            raise ShapeError("point", f"shape {offset.shape}", "shape (3,)")
        posture, number = self._rows(q=q)[1][0][0], self._frame(frame)
        J = pin.computeFrameJacobian(self.model, self._data, posture, number, pin.LOCAL_WORLD_ALIGNED)
        pin.updateFramePlacement(self.model, self._data, number)
        arm = self._data.oMf[number].rotation @ offset
        return np.asarray(J[:3] - pin.skew(arm) @ J[3:])

    def _frame(self, name: str) -> int:
        require_choice("frame", name, [frame.name for frame in self.model.frames])
        return int(self.model.getFrameId(name))

    def casadi(self) -> CasadiFunctions:
        """Return the dynamics as CasADi functions, by `pinocchio.casadi` (eq. 8).

        Raises:
            MissingPackageError: CasADi, or a Pinocchio built with it, is absent.
        """
        try:
            import casadi
            import pinocchio.casadi as cpin
        except ImportError as error:
            remedy = "PyPI's pin has no CasADi: conda install -c conda-forge pinocchio casadi"
            raise MissingPackageError(error.name or "pinocchio.casadi", "CasADi expressions", remedy) from error
        model = cpin.Model(self.model)
        data = model.createData()
        q, v = casadi.SX.sym("q", model.nq), casadi.SX.sym("v", model.nv)
        a, tau = casadi.SX.sym("a", model.nv), casadi.SX.sym("tau", model.nv)
        angles = cpin.difference(model, casadi.SX(pin.neutral(self.model)), q)
        preload, K, D = map(casadi.DM, (self.preload, self.stiffness, self.damping))
        spring = preload - K * angles - D * v
        motion = cpin.rnea(model, data, q, v, a) - spring
        acceleration = cpin.aba(model, data, q, v, tau + spring)
        return CasadiFunctions(
            casadi.Function("inverse_dynamics", [q, v, a], [motion], ["q", "v", "a"], ["tau"]),
            casadi.Function("forward_dynamics", [q, v, tau], [acceleration], ["q", "v", "tau"], ["a"]),
            casadi.Function("spring_torques", [q, v], [spring], ["q", "v"], ["tau"]),
        )
