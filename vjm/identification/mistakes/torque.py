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
from numpy.typing import NDArray

from vjm.experiment.checks import moves
from vjm.experiment.conventions import FACTORS
from vjm.identification.mistakes.evidence import (
    CERTAIN,
    EARTH,
    GRAM,
    LIKELY,
    MISTAKE_COST,
    Mistake,
    angle_at,
    gravity_key,
    negated,
    payload_remedy,
    root_headings,
    seen_markers,
)
from vjm.records import Array, Experiment, Link, Recording, Rig

_HUB_UNITS = {1e-4: "kg cm^2", 1e-6: "kg mm^2", 1e-7: "g cm^2"}  # as motors' data sheets have them, by size [kg m^2]
_ROUGHLY = np.geomspace(0.1, 10.0, 9)  # of a hub's inertia that is given
_UNKNOWN = np.array([0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0])  # of the link's, where none is given
_SEVERALFOLD = 0.1, 10.0  # of masses that are no unit's: of the right order of magnitude if that is wrong
_AS_DECLARED = np.ones(3)
_TRIMMED_STEPS = 3  # of a hub's least squares: what is used hardly changes any more
_SHORTEST = 16  # samples of a window: its second derivative is then sampled well


class _Scales(NamedTuple):
    """Hypothesis: true torque, inertias and gravity over those that are given; by default none is wrong."""

    torque: float = 1.0
    mass: float = 1.0  # of the link
    payload: float = 1.0  # of the link
    carried: float = 1.0  # payloads of recordings
    hub: float = 1.0
    gravity: complex = 1.0  # x + i y: none of it, or turned
    undeclared: complex = 0.0  # gravity x + i y where none is declared [m/s^2]

    @property
    def masses(self) -> Array:
        """(3,) of the link's mass, its payload and the recording's."""
        return np.array([self.mass, self.payload, self.carried])

    @property
    def falls(self) -> bool:
        """True if gravity is not as declared."""
        return self.gravity != 1.0 or self.undeclared != 0.0


def _all_masses(factor: float) -> _Scales:
    return _Scales(mass=factor, payload=factor, carried=factor)


@dataclass(frozen=True)
class _Balance:
    """Projections on windows of one length in one recording, a column for each window [N m s].

    Those of masses are of the link's, of its payload and of the recording's, a row for each.
    """

    file: str
    kind: str
    gravity: tuple[float, float]  # declared [m/s^2]
    payload: float  # of the recording, declared [kg]
    turns: bool  # by more than the encoder's noise
    hub_inertia: float  # declared [kg m^2]
    torque: Array  # (N,)
    momenta: Array  # (3, N) of the masses' motion
    turning: Array  # (N,) that an inertia of 1 kg m^2 at the joint would have
    levers: Array  # (3, N, 2) moments of a unit gravity along x and y
    heading_noise: float  # 1-sigma of `turning`
    root_inertias: Array  # (3,) that turn with the heading at the base, of each mass [kg m^2]
    marker_noises: Array  # (3, k) of the momenta, by each marker
    independent: float  # number of windows that do not overlap

    @property
    def silent(self) -> bool:
        """True if the torque is zero throughout."""
        return not np.any(self.torque)

    @property
    def momentum(self) -> Array:
        """Projections (N,) of the motion of all masses as declared, and of the hub."""
        return np.asarray(self.momenta.sum(axis=0) + self.hub_inertia * self.turning)

    @property
    def noise(self) -> float:
        """1-sigma of `momentum`."""
        root = self.hub_inertia + float(self.root_inertias.sum())
        return float(np.hypot(root * self.heading_noise, np.linalg.norm(self.marker_noises.sum(axis=0))))

    def weight(self, gravity: complex | NDArray[np.complex128], masses: Array = _AS_DECLARED) -> Array:
        """Return projections (..., N) of the moment of gravities x + i y (...) [m/s^2].

        They act on masses (..., 3) over those declared.
        """
        levers = np.tensordot(masses, self.levers, 1)
        gravity = np.asarray(gravity)[..., None]
        return np.asarray(levers[..., 0] * gravity.real + levers[..., 1] * gravity.imag)

    def masses_noise(self, masses: Array) -> Array:
        """Return the 1-sigma noise (...) of the momentum of masses (..., 3) over those declared, without the hub's."""
        markers = np.linalg.norm(masses @ self.marker_noises, axis=-1)
        return np.asarray(np.hypot(masses @ self.root_inertias * self.heading_noise, markers))


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
    link = rig.links[0]
    arcs = link.hub_radius + arcs  # from the axis
    ahead = link.hub_radius if link.markers_frame == "link" else 0.0
    angles = np.arctan2(points[..., 1], ahead + points[..., 0])
    complete = np.isfinite(heading) & np.isfinite(angles).all(axis=1)
    if link.markers_frame == "link":  # angles are those of deflections
        angles, heading = angles + theta[:, None], theta
    squares, firsts = _mass_moments(link, recording.payload, arcs)
    polar = np.column_stack([np.unwrap(heading[complete]), angles[complete]])
    polar[:, 1:] = polar[:, :1] + np.angle(np.exp(1j * (polar[:, 1:] - polar[:, :1])))
    time = recording.time[rows][complete]
    step = float(np.median(np.diff(time)))
    instants = np.arange(time[0], time[-1], step)
    turning = np.interp(instants, time, polar[:, 0])
    momenta = [np.interp(instants, time, polar @ moments) for moments in squares]
    places = [
        [np.interp(instants, time, wave @ moments) for wave in (np.cos(polar), np.sin(polar))] for moments in firsts
    ]
    torque = np.interp(instants, recording.time[torque_known], recording.tau[torque_known, 0])
    coordinate = rig.marker_noise or 1e-3 * link.length
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
                recording.kind,
                recording.gravity,
                recording.payload,
                moves(recording.theta[:, 0], rig.encoder_noise),
                link.hub_inertia,
                project(torque, window),
                np.stack([project(momentum - momentum.mean(), second) for momentum in momenta]),
                project(turning - turning.mean(), second),
                np.stack([np.column_stack([-project(y, window), project(x, window)]) for x, y in places]),
                heading_noise=heading_noise * kernel_norm,
                root_inertias=squares[:, 0],
                marker_noises=coordinate * kernel_norm * squares[:, 1:] / arcs,
                independent=instants.size / size,
            )
        )
        size *= 2
    return result


def _mass_moments(link: Link, payload: float, arcs: Array) -> tuple[Array, Array]:
    """Return second [kg m^2] and first moments [kg m] (3, 1 + k) of masses that turn with the base and each marker.

    The masses are the link's, its payload and the recording's. Between base and markers, at distances (k,) [m] from the
    axis along the link, the angle about the base is taken as linear.
    """
    grid = link.hub_radius + np.linspace(0.0, link.length, 201)
    nodes = np.array([0.0, *arcs])
    hats = np.stack([np.interp(grid, nodes, row) for row in np.eye(nodes.size)])
    density = np.full(grid.size, link.mass / grid.size)
    squares, firsts = np.zeros((3, nodes.size)), np.zeros((3, nodes.size))
    squares[0], firsts[0] = hats @ (density * grid**2), hats @ (density * grid)
    firsts[1:, -1] = np.array([link.payload, payload]) * (link.hub_radius + link.length)
    squares[1:, -1] = firsts[1:, -1] * (link.hub_radius + link.length)
    return squares, firsts


def torque_gains(experiment: Experiment, recordings: list[list[_Balance]]) -> dict[_Scales, float]:
    """Return the log-likelihood of each hypothesis over that of none, by how well torque and motion then balance.

    Under any of them, a recording's payload may be in grams.
    """
    current = FACTORS["torque"][experiment.conventions.units.torque]
    sizes = [size / current for size in FACTORS["torque"].values()]
    link = experiment.rig.links[0]
    scales = [_Scales(), _Scales(-1.0), *(_Scales(sign * size) for size in sizes if size != 1.0 for sign in (1, -1))]
    scales += [*map(_all_masses, (GRAM, *_SEVERALFOLD)), *(_Scales(hub=size) for size in _HUB_UNITS)]
    if link.payload or any(recording.payload for recording in experiment.recordings):
        scales.append(_Scales(mass=GRAM))
    if link.payload:
        scales.append(_Scales(payload=GRAM))
    scales += [_Scales(gravity=turn) for turn in (0.0, -1.0, 1.0j, -1.0j)]
    if (fitted := _undeclared_gravity(experiment, recordings)) and abs(fitted):
        scales.append(_Scales(undeclared=fitted / abs(fitted) * EARTH))  # a base that is tilted a little has less
    gains = np.zeros(len(scales))
    for recording in _informative(recordings):
        gains += np.max(_payload_gains(link, recording, scales), axis=0)
        if recording[0].kind == "driven" and recording[0].silent:  # it falls only if its kind is wrong as well
            gains -= MISTAKE_COST * np.array([scale.falls for scale in scales])
    # Two components were fitted to so many windows: G. Schwarz, Estimating the dimension of a model, Ann. Stat., 1978.
    windows = sum(recording[0].independent for recording in _informative(recordings))
    gains -= np.log(max(windows, 1.0)) * np.array([scale.undeclared != 0.0 for scale in scales])
    return dict(zip(scales, (gains - gains[0]).tolist(), strict=True))


def _informative(recordings: list[list[_Balance]]) -> list[list[_Balance]]:
    """Return recordings in which a known torque acts, or none at all.

    Where none was recorded, an arm at rest may be held by a brake, and one that is driven in gravity by its motor.
    """

    def known(balance: _Balance) -> bool:
        return balance.turns and (balance.kind == "decay" or (balance.kind == "driven" and not any(balance.gravity)))

    return [recording for recording in recordings if not recording[0].silent or known(recording[0])]


def _payload_gains(link: Link, recording: list[_Balance], scales: list[_Scales]) -> Array:
    """Return log-likelihoods (2, f) of hypotheses over that of the first, with the recording's payload in kg or g."""
    in_grams = [scale._replace(carried=scale.carried * GRAM) for scale in scales]
    gains = _gains(link, recording, [*scales, *in_grams]).reshape(2, -1)
    gains[1] = gains[1] - MISTAKE_COST if recording[0].payload else -np.inf
    return gains


def _gains(link: Link, recording: list[_Balance], scales: list[_Scales]) -> Array:
    """Return log-likelihoods (f,) of hypotheses over that of the first one.

    Each may suppose another hub: its inertia is known roughly, if at all, and much may be the motor's behind a gear.
    Where no torque acts it may not, for a free arm's momentum is conserved with the right one only.
    """
    gains = []
    masses = np.array([scale.masses for scale in scales])
    torques = np.array([scale.torque for scale in scales])[:, None]
    silent = recording[0].silent
    hubs = np.array([[scale.hub * link.hub_inertia] if silent else _possible_hubs(link, scale) for scale in scales])
    for balance in recording:
        declared = complex(*balance.gravity)
        if np.median((balance.momentum - balance.weight(declared)) ** 2) > 9 * balance.noise**2:
            # The full weight counts however little of it there may be.
            full = balance.weight(np.array([declared or scale.undeclared for scale in scales]), masses)
            given = np.array([scale.gravity * declared for scale in scales])
            weight = balance.weight(given, masses) if declared else full
            applied, links = torques * balance.torque + weight, masses @ balance.momenta
            sizes = torques[:, 0] ** 2 * np.median(balance.torque**2) + np.median(full**2, axis=1)
            supposed = _Hypotheses(
                applied - links, links, balance.turning, sizes, balance.masses_noise(masses), balance.heading_noise
            )
            misfits = np.array([supposed.misfit(hub) for hub in hubs.T])
            if not silent:  # between those supposed: what is left by their distance may favour wrong masses
                misfits = np.minimum(misfits, supposed.misfit(supposed.fitted(hubs, misfits)))
            gains.append(-0.5 * balance.independent * np.log(misfits))
    if not gains:
        return np.zeros(len(scales))
    likelihoods = np.mean(gains, axis=0).max(axis=0)
    return np.asarray(likelihoods - likelihoods[0])


class _Hypotheses(NamedTuple):
    """Terms of a balance under f hypotheses, over N windows, without the hub's."""

    missing: Array  # (f, N) of the links' momentum
    links: Array  # (f, N) the links' momentum
    turning: Array  # (N,) that an inertia of 1 kg m^2 at the joint would have
    sizes: Array  # (f,) median squares of torque and weight
    links_noise: Array  # (f,)
    heading_noise: float

    def misfit(self, hub: Array) -> Array:
        """Return median squared errors over those of the terms (f,) with hubs (f,) [kg m^2].

        Relative, so that none is likelier for small numbers; medians, since a glitch spoils few windows.
        """
        turned = hub[:, None] * self.turning
        noise = self.links_noise**2 + (hub * self.heading_noise) ** 2
        error, size = (np.median(x**2, axis=1) for x in (self.missing - turned, self.links + turned))
        return np.asarray((error + noise) / (self.sizes + size + noise))

    def fitted(self, hubs: Array, misfits: Array) -> Array:
        """Return the hubs (f,) that fit best, near the best of some (f, h) with misfits (h, f), and within their range.

        By least squares of the half of the windows that are explained best (P. J. Rousseeuw, Least median of squares
        regression, J. Am. Stat. Assoc. 79, 1984).
        """
        best = np.take_along_axis(hubs, np.argmin(misfits, axis=0)[:, None], axis=1)
        for _ in range(_TRIMMED_STEPS):
            error = np.abs(self.missing - best * self.turning)
            used = error <= np.median(error, axis=1, keepdims=True)
            square = np.sum(used * self.turning**2, axis=1, keepdims=True)
            product = np.sum(used * self.missing * self.turning, axis=1, keepdims=True)
            best = np.clip(np.divide(product, square, out=best.copy(), where=square > 0), hubs[:, :1], hubs[:, -1:])
        return np.asarray(best[:, 0])


def _possible_hubs(link: Link, scale: _Scales) -> Array:
    """Return inertias (h,) that a hub may have [kg m^2]."""
    if link.hub_inertia > 0:
        return scale.hub * link.hub_inertia * _ROUGHLY
    return link.length**2 * (scale.mass * link.mass / 3 + scale.payload * link.payload) * _UNKNOWN


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
    """Return mistakes in sign, unit or presence of the torque, in inertias, payloads or gravity."""
    best = max(gains, key=lambda scales: gains[scales])
    tau = experiment.conventions.name_in_files(f"{experiment.rig.links[0].name}.tau")
    if not best.falls or gains[best] < LIKELY:
        driven = [recording for recording in recordings if recording[0].kind == "driven" and recording[0].silent]
        silent = {recording[0].file: _moving_gain(recording) for recording in driven}
        unexplained = {file: gain for file, gain in silent.items() if gain > LIKELY}
        if unexplained:
            text = (
                f"{tau} is zero throughout although the link's angular momentum changes: no torque was recorded; "
                'record it, or set input = "motion" in the [[recording]] where the joint is driven by a controller'
            )
            return [Mistake(text, sum(unexplained.values()), tuple(unexplained))]
    if gains[best] < LIKELY:
        return _payload_mistakes(experiment, recordings, _Scales())
    payloads = _payload_mistakes(experiment, recordings, best)
    if best.falls:
        return [_gravity_mistake(experiment, recordings, best, gains[best]), *payloads]
    files = tuple(recording[0].file for recording in recordings if recording[0].kind == "driven")
    turned = best.torque != 1.0
    text = _torque_text(experiment, best.torque, tau) if turned else _inertia_text(experiment, best, tau)
    gain = min(gains[best], CERTAIN) if best.mass in _SEVERALFOLD else gains[best]
    return [Mistake(text, gain, files), *payloads]


def _torque_text(experiment: Experiment, factor: float, tau: str) -> str:
    """Return what is wrong with a torque that has to be multiplied with a factor, and the remedy."""
    if factor == -1.0:
        return f"{tau} turns the link against the way it moves: its sign is wrong; {negated(tau)}"
    unit = next(name for name in FACTORS["torque"] if name != experiment.conventions.units.torque)
    return (
        f"{tau} is {abs(1 / factor):.4g} times the torque that the motion takes: it looks like {unit}"
        f'{" and of the wrong sign" if factor < 0 else ""}; set [units] torque = "{unit}"'
        f"{f', and {negated(tau)}' if factor < 0 else ''}"
    )


def _inertia_text(experiment: Experiment, best: _Scales, tau: str) -> str:
    """Return what is wrong with masses, payloads or the hub's inertia, and the remedy."""
    link = experiment.rig.links[0]
    motion = f"than the torque that the motion takes with the inertias of [[link]] {link.name}"
    payload = link.payload or any(recording.payload for recording in experiment.recordings)
    if best.mass in _SEVERALFOLD:
        less, wrong = ("less", "large") if best.mass < 1 else ("more", "small")
        masses = "'mass' or 'payload'" if payload else "'mass'"
        return f"{tau} is several times {less} {motion}: {masses} is too {wrong}, unless the torque is wrong"
    text = f"{tau} is far less {motion}: "
    if best.hub != 1.0:
        remedy = f"give it in kg m^2, {link.hub_inertia * best.hub:.4g}"
        return f"{text}'hub_inertia' looks like {_HUB_UNITS[best.hub]}; {remedy}"
    if best.mass == 1.0:
        return f"{text}'payload' looks like grams; give it in kg, {link.payload * best.payload:.4g}"
    if payload and best.payload != 1.0:
        return f"{text}'mass' and 'payload' look like grams; give both in kg"
    return f"{text}'mass' looks like grams; give it in kg, {link.mass * best.mass:.4g}"


def _payload_mistakes(experiment: Experiment, recordings: list[list[_Balance]], scales: _Scales) -> list[Mistake]:
    """Return payloads of recordings that are in grams, given what else is wrong."""
    link, mistakes = experiment.rig.links[0], []
    tau = experiment.conventions.name_in_files(f"{link.name}.tau")
    for recording in _informative(recordings):
        file, payload = recording[0].file, recording[0].payload
        as_given, in_grams = _payload_gains(link, recording, [scales])[:, 0]
        if in_grams - as_given > LIKELY:
            text = (
                f"{tau} is far less than the torque that the motion takes with a payload of {payload:.4g} kg: it looks "
                f"like grams; {payload_remedy(file, payload)}"
            )
            mistakes.append(Mistake(text, float(in_grams - as_given), (file,)))
    return mistakes


def _gravity_mistake(experiment: Experiment, recordings: list[list[_Balance]], best: _Scales, gain: float) -> Mistake:
    """Return that the link moves under another gravity than the one declared, or under one where none is."""
    chosen = [
        recording[0] for recording in _informative(recordings) if any(recording[0].gravity) == (best.undeclared == 0.0)
    ]
    files, gravity = tuple(balance.file for balance in chosen), chosen[0].gravity
    key = gravity_key(experiment.rig, gravity)
    if best.undeclared:
        size = abs(_undeclared_gravity(experiment, recordings))
        text = (
            f"the link falls as if gravity of {size:.3g} m/s^2 acted on it in its plane, and none is declared; set "
            f"{key} = {_vector(best.undeclared)}, unless a spring, such as a cable, pulls the joint"
        )
    else:
        declared = complex(*gravity)
        other = best.gravity * declared
        finding = f"as if it were {_vector(other)}" if other else "as if there were none in its plane"
        text = f"gravity = {_vector(declared)} is declared, and the link moves {finding}; set {key} = {_vector(other)}"
        if not other and any(balance.silent for balance in chosen):
            text += ", unless friction at the joint bears its weight"
    return Mistake(text, min(gain, CERTAIN), files)


def _vector(gravity: complex) -> str:
    return f"[{gravity.real + 0.0:.3g}, {gravity.imag + 0.0:.3g}]"  # no negative zero


def _undeclared_gravity(experiment: Experiment, recordings: list[list[_Balance]]) -> complex:
    """Return the gravity x + i y [m/s^2] that balances recordings for which none is declared best; zero without any."""
    rows, values = [], []
    for recording in _informative(recordings):
        if any(recording[0].gravity) or experiment.rig.links[0].markers_frame == "link":
            continue
        for balance in recording:
            weight = np.sqrt(balance.independent / len(recording) / balance.torque.size) / np.sqrt(
                np.mean(balance.torque**2) + np.mean(balance.momentum**2) + balance.noise**2
            )
            rows.append(weight * balance.levers.sum(axis=0))
            values.append(weight * (balance.momentum - balance.torque))
    if not rows:
        return 0.0
    return complex(*np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0])
