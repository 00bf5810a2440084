"""What is odd about marker coordinates: each check returns plain sentences, none where all is well."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from vjm.experiment.records import Array

DEFAULT_MARKER_NOISE = 1e-3  # m, where the experiment does not give it
LARGEST_REACH = 20.0  # arm lengths; a coordinate beyond is no longer in metres
TOLERANCE = 6.0  # standard deviations of a distance: chance reaches it once in 1e9 comparisons
SHORTEST_CLIP = 5  # frames
CLIP_DROP = 20.0  # finest steps; a smooth peak, rounded, drops by 9 within its own width (see `clipped_runs`)
MOST_SWAP_FRAMES = 50


def units_warnings(markers: Array, arm_length: float) -> list[str]:
    """Coordinates far outside the arm's reach.

    Args:
        markers: (T, k, 2) positions [m].
        arm_length: sum of the links' lengths [m].
    """
    largest = float(np.nanmax(np.abs(markers), initial=0.0))
    if largest <= LARGEST_REACH * arm_length:
        return []
    return [
        f"a marker coordinate reaches {largest:.4g} m with an arm {arm_length:.4g} m long: "
        "the coordinates look like millimetres, and metres are expected"
    ]


def distance_warnings(time: Array, markers: Array, arcs: Array, names: list[str], noise: float) -> list[str]:
    """Frames in which two markers of one link are farther apart than the link between them is long.

    Args:
        time: (T,) [s].
        markers: (T, k, 2) positions of one link's markers [m]; an unknown coordinate is NaN and counts as no distance.
        arcs: (k,) arc lengths of the markers [m].
        names: k names of the markers.
        noise: 1-sigma noise of a coordinate [m].
    """
    limits = distance_limits(arcs, noise)
    bad, excess, pair = _beyond_limits(markers, limits)
    if not bad.size:
        return []
    first, second = pair
    sentence = (
        f"in {bad.size} frame{'s' if bad.size > 1 else ''} (first at t = {time[bad[0]]:.6g} s) markers are "
        f"farther apart than the link allows, by up to {excess:.3g} m between {names[first]} and {names[second]}, "
        f"which are {abs(arcs[second] - arcs[first]):.4g} m apart along the link"
    )
    return [sentence + _swap_hint(markers[bad], limits, names)]


def distance_limits(arcs: Array, noise: float) -> Array:
    """(k, k) distance [m] beyond which two of a link's markers cannot be apart, whatever the link's shape.

    Args:
        arcs: (k,) arc lengths of the markers [m].
        noise: 1-sigma noise of a coordinate [m].
    """
    limits: Array = np.abs(arcs[:, None] - arcs) + TOLERANCE * np.sqrt(2.0) * noise
    return limits


def _beyond_limits(markers: Array, limits: Array) -> tuple[NDArray[np.intp], float, tuple[int, int]]:
    """Frames with a distance beyond its limit, the largest excess over the arc [m], and the pair that has it."""
    count = markers.shape[1]
    bad = np.zeros(len(markers), dtype=np.bool_)
    worst, pair = 0.0, (0, 0)
    for first in range(count - 1):
        beyond = _lengths(markers[:, first + 1 :] - markers[:, [first]]) - limits[first, first + 1 :]
        bad |= (beyond > 0.0).any(axis=1)
        largest = beyond.max(axis=0, initial=0.0)
        if largest.max() > worst:
            worst, pair = float(largest.max()), (first, first + 1 + int(largest.argmax()))
    return np.flatnonzero(bad), worst + float(limits[0, 0]), pair


def _lengths(differences: Array) -> Array:
    """(...,) lengths of vectors (..., 2), the unknown parts of which count as zero."""
    known = np.where(np.isfinite(differences), differences, 0.0)
    lengths: Array = np.hypot(known[..., 0], known[..., 1])
    return lengths


def _swap_hint(markers: Array, limits: Array, names: list[str]) -> str:
    """Says which two labels, exchanged, make most of these frames (F, k, 2) consistent; empty where none do."""
    chosen = markers[np.unique(np.linspace(0, len(markers) - 1, MOST_SWAP_FRAMES).astype(int))]
    distances = _lengths(chosen[:, :, None] - chosen[:, None])
    best, repaired = (0, 0), 0
    for pair in combinations(range(len(limits)), 2):
        order = np.arange(len(limits))
        order[list(pair)] = order[[pair[1], pair[0]]]
        count = int((distances <= limits[np.ix_(order, order)]).all(axis=(1, 2)).sum())
        if count > repaired:
            best, repaired = pair, count
    if not repaired:
        return ""
    return (
        f"; labels may be swapped: exchanging {names[best[0]]} and {names[best[1]]} makes "
        f"{repaired} of the {len(chosen)} such frames looked at consistent"
    )


def clipping_warnings(time: Array, coordinates: Array, names: list[str]) -> list[str]:
    """Coordinates that stand still at their very extreme, as at the edge of a camera's image.

    Args:
        time: (T,) [s].
        coordinates: (T, c) marker coordinates [m].
        names: c names of the coordinates.
    """
    warnings: list[str] = []
    for values, name in zip(coordinates.T, names, strict=True):
        measured = np.flatnonzero(np.isfinite(values))
        for sign, extreme in ((1.0, "largest"), (-1.0, "smallest")):
            starts, lengths = clipped_runs(sign * values[measured])
            if not lengths.size:
                continue
            begin = int(measured[starts[0]])
            warnings.append(
                f"{name} stays at exactly its {extreme} value, {values[begin]:.6g} m, for up to {int(lengths.max())} "
                f"frames in a row (first at t = {time[begin]:.6g} s): it looks clipped, as at the edge of the image"
            )
    return warnings


def clipped_runs(values: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Where a signal stays at its maximum as a clipped one does.

    A run counts when it is long, touches neither end of the signal (an arm at rest), and the signal falls steeply
    on both sides: within the run's own length by more than a smooth peak does that is flat only because its values
    are rounded. A parabola that rounding to steps q keeps flat over a width w is 9 q lower at a distance of 3 w / 2.

    Args:
        values: (N,) finite values.

    Returns:
        First index and length of each run.
    """
    none = np.empty(0, dtype=np.intp)
    steps = np.unique(values[np.isfinite(values)])
    if steps.size < 2:
        return none, none
    finest = float(np.diff(steps).min())
    at_top = np.concatenate(([False], values == steps[-1], [False]))
    edges = np.flatnonzero(np.diff(at_top.astype(np.int8)))
    starts, stops = edges[::2], edges[1::2]
    lengths = stops - starts
    long = lengths >= SHORTEST_CLIP
    starts, stops, lengths = starts[long], stops[long], lengths[long]
    # a run at either end of the signal has no drop on that side
    before = steps[-1] - values[np.maximum(starts - lengths, 0)]
    after = steps[-1] - values[np.minimum(stops - 1 + lengths, len(values) - 1)]
    steep = np.minimum(before, after) > CLIP_DROP * finest
    return starts[steep], lengths[steep]


def absence_warnings(markers: Array, names: list[str], needs_x: NDArray[np.bool_]) -> list[str]:
    """Markers never measured, and frames that have one coordinate of a marker but not the other.

    Args:
        markers: (T, k, 2) positions [m].
        names: k names of the markers.
        needs_x: (k,) whether x is needed besides y: the marker is measured in the base frame.
    """
    measured = np.isfinite(markers)
    never = [names[index] for index in np.flatnonzero(~np.any(measured, axis=(0, 2)))]
    warnings = [f"no position of {', '.join(never)} in this recording"] if never else []
    halves = int(((measured[..., 0] != measured[..., 1]) & needs_x).any(axis=1).sum())
    if halves:
        warnings.append(f"in {halves} frame{'s' if halves > 1 else ''} a marker has one coordinate but not the other")
    return warnings
