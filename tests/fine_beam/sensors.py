"""What a camera and an encoder would have recorded of a simulated motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from tests.fine_beam.beam import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A marker camera.

    Attributes:
        rate: frames per second.
        noise: 1-sigma of each coordinate, m.
        noise_correlation: of the noise from one frame to the next, in [0, 1); 0 is white.
        dropped_frames: share of frames lost altogether.
        occluded: share of marker sightings lost, in runs of `occlusion_frames` on average.
        occlusion_frames: mean length of an occlusion, frames.
        outliers: share of marker sightings that are wrong.
        outlier_size: 1-sigma of a wrong sighting's displacement, m.
    """

    rate: float
    noise: float = 0.0
    noise_correlation: float = 0.0
    dropped_frames: float = 0.0
    occluded: float = 0.0
    occlusion_frames: float = 5.0
    outliers: float = 0.0
    outlier_size: float = 0.02


@dataclass(frozen=True)
class Encoder:
    """A joint encoder: samples per second, 1-sigma noise in rad, and resolution in rad (0: continuous)."""

    rate: float
    noise: float = 0.0
    resolution: float = 0.0


@dataclass(frozen=True)
class Frames:
    """Camera frames: time in s (f,), markers in m (f, k, 2) with NaN where a marker was not seen."""

    time: Array
    markers: Array


def observe(
    trajectory: Trajectory,
    arc_lengths: list[float],
    camera: Camera,
    seed: int,
    frame: Literal["base", "link"] = "base",
) -> Frames:
    """Film markers at arc lengths (m) from the trajectory's start to its end; the same seed sees the same noise."""
    time = _sample_times(trajectory, camera.rate)
    return film(time, trajectory.at(time).positions(arc_lengths, frame), camera, seed)


def film(time: Array, markers: Array, camera: Camera, seed: int) -> Frames:
    """What a camera makes of markers (f, k, 2) in m at instants (f,) in s; the same seed sees the same noise."""
    shape = markers.shape
    # One random stream per imperfection: switching one on leaves the others as they were.
    markers = markers + camera.noise * _coloured(_stream(seed, 0).standard_normal(shape), camera.noise_correlation)
    wrong = _stream(seed, 1).random(shape[:2]) < camera.outliers
    markers = markers + wrong[..., None] * camera.outlier_size * _stream(seed, 2).standard_normal(shape)
    markers[_occlusions(_stream(seed, 3), shape[:2], camera)] = np.nan
    kept = _stream(seed, 4).random(len(time)) >= camera.dropped_frames
    return Frames(time[kept], markers[kept])


def read_encoder(trajectory: Trajectory, encoder: Encoder, seed: int) -> tuple[Array, Array]:
    """Sample times in s (e,) and joint angles in rad (e,)."""
    time = _sample_times(trajectory, encoder.rate)
    noise = _stream(seed, 5).standard_normal(len(time))
    theta = trajectory.at(time).theta + encoder.noise * noise
    if encoder.resolution > 0.0:
        theta = encoder.resolution * np.round(theta / encoder.resolution)
    return time, theta


def _sample_times(trajectory: Trajectory, rate: float) -> Array:
    """Instants, s, of a sensor that starts with the trajectory."""
    start, end = trajectory.time[0], trajectory.time[-1]
    return np.asarray(start + np.arange(int(np.floor((end - start) * rate + 1e-6)) + 1) / rate)


def _stream(seed: int, purpose: int) -> np.random.Generator:
    """An independent random stream for each purpose."""
    return np.random.default_rng([seed, purpose])


def _coloured(white: Array, correlation: float) -> Array:
    """First-order autoregressive noise of unit variance along the first axis."""
    if correlation == 0.0:
        return white
    driven = white * np.sqrt(1.0 - correlation**2)
    driven[0] = white[0]
    return np.asarray(lfilter([1.0], [1.0, -correlation], driven, axis=0))


def _occlusions(stream: np.random.Generator, shape: tuple[int, ...], camera: Camera) -> NDArray[np.bool_]:
    """Where a marker is hidden, (f, k): a two-state Markov chain with the asked share and mean run length."""
    hidden = np.zeros(shape, dtype=bool)
    if camera.occluded == 0.0:
        return hidden
    ends = 1.0 / camera.occlusion_frames
    begins = ends * camera.occluded / (1.0 - camera.occluded)
    draws = stream.random(shape)
    hidden[0] = draws[0] < camera.occluded
    for index in range(1, shape[0]):
        hidden[index] = np.where(hidden[index - 1], draws[index] >= ends, draws[index] < begins)
    return hidden
