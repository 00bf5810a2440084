"""What the torque method needs of a recording: filtered angles with their derivatives, torques and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from vjm.chain.layout import DEFAULT_LAYOUT, Layout, rig_layouts
from vjm.errors import ChoiceError, InsufficientDataError
from vjm.experiment.noise import sensor_noise
from vjm.experiment.spectrum import MeasuredModes, measure_modes
from vjm.identification.virtual_joints import JointChoice, choose_virtual_joints
from vjm.markers.angles import AngleMethod, Angles, ShapeSettings, estimate_angles
from vjm.markers.shape import choose_order
from vjm.markers.smoothing import Derivatives, Smoother, interpolate
from vjm.records import REFERENCE, Array, Experiment, Link, Recording, Rig

_LEAST_MOTION = 2.0  # times the noise
_EXTRA_MODES = 2  # peaks looked for beyond the modes that the shapes show


@dataclass(frozen=True)
class Options:
    """How an experiment is read for identification.

    Attributes:
        parameters: the parametrisation.
        virtual_joints: n of every link; None: the experiment file's, or chosen.
        layout: where the links are cut.
        family: of the shape functions.
        angles: how angles are read off them; None: chosen.
        derivatives: `smoothing` or `interpolating`.
    """

    parameters: str = "uniform"
    virtual_joints: int | None = None
    layout: str = DEFAULT_LAYOUT
    family: str = "cantilever"
    angles: AngleMethod | None = None
    derivatives: str = "smoothing"


@dataclass(frozen=True)
class Data:
    """The fitted recordings as the methods see them.

    Attributes:
        options: how they were read.
        plan: shape functions, numbers of joints, cuts.
        settings: how the recordings were prepared.
        recordings: those a model is fitted to, without coordinates that cannot be right.
        prepared: those that the torque method can use, prepared.
        problems: why it cannot use the others, a sentence each.
        seen: modes of those with the commonest payload.
        payload: that payload [kg].
    """

    options: Options
    plan: Plan
    settings: Settings
    recordings: tuple[Recording, ...]
    prepared: tuple[Prepared, ...]
    problems: tuple[str, ...]
    seen: tuple[MeasuredModes, ...]
    payload: float


def read_data(experiment: Experiment, options: Options) -> Data:
    """Choose the recordings and prepare them.

    Raises:
        InsufficientDataError: nothing to fit, or a link without markers.
    """
    rig = experiment.rig
    recordings = fitted_recordings(experiment.cleaned_recordings)
    noise = sensor_noise(rig, experiment.cleaned_recordings)
    if max(motion_of(recording, noise) for recording in recordings) < _LEAST_MOTION:
        raise InsufficientDataError(
            "identification",
            "in no training recording does the arm move by more than its sensors' noise",
            "record it swinging or driven",
        )
    plan = make_plan(
        experiment,
        recordings,
        options.parameters,
        options.virtual_joints,
        options.layout,
        options.family,
        options.angles,
    )
    settings = Settings(plan.shape, options.derivatives, *noise)
    prepared, problems = [], []
    for recording in recordings:
        try:
            prepared.append(prepare(rig, plan.cuts, recording, settings))
        except InsufficientDataError as error:
            problems.append(str(error))
    chosen, payload = _commonest_payload([one.recording for one in prepared] or recordings)
    most = max(plan.shape.orders) + _EXTRA_MODES
    seen = tuple(modes_in(prepared[k], noise[0], most) for k in chosen if prepared)
    return Data(options, plan, settings, recordings, tuple(prepared), tuple(problems), seen, payload)


def _commonest_payload(recordings: Sequence[Recording]) -> tuple[list[int], float]:
    """Recordings with the payload that most of them have: frequencies are compared among equals only."""
    payloads = [recording.payload for recording in recordings]
    best = max(sorted(set(payloads)), key=payloads.count)
    return [k for k, payload in enumerate(payloads) if payload == best], best


DERIVATIVE_METHODS = ("smoothing", "interpolating")
_VISIBLE = 1e-9  # of the largest variance of the angles: directions the shape functions can take


@dataclass(frozen=True)
class Settings:
    """How recordings are prepared.

    Attributes:
        shape: shape functions and angles.
        derivatives: `smoothing` or `interpolating`.
        marker_noise: 1-sigma [m].
        encoder_noise: 1-sigma [rad].
    """

    shape: ShapeSettings
    derivatives: str
    marker_noise: float
    encoder_noise: float

    def __post_init__(self) -> None:
        if self.derivatives not in DERIVATIVE_METHODS:
            raise ChoiceError("derivatives", self.derivatives, DERIVATIVE_METHODS)


@dataclass(frozen=True)
class Prepared:
    """One recording, ready for torque errors.

    Attributes:
        recording: its source.
        angles: at the camera's frames.
        derivatives: (S, nv) angles, rates, accelerations at the instants used.
        torque: (S, n_a) through the same filter [N m]; NaN where none was measured.
        smoother: of the recording's complete frames; None for interpolation.
        rows: (nv, r) maps torque errors to the rows that the data can speak of: passive ones along the shape functions,
            active ones where a torque was measured.
    """

    recording: Recording
    angles: Angles
    derivatives: Derivatives
    torque: Array
    smoother: Smoother | None
    rows: Array

    @property
    def q(self) -> Array:
        """(S, nv) angles away from the recording's ends [rad]."""
        return self.derivatives.value[self.derivatives.interior]

    @property
    def v(self) -> Array:
        """(S, nv) rates [rad/s]."""
        return self.derivatives.rate[self.derivatives.interior]

    @property
    def a(self) -> Array:
        """(S, nv) accelerations [rad/s^2]."""
        return self.derivatives.acceleration[self.derivatives.interior]

    @property
    def tau(self) -> Array:
        """(S, n_a) torques [N m]."""
        return self.torque[self.derivatives.interior]


def fitted_recordings(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """The recordings a model is fitted to: training ones in which the arm moves.

    Where some recordings are in the `reference` condition the model is the reference's, and only they are fitted.

    Raises:
        InsufficientDataError: there is none.
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


def motion_of(recording: Recording, noise: tuple[float, float]) -> float:
    """How much the coordinate that moves most does, as a multiple of its sensor's noise [m, rad]."""
    sizes = [0.0]
    for values, sigma in ((recording.markers.reshape(len(recording.time), -1), noise[0]), (recording.theta, noise[1])):
        seen = values[:, np.isfinite(values).sum(axis=0) > 1]
        if seen.size:
            sizes.append(float(np.nanstd(seen, axis=0).max()) / sigma)
    return max(sizes)


def choose_orders(rig: Rig, cuts: Sequence[Layout], recordings: Sequence[Recording], family: str) -> tuple[int, ...]:
    """For each link, the largest number of shape functions that a recording supports by cross-validation.

    Raises:
        InsufficientDataError: a link without markers.
    """
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


def prepare(
    rig: Rig, cuts: Sequence[Layout], recording: Recording, settings: Settings, before: Prepared | None = None
) -> Prepared:
    """Angles, derivatives and torques of one recording.

    Args:
        rig: the arm.
        cuts: each link's virtual links and cells.
        recording: the source.
        settings: shape functions, derivatives and noise.
        before: the same recording at other cuts, whose shape functions and filter are used again.

    Raises:
        InsufficientDataError: too few frames from which all angles follow.
    """
    noise = (settings.marker_noise, settings.encoder_noise)
    shapes = None if before is None else before.angles.shapes
    angles = estimate_angles(rig, cuts, recording, settings.shape, *noise, shapes)
    measured = np.asarray(np.isfinite(angles.torque).any(axis=0))
    values = np.hstack([angles.q, angles.torque[:, measured]])
    usable = np.isfinite(values).all(axis=1)
    if usable.sum() < 10:
        raise InsufficientDataError(
            f"identification from {recording.file}",
            f"only {int(usable.sum())} frames have all markers, encoders and torques it needs",
            "record more complete frames",
        )
    smoother = None
    if settings.derivatives == "smoothing":
        covariance = block_diag(angles.covariance, np.zeros((int(measured.sum()),) * 2))
        same = before is not None and np.array_equal(angles.time[usable], before.derivatives.time)
        smoother = before.smoother if before is not None and same else None
        smoother = smoother or Smoother.of(angles.time[usable])
        exponent = None if before is None else before.derivatives.smoothing
        filtered = smoother.derivatives(values[usable], covariance, exponent)
    else:
        filtered = interpolate(angles.time, values)
    size = angles.q.shape[1]
    torque = np.full((filtered.time.size, measured.size), np.nan)
    torque[:, measured] = filtered.value[:, size:]
    kept = Derivatives(
        filtered.time,
        filtered.value[:, :size],
        filtered.rate[:, :size],
        filtered.acceleration[:, :size],
        filtered.gains,
        filtered.interior,
        filtered.smoothing,
    )
    return Prepared(recording, angles, kept, torque, smoother, _rows(rig, cuts, angles, measured))


def _rows(rig: Rig, cuts: Sequence[Layout], angles: Angles, measured: NDArray[np.bool_]) -> Array:
    """Passive rows along the shapes that the markers can show; active rows with a measured torque."""
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
        visible = np.zeros((size, int((values > _VISIBLE * values[-1]).sum())))
        visible[part] = vectors[:, values > _VISIBLE * values[-1]]
        columns.append(visible)
        start += cut.cells.size
    return np.hstack(columns)


def modes_in(prepared: Prepared, marker_noise: float, most: int) -> MeasuredModes:
    """Modes seen in one recording's shape coefficients, whitened; `marker_noise` in [m]."""
    signals = [fit.coefficients @ np.linalg.cholesky(np.linalg.inv(fit.covariance)) for fit in prepared.angles.shapes]
    torque = driving_torque(prepared.recording)
    return measure_modes(prepared.angles.time, np.hstack(signals), marker_noise, most, torque)


def driving_torque(recording: Recording) -> tuple[Array, Array] | None:
    """Instants [s] and torques [N m] of the active joints where all were measured; None for a motion without any."""
    known = np.isfinite(recording.tau).all(axis=1)
    driven = recording.tau.shape[1] > 0 and known.sum() > 2
    return (recording.time[known], recording.tau[known]) if driven else None


@dataclass(frozen=True)
class Plan:
    """Decisions for every link.

    Attributes:
        shape: shape functions and how angles are read off them.
        joints: numbers of virtual joints, and what they cost.
        cuts: virtual links and cells.
    """

    shape: ShapeSettings
    joints: tuple[JointChoice, ...]
    cuts: tuple[Layout, ...]


def make_plan(
    experiment: Experiment,
    recordings: Sequence[Recording],
    parameters: str,
    virtual_joints: int | None,
    layout: str,
    family: str,
    angles: AngleMethod | None,
) -> Plan:
    """Choose the shape functions' orders by cross-validation, and from them the numbers of joints.

    Args:
        experiment: the rig.
        recordings: those to be fitted.
        parameters: parametrisation; with parameters of their own, there are no more joints than can be told apart.
        virtual_joints: n of every link where it is given.
        layout: where the links are cut.
        family: of the shape functions.
        angles: how angles are read off them; None: for uniform links by the curvature of the shape functions, for
            joints with parameters of their own by the chain's own curve, where there are markers enough.
    """
    rig = experiment.rig
    provisional = rig_layouts(rig, [3] * len(rig.links), layout)
    orders = choose_orders(rig, provisional, recordings, family)
    joints = tuple(
        _choose_joints(link, order, parameters, virtual_joints or link.virtual_joints)
        for link, order in zip(rig.links, orders, strict=True)
    )
    if angles is None:
        placed = all(len(link.markers) >= choice.joints for link, choice in zip(rig.links, joints, strict=True))
        angles = "curve" if parameters != "uniform" and placed else "curvature"
    robust = all(len(link.markers) >= order + 2 for link, order in zip(rig.links, orders, strict=True))
    shape = ShapeSettings(family, orders, angles, robust)
    return Plan(shape, joints, tuple(rig_layouts(rig, [choice.joints for choice in joints], layout)))


def _choose_joints(link: Link, order: int, parameters: str, asked: int | None) -> JointChoice:
    choice = choose_virtual_joints(link, order, asked or _joints_told(link, order, parameters))
    return replace(choice, asked=asked is not None)


def _joints_told(link: Link, order: int, parameters: str) -> int | None:
    """Number of joints whose own parameters the markers can tell apart; None: as many as accuracy asks.

    Fixed lengths need two joints more than there are modes to carry those modes well; free lengths need none.
    """
    if parameters == "uniform":
        return None
    return min(order + 2 if parameters == "joints" else order, len(link.markers))
