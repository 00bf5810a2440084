"""Training recordings with the angles, derivatives and torques that torque errors need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, Self

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular

from vjm.chain.layout import DEFAULT_LAYOUT, Cuts, Layout, layout, rig_layouts, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError
from vjm.experiment.spectrum import MeasuredModes, measure_modes, sensor_noise
from vjm.markers.angles import AngleMethod, Angles, ShapeSettings, estimate_angles
from vjm.markers.shape import choose_order
from vjm.markers.smoothing import Derivatives, Smoother, interpolate
from vjm.model.dynamics import Mechanism, torque_errors
from vjm.model.modes import modes
from vjm.records import NO_PAYLOAD, REFERENCE, Array, Experiment, Link, Mask, Payload, Record, Recording, Rig

DerivativeMethod = Literal["smoothing", "interpolating"]

FREQUENCY_TOLERANCE = 1e-3  # relative; of the order to which a few seconds of recording show a frequency
_MOST_JOINTS = 20  # tried; beside twice as many, frequencies count as exact: 16 times as exact at fourth order


@dataclass(frozen=True, repr=False)
class PreparedRecording(Record):
    """One recording as the torque method sees it."""

    recording: Recording
    angles: Angles  # of the markers, at the camera's frames
    derivatives: Derivatives  # (S, nv) angles, rates and accelerations at the instants used
    torque: Array  # (S, n_a) active joint torques, through the same filter [N m]; NaN where none was measured
    smoother: Smoother | None  # of the recording's complete frames; None for interpolation
    # (nv, r) maps torque errors to those that the data determine: passive ones along the shape functions, active ones
    # where a torque was measured.
    rows: Array
    # Modes by noise and number: a fit and its report ask for the same, and measuring takes seconds.
    _measured: dict[tuple[float, int], MeasuredModes] = field(default_factory=dict, repr=False, compare=False)

    def errors(self, chain: Chain, at: Mask | slice = slice(None)) -> Array:
        """Return torque errors (S, nv) of a chain (eq. 14) `at` some instants [N m]; NaN without measured torque."""
        derivatives, recording = self.derivatives, self.recording
        state = derivatives.value[at], derivatives.rate[at], derivatives.acceleration[at]
        return torque_errors(chain, *state, self.torque[at], recording.payload_body, recording.gravity)

    def weighted_errors(self, chain: Chain, weighting: Chain) -> Array:
        """Return torque errors (S, r), away from the ends, in the rows determined, in units of `weighting`'s noise."""
        return self.over_noise(self.determined_errors(chain), weighting, self.inertia(weighting))

    def determined_errors(self, chain: Chain) -> Array:
        """Return torque errors (S, r), away from the ends, in the rows determined [N m]."""
        return np.asarray(np.nan_to_num(self.errors(chain, self.derivatives.interior)) @ self.rows)

    def over_noise(self, errors: Array, chain: Chain, inertia: Array) -> Array:
        """Return torque errors (S, r) in units of the noise that a chain of given `inertia` (nv, nv) gives them."""
        covariance = self.rows.T @ self.noise_covariance(chain, inertia) @ self.rows
        ridge = 1e-12 * np.trace(covariance)  # keeps exact data's covariance invertible
        noise_factor = cholesky(covariance + ridge * np.eye(len(covariance)), lower=True)
        return np.asarray(solve_triangular(noise_factor, errors.T, lower=True).T)

    def inertia(self, chain: Chain) -> Array:
        """Return a chain's mass matrix (nv, nv) at the mean angles of the instants used [kg m^2]."""
        mechanism = Mechanism(chain, self.recording.payload_body, self.recording.gravity)
        mean = self.derivatives.value[self.derivatives.interior].mean(axis=0)
        return np.asarray(mechanism.mass_matrix(mean[None])[0])

    def noise_covariance(self, chain: Chain, inertia: Array) -> Array:
        """Return the covariance (nv, nv) that the noise of the angles gives a chain's torque errors [N^2 m^2]."""
        derivatives, noise = self.derivatives, self.angles.covariance
        terms = [np.diag(chain.stiffness), np.diag(chain.damping), inertia]
        pairs = [(i, j) for i in range(3) for j in range(3)]
        covariance = np.asarray(sum(derivatives.gains[i, j] * terms[i] @ noise @ terms[j].T for i, j in pairs))
        return np.asarray((covariance + covariance.T) / 2)

    @property
    def driving_torque(self) -> tuple[Array, Array] | None:
        """Instants [s] and torques [N m] of the active joints where all were measured; None for free motion."""
        time, tau = self.recording.time, self.recording.tau
        known = np.isfinite(tau).all(axis=1)
        return (time[known], tau[known]) if tau.shape[1] > 0 and known.sum() > 2 else None

    def modes(self, marker_noise: float, most: int) -> MeasuredModes:
        """Measure at most so many modes in the whitened shape coefficients; `marker_noise` in [m]."""
        if (marker_noise, most) not in self._measured:
            whitened = [
                shape.coefficients @ np.linalg.cholesky(np.linalg.inv(shape.covariance)) for shape in self.angles.shapes
            ]
            modes = measure_modes(self.angles.time, np.hstack(whitened), marker_noise, most, self.driving_torque)
            self._measured[marker_noise, most] = modes
        return self._measured[marker_noise, most]


@dataclass(frozen=True)
class JointChoice:
    """A number n of virtual joints and its discretisation error."""

    joints: int
    error: float  # largest relative one of the visible modes' frequencies, against a `fourth-order` chain of 40 joints
    requested: bool = False  # True if a user asked for this n

    @classmethod
    def of(
        cls,
        link: Link,
        visible: int,
        joints: int | None = None,
        requested: bool = False,
        layout_name: str = DEFAULT_LAYOUT,
    ) -> Self:
        """Choose the smallest n whose chain has the frequencies of the `visible` slowest modes right to 0.1 %.

        The link has its nominal values, is the only one and its active joint is free. Of given `joints` only the error
        is found. Where no chain of that layout is so accurate, n is the largest one tried.
        """

        def frequencies(n: int, name: str = layout_name) -> Array:
            return modes(Chain(link.name, (uniform_chain(link, layout(link.length, n, name)),))).frequencies[:visible]

        exact = frequencies(2 * _MOST_JOINTS, DEFAULT_LAYOUT)
        choice = cls(joints or _MOST_JOINTS, np.inf, requested)
        for n in range(visible + 1, _MOST_JOINTS + 1) if joints is None else [joints]:
            approximate = frequencies(n)
            choice = cls(n, float(np.max(np.abs(approximate / exact[: approximate.size] - 1))), requested)
            if choice.error < FREQUENCY_TOLERANCE:
                break
        return choice


@dataclass(frozen=True)
class TrainingData:
    """The recordings that a model is fitted to, and how they are read."""

    rig: Rig
    parameters: str  # the parametrisation they are read for
    layout: str  # where the links are cut
    cuts: tuple[Layout, ...]  # virtual links and cells of each link
    joints: tuple[JointChoice, ...]
    shape: ShapeSettings  # shape functions and how angles are read off them
    derivatives: str  # `smoothing` or `interpolating`
    noise: tuple[float, float]  # 1-sigma of a marker coordinate [m] and of an encoder [rad]
    recordings: tuple[Recording, ...]  # without coordinates that cannot be right
    prepared: tuple[PreparedRecording, ...] = ()  # those that the torque method can use
    problems: tuple[InsufficientDataError, ...] = ()  # why it cannot use the others
    payload: Payload = NO_PAYLOAD  # the commonest one of prepared recordings

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        parameters: str = "uniform",
        virtual_joints: int | None = None,
        layout: str = DEFAULT_LAYOUT,
        family: str = "cantilever",
        angles: AngleMethod | None = None,
        derivatives: str = "smoothing",
    ) -> Self:
        """Choose the recordings, the shape functions' orders and the numbers of joints, and prepare the recordings.

        Options are those of `identify`. Joints with parameters of their own are no more than can be told apart, and
        their angles are by default read off the chain's own curve, where there are markers enough.

        Raises:
            InsufficientDataError: nothing to fit, or a link without markers.
        """
        rig = experiment.rig
        recordings = _training_recordings(experiment.cleaned_recordings)
        noise = sensor_noise(rig, experiment.cleaned_recordings)
        if max(_relative_motion(recording, noise) for recording in recordings) < 2.0:  # pure noise reaches one
            raise InsufficientDataError(
                "identification",
                "in no training recording does the arm move by more than its sensors' noise",
                "record it swinging or driven",
            )
        payloads = [recording.payload_body for recording in recordings]
        orders = _choose_orders(rig, rig_layouts(rig, [3] * len(rig.links), layout, payloads), recordings, family)
        joints = tuple(
            _choose_joints(link, order, parameters, virtual_joints or link.virtual_joints, layout)
            for link, order in zip(rig.links, orders, strict=True)
        )
        if angles is None:
            enough = all(len(link.markers) >= choice.joints for link, choice in zip(rig.links, joints, strict=True))
            angles = "curve" if parameters != "uniform" and enough else "curvature"
        robust = all(len(link.markers) >= order + 2 for link, order in zip(rig.links, orders, strict=True))
        cuts = tuple(rig_layouts(rig, [choice.joints for choice in joints], layout, payloads))
        shape = ShapeSettings(family, orders, angles, robust)
        return cls(rig, parameters, layout, cuts, joints, shape, derivatives, noise, recordings)._with_prepared()

    def _with_prepared(self) -> Self:
        """Return the data with recordings prepared."""
        prepared, problems = [], []
        for recording in self.recordings:
            try:
                prepared.append(_prepare(self, self.cuts, recording))
            except InsufficientDataError as error:
                problems.append(error.with_traceback(None))  # which would keep all that was computed until then
        recordings = [p.recording for p in prepared] or self.recordings
        payloads = [recording.payload_body for recording in recordings]
        payload = max(sorted(set(payloads)), key=payloads.count)
        return replace(self, prepared=tuple(prepared), problems=tuple(problems), payload=payload)

    @property
    def freely_moving(self) -> tuple[PreparedRecording, ...]:
        """Recordings in which the arm has the modes of the model: with the commonest payload, and no motion given."""
        same_payload = [prepared for prepared in self.prepared if prepared.recording.payload_body == self.payload]
        return tuple(prepared for prepared in same_payload if prepared.recording.input == "torque")

    @cached_property
    def modes(self) -> tuple[MeasuredModes, ...]:
        """Modes that each of the `freely_moving` recordings shows: frequencies are compared at one payload only."""
        count = max(self.shape.orders) + 2  # faster ones may be too faint for shapes
        return tuple(prepared.modes(self.noise[0], count) for prepared in self.freely_moving)

    def driven_hubs(self, recordings: Sequence[Recording]) -> tuple[int, ...]:
        """Return the links whose hub inertia shows: their active joint's torque was measured in a recording."""
        return tuple(
            link
            for k, link in enumerate(self.rig.active_links)
            if any(np.isfinite(recording.tau[:, k]).any() for recording in recordings)
        )

    def prepared_for(self, chain: Chain) -> tuple[PreparedRecording, ...]:
        """Return the prepared recordings with angles at a chain's own cuts, through the same filters."""
        pairs = zip(chain.links, self.cuts, strict=True)
        if all(
            np.array_equal(link.lengths, cut.lengths) and np.array_equal(link.cells, cut.cells) for link, cut in pairs
        ):
            return self.prepared
        return tuple(_prepare(self, chain.links, prepared.recording, prepared) for prepared in self.prepared)

    def weighted_errors(self, chain: Chain, weighting: Chain | None = None) -> list[Array]:
        """Return the torque errors (S, r) of each prepared recording over their noise, in `weighting` if it is given.

        Both chains have the same cuts.
        """
        return [prepared.weighted_errors(chain, weighting or chain) for prepared in self.prepared_for(chain)]


def _training_recordings(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """Return the training recordings in which the arm moves.

    Where some recordings are in the `reference` condition the model is the reference's, and only they are fitted.
    """
    reference = any(recording.condition == REFERENCE for recording in recordings)
    chosen = tuple(
        recording
        for recording in recordings
        if recording.role == "train"
        and recording.kind in ("driven", "decay")
        and (not reference or recording.condition == REFERENCE)
    )
    if not chosen:
        raise InsufficientDataError(
            "identification",
            "no recording with role 'train' is of kind 'driven' or 'decay'"
            + (" and in the reference condition" if reference else ""),
            "add one in which the arm moves",
        )
    return chosen


def _relative_motion(recording: Recording, noise: tuple[float, float]) -> float:
    """Return the standard deviation of the coordinate that moves most, over its sensor's noise [m, rad]."""
    markers = recording.markers.reshape(recording.time.size, -1)
    values = np.hstack([markers / noise[0], recording.theta / noise[1]])
    return float(np.nanstd(values[:, np.isfinite(values).sum(axis=0) > 1], axis=0).max(initial=0.0))


def _choose_orders(rig: Rig, cuts: Sequence[Cuts], recordings: Sequence[Recording], family: str) -> tuple[int, ...]:
    """Return, for each link, the largest number of shape functions that a recording supports by cross-validation."""
    orders = [1] * len(rig.links)
    for i, link in enumerate(rig.links):
        if not link.markers:
            raise InsufficientDataError(f"identification of {link.name}", "it has no markers", "put some on it")
        for recording in recordings:
            settings = ShapeSettings(family, tuple(orders))
            fit = estimate_angles(rig, cuts, recording, settings, 1.0, 1.0).shapes[i]
            lateral = fit.evaluate(link.markers) + fit.residuals
            orders[i] = max(orders[i], choose_order(link.markers, lateral, link.length, family))
    return tuple(orders)


def _choose_joints(link: Link, order: int, parameters: str, requested: int | None, layout_name: str) -> JointChoice:
    """Return the number of joints asked for, or right for the modes seen, or that the markers can tell apart.

    Fixed lengths need two joints more than there are modes to carry those modes well; free lengths need none.
    """
    distinct = min(order + 2 if parameters == "joints" else order, len(link.markers))
    joints = requested or (None if parameters == "uniform" else distinct)
    return JointChoice.of(link, order, joints, requested is not None, layout_name)


def _prepare(
    data: TrainingData,
    cuts: Sequence[Cuts],
    recording: Recording,
    before: PreparedRecording | None = None,
) -> PreparedRecording:
    """Return angles, derivatives and torques of one recording; with the shape functions and the filter of `before`."""
    shapes = None if before is None else before.angles.shapes
    angles = estimate_angles(data.rig, cuts, recording, data.shape, *data.noise, shapes)
    measured = np.asarray(np.isfinite(angles.torque).any(axis=0))
    values = np.hstack([angles.q, angles.torque[:, measured]])
    usable = np.isfinite(values).all(axis=1)
    if usable.sum() < 10:  # as few as a recording may have
        raise InsufficientDataError(
            f"identification from {recording.file}",
            f"only {int(usable.sum())} frames have all markers, encoders and torques it needs",
            "record more complete frames",
        )
    smoother = None
    if data.derivatives == "smoothing":
        covariance = block_diag(angles.covariance, np.zeros((int(measured.sum()),) * 2))
        unchanged = before is not None and np.array_equal(angles.time[usable], before.derivatives.time)
        smoother = before.smoother if before is not None and unchanged else None
        smoother = smoother or Smoother(angles.time[usable])
        exponent = None if before is None else before.derivatives.smoothing
        filtered = smoother.derivatives(values[usable], covariance, exponent)
    else:
        filtered = interpolate(angles.time, values)
    nv = angles.q.shape[1]
    torque = np.full((filtered.time.size, measured.size), np.nan)
    torque[:, measured] = filtered.value[:, nv:]
    derivatives = replace(
        filtered,
        value=filtered.value[:, :nv],
        rate=filtered.rate[:, :nv],
        acceleration=filtered.acceleration[:, :nv],
    )
    return PreparedRecording(recording, angles, derivatives, torque, smoother, _rows(data.rig, cuts, angles, measured))


def _rows(rig: Rig, cuts: Sequence[Cuts], angles: Angles, measured: Mask) -> Array:
    """Return passive rows along the shapes that the markers can show; active rows with a measured torque."""
    columns, start, active = [], 0, 0
    size = len(angles.covariance)
    for link, cut in zip(rig.links, cuts, strict=True):
        if link.joint == "revolute":
            if measured[active]:
                columns.append(np.eye(size)[:, [start]])
            active += 1
            start += 1
        part = slice(start, start + cut.cells.size)
        values, vectors = np.linalg.eigh(angles.covariance[part, part])
        shown = values > 1e-9 * values[-1]  # smaller variances are rounding errors, which no shape function takes
        visible = np.zeros((size, int(shown.sum())))
        visible[part] = vectors[:, shown]
        columns.append(visible)
        start += cut.cells.size
    return np.hstack(columns)
