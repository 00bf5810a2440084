"""What a residual is held against to show a cause: time, amplitude, velocity, position or the marker.

Each effect has the abscissa that makes it plain. All of them can be shown another way as well: what the model without
the cause misses, against what the cause adds to it; it lies on the diagonal where the cause is right.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vjm.effects.effect import Effect
from vjm.experiment.records import Recording
from vjm.simulate.initial_state import Replay

if TYPE_CHECKING:
    from vjm.diagnosis.records import Diagnosis, Replayed

Array = NDArray[np.float64]
Abscissa = Literal["time", "amplitude", "velocity", "position", "radius", "turn", "marker", "frequency", "joint"]

_OF: dict[str, Abscissa] = {
    "coulomb_friction": "joint",
    "viscous_friction": "joint",
    "joint_spring": "joint",
    "torque_offset": "joint",
    "linear_drag": "amplitude",
    "quadratic_drag": "amplitude",
    "structural_damping": "amplitude",
    "viscoelastic_creep": "amplitude",
    "hysteresis": "amplitude",
    "cubic_stiffness": "amplitude",
    "rest_curvature": "marker",
    "marker_offset": "marker",
    "external_tone": "frequency",
    "time_offset": "velocity",
    "rolling_shutter": "velocity",
    "camera_scale": "position",
    "lens_distortion": "radius",
    "camera_rotation": "turn",
}
_WINDOW = 0.08  # of a recording, over which a local size is taken
_LEAST_FRAMES = 40


class Cloud(NamedTuple):
    """A residual without and with a cause, against something.

    Attributes:
        x: (P,) what it is held against.
        before, after: (P,) what the two models leave [m].
        label: of x, with its unit.
        squared: whether the size of the residual matters, not its sign.
    """

    x: Array
    before: Array
    after: Array
    label: str
    squared: bool


def abscissa_of(effect: Effect) -> Abscissa:
    """Against what an effect is plainest; time for those that nothing is known of."""
    return _OF.get(effect.id, "time")


def most_improved(diagnosis: Diagnosis) -> Replayed | None:
    """The recording in which the causes gain most; a held-out one where that gains about as much. None: nowhere."""
    known = [each for each in diagnosis.recordings if each.before is not None and each.after is not None]
    known = [each for each in known if each.recording.kind != "quiet" and each.recording.frames.size >= _LEAST_FRAMES]
    known = known or [each for each in diagnosis.recordings if each.before is not None and each.after is not None]

    def gained(each: Replayed) -> float:
        before, after = (0.0 if replay is None else replay.marker_rms for replay in (each.before, each.after))
        return (before**2 - after**2) / each.noise**2 * (2.0 if each.recording.role == "holdout" else 1.0)

    return max(known, key=gained, default=None)


def cloud(effect: Effect, recording: Recording, before: Replay, after: Replay) -> Cloud:
    """What two models leave of a recording against the abscissa of an effect (never `joint` or `frequency`)."""
    frames = recording.frames
    measured = recording.markers[frames]
    left = [measured - each.simulation.markers[frames] for each in (before, after)]
    time, shown = recording.time[frames], after.simulation.markers[frames]
    kind = abscissa_of(effect)
    if kind == "velocity":
        velocity = np.gradient(shown, time, axis=0)
        return _cloud(velocity, left, "velocity of the marker [m/s]", False)
    if kind == "position":
        return _cloud(shown, left, "coordinate of the marker [m]", False)
    if kind in ("radius", "turn"):
        return _polar(shown, left, kind)
    if kind == "marker":
        marker = np.broadcast_to(np.arange(1.0, shown.shape[1] + 1)[None, :, None], shown.shape)
        return _cloud(marker, left, "marker, from the base outwards [1]", True)
    if kind == "amplitude":
        return _cloud(_local(shown - np.nanmean(shown, axis=0)), left, "local size of the motion, RMS [m]", True)
    whole = np.broadcast_to((time - time[0])[:, None, None], shown.shape)
    return _cloud(whole, left, "time since the start [s]", True)


def added(recording: Recording, before: Replay, after: Replay) -> tuple[Array, Array]:
    """What the causes add to the simulated marker coordinates, and what was missing: (P,), (P,) [m]."""
    frames = recording.frames
    first = before.simulation.markers[frames]
    x, y = after.simulation.markers[frames] - first, recording.markers[frames] - first
    known = np.isfinite(y)
    return x[known], y[known]


def _cloud(x: Array, left: list[Array], label: str, squared: bool) -> Cloud:
    known = np.isfinite(left[0]) & np.isfinite(left[1]) & np.isfinite(x)
    return Cloud(x[known], left[0][known], left[1][known], label, squared)


def _polar(shown: Array, left: list[Array], kind: Abscissa) -> Cloud:
    """Residual outwards, or around the base, against the distance from it."""
    radius = np.linalg.norm(shown, axis=-1)
    outwards = shown / np.maximum(radius, 1e-12)[..., None]
    around = np.stack([-outwards[..., 1], outwards[..., 0]], axis=-1)
    way = outwards if kind == "radius" else around
    parts = [(each * way).sum(axis=-1) for each in left]
    return _cloud(radius, parts, "distance from the base [m]", False)


def _local(values: Array) -> Array:
    """Root mean square over a stretch of time around each frame, of values (F, k, 2)."""
    width = max(3, round(_WINDOW * len(values)))
    kernel = np.ones(width) / width
    squares = np.nan_to_num(values**2).reshape(len(values), -1)
    weights = np.convolve(np.ones(len(values)), kernel, mode="same")
    smooth = np.stack([np.convolve(column, kernel, mode="same") / weights for column in squares.T], axis=1)
    result: Array = np.sqrt(np.maximum(smooth, 0.0)).reshape(values.shape)
    return result
