"""Mistakes in an experiment, how sure the recordings are of them, and what they show of angles and modes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vjm.experiment.checks import moves
from vjm.experiment.conventions import FACTORS
from vjm.experiment.spectrum import measure_modes, sensor_noise
from vjm.records import Array, Indices, Mask, Recording, Rig

# Logarithms of how many times likelier the data are with the mistake than without: a mistake is certain where the data
# alone would fool us once in a million experiments, as in vjm.experiment.spectrum, and likely at once in a thousand.
CERTAIN, LIKELY = float(np.log(1e6)), float(np.log(1e3))
MISTAKE_COST = float(np.log(100.0))  # cost in log-likelihood of supposing it: one number in a hundred has one
GRAM = 1e-3  # kg
EARTH = 9.81  # m/s^2, its gravity


@dataclass(frozen=True)
class Mistake:
    """A mistake that explains the recordings far better than the experiment file does.

    Attributes:
        text: what is seen, what is likely wrong, and which key to change, in a sentence.
        gain: logarithm of how many times likelier the recordings are with the mistake.
        files: of the recordings that show it; empty where it is one of the rig.
    """

    text: str
    gain: float
    files: tuple[str, ...] = ()

    @property
    def certain(self) -> bool:
        """True if nothing should be fitted before it is mended."""
        return self.gain > CERTAIN

    def __str__(self) -> str:
        count = len(self.files) - 1
        suffix = f" and {count} other recording{'s' if count > 1 else ''}" if count > 0 else ""
        return f"{self.files[0]}{suffix}: {self.text}" if self.files else self.text


def negated(column: str) -> str:
    """Return the remedy of a wrong sign; an experiment file has a key for the sign of an axis only."""
    return f"multiply the column '{column}' by -1"


def gravity_key(rig: Rig, gravity: tuple[float, float]) -> str:
    """Return where a gravity [m/s^2] that recordings have is declared."""
    return "[base] gravity" if gravity == rig.gravity else "gravity in the [[recording]]"


def payload_remedy(file: str, payload: float) -> str:
    """Return the remedy of a recording's payload that was read in kg but is in grams."""
    return f"give 'payload' of [[recording]] {file} in kg, {payload * GRAM:.4g}"


def unit_factors(quantity: str, current: str) -> dict[str, float]:
    """Return, by unit, the factor that mends numbers which were read in the current unit but are in that one."""
    return {unit: size / FACTORS[quantity][current] for unit, size in FACTORS[quantity].items() if unit != current}


def chosen_frames(recording: Recording) -> Indices:
    """Return rows (F,) of a recording in which the camera saw something, at most 2000: more show no more mistakes."""
    frames = recording.frames
    chosen: Indices = frames[np.unique(np.linspace(0, frames.size - 1, min(frames.size, 2000)).astype(np.intp))]
    return chosen


def swings(signal: Array) -> int:
    """Return how often a signal (N,) crosses its mean: at least so many independent pieces of evidence it holds."""
    return int(np.count_nonzero(np.diff(np.sign(signal - signal.mean()))))


def root_headings(rig: Rig, markers: Array, based: bool = False) -> tuple[Array, Array | None, float] | None:
    """Return the heading (F,) of the first link at its base, what of it was extrapolated (F,) and its noise [rad].

    It is extrapolated from the directions between the three markers nearest to the base, which do not depend on the
    origin of coordinates; if `based`, from the base itself and the two nearest markers. With fewer points it includes
    the link's bending, which then is not known (None); a single marker is always taken with the base. None where too
    few markers are seen.
    """
    arcs, points = seen_markers(rig, markers)
    if not arcs.size:
        return None
    if based or arcs.size == 1:
        axis = -rig.links[0].hub_radius if rig.links[0].markers_frame == "base" else 0.0
        points, arcs = np.concatenate([np.zeros_like(points[:, :1]), points], axis=1), np.array([axis, *arcs])
    steps = np.diff(points[:, :3], axis=1)
    directions = np.arctan2(steps[..., 1], steps[..., 0])
    noise = (rig.marker_noise or 1e-3 * rig.links[0].length) * np.sqrt(2.0) / np.diff(arcs[:3])
    if arcs.size == 2:
        return directions[:, 0], None, float(noise[0])
    # A clamped link's slope grows with the arc length from zero on: linearly to begin with.
    centers = (arcs[:2] + arcs[1:3]) / 2
    share = centers[0] / (centers[1] - centers[0])
    difference = np.angle(np.exp(1j * (directions[:, 1] - directions[:, 0])))
    bending = share * difference
    return directions[:, 0] - bending, bending, float(np.hypot((1 + share) * noise[0], share * noise[1]))


def seen_markers(rig: Rig, markers: Array) -> tuple[Array, Array]:
    """Return arc lengths (k,) and places (F, k, 2) of the first link's markers that most frames show, none if too few.

    Frames without all of these are NaN.
    """
    arcs, points = np.array(rig.links[0].markers), markers.copy()
    if rig.links[0].markers_frame == "link":  # a lone y will do there
        points[..., 0] = np.where(np.isfinite(points[..., 0]), points[..., 0], arcs)
    visible: Mask = np.asarray(np.isfinite(points).all(axis=2))
    usable = visible.mean(axis=0) > 0.5 if visible.size else np.zeros(arcs.size, dtype=np.bool_)
    complete: Mask = np.asarray(visible[:, usable].all(axis=1))
    points[~complete] = np.nan
    return (arcs[usable], points[:, usable]) if complete.sum() >= 10 else (np.zeros(0), points[:, :0])


def angle_at(recording: Recording, rows: Indices) -> Array:
    """Return the first active joint's angle at some rows (F,) [rad]; zero where there is no such joint."""
    if not recording.theta.shape[1]:
        return np.zeros(rows.size)
    known = np.isfinite(recording.theta[:, 0])
    return np.asarray(np.interp(recording.time[rows], recording.time[known], recording.theta[known, 0]))


def seen_modes(rig: Rig, recording: Recording, most: int) -> Array:
    """Return the frequencies (m,) that the first link's outermost markers show in its frame, slowest first [Hz]."""
    if not rig.links[0].markers or recording.kind not in ("driven", "decay") or recording.input != "torque":
        return np.empty(0)
    rows = recording.frames[:20_000]  # of a longer recording, its beginning
    markers, theta = recording.markers[rows][:, rig.marker_slices[0]], angle_at(recording, rows)
    y = markers[..., 1]
    if rig.links[0].markers_frame == "base":
        y = np.cos(theta)[:, None] * y - np.sin(theta)[:, None] * markers[..., 0]
    y = y[:, np.isfinite(y).mean(axis=0) > 0.5][:, -2:]  # NaN in frames that lack one are left out
    known = np.isfinite(y).all(axis=1)
    if (
        not y.size
        or known.sum() < 16
        or not any(moves(column[known], rig.marker_noise, rig.links[0].length) for column in y.T)
    ):
        return np.empty(0)
    driven = np.isfinite(recording.tau).all(axis=1) & bool(recording.tau.shape[1])
    torque = (recording.time[driven], recording.tau[driven]) if driven.sum() > 2 else None
    noise = sensor_noise(replace(rig, marker_noise=None), [recording])[0]
    deflection = y[known] - y[known].mean(axis=0)
    return measure_modes(recording.time[rows][known], deflection, noise, most, torque).frequencies
