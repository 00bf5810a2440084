"""Mistakes in the torque and in gravity, by the balance of angular momentum about the first joint.

Whatever the link's stiffness, the torque is the rate of the angular momentum less the moment of gravity. Multiplied
with a smooth function of time that is zero at both ends, and integrated by parts twice, the balance needs neither rates
nor accelerations (the weak form). The momentum follows from the angles to the markers, between which the link's mass
is spread.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vjm.experiment.conventions import FACTORS
from vjm.identification.mistakes.evidence import (
    CERTAIN,
    EARTH,
    LIKELY,
    Mistake,
    angle_at,
    gravity_key,
    negated,
    root_headings,
    seen_markers,
)
from vjm.records import Array, Experiment, Link, Recording, Rig

_GRAM = 1e-3  # kg
_HUB_UNITS = {1e-4: "kg cm^2", 1e-6: "kg mm^2", 1e-7: "g cm^2"}  # as motors' data sheets have them, by size [kg m^2]
_ROUGHLY = np.geomspace(0.1, 10.0, 5)  # of a hub's inertia that is given
_UNKNOWN = np.array([0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0])  # of the link's, where none is given
_SEVERALFOLD = 0.1, 10.0  # of masses that are no unit's: of the right order of magnitude if that is wrong
_SHORTEST = 16  # samples of a window: its second derivative is then sampled well


class _Scales(NamedTuple):
    """Hypothesis: true torque, inertias and gravity over those that are given; by default none is wrong."""

    torque: float = 1.0
    mass: float = 1.0  # of the link and of what it carries
    hub: float = 1.0
    gravity: complex = 1.0  # x + i y: none of it, or turned


@dataclass(frozen=True)
class _Balance:
    """Projections on windows of one length in one recording, a row for each window [N m s]."""

    file: str
    driven: bool
    gravity: tuple[float, float]  # declared [m/s^2]
    torque: Array  # (N,)
    momentum: Array  # (N,) of the motion
    turning: Array  # (N,) that an inertia of 1 kg m^2 at the joint would have
    lever: Array  # (N, 2) moments of a unit gravity along x and y
    noise: float  # 1-sigma of the momentum's projection
    link_noise: float  # the same without the hub's part
    turning_noise: float  # and of `turning`
    independent: float  # number of windows that do not overlap

    def weight(self, gravity: complex) -> Array:
        """Return projections (N,) of the moment of a gravity x + i y [m/s^2]."""
        return np.asarray(self.lever @ np.array([gravity.real, gravity.imag]))


def balances(experiment: Experiment) -> list[list[_Balance]]:
    """Return for each recording with a torque the balances over windows of several lengths; for a single link only."""
    rig = experiment.rig
    if len(rig.links) > 1 or rig.links[0].joint != "revolute" or not rig.links[0].markers:
        return []
    result = []
    for recording in experiment.cleaned_recordings:
        if recording.input == "torque" and recording.kind != "static":
            result.append(_balances(rig, recording))
    return [recording_balances for recording_balances in result if recording_balances]


def _balances(rig: Rig, recording: Recording) -> list[_Balance]:
    rows = recording.frames
    torque_known = np.isfinite(recording.tau[:, 0])
    if torque_known.sum() < _SHORTEST:
        return []
    theta = angle_at(recording, rows)
    markers = recording.markers[rows][:, rig.marker_slices[0]]
    root = root_headings(rig, markers)
    if root is None:
        return []
    heading, _, heading_noise = root
    arcs, points = seen_markers(rig, markers)
    angles = np.arctan2(points[..., 1], points[..., 0])
    complete = np.isfinite(heading) & np.isfinite(angles).all(axis=1)
    if rig.links[0].markers_frame == "link":  # angles are those of deflections
        angles, heading = angles + theta[:, None], theta
    squares, firsts = _mass_moments(rig, recording.payload, arcs)
    polar = np.column_stack([np.unwrap(heading[complete]), angles[complete]])
    polar[:, 1:] = polar[:, :1] + np.angle(np.exp(1j * (polar[:, 1:] - polar[:, :1])))
    time = recording.time[rows][complete]
    step = float(np.median(np.diff(time)))
    instants = np.arange(time[0], time[-1], step)
    momentum, turning = (np.interp(instants, time, signal) for signal in (polar @ squares, polar[:, 0]))
    place = [np.interp(instants, time, wave @ firsts) for wave in (np.cos(polar), np.sin(polar))]
    torque = np.interp(instants, recording.time[torque_known], recording.tau[torque_known, 0])
    coordinate = rig.marker_noise or 1e-3 * rig.links[0].length
    markers_noise = coordinate * np.sqrt(np.sum((squares[1:] / arcs) ** 2))
    bases = np.array([squares[0], squares[0] - rig.links[0].hub_inertia, 1.0])  # inertias that turn with the base
    noises = np.hypot(bases * heading_noise, markers_noise * np.array([1.0, 1.0, 0.0]))
    result, size = [], _SHORTEST
    while 2 * size <= instants.size:
        phase = np.pi * (np.arange(size) + 0.5) / size
        window = np.sin(phase) ** 4
        second = 4 * np.sin(phase) ** 2 * (3 - 4 * np.sin(phase) ** 2) * (np.pi / (size * step)) ** 2
        second -= second.mean()
        kernel_norm = float(np.sqrt(np.sum(second**2))) * step
        hop = slice(None, None, max(size // 2, 1))

        def project(signal: Array, kernel: Array, hop: slice = hop) -> Array:
            return np.asarray(np.convolve(signal, kernel, "valid")[hop] * step)

        result.append(
            _Balance(
                recording.file,
                recording.kind == "driven",
                recording.gravity,
                project(torque, window),
                project(momentum - momentum.mean(), second),
                project(turning - turning.mean(), second),
                np.column_stack([-project(place[1], window), project(place[0], window)]),
                noise=float(noises[0] * kernel_norm),
                link_noise=float(noises[1] * kernel_norm),
                turning_noise=float(noises[2] * kernel_norm),
                independent=instants.size / size,
            )
        )
        size *= 2
    return result


def _mass_moments(rig: Rig, payload: float, arcs: Array) -> tuple[Array, Array]:
    """Return second [kg m^2] and first moments [kg m] (1 + k,) of the mass that turns with the base and each marker.

    Between them, at arc lengths (k,) [m], the angle about the base is taken as linear.
    """
    link, grid = rig.links[0], np.linspace(0.0, rig.links[0].length, 201)
    nodes = np.array([0.0, *arcs])
    hats = np.stack([np.interp(grid, nodes, row) for row in np.eye(nodes.size)])
    density = np.full(grid.size, link.mass / grid.size)
    squares, firsts = hats @ (density * grid**2), hats @ (density * grid)
    tip = (link.payload + payload) * link.length
    squares[0] += link.hub_inertia
    squares[-1] += tip * link.length
    firsts[-1] += tip
    return squares, firsts


def torque_gains(experiment: Experiment, recordings: list[list[_Balance]]) -> dict[_Scales, float]:
    """Return the log-likelihood of each hypothesis over that of none, by how well torque and motion then balance."""
    current = FACTORS["torque"][experiment.conventions.units.torque]
    sizes = [size / current for size in FACTORS["torque"].values()]
    scales = [_Scales(), _Scales(-1.0), *(_Scales(sign * size) for size in sizes if size != 1.0 for sign in (1, -1))]
    scales += [*(_Scales(mass=size) for size in (_GRAM, *_SEVERALFOLD)), *(_Scales(hub=size) for size in _HUB_UNITS)]
    scales += [_Scales(gravity=turn) for turn in (0.0, -1.0, 1.0j, -1.0j)]
    link = experiment.rig.links[0]
    gains = np.sum([_gains(link, recording, scales) for recording in _driven(recordings, silent=False)], axis=0)
    return dict(zip(scales, np.broadcast_to(gains, len(scales)).tolist(), strict=True))


def _driven(recordings: list[list[_Balance]], silent: bool) -> list[list[_Balance]]:
    """Return driven recordings in which the torque is zero throughout, or those in which it is not."""
    return [
        recording for recording in recordings if recording[0].driven and (not np.any(recording[0].torque)) is silent
    ]


def _gains(link: Link, recording: list[_Balance], scales: list[_Scales]) -> Array:
    """Return log-likelihoods (f,) of hypotheses over that of the first one.

    Each may suppose another hub: its inertia is known roughly, if at all, and much may be the motor's behind a gear.
    """
    gains = [np.zeros(len(scales))]
    hubs = [_possible_hubs(link, scale) for scale in scales]
    for balance in recording:
        declared = complex(*balance.gravity)
        if np.median((balance.momentum - balance.weight(declared)) ** 2) > 9 * balance.noise**2:
            misfits = []
            for scale, hub in zip(scales, hubs, strict=True):
                torque, weight = scale.torque * balance.torque, balance.weight(scale.gravity * declared)
                motion = scale.mass * (balance.momentum - link.hub_inertia * balance.turning - weight)
                motion = motion + hub[:, None] * balance.turning
                noise = (scale.mass * balance.link_noise) ** 2 + (hub * balance.turning_noise) ** 2
                # Relative, so that none is likelier for small numbers; medians, since a glitch spoils few windows.
                error, torques, motions = (np.median(x**2, axis=-1) for x in (torque - motion, torque, motion))
                misfits.append(np.min((error + noise) / (torques + motions + noise)))
            gains.append(-0.5 * balance.independent * np.log(np.array(misfits) / misfits[0]))
    return np.asarray(np.mean(gains[1:] or gains, axis=0))


def _possible_hubs(link: Link, scale: _Scales) -> Array:
    """Return inertias (h,) that a hub may have [kg m^2]."""
    if link.hub_inertia > 0:
        return scale.hub * link.hub_inertia * _ROUGHLY
    return scale.mass * link.length**2 * (link.mass / 3 + link.payload) * _UNKNOWN


def _moving_gain(recording: list[_Balance]) -> float:
    """Return the log-likelihood of a motion over that of rest, in a recording whose torque is zero throughout."""
    gains = []
    for balance in recording:
        motion = np.median((balance.momentum - balance.weight(complex(*balance.gravity))) ** 2)
        gains.append(0.5 * balance.independent * float(np.log1p(0.5 * motion / balance.noise**2)))
    return float(np.mean(gains))


def torque_sign(gains: dict[_Scales, float]) -> float | None:
    """Return the sign of the torque relative to the motion of the markers; None where it is not certain."""
    positive = max((gain for scales, gain in gains.items() if scales.torque > 0), default=0.0)
    negative = max((gain for scales, gain in gains.items() if scales.torque < 0), default=0.0)
    return None if abs(positive - negative) < LIKELY else 1.0 if positive > negative else -1.0


def torque_mistakes(
    experiment: Experiment, recordings: list[list[_Balance]], gains: dict[_Scales, float]
) -> list[Mistake]:
    """Return mistakes in sign, unit or presence of the torque, in inertias or in gravity."""
    link, conventions = experiment.rig.links[0], experiment.conventions
    best = max(gains, key=lambda scales: gains[scales])
    driven = _driven(recordings, silent=False)
    files = tuple(recording[0].file for recording in driven)
    gravity = _gravity_mistake(experiment, recordings)
    tau = conventions.name_in_files(f"{link.name}.tau")
    motion = f"than the torque that the motion takes with the inertias of [[link]] {link.name}"
    payload = link.payload or any(recording.payload for recording in experiment.recordings)
    silent = {recording[0].file: _moving_gain(recording) for recording in _driven(recordings, silent=True)}
    unexplained = {file: gain for file, gain in silent.items() if gain > LIKELY}
    if unexplained and not gravity:
        text = (
            f"{tau} is zero throughout although the link's angular momentum changes: no torque was recorded; record "
            'it, or set input = "motion" in the [[recording]] where the joint is driven by a controller'
        )
        return [Mistake(text, sum(unexplained.values()), tuple(unexplained))]
    if gains[best] < LIKELY or (gravity and gravity.gain > gains[best]):
        return [gravity] if gravity else []
    negative = best.torque < 0
    unit = next(name for name in FACTORS["torque"] if name != conventions.units.torque)
    if best == _Scales(-1.0):
        text = f"{tau} turns the link against the way it moves: its sign is wrong; {negated(tau)}"
    elif best.torque != 1.0:
        text = (
            f"{tau} is {abs(1 / best.torque):.4g} times the torque that the motion takes: it looks like {unit}"
            f'{" and of the wrong sign" if negative else ""}; set [units] torque = "{unit}"'
            f"{f', and {negated(tau)}' if negative else ''}"
        )
    elif best.gravity != 1.0:
        heavy = [recording[0] for recording in driven if any(recording[0].gravity)]
        files, declared = tuple(balance.file for balance in heavy), complex(*heavy[0].gravity)
        other, key = best.gravity * declared, gravity_key(experiment.rig, heavy[0].gravity)
        finding = f"as if it were {_vector(other)}" if other else "as if there were none in its plane"
        text = f"gravity = {_vector(declared)} is declared, and the link moves {finding}; set {key} = "
        return [Mistake(f"{text}{_vector(other)}", min(gains[best], CERTAIN), files)]
    elif best.mass in _SEVERALFOLD:
        less, wrong = ("less", "large") if best.mass < 1 else ("more", "small")
        masses = "'mass' or 'payload'" if payload else "'mass'"
        text = f"{tau} is several times {less} {motion}: {masses} is too {wrong}, unless the torque is wrong"
        return [Mistake(text, min(gains[best], CERTAIN), files)]
    else:
        text = f"{tau} is far less {motion}: "
        if best.hub != 1.0:
            remedy = f"give it in kg m^2, {link.hub_inertia * best.hub:.4g}"
            text += f"'hub_inertia' looks like {_HUB_UNITS[best.hub]}; {remedy}"
        elif payload:
            text += "'mass' or 'payload' looks like grams; give both in kg"
        else:
            text += f"'mass' looks like grams; give it in kg, {link.mass * best.mass:.4g}"
    return [Mistake(text, gains[best], files)]


def _vector(gravity: complex) -> str:
    return f"[{gravity.real + 0.0:.3g}, {gravity.imag + 0.0:.3g}]"  # no negative zero


def _gravity_mistake(experiment: Experiment, recordings: list[list[_Balance]]) -> Mistake | None:
    """Return that the balance needs the earth's gravity although none was declared; None if it does not."""
    chosen = [recording for recording in recordings if not any(recording[0].gravity)]
    if not chosen or experiment.rig.links[0].markers_frame == "link":
        return None
    rows, values, gain = [], [], 0.0
    for recording in chosen:
        for balance in recording:
            weight = np.sqrt(balance.independent / len(recording) / balance.torque.size) / np.sqrt(
                np.mean(balance.torque**2) + np.mean(balance.momentum**2) + balance.noise**2
            )
            rows.append(weight * balance.lever)
            values.append(weight * (balance.momentum - balance.torque))
    if not rows:
        return None
    fitted_gravity = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
    size = float(np.hypot(*fitted_gravity))
    gravity = fitted_gravity / max(size, 1e-300) * EARTH  # a base that is tilted a little has less in its plane
    for recording in chosen:
        for balance in recording:
            motion = balance.momentum - balance.torque
            without_gravity, with_gravity = (
                np.median(error**2) for error in (motion, motion - balance.lever @ gravity)
            )
            ratio = (without_gravity + balance.noise**2) / (with_gravity + balance.noise**2)
            gain += 0.5 * balance.independent / len(recording) * float(np.log(ratio))
    if gain < LIKELY:
        return None
    text = (
        f"the link falls as if gravity of {size:.3g} m/s^2 acted on it in its plane, and none is declared; set "
        f"{gravity_key(experiment.rig, (0.0, 0.0))} = {_vector(complex(*gravity))}, unless a spring, such as a cable, "
        "pulls the joint"
    )
    return Mistake(text, min(gain, CERTAIN), tuple(recording[0].file for recording in chosen))
