"""result.json: what a command found, as plain dictionaries; every number finite, or None."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from vjm.chain.virtual_links import Chain, LinkChain
from vjm.identification.records import Identification, ModeComparison
from vjm.records import Array, Estimate, RecordingComparison
from vjm.simulation.model import Model

if TYPE_CHECKING:
    from vjm.diagnosis.records import Candidate, Cause, Diagnosis, Gain
    from vjm.effects.effect import Effect
    from vjm.identification.check import Check
    from vjm.identification.comparison import Comparison


Result = dict[str, Any]


def finite(value: float | None) -> float | None:
    """The number; None where it is not finite."""
    return None if value is None or not math.isfinite(value) else float(value)


def model_result(chain: Chain, estimates: Sequence[Estimate] = (), covariance: Array | None = None) -> Result:
    """The virtual-joint model link by link, with the standard errors that follow from the estimates' covariance."""
    known = _Known(estimates, covariance)
    return {"links": [_link(link, known) for link in chain.links]}


def bending_stiffness(
    link: LinkChain, estimates: Sequence[Estimate], covariance: Array | None = None
) -> tuple[float, float | None]:
    """A link's bending stiffness EI and its standard error [N m^2].

    The estimate `LINK.bending_stiffness` where there is one; else the mean over the virtual joints of stiffness times
    cell, the cells being taken as known.

    Args:
        link: the identified link.
        estimates: what was identified.
        covariance: (p, p) of those with a standard error; None: uncorrelated.
    """
    found = next((each for each in estimates if each.name == f"{link.name}.bending_stiffness"), None)
    if found is not None:
        return found.value, finite(found.std)
    weights = link.cells / link.virtual_joints
    slopes = {f"{link.name}.stiffness_{j + 1}": float(weight) for j, weight in enumerate(weights)}
    return float(weights @ link.stiffness), _Known(estimates, covariance).std(slopes)


class _Known:
    """Standard errors of what follows from the estimates."""

    def __init__(self, estimates: Sequence[Estimate], covariance: Array | None) -> None:
        self.estimates = estimates
        estimated = [each for each in estimates if each.std is not None]
        self.index = {each.name: k for k, each in enumerate(estimated)}
        self.covariance = np.diag([(each.std or 0.0) ** 2 for each in estimated])
        if covariance is not None and covariance.shape == self.covariance.shape:
            self.covariance = covariance

    def std(self, slopes: Mapping[str, float]) -> float | None:
        """Of a quantity with these derivatives by the estimates; None where none of them was estimated."""
        known = {name: slope for name, slope in slopes.items() if name in self.index}
        if not known:
            return None
        rows = [self.index[name] for name in known]
        slope = np.array(list(known.values()))
        return finite(float(np.sqrt(max(slope @ self.covariance[np.ix_(rows, rows)] @ slope, 0.0))))


def _link(link: LinkChain, known: _Known) -> Result:
    value, std = bending_stiffness(link, known.estimates, known.covariance)
    fields = zip(link.lengths, link.mass_centers, link.masses, link.inertias, strict=True)
    return {
        "name": link.name,
        "bending_stiffness": {"value": finite(value), "std": std},
        "hub_inertia": finite(link.hub_inertia),
        "virtual_links": [
            {"length": finite(length), "mass_center": finite(center), "mass": finite(mass), "inertia": finite(inertia)}
            for length, center, mass, inertia in fields
        ],
        "virtual_joints": [_joint(link, j, known) for j in range(link.virtual_joints)],
    }


def _joint(link: LinkChain, j: int, known: _Known) -> Result:
    stiffness, damping = float(link.stiffness[j]), float(link.damping[j])
    bending, time = f"{link.name}.bending_stiffness", f"{link.name}.kelvin_voigt_time"
    # K = EI / cell and D = tau K where the link's own EI and tau were estimated, else each by itself.
    of_stiffness = {bending: 1 / float(link.cells[j]), f"{link.name}.stiffness_{j + 1}": 1.0}
    ratio = damping / stiffness if stiffness > 0 else 0.0
    of_damping = {bending: ratio / float(link.cells[j]), time: stiffness, f"{link.name}.damping_{j + 1}": 1.0}
    return {
        "stiffness": {"value": finite(stiffness), "std": known.std(of_stiffness)},
        "damping": {"value": finite(damping), "std": known.std(of_damping)},
    }


SCHEMA = 1


def identification_result(fit: Identification) -> Result:
    """The result object of `vjm identify`."""
    summary = fit.trajectory
    return {
        **_common("identify", fit.experiment.rig.name, fit.warnings),
        "notes": list(fit.notes),
        "method": fit.method,
        "parameters": fit.parametrisation,
        "model": model_result(fit.model.chain, fit.parameters, fit.covariance),
        "frequencies_hz": [_frequency(mode) for mode in fit.modes],
        "damping_ratios": [
            {"model": finite(mode.damping_model), "measured": finite(mode.damping_measured)} for mode in fit.modes
        ],
        "mode_shape_mac": [finite(mode.mac) for mode in fit.modes],
        "objective": {
            "torque": finite(fit.objective),
            "trajectory_chi2_per_sample": finite(None if summary is None else summary.chi2_per_sample),
        },
        "recordings": [{**recording_result(each), "whiteness": _whiteness(fit, each)} for each in fit.recordings],
        "status": fit.status,
        "remedy": fit.remedy,
        "identifiable": [_identifiable(estimate) for estimate in fit.parameters],
        "estimates": [_estimate(estimate) for estimate in fit.parameters],
    }


def comparison_result(comparison: Comparison) -> Result:
    """The result object of `vjm simulate`."""
    model = comparison.model
    return {
        **_common("simulate", comparison.experiment.rig.name, comparison.warnings),
        "model": model_result(model.chain, model.estimates, comparison.covariance),
        "frequencies_hz": [{"model": finite(each), "measured": None} for each in model.modes().frequencies],
        "effects": [_effect(each, model) for each in model.effects],
        "recordings": [recording_result(each) for each in comparison.recordings],
    }


def diagnosis_result(diagnosis: Diagnosis) -> Result:
    """The result object of `vjm diagnose`; `model` is the extended model's chain, on which the causes act."""
    model, symptoms = diagnosis.model, diagnosis.symptoms
    return {
        **_common("diagnose", diagnosis.experiment.rig.name, diagnosis.warnings),
        "notes": list(diagnosis.notes),
        "verdict": diagnosis.verdict,
        "causes": [_cause(cause, model) for cause in diagnosis.causes],
        "recordings": [_followed(each) for each in diagnosis.recordings],
        "gain": None if diagnosis.gain is None else _gain(diagnosis.gain),
        "candidates": [_candidate(each, model) for each in diagnosis.candidates],
        "remaining": {
            "p_value": finite(diagnosis.remaining.p_value),
            "description": diagnosis.remaining.description,
        },
        "next_experiment": diagnosis.next_experiment,
        "symptoms": [] if symptoms is None else [each.sentence for each in symptoms.headlines()],
        "noise": diagnosis.noise,
        "model": model_result(model.chain, diagnosis.parameters),
        "estimates": [_estimate(each) for each in diagnosis.parameters],
    }


def _place(effect: Effect, model: Model) -> Result:
    """Which effect, and the name of the link where it acts."""
    return {"effect": effect.id, "link": None if effect.link is None else model.chain.links[effect.link].name}


def _effect(effect: Effect, model: Model) -> Result:
    return {**_place(effect, model), "parameters": {name: finite(value) for name, value in effect.values.items()}}


def _cause(cause: Cause, model: Model) -> Result:
    return {
        **_place(cause.effect, model),
        "parameters": {
            name: {"value": finite(size.value), "std": finite(size.std), "unit": size.unit}
            for name, size in cause.parameters.items()
        },
        "p_value": finite(cause.p_value),
        "chi2_gain": finite(cause.gain),
        "indistinguishable_from": list(dict.fromkeys(alternative.effect.id for alternative in cause.alternatives)),
        "alternatives": [
            {**_effect(each.effect, model), "chi2_worse": finite(each.worse)} for each in cause.alternatives
        ],
        "evidence": cause.evidence,
    }


def _candidate(candidate: Candidate, model: Model) -> Result:
    return {
        **_place(candidate.effect, model),
        "z": finite(candidate.z),
        "p_value": finite(candidate.p_value),
        "size": {name: finite(value) for name, value in candidate.sizes.items()},
        "smallest_detectable": {name: finite(value) for name, value in candidate.smallest_detectable.items()},
        "testable": candidate.testable,
        "reason": candidate.reason,
    }


def _followed(followed: RecordingComparison) -> Result:
    replays = followed.reference, followed.simulated, followed.alternative
    before, after, next_best = (finite(None if each is None else each.marker_rms) for each in replays)
    return {
        "file": followed.recording.file,
        "role": followed.recording.role,
        "marker_rms_before_m": before,
        "marker_rms_after_m": after,
        "marker_rms_runner_up_m": next_best,
        "noise_m": finite(followed.noise[0]),
    }


def _gain(gain: Gain) -> Result:
    return {
        "holdout_rms_before_m": finite(gain.before),
        "holdout_rms_after_m": finite(gain.after),
        "holdout_rms_runner_up_m": finite(gain.next_best),
        "noise_m": finite(gain.noise),
        "reduction": finite(gain.reduction),
        "ci95": [finite(each) for each in gain.interval],
    }


def check_result(check: Check) -> Result:
    """The result object of `vjm check`; `identifiable` has a list for each choice of `--parameters`."""
    rig = check.experiment.rig
    joints = check.virtual_joints or (None,) * len(rig.links)  # none where nothing can be identified
    return {
        **_common("check", rig.name, check.warnings),
        "problem": check.problem,
        "links": [{"name": link.name, "virtual_joints": n} for link, n in zip(rig.links, joints, strict=True)],
        "frequencies_hz": [{"model": finite(each), "measured": None} for each in check.modes],
        "recordings": [
            {"file": each.file, "kind": each.kind, "role": each.role, "duration_s": float(each.time[-1] - each.time[0])}
            for each in check.experiment.recordings
        ],
        "identifiable": {kind: [_identifiable(each) for each in found] for kind, found in check.identifiable.items()},
    }


def urdf_result(chain: Chain, text: str, file: str | None) -> Result:
    """The result object of `vjm urdf`; holds the text itself where no file was asked for."""
    return {
        **_common("urdf", chain.name, ()),
        "file": file,
        "joints": list(chain.joint_names),
        "urdf": text if file is None else None,
    }


def recording_result(fit: RecordingComparison) -> Result:
    """How well one recording is followed."""
    replay, nominal = fit.simulated, fit.reference
    return {
        "file": fit.recording.file,
        "role": fit.recording.role,
        "marker_rms_m": finite(replay.marker_rms if replay else None),
        "theta_rms_rad": finite(replay.theta_rms if replay else None),
        "noise_m": finite(fit.noise[0]),
        "nominal_marker_rms_m": finite(nominal.marker_rms if nominal else None),
        "torque_marker_rms_m": finite(fit.alternative.marker_rms if fit.alternative else None),
        "left_out": fit.left_out,
        "problem": fit.problem,
    }


def _common(command: str, experiment: str, warnings: Sequence[str]) -> Result:
    return {
        "schema": SCHEMA,
        "command": command,
        "vjm": version("vjm"),
        "experiment": experiment,
        "warnings": list(warnings),
    }


def _frequency(mode: ModeComparison) -> Result:
    return {
        "model": finite(mode.frequency_model),
        "measured": finite(mode.frequency_measured),
        "measured_std": finite(mode.frequency_std),
    }


def _whiteness(fit: Identification, recording: RecordingComparison) -> Result | None:
    """Whether what is left of a recording is noise; None for one that whole trajectories were not fitted to."""
    known = () if fit.trajectory is None else fit.trajectory.whiteness
    found = next((each for each in known if each.file == recording.recording.file), None)
    if found is None:
        return None
    return {
        "chi2_per_sample": finite(found.chi2),
        "largest_correlation": finite(found.correlation),
        "coloured": bool(found.coloured),
    }


def _identifiable(estimate: Estimate) -> Result:
    return {
        "parameter": estimate.name,
        "identifiable": bool(estimate.identifiable),
        "reason": estimate.reason,
        "remedy": estimate.remedy,
    }


def _estimate(estimate: Estimate) -> Result:
    value, std = finite(estimate.value), finite(estimate.std)
    return {"parameter": estimate.name, "value": value, "std": std, "unit": estimate.unit}
