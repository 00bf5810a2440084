"""Stiffness and damping of a robot's virtual joints from 3D markers, by torque errors (eqs. 14-15) and least squares.

The rows of eq. (8) that belong to passive joints, M21 theta'' + M22 phi'' + h2 + K phi + D phi' = 0, are linear in K
and D. Markers give phi with noise, which its second derivative makes large, and which is in both sides of the equation:
least squares is biased (R. Pintelon and J. Schoukens, System Identification, 2nd ed. 2012, section 9.8). Here every
second frame gives the equation and the frames between give the instruments, whose noise is independent of it (J. D.
Angrist and A. B. Krueger, Split-sample instrumental variables estimates of the return to schooling, J. Business &
Economic Statistics 13, 1995; T. Soderstrom and P. Stoica, Instrumental Variable Methods, 1983).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from vjm.errors import InsufficientDataError, require_kind
from vjm.identification.robot_data import (
    FEWEST_FRAMES,
    RobotSignals,
    SpringGroup,
    angles_from_markers,
    checked_motion,
    sampled_signals,
    spring_groups,
    unseen_coordinates,
)
from vjm.identification.uncertainty import SINGULAR
from vjm.markers.smoothing import Smoother
from vjm.model.flexible import FlexibleModel
from vjm.model.kinematics import marker_tree
from vjm.records import CI95, Array, ByParameter, Estimate, Indices, Mask, Record
from vjm.threads import on_one_thread

# Turns about axes at one place do not commute: half of phi_y phi_z is torsion or not, by their order. An angle that is
# ten times that has its stiffness right to a tenth.
_COMMUTATOR = 10.0
# Share of the frames within the filter's width that must be there. Beside a pause half of them are, as at an end, where
# accelerations are several times noisier.
_SUPPORT = 0.75
_SETTLED = 5  # rounds; weights follow from the estimate, and settle in two or three


@dataclass(frozen=True, repr=False)
class RobotIdentification(Record, ByParameter):
    """Stiffness and damping of a robot's virtual joints, identified.

    Attributes:
        model: with the identified values.
        parameters: every parameter, identified or held at the given model's value.
        covariance: (p, p) of those that are identifiable, in order.
        condition: condition number of their normal equations, scaled to a unit diagonal.
        time: (S,) instants that were used [s].
        q: (S, nv) angles of all coordinates, smoothed [rad].
        v, a: (S, nv) rates [rad/s] and accelerations [rad/s^2].
        residual_torque: (S, nv) torque errors of the identified model (eq. 14) [N m]; NaN without measured torque.
        marker_noise: 1-sigma of a coordinate [m].
        marker_misfit: RMS between markers and the model's at the angles found [m].
    """

    model: FlexibleModel
    parameters: tuple[Estimate, ...]
    covariance: Array
    condition: float
    time: Array
    q: Array
    v: Array
    a: Array
    residual_torque: Array
    marker_noise: float
    marker_misfit: float

    @property
    def not_identifiable(self) -> tuple[Estimate, ...]:
        """Parameters that the data do not determine, each with reason and remedy."""
        return tuple(estimate for estimate in self.parameters if not estimate.identifiable)

    def __str__(self) -> str:
        """Return a line for each parameter; the reason instead of the value where there is none."""
        return "\n".join(
            str(estimate)
            if estimate.identifiable
            else f"{estimate.name}: not identifiable, {estimate.reason}; {estimate.remedy}"
            for estimate in self.parameters
        )


@dataclass(frozen=True)
class _Motion:
    """Motion at the instants used, as one half of the frames shows it."""

    q: Array  # (S, nv)
    v: Array
    a: Array
    torque: Array  # (S, n_a)


@on_one_thread
def identify_stiffness(
    model: FlexibleModel,
    q_active: ArrayLike,
    rates: ArrayLike | None,
    accelerations: ArrayLike | None,
    torques: ArrayLike | None,
    marker_positions_3d: ArrayLike,
    *,
    time: ArrayLike,
    markers: Sequence[tuple[str, ArrayLike]] | Mapping[str, tuple[str, ArrayLike]],
    bandwidth: float | None = None,
    tied: bool = True,
) -> RobotIdentification:
    """Identify stiffness and damping of the passive joints of a robot that `vjm.flexify` has made flexible.

    Angles phi(t) of the passive joints follow from the markers frame by frame. Torque errors of the passive joints
    (Yoshikawa, Ohta and Kanaoka, ICRA 2001, eqs. 14-15, which hold in space) are then linear in stiffness and damping;
    split-sample instrumental variables keep the markers' noise from biasing them. All inertias are taken as known.

    Parameters of a flexible link are EI about each axis across it, GJ, and their Kelvin-Voigt damping, EI and GJ times
    a time: `LINK.bending_stiffness_y`, `LINK.torsional_stiffness` [N m^2], `LINK.bending_damping_y`,
    `LINK.torsional_damping` [N m^2 s]. Of other joints they are `JOINT.stiffness` [N m/rad] and `JOINT.damping`.

    Args:
        model: the robot; its values are where the estimation starts, and stay where the data say nothing.
        q_active: (T, n_a) angles of the active joints, in the order of `model.active` [rad].
        rates: (T, n_a) [rad/s]; None: those of the angles.
        accelerations: (T, n_a) [rad/s^2]; None: those of the angles.
        torques: (T, n_a) of the motors, for their residuals alone [N m]; None where not measured.
        marker_positions_3d: (T, k, 3) in the model's world [m]; NaN where a marker was not seen. Frames are left out
            whose markers determine the angles with more than ten times the noise that all markers would give.
        time: (T,) instants of all of them [s].
        markers: for each marker, a frame of the model and the marker's place in it (3,) [m]; by name, or in a list.
            On a flexible link the place may be given in the link's own frame, wherever along it.
        bandwidth: half-power frequency of the filter that all signals pass [Hz], above those of the motion. The lower,
            the less noise, and the less a model of few virtual joints has to explain (default: as high as the noise
            allows, by the discrepancy principle).
        tied: whether the joints of a flexible link share its material; False: each has values of its own.

    Returns:
        Values, standard errors by the sensors' noise, and which of them the data do not determine, and why.

    Raises:
        ShapeError: arrays that do not fit, NaN in what the motors measure, units out of range, markers that are not
            where the model can have them.
        ChoiceError: a marker's frame that the model has not.
        InsufficientDataError: fewer than 40 frames; markers that leave angles of a link open.
    """
    require_kind("tied", tied, bool, "True or False")
    t, motors, positions, places = checked_motion(
        model, time, q_active, rates, accelerations, torques, marker_positions_3d, markers, bandwidth
    )
    groups = spring_groups(model, tied)
    tree = marker_tree(model, places)
    unobservable = unseen_coordinates(model, tree, motors["q_active"], groups)
    shown = np.setdiff1d(model.passive, unobservable)
    q, misfit, noise = angles_from_markers(model, tree, motors["q_active"], positions, shown)
    complete = np.isfinite(q).all(axis=1)
    visible = np.isfinite(positions).reshape(t.size, -1)[complete]
    motor_signals = {name: values[complete] for name, values in motors.items()}
    signals = sampled_signals(model, tree, q[complete], motor_signals, visible, shown, noise)
    problem = _Problem(model, groups, shown, t[complete], signals, bandwidth)
    if problem.time.size < FEWEST_FRAMES:
        reason = f"{problem.time.size} frames remain where the filter is cut off at both ends"
        raise InsufficientDataError("stiffness", reason, "record longer, or give a higher bandwidth")
    return problem.identified(misfit, noise, unobservable)


_BESIDE = "put markers beside the link's axis"
_EXCITE = "move so that it bends or twists more: faster, in other directions, or with a mass beside the link's axis"


class _Problem:
    """Torque errors of the passive joints as equations in their stiffness and damping."""

    def __init__(
        self,
        model: FlexibleModel,
        groups: Sequence[SpringGroup],
        shown: Indices,
        time: Array,
        signals: RobotSignals,
        bandwidth: float | None,
    ) -> None:
        self.model, self.groups, self.signals, self.shown = model, groups, signals, shown
        angles = np.r_[model.active, shown]
        # All signals that are differentiated decide on the filter.
        filtering = np.zeros_like(signals.covariance)
        filtering[np.ix_(angles, angles)] = signals.covariance[np.ix_(angles, angles)]
        halves = (slice(0, None, 2), slice(1, None, 2))
        instants = time[1 : min(time.size - 1, 2 * (time.size // 2) - 1)]  # inside both halves
        self.smoothers = [Smoother(time[half], instants) for half in halves]
        exponent = None if bandwidth is None else self.smoothers[0].exponent_of(bandwidth)
        first = self.smoothers[0].derivatives(signals.columns[halves[0]], filtering, exponent)
        self.exponent = first.smoothing or 0.0
        second = self.smoothers[1].derivatives(signals.columns[halves[1]], filtering, self.exponent)
        inner = first.interior & second.interior
        if inner.any():  # and where frames are missing, as at the ends
            width = float(instants[inner][0] - time[0])
            for half in halves:
                counts = np.subtract(*(np.searchsorted(time[half], instants + side * width) for side in (1, -1)))
                inner &= counts >= _SUPPORT * counts.max()
        self.inside: Mask = inner
        self.time, self.gains = instants[inner], first.gains
        self.halves = [self._motion(d.value[inner], d.rate[inner], d.acceleration[inner]) for d in (first, second)]
        self.mean = _Motion(*(sum(pair) / 2 for pair in zip(*(vars(h).values() for h in self.halves), strict=True)))

    def _motion(self, value: Array, rate: Array, acceleration: Array) -> _Motion:
        """Return the motion in filtered signals (S, m) and their derivatives."""
        nv, active, signals = self.model.model.nv, self.model.active, self.signals
        q, v, a, place = value[:, :nv], rate[:, :nv].copy(), acceleration[:, :nv].copy(), nv
        if signals.rates:
            v[:, active] = value[:, place : place + active.size]
            place += active.size
        if signals.accelerations:
            a[:, active] = value[:, place : place + active.size]
            place += active.size
        torque = value[:, place:] if value.shape[1] > place else np.full((len(q), active.size), np.nan)
        return _Motion(q, v, a, torque)

    def equations(self, motion: _Motion) -> tuple[Array, Array]:
        """Return regressors (S, r, p) and right-hand sides (S, r) of the passive rows."""
        springless = _with_springs(self.model, np.zeros(self.model.model.nv), np.zeros(self.model.model.nv))
        right_hand_side = -springless.inverse_dynamics(self.model.configuration(motion.q), motion.v, motion.a)
        matrix = np.zeros((*motion.q.shape, 2 * len(self.groups)))
        for g, group in enumerate(self.groups):
            matrix[:, group.joints, 2 * g] = motion.q[:, group.joints] / group.cells
            matrix[:, group.joints, 2 * g + 1] = motion.v[:, group.joints] / group.cells
        return matrix[:, self.shown], right_hand_side[:, self.shown]

    def error_jacobian(self, model: FlexibleModel) -> list[Array]:
        """Return the derivatives (S, r, nv) of the passive torque errors by angles, rates and accelerations."""
        q = model.configuration(self.mean.q)
        return [-part[:, self.shown] for part in model.inverse_dynamics_derivatives(q, self.mean.v, self.mean.a)]

    def factors(self, slopes: Sequence[Array]) -> list[Array]:
        """Return the derivatives (..., m) of torque errors by values, rates and accelerations of the signals."""
        nv, active, count = self.model.model.nv, self.model.active, self.signals.columns.shape[1]
        result = [np.zeros((*slope.shape[:-1], count)) for slope in slopes]
        for padded, slope in zip(result, slopes, strict=True):
            padded[..., :nv] = slope
        place = nv
        for order, measured in ((1, self.signals.rates), (2, self.signals.accelerations)):
            if measured:
                result[0][..., place : place + active.size] = slopes[order][..., active]
                result[order][..., active] = 0.0
                place += active.size
        return result

    def weight(self, factors: Sequence[Array]) -> Array:
        """Return the inverse (r, r) of the torque errors' noise covariance (eq. 15)."""
        mean = [part.mean(axis=0) for part in factors]
        noise = self.signals.covariance
        covariance = sum(self.gains[i, j] * mean[i] @ noise @ mean[j].T for i in range(3) for j in range(3))
        covariance = np.asarray((covariance + covariance.T) / 2)
        size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        scaled = covariance / np.outer(size, size) + 1e-12 * np.eye(size.size)
        return np.asarray(np.linalg.inv(scaled) / np.outer(size, size))

    def score_covariance(self, factors: Sequence[Array], weighted: Array) -> Array:
        """Return the covariance (p, p) of the scores, white noise of all sensors through the filter and the equations.

        The noise of one sample moves a score by the filter's adjoint of the score's derivatives.
        """
        count = weighted.shape[2]
        result = np.zeros((count, count))
        for half, smoother in enumerate(self.smoothers):
            adjoints = []
            for p in range(count):
                weights = []
                for factor in factors:
                    padded = np.zeros((self.inside.size, factor.shape[2]))
                    padded[self.inside] = np.einsum("srm,sr->sm", factor, weighted[..., p])
                    weights.append(padded)
                adjoints.append(smoother.adjoint(weights, self.exponent))
            stacked = np.stack(adjoints)
            sets = self.signals.sets[half::2]
            for k, covariance in enumerate(self.signals.covariances):
                subset = stacked[:, sets == k]
                result += np.einsum("ptm,mn,qtn->pq", subset, covariance, subset, optimize=True)
        return result

    def solve(self, model: FlexibleModel, free: Indices) -> tuple[Array, Array, float]:
        """Return values of the free parameters, their covariance and the condition number, weighted as of a model."""
        factors = self.factors(self.error_jacobian(model))
        W = self.weight(factors)
        (first, first_right), (second, second_right) = (self.equations(half) for half in self.halves)
        held = np.setdiff1d(np.arange(first.shape[2]), free)
        known = self.values(self.model)[held]
        first_right, second_right = first_right - first[..., held] @ known, second_right - second[..., held] @ known
        first, second = first[..., free], second[..., free]
        weighted = [np.einsum("rs,tsp->trp", W, matrix) for matrix in (first, second)]
        normal = np.einsum("trp,trq->pq", weighted[1], first) + np.einsum("trp,trq->pq", weighted[0], second)
        vector = np.einsum("trp,tr->p", weighted[1], first_right) + np.einsum("trp,tr->p", weighted[0], second_right)
        size = np.sqrt(np.maximum(np.abs(np.diag(normal)), 1e-300))
        scaled = normal / np.outer(size, size)
        inverse = np.linalg.pinv(scaled, rcond=SINGULAR) / np.outer(size, size)
        scores = self.score_covariance(factors, (weighted[0] + weighted[1]) / 2)
        return inverse @ vector, inverse @ scores @ inverse.T, float(np.linalg.cond(scaled))

    def values(self, model: FlexibleModel) -> Array:
        """Return a model's parameters (p,): stiffness and damping of each group."""
        return np.array([value for group in self.groups for value in group.values(model)])

    def model_of(self, values: Array) -> FlexibleModel:
        """Return the model with other parameters; stiffness and damping below zero are zero."""
        K, D = self.model.stiffness.copy(), self.model.damping.copy()
        for g, group in enumerate(self.groups):
            K[group.joints], D[group.joints] = (np.maximum(v, 0.0) / group.cells for v in values[2 * g : 2 * g + 2])
        return _with_springs(self.model, K, D)

    def identified(self, misfit: float, noise: float, unobservable: Indices) -> RobotIdentification:
        """Return the estimate. Parameters that the data do not determine are held, the least certain one first."""
        silent: dict[int, tuple[str, str]] = {}
        for g, group in enumerate(self.groups):
            if np.isin(group.joints, unobservable).all():
                silent[2 * g] = silent[2 * g + 1] = (f"no marker moves with the {group.motion}", _BESIDE)
            else:
                angle, order = self.angle(group), self.order_of_turns(group)
                if angle < _COMMUTATOR * order:
                    moved = f"its angles are {1e3 * angle:.2g} mrad RMS, of which bends and twists about the other axes"
                    reason = f"the motion does not excite the {group.motion}: {moved} make {1e3 * order:.2g} mrad"
                    silent[2 * g] = silent[2 * g + 1] = reason, _EXCITE
        start = self.values(self.model)
        while True:
            free = np.setdiff1d(np.arange(start.size), list(silent))
            values, covariance, condition = self.converged(start, free)
            stds = np.sqrt(np.diag(covariance))
            doubt = np.where(values[free] > CI95 * stds, 0.0, stds / np.maximum(values[free], 1e-300))
            if not doubt.any():
                break
            # A stiffness goes before a damping: damping of springs that do not move is never known.
            stiff = doubt * (free % 2 == 0)
            worst = int(np.argmax(stiff if stiff.any() else doubt))
            p = int(free[worst])
            silent[p] = self.reason(p, values[p], stds[worst])
            if p % 2 == 0:
                silent.setdefault(p + 1, silent[p])
        return self.record(values, free, covariance, condition, silent, misfit, noise)

    def converged(self, start: Array, free: Indices) -> tuple[Array, Array, float]:
        """Return all parameters, the covariance of the free ones, and the condition, with weights that have settled."""
        values, covariance, condition = start.copy(), np.zeros((0, 0)), float("nan")
        for _ in range(_SETTLED if free.size else 0):
            before = values[free]
            values[free], covariance, condition = self.solve(self.model_of(values), free)
            if (np.abs(values[free] - before) <= 0.1 * np.sqrt(np.diag(covariance))).all():
                break
        return values, covariance, condition

    def reason(self, p: int, value: float, std: float) -> tuple[str, str]:
        """Return why a parameter is not identifiable, and what would make it so."""
        group = self.groups[p // 2]
        angle = self.angle(group)
        blur = np.sqrt(self.gains[0, 0] * float(np.mean(np.diag(self.signals.covariance)[group.joints])))
        if p % 2 == 0 and angle < blur:
            moved = f"its angles are {1e3 * angle:.2g} mrad RMS, their noise {1e3 * blur:.2g} mrad"
            return f"the motion does not excite the {group.motion}: {moved}", _EXCITE
        name, unit = (group.stiffness, group.unit) if p % 2 == 0 else (group.damping, group.damping_unit)
        return f"{name} is {value:.2g} ± {std:.2g} {unit}, not certainly above zero", _EXCITE

    def angle(self, group: SpringGroup) -> float:
        """Return the RMS of a group's angles [rad]; noise of the two halves is independent, their product has none."""
        first, second = (half.q[:, group.joints] for half in self.halves)
        return float(np.sqrt(max(float(np.mean(first * second)), 0.0)))

    def order_of_turns(self, group: SpringGroup) -> float:
        """Return the RMS of the angle [rad] that the order of turns about the other axes makes: half their product."""
        pairs = [
            self.model.indices([name for name in names if name not in group_names])
            for link in self.model.links
            for names in zip(*link.joints.values(), strict=True)
            for group_names in [{self.model.names[k] for k in group.joints}]
            if group_names & set(names) and len(names) == 3
        ]
        products = [self.mean.q[:, k[0]] * self.mean.q[:, k[1]] / 2 for k in pairs]
        return float(np.sqrt(np.mean(np.square(products)))) if products else 0.0

    def record(
        self,
        values: Array,
        free: Indices,
        covariance: Array,
        condition: float,
        silent: Mapping[int, tuple[str, str]],
        misfit: float,
        noise: float,
    ) -> RobotIdentification:
        """Return the result."""
        model, motion = self.model_of(values), self.mean
        stds = dict(zip(free.tolist(), np.sqrt(np.diag(covariance)).tolist(), strict=True))
        estimates = []
        for p, value in enumerate(values.tolist()):
            group = self.groups[p // 2]
            name, unit = (group.damping, group.damping_unit) if p % 2 else (group.stiffness, group.unit)
            reason, remedy = silent.get(p, ("", ""))
            estimates.append(
                Estimate(name, value, stds.get(p), unit, p not in silent, reason, remedy, nonnegative=True)
            )
        errors = -model.inverse_dynamics(model.configuration(motion.q), motion.v, motion.a)
        errors[:, model.active] += motion.torque
        return RobotIdentification(
            model=model,
            parameters=tuple(estimates),
            covariance=covariance,
            condition=condition,
            time=self.time,
            q=motion.q,
            v=motion.v,
            a=motion.a,
            residual_torque=errors,
            marker_noise=noise,
            marker_misfit=misfit,
        )


def _with_springs(model: FlexibleModel, stiffness: Array, damping: Array) -> FlexibleModel:
    """Return a model with other springs and dampers (nv,)."""
    passive = [model.names[k] for k in model.passive]
    preload, cells, links = model.preload, model.cells, model.links
    return FlexibleModel(model.model, stiffness, damping, passive=passive, preload=preload, cells=cells, links=links)
