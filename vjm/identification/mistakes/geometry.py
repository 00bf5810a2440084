"""Mistakes in the geometry of recordings: units, order of markers, the camera's origin and axes, the joint's angle."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from vjm.experiment.checks import UNTRACKED_PLACE, untracked
from vjm.experiment.conventions import FACTORS, Conventions
from vjm.identification.mistakes.evidence import (
    LIKELY,
    Mistake,
    angle_at,
    chosen_frames,
    negated,
    root_headings,
    swings,
    unit_factors,
)
from vjm.records import Array, Experiment, Indices, Link, Mask
from vjm.text import listed

# What is off by less is a scale, a marker or a pose to be found by a diagnosis, and no mistake of another kind: the
# slack of vjm.experiment.checks, and five times the everyday misalignment of a camera that somebody aligned.
_RELATIVE, _SHARE = 0.04, 0.02  # of a distance, and of the link's length
# Of the direction from the base to a single marker [rad], whose bending nothing shows: while the joint turns, as far as
# links bend in proportion to their loads; at rest in a mean posture, under their own weight, farther.
_UNSEEN_SWING, _UNSEEN_SAG = 0.1, 0.3
_OFFSET = 0.05  # rad; of a heading from where the camera's axes and the encoder's zero have it
_ORIGIN = 0.005  # of the length: what the origin may be off, a few millimetres on an arm of a metre


class _Hypothesis(NamedTuple):
    """Mistake that distances between markers may come from; by default none."""

    order: tuple[int, ...] = ()  # two markers that are exchanged, or all of them in reverse, numbered from 1
    unit: str = ""  # that numbers are in
    source: str = ""  # of the numbers in that unit: `recordings` or `rig`


def untracked_mistakes(experiment: Experiment) -> Iterator[Mistake]:
    """Yield recordings in most of whose frames a marker is at a place that no camera measures."""
    rig = experiment.rig
    for recording in experiment.recordings:
        seen = np.isfinite(recording.markers).all(axis=2).sum(axis=0)
        lost = untracked(rig, recording, experiment.conventions.camera.origin).sum(axis=0) > 0.5 * seen
        if lost.any():
            names = listed([rig.marker_names[k] for k in np.flatnonzero(lost)])
            text = (
                f"{names} stand exactly {UNTRACKED_PLACE} in most frames: "
                "zeros, as it seems, of what was not tracked; leave these cells empty, or leave the recording out"
            )
            yield Mistake(text, np.inf, (recording.file,))


def distance_mistakes(experiment: Experiment, skipped: Collection[str]) -> list[Mistake]:
    """Return mistakes in the unit of length and the order of the markers, seen in distances, which no bending changes.

    Each hypothesis, a unit and an order, predicts the distances between a link's markers and, of the first link, to the
    base, unless that is elsewhere; they are compared by their likelihoods. Files in `skipped` show no distances.
    """
    evidence: dict[tuple[int, _Hypothesis], list[tuple[str, float, float]]] = {}
    for recording in experiment.recordings:
        if recording.file in skipped:
            continue
        rows = chosen_frames(recording)
        for index, marker_slice in enumerate(experiment.rig.marker_slices):
            key, gain, scale = _best_hypothesis(experiment, index, recording.markers[rows, marker_slice])
            if gain > LIKELY:
                evidence.setdefault((index, key), []).append((recording.file, gain, scale))
    mistakes = []
    for (index, key), group in evidence.items():
        files, gains, scales = zip(*group, strict=True)
        text = _distance_text(experiment.rig.links[index], key, float(np.median(scales)))
        mistakes.append(Mistake(text, sum(gains), files))
    return mistakes


def _best_hypothesis(experiment: Experiment, index: int, markers: Array) -> tuple[_Hypothesis, float, float]:
    """Return the likeliest hypothesis of a link's markers (F, k, 2), its gain and how much too large distances are."""
    link = experiment.rig.links[index]
    based, count = index == 0, len(link.markers)
    arcs = np.array([-link.hub_radius if link.markers_frame == "base" else 0.0, *link.markers])  # the base's first
    points = np.concatenate([np.zeros((len(markers), 1, 2)), markers], axis=1)
    first, second = np.triu_indices(arcs.size, 1)
    distances = np.hypot(*np.moveaxis(points[:, first] - points[:, second], 2, 0))
    usable = np.isfinite(distances).sum(axis=0) >= 10
    inner = usable & (first > 0)
    if not (usable if based else inner).any():
        return _Hypothesis(), 0.0, 1.0
    median = np.full(first.size, 1.0)
    median[usable] = np.maximum(np.nanmedian(distances[:, usable], axis=0), 1e-300)
    scales: dict[tuple[str, str], float] = {("", ""): 1.0}
    units = unit_factors("length", experiment.conventions.units.length)
    scales |= {(name, "recordings"): factor for name, factor in units.items()}
    scales |= {(name, "rig"): 1 / factor for name, factor in unit_factors("length", "m").items()}
    orders: list[tuple[int, ...]] = [(), *combinations(range(1, count + 1), 2)]
    orders += [tuple(range(count, 0, -1))] if count > 2 else []
    places = np.tile(np.arange(arcs.size), (len(orders), 1))
    for row, order in zip(places, orders, strict=True):
        if len(order) == 2:
            row[list(order)] = order[::-1]
        elif order:
            row[1:] = order
    nominal = np.abs(arcs[places[:, first]] - arcs[places[:, second]])
    factors = np.array(list(scales.values()))[:, None, None]
    deviation = np.log(median * factors / nominal) / np.hypot(_RELATIVE, _SHARE * link.length / nominal)
    fits = [_log_likelihood(deviation, usable, first, second)] if based else []
    if not based or (inner.any() and link.markers_frame == "base"):
        origin_cost = 2 * np.log(1 / _ORIGIN) if based else 0.0  # two numbers that would have to be found
        fits.append(_log_likelihood(deviation, inner, first, second) - origin_cost)
    results: dict[_Hypothesis, float] = {}
    likelihoods = np.max(fits, axis=0).ravel().tolist()
    for ((unit, source), order), likelihood in zip(product(scales, orders), likelihoods, strict=True):
        # A mistake has to make up for the number of those that were looked for.
        cost = np.log(len(scales)) * bool(unit) + np.log(len(orders)) * bool(order)
        prior = _size_prior(arcs[-1], unit if source == "rig" else "")
        results[_Hypothesis(order, unit, source)] = likelihood - cost + prior
    best = max(results, key=lambda key: results[key])
    shown = inner if inner.any() else usable
    scale = float(np.median(median[shown] / np.abs(arcs[first] - arcs[second])[shown]))
    return best, results[best] - results[_Hypothesis()], scale


def _log_likelihood(deviation: Array, chosen: Mask, first: Indices, second: Indices) -> Array:
    """Return log-likelihoods (...) of distances (..., d) between pairs of points, which hold one distance a point."""
    independent = np.unique([*first[chosen], *second[chosen]]).size - 1
    return np.asarray(-0.5 * independent * np.mean(deviation[..., chosen] ** 2, axis=-1))


def _size_prior(length: float, unit: str) -> float:
    """Return the log-likelihood of a length [m] given in another unit: arms are half a metre long, give or take."""
    metres = length * (unit_factors("length", "m")[unit] if unit else 1.0)
    return -0.5 * float(np.log(metres / 0.5) / np.log(4.0)) ** 2


def _distance_text(link: Link, key: _Hypothesis, scale: float) -> str:
    order, unit, source = key
    parts, remedies = [], []
    if unit:
        finding = f"distances between the markers of {link.name} are {scale:.4g} times those of its key 'markers'"
        names = {"mm": "millimetres", "cm": "centimetres", "in": "inches", "m": "metres"}
        parts.append(
            f"{finding}: {'the coordinates look' if source == 'recordings' else 'its lengths look'} like {names[unit]}"
        )
        remedies.append(
            f'set [units] length = "{unit}"'
            if source == "recordings"
            else f"give 'markers' and all other lengths of [[link]] {link.name} in metres"
        )
    if len(order) == 2:
        first, second = (f"{link.name}.m{k}" for k in order)
        parts.append(f"distances fit 'markers' only with {first} and {second} exchanged: the two are swapped")
        remedies.append(f'exchange them in the file or in [columns] ("{first}.x" and "{second}.x", and so on)')
    elif order:
        parts.append(f"distances fit 'markers' only with those of {link.name} counted from the tip: they are reversed")
        remedies.append("number them from the base outwards, in the file or in [columns]")
    return f"{'; '.join(parts)}; {'; '.join(remedies)}"


def sideways_mistakes(experiment: Experiment) -> Iterator[Mistake]:
    """Yield links whose markers, in the link's own frame and of y alone, are farther to the side than they can be."""
    for link, marker_slice in zip(experiment.rig.links, experiment.rig.marker_slices, strict=True):
        if link.markers_frame == "base":
            continue
        for recording in experiment.recordings:
            markers = recording.markers[:, marker_slice]
            if np.isfinite(markers[..., 0]).any() or not np.isfinite(markers[..., 1]).any():
                continue
            reach = float(np.nanmax(np.abs(markers[..., 1]) / np.array(link.markers)))
            if reach > 1.0 + _RELATIVE + _SHARE:  # a link does not stretch
                text = (
                    f"markers of {link.name} are up to {reach:.3g} times as far beside it as along it: the "
                    'coordinates look like millimetres; set [units] length = "mm"'
                )
                yield Mistake(text, np.inf, (recording.file,))
                break


def heading_mistakes(experiment: Experiment, skipped: Sequence[str], torque_sign: float | None) -> list[Mistake]:
    """Return mistakes of axes, of the frame and of the joint's angle that the headings of the first link show.

    Args:
        experiment: the recordings.
        skipped: files of those whose distances already show a mistake.
        torque_sign: of the torque relative to the motion of the markers; None where it was not seen.
    """
    link = experiment.rig.links[0]
    slope, slope_gain, offsets = _headings(experiment, skipped)
    based, bent = link.markers_frame == "base", _UNSEEN_SAG if len(link.markers) == 1 else 0.0
    groups: dict[int | None, list[tuple[str, float, float]]] = {}
    for file, offset in offsets:
        quarter, gain = _quarter_turns(offset, float(np.hypot(_OFFSET, bent))) if based else (0, 0.0)
        if slope_gain:
            quarter, gain = quarter if slope in (1.0, -1.0) else 0, slope_gain
        if gain > LIKELY:
            groups.setdefault(quarter, []).append((file, offset, gain))
    mistakes = []
    for quarter, group in groups.items():
        files, turns, gains = zip(*group, strict=True)
        offset = float(np.angle(np.mean(np.exp(1j * np.array(turns)))))
        text = _heading_text(experiment, slope, quarter, offset, torque_sign)
        mistakes.append(Mistake(text, max(gains), files))
    return mistakes


def _headings(experiment: Experiment, skipped: Sequence[str]) -> tuple[float | None, float, list[tuple[str, float]]]:
    """Compare the heading of the first link's markers at the base with the joint's angle.

    The slope of heading over angle is one of those that a mistake makes: of the other sign, of another unit, or zero
    where coordinates are in the link's frame. It is the sensor's, so the same in all recordings. A stiff drive bends
    the link as it turns it, and a heading extrapolated to the base is off by about the bending that it assumes. But
    bending looks different from the markers alone and from the base on, while a mistake shows both ways.

    Returns:
        The slope (None without an active joint); the logarithm of how much likelier it is than the one expected, zero
        where that will do; each recording's file, with its heading at angle zero [rad].
    """
    rig = experiment.rig
    link, units = rig.links[0], unit_factors("angle", experiment.conventions.units.angle)
    slopes = [1.0, -1.0, 0.0, *(sign * factor for factor in units.values() for sign in (1, -1))]
    if link.markers_frame == "link":
        slopes = [0.0, 1.0, -1.0]  # a unit of the angle does not show there
    chosen = [recording for recording in experiment.recordings if link.markers and recording.file not in skipped]
    ways = 2 if len(link.markers) > 2 else 1  # two markers alone show no bending
    measured, gains = [], np.zeros((ways, len(slopes)))
    for recording in chosen:
        rows = chosen_frames(recording)
        markers, theta = recording.markers[rows][:, rig.marker_slices[0]], angle_at(recording, rows)
        estimates = [root_headings(rig, markers, based) for based in (False, True)]
        if estimates[0] is not None:
            measured.append((recording.file, theta, estimates[0][0]))
            likelihoods = [
                _slope_likelihoods(np.array(slopes), theta, *estimate, len(chosen))
                for estimate in estimates[-ways:]
                if estimate
            ]
            gains += [likelihood - likelihood[0] for likelihood in likelihoods]
    best = int(np.argmax(gains.min(axis=0)))
    gain = float(gains[:, best].min())
    slope: float | None = slopes[best] if gain > LIKELY else slopes[0]
    if link.joint != "revolute":
        slope = None
    phasors = [(file, np.exp(1j * (heading - (slope or 0.0) * theta))) for file, theta, heading in measured]
    offsets = [(file, float(np.angle(np.nanmean(phasor)))) for file, phasor in phasors]
    return slope, gain if slope not in (None, slopes[0]) else 0.0, offsets


def _slope_likelihoods(
    slopes: Array, theta: Array, heading: Array, bending: Array | None, noise: float, recordings: int
) -> Array:
    """Return the log-likelihoods (S,) of slopes of the heading (F,) over the joint's angle (F,) in a recording.

    The measured slope is off by the part of the extrapolated bending that goes with the angle, times a factor of mean
    zero and deviation one that is the same in all `recordings`, and so counts but once; and by all that does not go
    with it, and averages out over the swings. With few of these, Student's distribution.
    """
    known = np.isfinite(heading)
    x, y = theta[known] - theta[known].mean(), np.unwrap(heading[known])
    y -= y.mean()
    square, count = max(float(np.mean(x**2)), 1e-300), swings(x) + 1
    slope = float(np.mean(x * y)) / square
    bent = _UNSEEN_SWING / np.sqrt(square) if bending is None else float(np.mean(x * bending[known])) / square
    variance = recordings * bent**2 + (float(np.mean((y - slope * x) ** 2)) + noise**2) / (count * square)
    return np.asarray(-0.5 * count * np.log1p((slope - slopes) ** 2 / (count * variance)))


def origin_mistakes(experiment: Experiment, skipped: Sequence[str]) -> list[Mistake]:
    """Return that the first link starts elsewhere: at another origin, or further from its joint's axis than described.

    The marker nearest to the base is its own arc length away from there, in the link's direction: it bends least.
    """
    link, marker_slice = experiment.rig.links[0], experiment.rig.marker_slices[0]
    moved, on_hub = list[tuple[str, float, Array]](), list[tuple[str, float, float]]()
    for recording in experiment.recordings:
        markers = recording.markers[chosen_frames(recording)][:, marker_slice]
        angles = root_headings(experiment.rig, markers)
        if recording.file in skipped or link.markers_frame == "link" or len(link.markers) < 2 or angles is None:
            continue
        nearest = int(np.argmax(np.isfinite(markers).all(axis=2).mean(axis=0) > 0.5))
        direction = np.stack([np.cos(angles[0]), np.sin(angles[0])], axis=1)
        start = markers[:, nearest] - (link.hub_radius + link.markers[nearest]) * direction
        known = np.isfinite(start).all(axis=1)
        ahead = np.sum(start * direction, axis=1)[known, None]
        offset, gain = _displacement(start[known], link.length)
        moved.append((recording.file, gain, offset))
        radius, gain = _displacement(ahead, link.length)
        on_hub.append((recording.file, gain if link.joint == "revolute" else 0.0, float(radius[0])))
    moved = [each for each in moved if each[1] > LIKELY]
    on_hub = [each for each in on_hub if each[1] > LIKELY]
    if sum(gain for _, gain, _ in on_hub) > sum(gain for _, gain, _ in moved):
        files, gains, radii = zip(*on_hub, strict=True)
        further = float(np.median(radii))
        total = link.hub_radius + further
        text = (
            f"the markers of {link.name} are {abs(further):.3g} m {'further from' if further > 0 else 'nearer to'} its "
            "joint's axis than given: "
        )
        if total > 0:
            text += f"if it begins on a hub, give 'hub_radius' of [[link]] {link.name} in m, {total:.3g}; "
        text += f"if the ruler began elsewhere, add {further:.3g} to its 'markers'"
        return [Mistake(text, max(gains), files)]
    if not moved:
        return []
    files, gains, offsets = zip(*moved, strict=True)
    x, y = np.median(offsets, axis=0)
    camera = experiment.conventions.camera.origin
    text = (
        f"the markers show that {link.name} starts at ({x:.3g}, {y:.3g}) m, and not at the base's origin: the camera's "
        f"origin is another; set [camera] origin = [{camera[0] - x:.3g}, {camera[1] - y:.3g}]"
    )
    return [Mistake(text, max(gains), files)]


def _displacement(start: Array, length: float) -> tuple[Array, float]:
    """Return how far a link's beginning (F, d) is from where it should be, and what is gained by these d numbers."""
    # The link bends while it moves, and little of that is evidence of where it starts.
    spread = start.std(axis=0).max() / np.sqrt(swings(start[:, -1]) + 1)
    allowed = float(np.hypot(_ORIGIN * length, spread))
    offset = np.median(start, axis=0)
    cost = offset.size * float(np.log(length / allowed))
    return offset, 0.5 * float(np.sum((offset / allowed) ** 2)) - cost


def _quarter_turns(offset: float, std: float) -> tuple[int | None, float]:
    """Return how many quarter turns explain an offset best (None: another angle), and the gain over no turn."""
    deviations = np.angle(np.exp(1j * (offset - np.arange(4) * np.pi / 2)))
    fits = -0.5 * (deviations / std) ** 2 - np.array([0.0, 1.0, 1.0, 1.0]) * np.log(3.0)
    uniform = -float(np.log(2 * np.pi / std))
    best = int(np.argmax(fits))
    return (None, uniform - float(fits[0])) if uniform > fits[best] else (best, float(fits[best] - fits[0]))


def _heading_text(
    experiment: Experiment, slope: float | None, quarter: int | None, offset: float, torque_sign: float | None
) -> str:
    link, conventions = experiment.rig.links[0], experiment.conventions
    theta = conventions.name_in_files(f"{link.name}.theta")
    if link.markers_frame == "link":
        return (
            f"the markers of {link.name} turn {'with' if slope == 1.0 else 'against'} {theta}, which they do not in "
            'the link\'s own frame: the coordinates look like those of the base frame; set markers_frame = "base" in '
            f"[[link]] {link.name}"
        )
    if slope == 0.0:
        return (
            f"the markers of {link.name} do not turn while {theta} does: the coordinates look like those of the link's "
            f'own frame; set markers_frame = "link" in [[link]] {link.name}'
        )
    if slope is not None and abs(slope) != 1.0:
        unit = next(
            name for name, factor in unit_factors("angle", conventions.units.angle).items() if factor == abs(slope)
        )
        words = {"deg": "degrees", "rad": "radians"}[unit]
        sign = f", and {negated(theta)}, whose sign is wrong too" if slope < 0 else ""
        return (
            f"the markers of {link.name} turn {abs(slope):.3g} times as far as {theta} says: it looks like {words}; "
            f'set [units] angle = "{unit}"{sign}'
        )
    if slope == -1.0 and quarter == 0:
        if torque_sign is not None:
            if torque_sign > 0:
                finding = f"{theta} falls while the markers, and the torque, turn the link the other way"
                return f"{finding}: its sign is wrong; {negated(theta)}"
            return _axes_text(
                conventions, "the markers turn against both the angle and the torque: y points the other way", -1.0, 0
            )
        return (
            f"the markers turn against {theta}: either its sign is wrong ({negated(theta)}), or an axis points the "
            f"other way (set [camera] axes = {_axes(conventions, -1.0, 0)})"
        )
    if quarter is None:
        side = "ahead of" if offset > 0 else "behind"
        description = f"the markers of {link.name} are {abs(np.rad2deg(offset)):.3g} degrees {side} where "
        description += f"{theta} has them" if slope is not None else "a link along x has them"
        unit = conventions.units.angle
        alternative = f", or add {offset / FACTORS['angle'][unit]:.3g} {unit} to {theta}" if slope is not None else ""
        rotation = np.angle(np.exp(1j * (conventions.camera.rotation - offset)))
        remedy = f"set [camera] rotation = {rotation:.3g} (radians){alternative}"
        return f"{description}: the camera's frame is turned; {remedy}"
    direction = {1: "along +y", 2: "along -x", 3: "along -y"}[quarter] if quarter else "along +x"
    likely = {1: "x and y look swapped", 2: "x looks as if it pointed the other way", 3: "x and y look swapped"}
    finding = f"the link lies {direction} of the camera's frame where it should lie along +x: {likely.get(quarter, '')}"
    # Of a clamped link nothing tells a swap from a turn; the former is the commoner mistake.
    mirrored = -1.0 if slope is None else slope
    if slope == 1.0:
        finding = finding.partition(":")[0] + ": its frame is turned"
    return _axes_text(conventions, finding, mirrored, quarter)


def _axes_text(conventions: Conventions, finding: str, slope: float, quarter: int) -> str:
    return f"{finding}; set [camera] axes = {_axes(conventions, slope, quarter)}"


def _axes(conventions: Conventions, slope: float, quarter: int) -> str:
    """Return the axes that undo a turn by some quarters, and a mirror image if the slope is negative."""
    c, s = round(np.cos(quarter * np.pi / 2)), round(np.sin(quarter * np.pi / 2))
    matrix = [[c, s], [s, -c]] if slope < 0 else [[c, s], [-s, c]]
    axes = []
    for row in matrix:
        position = 0 if row[0] else 1
        axis = conventions.camera.axes[position]
        negative = (row[position] < 0) != axis.startswith("-")
        axes.append(f'"{"-" if negative else ""}{axis[-1]}"')
    return f"[{', '.join(axes)}]"


def length_mistake(link: Link) -> Mistake | None:
    """Return that a link's length is in another unit than its markers; None if they fit each other.

    Somebody who measures a link's bending puts a marker on its outer half: a tenth of it is unlikely by itself.
    """
    share = link.markers[-1] / link.length if link.markers else 1.0
    fits = {
        unit: -0.5 * (np.log(share / factor) / np.log(2.0)) ** 2 for unit, factor in unit_factors("length", "m").items()
    }
    unit = max(fits, key=lambda name: fits[name])
    gain = float(fits[unit] + 0.5 * (np.log(share) / np.log(2.0)) ** 2 - np.log(len(fits)))
    if gain < LIKELY:
        return None
    metres = link.length * unit_factors("length", "m")[unit]
    text = (
        f"the outermost marker of {link.name} is {link.markers[-1]:.4g} m along a link {link.length:.4g} m long: the "
        f"length looks like {unit}; give 'length' of [[link]] {link.name} in metres, {metres:.4g}"
    )
    return Mistake(text, gain)
