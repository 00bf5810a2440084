"""The content of result.json as plain dictionaries; every number is finite or None."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
import uncertainties

from vjm.chain.virtual_links import Chain, LinkChain
from vjm.diagnosis.records import Candidate, Cause, Diagnosis, Gain
from vjm.effects.effect import Effect
from vjm.identification.check import Check
from vjm.identification.comparison import Comparison
from vjm.identification.records import Identification, ModeComparison
from vjm.records import Array, Estimate, RecordingComparison
from vjm.simulation.model import Model

Result = dict[str, Any]
Uncertain = Any  # a float, or a ufloat of the package uncertainties


def finite(value: float | None) -> float | None:
    """Return the number; None if it is not finite."""
    return None if value is None or not math.isfinite(value) else float(value)


def model_result(chain: Chain, estimates: Sequence[Estimate] = (), covariance: Array | None = None) -> Result:
    """Return the virtual-joint model link by link, with the standard errors that follow from the estimates'.

    Args:
        chain: the model.
        estimates: what was identified.
        covariance: (p, p) of those with a standard error; None: uncorrelated.
    """
    known = _uncertain(estimates, covariance)
    return {"links": [_link(link, known) for link in chain.links]}


def bending_stiffness(
    link: LinkChain, estimates: Sequence[Estimate], covariance: Array | None = None
) -> tuple[float, float | None]:
    """Return a link's bending stiffness EI and its standard error [N m^2]; None where it was not estimated.

    It is the estimate `LINK.bending_stiffness` where there is one; else the mean over the virtual joints of stiffness
    times cell, the cells being taken as known.

    Args:
        link: the identified link.
        estimates, covariance: as of `model_result`.
    """
    bending = _bending_stiffness(link, _uncertain(estimates, covariance))
    return float(uncertainties.nominal_value(bending)), _std(bending)


def _uncertain(estimates: Sequence[Estimate], covariance: Array | None) -> dict[str, Uncertain]:
    """Return the estimates that have a standard error by name, correlated as their covariance says."""
    estimated = [estimate for estimate in estimates if finite(estimate.std) is not None]
    stds = np.array([estimate.std for estimate in estimated], dtype=float)
    if covariance is None or covariance.shape != (stds.size, stds.size) or not np.isfinite(covariance).all():
        covariance = np.diag(stds**2)
    values = [estimate.value for estimate in estimated]
    correlated = uncertainties.correlated_values(values, covariance) if estimated else ()
    return dict(zip([estimate.name for estimate in estimated], correlated, strict=True))


def _bending_stiffness(link: LinkChain, known: Mapping[str, Uncertain]) -> Uncertain:
    joints = [known.get(f"{link.name}.stiffness_{j + 1}", float(K)) for j, K in enumerate(link.stiffness)]
    mean = sum(K * float(cell) for K, cell in zip(joints, link.cells, strict=True)) / link.virtual_joints
    return known.get(f"{link.name}.bending_stiffness", mean)


def _std(value: Uncertain) -> float | None:
    """Return the standard error; None where the value rests on nothing that was estimated."""
    return finite(value.std_dev) if isinstance(value, uncertainties.UFloat) else None


def _link(link: LinkChain, known: Mapping[str, Uncertain]) -> Result:
    bending = _bending_stiffness(link, known)
    fields = zip(link.lengths, link.mass_centers, link.masses, link.inertias, strict=True)
    return {
        "name": link.name,
        "bending_stiffness": {"value": finite(uncertainties.nominal_value(bending)), "std": _std(bending)},
        "hub_inertia": finite(link.hub_inertia),
        "virtual_links": [
            {"length": finite(length), "mass_center": finite(center), "mass": finite(mass), "inertia": finite(inertia)}
            for length, center, mass, inertia in fields
        ],
        "virtual_joints": [_joint(link, j, known) for j in range(link.virtual_joints)],
    }


def _joint(link: LinkChain, j: int, known: Mapping[str, Uncertain]) -> Result:
    stiffness, damping = float(link.stiffness[j]), float(link.damping[j])
    # K = EI / cell and D = tau K where the link's own EI and tau were estimated, else each by itself.
    bending = known.get(f"{link.name}.bending_stiffness", stiffness * float(link.cells[j]))
    time = known.get(f"{link.name}.kelvin_voigt_time", damping / stiffness if stiffness > 0 else 0.0)
    uniform = bending / float(link.cells[j])
    return {
        "stiffness": {"value": finite(stiffness), "std": _std(known.get(f"{link.name}.stiffness_{j + 1}", uniform))},
        "damping": {"value": finite(damping), "std": _std(known.get(f"{link.name}.damping_{j + 1}", time * uniform))},
    }


def result_object(result: Check | Identification | Comparison | Diagnosis) -> Result:
    """Return the result object of a command, as result.json holds it."""
    if isinstance(result, Identification):
        return _identification(result)
    if isinstance(result, Comparison):
        return _comparison(result)
    return _check(result) if isinstance(result, Check) else _diagnosis(result)


def _identification(fit: Identification) -> Result:
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
        "recordings": [{**_recording(each), "whiteness": _whiteness(fit, each)} for each in fit.recordings],
        "status": fit.status,
        "remedy": fit.remedy,
        "identifiable": [_identifiable(estimate) for estimate in fit.parameters],
        "estimates": [_estimate(estimate) for estimate in fit.parameters],
    }


def _comparison(comparison: Comparison) -> Result:
    model = comparison.model
    return {
        **_common("simulate", comparison.experiment.rig.name, comparison.warnings),
        "model": model_result(model.chain, model.estimates, comparison.covariance),
        "frequencies_hz": [{"model": finite(each), "measured": None} for each in model.modes().frequencies],
        "effects": [_effect(each, model) for each in model.effects],
        "recordings": [_recording(each) for each in comparison.recordings],
    }


def _diagnosis(diagnosis: Diagnosis) -> Result:
    model, symptoms = diagnosis.model, diagnosis.symptoms
    return {
        **_common("diagnose", diagnosis.experiment.rig.name, diagnosis.warnings),
        "notes": list(diagnosis.notes),
        "verdict": diagnosis.verdict,
        "causes": [_cause(cause, model) for cause in diagnosis.causes],
        "recordings": [_diagnosed_recording(each) for each in diagnosis.recordings],
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
            {**_effect(each.effect, model), "chi2_increase": finite(each.worse)} for each in cause.alternatives
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


def _diagnosed_recording(fit: RecordingComparison) -> Result:
    replays = fit.reference, fit.simulated, fit.alternative
    before, after, next_best = (finite(None if each is None else each.marker_rms) for each in replays)
    return {
        "file": fit.recording.file,
        "role": fit.recording.role,
        "marker_rms_before_m": before,
        "marker_rms_after_m": after,
        "marker_rms_next_best_m": next_best,
        "noise_m": finite(fit.noise[0]),
    }


def _gain(gain: Gain) -> Result:
    return {
        "holdout_rms_before_m": finite(gain.before),
        "holdout_rms_after_m": finite(gain.after),
        "holdout_rms_next_best_m": finite(gain.next_best),
        "noise_m": finite(gain.noise),
        "reduction": finite(gain.reduction),
        "ci95": [finite(each) for each in gain.interval],
    }


def _check(check: Check) -> Result:
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
    """Return the result object of `vjm urdf`; it holds the text itself where no file was asked for."""
    return {
        **_common("urdf", chain.name, ()),
        "file": file,
        "joints": list(chain.joint_names),
        "urdf": text if file is None else None,
    }


def _recording(fit: RecordingComparison) -> Result:
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
        "schema": 1,
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
    """Return whether a recording's residual is noise; None for one that whole trajectories were not fitted to."""
    for whiteness in () if fit.trajectory is None else fit.trajectory.whiteness:
        if whiteness.file == recording.recording.file:
            return {
                "chi2_per_sample": finite(whiteness.chi2),
                "largest_correlation": finite(whiteness.correlation),
                "coloured": bool(whiteness.coloured),
            }
    return None


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
