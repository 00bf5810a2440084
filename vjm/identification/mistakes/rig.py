"""Mistakes in the rig's numbers, in the unit of time and in the sensors' noise.

A number in the wrong unit is off by a known factor. Each such factor, and each pair of them, is a hypothesis; it is
judged by what it makes of the slowest frequency, of the material and of the camera's rate. How far those may be off
without a mistake is what is said beside the numbers; they cover what arms are made of and how they are filmed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
from scipy.stats import norm

from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.chain.virtual_links import Chain
from vjm.errors import VjmError
from vjm.experiment.spectrum import measured_noise
from vjm.identification.mistakes.evidence import (
    CERTAIN,
    EARTH,
    GRAM,
    LIKELY,
    MISTAKE_COST,
    Mistake,
    gravity_key,
    payload_remedy,
    seen_modes,
    unit_factors,
)
from vjm.model.modes import linearise, modes_of
from vjm.records import Array, Experiment, Link, Recording, Rig
from vjm.simulation.integrate import locked_joint_frequencies

# Medians and standard deviations of logarithms, of rigs that somebody might build (Ashby, Materials Selection in
# Mechanical Design, for materials): silicone to steel and tungsten, foam to lead, gram to tonne.
_DENSITY = 2700.0, np.log(3.0)  # kg/m^3
_SPECIFIC_STIFFNESS = 3e6, np.log(20.0)  # m^2/s^2, E over density
_MASS = 0.5, np.log(6.0)  # kg
_PAYLOAD = 0.3, np.log(6.0)  # over the link's mass
_RATE = 100.0, np.log(4.0)  # Hz, of cameras
_FREQUENCY = np.log(1.5)  # of a ratio of frequencies: EI is known within a factor of two or so
_RATIO = np.log(1.1)  # of two recordings' frequencies, whose stiffness is the same: masses are known to some 20 %
_HIGHER = 2.0  # cost in log-likelihood of supposing that the slowest mode seen is not the first, but so many on
_SURPRISING = 0.5 * norm.isf(0.005) ** 2  # log-likelihood that is lost by chance once in a hundred times
_SLENDERNESS = 0.3, np.log(1.5)  # of thickness over length, above which a link is hardly a beam
_NOISE = np.log(2.7)  # of a noise that somebody wrote down over the one that the recordings have
_ROUNDING = 1e-9  # of the largest eigenvalue
_CURVED = 0.01  # of the length: what a link may be off straight, or its camera off level by half a degree, at rest


@dataclass(frozen=True)
class _Numbers:
    """Hypothesis: factors that mend the rig's numbers and time, what they mean, and what to do."""

    name: str
    text: str
    remedy: str
    width: float = 1.0
    thickness: float = 1.0
    modulus: float = 1.0
    stiffness: float = 1.0  # of a bending stiffness that is given as such
    mass: float = 1.0
    payload: float = 1.0  # of the link
    carried: float = 1.0  # the payload of the recording that shows a frequency
    time: float = 1.0


@dataclass(frozen=True)
class _Frequencies:
    """Slowest frequencies of the arm, joints held where no recording of a single link shows one.

    Attributes:
        rig: the arm.
        recording: the one that shows a frequency, or whose payload the joints hold; None where nothing moves.
        measured: the slowest frequency that it shows [Hz].
        nominal: (m,) slowest ones of the rig's numbers [Hz].
    """

    rig: Rig
    recording: Recording | None
    measured: float | None
    nominal: Array

    def expected(self, mass: float, payload: float, carried: float) -> Array:
        """Return the nominal frequencies (m,) [Hz] with factors on the link's mass, its payload and the recording's."""
        if self.measured is None or self.recording is None:  # an arm of several links, perhaps
            return np.asarray(self.nominal / np.sqrt(mass))
        if mass == payload == carried == 1.0:
            return self.nominal
        link = self.rig.links[0]
        link = replace(link, mass=mass * link.mass, payload=payload * link.payload)
        rig = replace(self.rig, links=(link,))
        return _nominal_frequencies(rig, self.recording, carried * self.recording.payload)


def _hypotheses(experiment: Experiment, link: Link, recording: Recording | None) -> list[_Numbers]:
    table, hypotheses = f"[[link]] {link.name}", []
    dimensions = {"width": link.width, "thickness": link.thickness}
    for key, value in dimensions.items():
        for unit, factor in unit_factors("length", "m").items():
            if value is not None and unit != "in":
                text, remedy = f"'{key}' looks like {unit}", f"give '{key}' of {table} in metres, {value * factor:.4g}"
                hypotheses.append(_Numbers(key, text, remedy, **{key: factor}))
    if link.width and link.thickness and link.width != link.thickness:
        ratio = link.thickness / link.width
        remedy = f"exchange 'width' and 'thickness' of {table}"
        text = "'width' and 'thickness' look exchanged: the thickness is in the bending plane"
        hypotheses.append(_Numbers("section", text, remedy, width=ratio, thickness=1 / ratio))
    if link.youngs_modulus is not None:
        for unit, factor in (("GPa", 1e9), ("MPa", 1e6)):
            value = link.youngs_modulus * factor
            remedy = f"give 'youngs_modulus' of {table} in Pa, {value:.4g}"
            hypotheses.append(_Numbers("modulus", f"'youngs_modulus' looks like {unit}", remedy, modulus=factor))
    else:
        remedy = f"give 'bending_stiffness' of {table} in N m^2, {link.bending_stiffness * 1e-6:.4g}"
        hypotheses.append(_Numbers("modulus", "'bending_stiffness' looks like N mm^2", remedy, stiffness=1e-6))
    remedy = f"give 'mass' of {table} in kg, {link.mass * GRAM:.4g}"
    hypotheses.append(_Numbers("mass", "'mass' looks like grams", remedy, mass=GRAM))
    if link.payload:
        remedy = f"give 'payload' of {table} in kg, {link.payload * GRAM:.4g}"
        hypotheses.append(_Numbers("payload", "'payload' looks like grams", remedy, payload=GRAM))
    if recording and recording.payload:
        text, remedy = "its 'payload' looks like grams", payload_remedy(recording.file, recording.payload)
        hypotheses.append(_Numbers("carried", text, remedy, carried=GRAM))
    words = {"s": "seconds", "ms": "milliseconds", "us": "microseconds"}
    for unit, factor in unit_factors("time", experiment.conventions.units.time).items():
        text, remedy = f"times look like {words[unit]}", f'set [units] time = "{unit}"'
        hypotheses.append(_Numbers("time", text, remedy, time=factor))
    return hypotheses


def rig_mistakes(experiment: Experiment) -> list[Mistake]:
    """Return the numbers of the first link, or the unit of time, that are in the wrong unit."""
    link = experiment.rig.links[0]
    moving = [recording for recording in experiment.recordings if recording.kind in ("driven", "decay")]
    filmed = moving or experiment.recordings
    rates = [1 / float(np.median(np.diff(recording.time[recording.frames]))) for recording in filmed]
    rate = float(np.median(rates))
    shown = _frequencies(experiment)
    measured = shown.measured
    loaded = shown.recording if shown.recording and measured else None
    carried = loaded.payload if loaded else 0.0
    single = _hypotheses(experiment, link, loaded)
    pairs = [(first, second) for first, second in combinations(single, 2) if first.name != second.name]
    expected_of = cache(shown.expected)

    def likelihood(*assumed: _Numbers) -> float:
        factors = {
            key: float(np.prod([getattr(hypothesis, key) for hypothesis in assumed]))
            for key in ("width", "thickness", "modulus", "stiffness", "mass", "payload", "carried", "time")
        }
        fit = -MISTAKE_COST * len(assumed)
        fit += _material(link, factors) + _normal(rate / factors["time"], *_RATE)
        payloads = link.payload * factors["payload"], carried * factors["carried"]
        fit += sum(_normal(payload / (link.mass * factors["mass"]), *_PAYLOAD) for payload in payloads if payload)
        bending = factors["width"] * factors["thickness"] ** 3 * factors["modulus"] * factors["stiffness"]
        expected = expected_of(factors["mass"], factors["payload"], factors["carried"]) * np.sqrt(bending)
        if measured is None:  # nobody films what swings with frames too few to show it
            shares = rate / factors["time"] / (2 * expected[:1])
            fit += sum(_normal(float(share), 1.0, _RATE[1]) for share in shares if share < 1.0)
        else:
            fit -= _loss(np.log(measured / factors["time"] / expected), _FREQUENCY)
        return float(fit)

    results: dict[tuple[_Numbers, ...], float] = {(): likelihood()} | {
        (hypothesis,): likelihood(hypothesis) for hypothesis in single
    }
    results |= {pair: likelihood(*pair) for pair in pairs}
    best = max(results, key=lambda key: results[key])
    gain = results[best] - results[()]
    factor = float(np.prod([hypothesis.carried for hypothesis in best])) if gain > LIKELY else 1.0
    payloads = _payload_mistakes(experiment, shown, expected_of(1.0, 1.0, factor))
    if gain < LIKELY:
        return payloads or _frequency_mistakes(link, shown)
    return [Mistake(_rig_text(link, best, rate, shown), gain), *payloads]


def _loss(deviations: Array, std: float) -> float:
    """Return the log-likelihood lost by a frequency's deviations (m,) from the slowest ones, of which it is any."""
    losses = 0.5 * (deviations / std) ** 2 + _HIGHER * np.arange(deviations.size)
    return float(np.min(losses, initial=np.inf))


def _payload_mistakes(experiment: Experiment, shown: _Frequencies, nominal: Array) -> list[Mistake]:
    """Return payloads of a clamped link's recordings that are in grams, by their frequencies over that of another one.

    That one's nominal frequencies [Hz] are given; its own payload, if any, is judged with the rig's numbers.
    """
    rig, mistakes = experiment.rig, []
    if shown.measured is None or shown.recording is None or rig.links[0].joint != "clamped" or not nominal.size:
        return []
    order = _HIGHER * np.arange(nominal.size)
    reference = 0.5 * (np.log(shown.measured / nominal) / _FREQUENCY) ** 2 + order  # what it loses as each of these
    for recording in experiment.recordings:
        if not recording.payload or recording is shown.recording:
            continue
        expected = [_nominal_frequencies(rig, recording, factor * recording.payload) for factor in (1.0, GRAM)]
        frequencies = seen_modes(rig, recording, 1)
        if not frequencies.size or not all(each.size for each in expected):
            continue
        ratios = frequencies[0] / shown.measured * nominal
        as_given, in_grams = (
            min(loss + _loss(np.log(ratio / each), _RATIO) for loss, ratio in zip(reference, ratios, strict=True))
            for each in expected
        )
        gain = as_given - in_grams - MISTAKE_COST
        if gain > LIKELY and in_grams - reference.min() < _SURPRISING:
            text = (
                f"it shows {frequencies[0]:.3g} Hz beside the {shown.measured:.3g} Hz of {shown.recording.file}, far "
                f"from what a payload of {recording.payload:.4g} kg makes of them: 'payload' looks like grams; "
                f"{payload_remedy(recording.file, recording.payload)}"
            )
            mistakes.append(Mistake(text, float(gain), (recording.file,)))
    return mistakes


def _frequency_mistakes(link: Link, shown: _Frequencies) -> list[Mistake]:
    """Return that the slowest frequency that a clamped link shows is far from what the rig's numbers make of it.

    That of a driven one depends on its hub's inertia, which is often a guess, and is masked by the drive.
    """
    if shown.measured is None or shown.recording is None or link.joint != "clamped":
        return []
    measured, nominal, file = shown.measured, shown.nominal, shown.recording.file
    loss = _loss(np.log(measured / nominal), _FREQUENCY)
    if loss < _SURPRISING:
        return []
    text = (
        f"{link.name}'s first natural frequency would be {nominal[0]:.3g} Hz, and {file} shows {measured:.3g} Hz: "
        f"masses, payloads, lengths or what gives the bending stiffness of [[link]] {link.name} are far off; check "
        "them, for an identified stiffness is as wrong as the masses"
    )
    return [Mistake(text, min(loss, CERTAIN))]


def _rig_text(link: Link, best: Sequence[_Numbers], rate: float, shown: _Frequencies) -> str:
    measured, nominal, findings = shown.measured, shown.nominal, []
    if any(hypothesis.name == "time" for hypothesis in best):
        arm = (
            f" of an arm that swings at {nominal[0]:.3g} Hz, its joints held"
            if measured is None and nominal.size
            else ""
        )
        findings.append(f"the camera would take {rate:.3g} frames/s{arm}")
    elif None not in (link.width, link.thickness):
        volume = link.length * (link.width or 1.0) * (link.thickness or 1.0)
        findings.append(f"{link.name} would have {link.mass / volume:.3g} kg/m^3")
    if measured is not None and shown.recording is not None:
        file = shown.recording.file
        whose = "its" if findings else f"{link.name}'s"
        findings.append(
            f"{whose} first natural frequency would be {nominal[0]:.3g} Hz, and {file} shows {measured:.3g} Hz"
        )
    causes = " and ".join(hypothesis.text for hypothesis in best)
    return f"{', '.join(findings) or link.name}: {causes}; {'; '.join(hypothesis.remedy for hypothesis in best)}"


def _normal(value: float, median: float, std: float) -> float:
    return -0.5 * float(np.log(value / median) / std) ** 2


def _material(link: Link, factors: dict[str, float]) -> float:
    """Return the log-likelihood of a link's mass and, as far as its section is known, of its material and shape."""
    mass = link.mass * factors["mass"]
    fit = _normal(mass, *_MASS)
    if link.width is None or link.thickness is None or link.youngs_modulus is None:
        return fit
    width, thickness = link.width * factors["width"], link.thickness * factors["thickness"]
    density = mass / (link.length * width * thickness)
    fit += _normal(density, *_DENSITY)
    fit += _normal(link.youngs_modulus * factors["modulus"] / density, *_SPECIFIC_STIFFNESS)
    for size in (width, thickness):
        share = size / link.length
        fit += _normal(share, *_SLENDERNESS) if share > _SLENDERNESS[0] else 0.0
    return fit


def _frequencies(experiment: Experiment) -> _Frequencies:
    """Return the slowest frequency that a recording of a single link shows, one of the least payload."""
    rig = experiment.rig
    moving = [
        recording
        for recording in experiment.recordings
        if recording.kind in ("driven", "decay") and recording.input == "torque"
    ]
    if not moving:
        return _Frequencies(rig, None, None, np.zeros(0))
    order = sorted(
        moving, key=lambda recording: (recording.payload, recording.kind != "decay", recording.role != "train")
    )
    for recording in order[:2] if len(rig.links) == 1 and rig.links[0].markers else []:
        if (frequencies := seen_modes(rig, recording, 1)).size:
            nominal = _nominal_frequencies(rig, recording, recording.payload)
            if nominal.size:
                return _Frequencies(rig, recording, float(frequencies[0]), nominal)
    try:
        locked = np.array(locked_joint_frequencies(_chain(rig), order[0].payload_body)[:1])
    except VjmError:  # a link that buckles under its weight
        locked = np.zeros(0)
    return _Frequencies(rig, order[0], None, locked)


def _chain(rig: Rig) -> Chain:
    return nominal_chain(rig, rig_layouts(rig, [6] * len(rig.links)))


def _nominal_frequencies(rig: Rig, recording: Recording, payload_mass: float) -> Array:
    """Return the slowest frequencies (m,) of the rig's numbers [Hz] in a recording, with a mass [kg] of its payload.

    There are none of a link that falls, which is no vibration, or buckles.
    """
    try:
        M, D, K, _ = linearise(_chain(rig), recording.payload_body._replace(mass=payload_mass), recording.gravity)
    except VjmError:
        return np.zeros(0)
    stiffness = np.linalg.eigvalsh(K)
    return np.zeros(0) if stiffness[0] < -_ROUNDING * stiffness[-1] else modes_of(M, D, K).frequencies[:4]


def noise_mistakes(experiment: Experiment) -> list[Mistake]:
    """Return sensors whose declared noise is about a thousand times that of the recordings, or a thousandth."""
    rig, mistakes = experiment.rig, []
    declared = {"marker_noise": (rig.marker_noise, "m"), "encoder_noise": (rig.encoder_noise, "rad")}
    for (key, (value, unit)), estimate in zip(declared.items(), measured_noise(experiment.recordings), strict=True):
        if value is None or not estimate > 0:  # NaN: the recordings do not show it
            continue
        ratio = float(np.log(estimate / value))
        fits = {factor: -0.5 * ((ratio - np.log(factor)) / _NOISE) ** 2 for factor in (1.0, 1e3, 1e-3)}
        best = max(fits, key=lambda factor: fits[factor])
        gain = float(fits[best] - fits[1.0])
        if gain > LIKELY:
            words, times = "small" if best > 1 else "large", 10 ** round(abs(ratio) / np.log(10))
            text = (
                f"'{key}' of [sensors] is {value:.3g} {unit}, and the recordings' own noise is {estimate:.2g} {unit}: "
                f"it is about {times} times too {words}; give it in {unit}, or leave it out"
            )
            # Recordings that somebody smoothed have less noise than their sensor, which is no mistake of the file; but
            # what hides every motion, or neighbouring markers from each other, has to go.
            signals = [
                recording.markers if key == "marker_noise" else recording.theta for recording in experiment.recordings
            ]
            hidden = all(np.nanstd(signal, axis=0).max() < value for signal in signals)
            arcs = np.array([0.0, *rig.links[0].markers])
            hidden = hidden or (key == "marker_noise" and value > np.diff(arcs).min(initial=np.inf))
            mistakes.append(Mistake(text, gain if best > 1 or hidden else min(gain, CERTAIN)))
    return mistakes


def sag_mistakes(experiment: Experiment) -> list[Mistake]:
    """Return that a clamped link rests where another gravity than is declared would bend it: the earth's, or none."""
    rig = experiment.rig
    link = rig.links[0]
    if len(rig.links) > 1 or link.joint != "clamped" or link.markers_frame != "base" or not link.markers:
        return []
    # A decay shows where it ends up if its second half holds a whole swing, here by the nominal first frequency.
    period = 2 * np.pi / 1.875**2 * (link.mass * link.length**3 / link.bending_stiffness) ** 0.5
    groups: dict[tuple[float, float], list[Recording]] = {}
    for recording in experiment.recordings:
        x, y = recording.gravity
        if abs(x) <= abs(y) and (  # a link that stands or hangs rests straight
            recording.kind == "quiet" or (recording.kind == "decay" and np.ptp(recording.time) > 2 * period)
        ):
            groups.setdefault((x, y), []).append(recording)
    found = [_other_sag(rig, gravity, recordings) for gravity, recordings in groups.items()]
    return [mistake for mistake in found if mistake]


def _other_sag(rig: Rig, gravity: tuple[float, float], recordings: Sequence[Recording]) -> Mistake | None:
    """Return that recordings of a clamped link with one declared gravity [m/s^2] show another; None if they do not."""
    link = rig.links[0]
    # Half of a decay is over by then; what is left of the motion is on both sides of the rest.
    rests = [
        float(np.nanmedian(recording.markers[recording.frames[recording.frames.size // 2 :], -1, 1]))
        for recording in recordings
    ]
    payloads = np.array([link.payload + recording.payload for recording in recordings])
    across = np.array([gravity[1], 0.0, -EARTH, EARTH])
    # Euler-Bernoulli, a uniform load and one on the tip; of half the length, it is no longer proportional.
    sags = np.outer(across, (link.mass / 8 + payloads / 3) * link.length**3 / link.bending_stiffness)
    largest = 0.5 * link.length
    share = (link.markers[-1] / link.length) ** 2  # of the outermost marker, nearly
    sags = np.clip(sags, -largest, largest) * share
    known = np.isfinite(rests)
    if not known.any():
        return None
    rest, sag = (np.median(np.asarray(values)[..., known], axis=-1) for values in (rests, sags))
    straight = _CURVED * link.length
    bent = np.log(np.maximum(rest / np.where(sag == 0.0, 1.0, sag), 1e-300)) / np.log(1.5)
    likelihoods = -0.5 * np.where(np.abs(sag) < straight, rest / straight, bent) ** 2
    best = int(np.argmax(likelihoods))
    gain = float(likelihoods[best] - likelihoods[0]) - np.log(2.0)
    if gain < LIKELY:
        return None
    bends = "more than " if abs(sag[0]) >= largest * share else ""
    finding = (
        f"the outermost marker of {link.name} rests at y = {1e3 * rest:.3g} mm, and the declared gravity would bend it "
        f"by {bends}{1e3 * sag[0]:.3g} mm"
    )
    if not gravity[1]:
        finding += f", its own weight by {1e3 * sag[best]:.3g} mm: if the plane is vertical"
    elif best == 1:
        finding += ": if the plane is horizontal"
    else:
        finding += ", to the other side: if the signs of x and y are right"
    remedy = f"set {gravity_key(rig, gravity)} = [{gravity[0]:.3g}, {across[best]:.3g}]"
    curved = "unless the link is curved at rest, which vjm diagnose finds as rest_curvature"
    files = tuple(recording.file for recording in recordings)
    return Mistake(f"{finding}, {remedy}, {curved}", min(gain, CERTAIN), files)
