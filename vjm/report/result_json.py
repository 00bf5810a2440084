"""The content of result.json as plain dictionaries; every number is finite or None."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any, cast

import numpy as np
import uncertainties

from vjm.chain.virtual_links import Chain, LinkChain
from vjm.diagnosis.records import Candidate, Cause, Diagnosis
from vjm.effects.effect import Effect
from vjm.files import plain
from vjm.identification.check import Check
from vjm.identification.records import Comparison, Identification
from vjm.model.urdf_document import Spring
from vjm.records import Array, Estimate, RecordingComparison, SimulatedRecording
from vjm.report.text import place
from vjm.simulation.model import Model

_Result = dict[str, Any]
_Uncertain = Any  # a float, or a ufloat of the package uncertainties
_IDENTIFIABLE = ("identifiable", "reason", "remedy")  # fields of an Estimate
_ERRORS = ("std", "std_discretisation", "ci95")
_ESTIMATED = ("value", *_ERRORS, "unit")
_MORE_JOINTS = "more virtual joints"  # tag of the variable that stands for them


def _model_object(chain: Chain, estimates: Sequence[Estimate], covariance: Array | None = None) -> _Result:
    """Return the virtual-joint model link by link, with the standard errors that follow from the estimates'."""
    known = _uncertain(estimates, covariance)
    return {"links": [_link(link, known) for link in chain.links]}


def _uncertain(estimates: Sequence[Estimate], covariance: Array | None) -> dict[str, _Uncertain]:
    """Return the estimates that have a standard error by name, uncorrelated where there is no covariance (p, p).

    What more virtual joints would change is a variable of its own, since it moves all estimates together.
    """
    estimated = [estimate for estimate in estimates if estimate.std is not None and math.isfinite(estimate.std)]
    stds = np.array([estimate.std for estimate in estimated], dtype=float)
    if covariance is None or covariance.shape != (stds.size, stds.size) or not np.isfinite(covariance).all():
        covariance = np.diag(stds**2)
    values = [estimate.value for estimate in estimated]
    correlated = uncertainties.correlated_values(values, covariance) if estimated else ()
    more_joints = uncertainties.ufloat(0.0, 1.0, _MORE_JOINTS)
    shifts = [estimate.discretization_shift for estimate in estimated]
    shifted = [
        value if shift is None else value + shift * more_joints for value, shift in zip(correlated, shifts, strict=True)
    ]
    return dict(zip([estimate.name for estimate in estimated], shifted, strict=True))


def _quantity(value: _Uncertain) -> _Result:
    """Return a stiffness or damping with its errors, None where it rests on nothing that was estimated or measured."""
    nominal = uncertainties.nominal_value(value)
    if not isinstance(value, uncertainties.UFloat):
        return {"value": nominal, **dict.fromkeys(_ERRORS)}
    parts = value.error_components()
    shift = next((error for variable, error in parts.items() if variable.tag == _MORE_JOINTS), None)
    noise = math.sqrt(sum(error**2 for variable, error in parts.items() if variable.tag != _MORE_JOINTS))
    estimate = Estimate("", nominal, noise, "", discretization_shift=shift, nonnegative=True)
    return {"value": nominal, **{name: getattr(estimate, name) for name in _ERRORS}}


def _link(link: LinkChain, known: Mapping[str, _Uncertain]) -> _Result:
    joints = [known.get(f"{link.name}.stiffness_{j}", float(K)) for j, K in enumerate(link.stiffness, start=1)]
    # EI is an estimate, or the mean over the virtual joints of stiffness times cell, the cells being taken as known.
    mean = sum(K * float(cell) for K, cell in zip(joints, link.cells, strict=True)) / link.virtual_joints
    bending = known.get(f"{link.name}.bending_stiffness", mean)
    fields = {"length": link.lengths, "mass_center": link.mass_centers, "mass": link.masses, "inertia": link.inertias}
    return {
        "name": link.name,
        "bending_stiffness": _quantity(bending),
        "hub_inertia": link.hub_inertia,
        "virtual_links": [{name: values[i] for name, values in fields.items()} for i in range(link.lengths.size)],
        "virtual_joints": [_joint(link, j, known) for j in range(link.virtual_joints)],
    }


def _joint(link: LinkChain, j: int, known: Mapping[str, _Uncertain]) -> _Result:
    stiffness, damping = float(link.stiffness[j]), float(link.damping[j])
    # K = EI / cell and D = tau K where the link's own EI and tau were estimated, else each by itself.
    bending = known.get(f"{link.name}.bending_stiffness", stiffness * float(link.cells[j]))
    time = known.get(f"{link.name}.kelvin_voigt_time", damping / stiffness if stiffness > 0 else 0.0)
    uniform = bending / float(link.cells[j])
    return {
        "stiffness": _quantity(known.get(f"{link.name}.stiffness_{j + 1}", uniform)) | {"value": stiffness},
        "damping": _quantity(known.get(f"{link.name}.damping_{j + 1}", time * uniform)) | {"value": damping},
    }


def result_object(result: Check | Comparison | Diagnosis) -> _Result:
    """Return the result object of a command, as result.json holds it: every number finite or None."""
    if isinstance(result, Identification):
        command, content = "identify", _identification(result)
    elif isinstance(result, Comparison):
        command, content = "simulate", _comparison(result)
    elif isinstance(result, Check):
        command, content = "check", _check(result)
    else:
        command, content = "diagnose", _diagnosis(result)
    common = _common(command, result.experiment.rig.name, result.warnings)
    return cast(_Result, plain({**common, **content}))


def urdf_result(
    chain: Chain, text: str, file: str | None, beside: str | None = None, left_out: Sequence[str] = ()
) -> _Result:
    """Return the result object of `vjm urdf`; it holds the text itself where no file was asked for.

    With a file `beside` for a simulator, it names the effects left out of both.
    """
    content: _Result = {"file": file, "joints": list(chain.joint_names), "urdf": text if file is None else None}
    if beside is not None:
        content |= {"simulator_file": beside, "left_out": list(left_out)}
    return {**_common("urdf", chain.name, ()), **content}


def flexify_result(robot: str, springs: Sequence[Spring], text: str, file: str | None) -> _Result:
    """Return the result object of `vjm flexify`; it holds the text itself where no file was asked for."""
    content = {
        "file": file,
        "springs": [spring._asdict() for spring in springs],
        "urdf": text if file is None else None,
    }
    return {**_common("flexify", robot, ()), **content}


def _common(command: str, experiment: str, warnings: Sequence[str]) -> _Result:
    names = {"command": command, "vjm": version("vjm"), "experiment": experiment}
    return {"schema": 1, **names, "warnings": list(warnings)}


def _identification(fit: Identification) -> _Result:
    # None for a recording that whole trajectories were not fitted to
    whiteness = {
        test.file: {
            "chi2_per_sample": test.mean_square,
            "largest_correlation": test.correlation,
            "coloured": test.correlated,
        }
        for test in reversed(fit.whiteness)
    }
    return {
        "notes": fit.notes,
        "method": fit.method,
        "parameters": fit.parametrisation,
        "model": _model_object(fit.model.chain, fit.parameters, fit.covariance),
        "frequencies_hz": [
            {"model": mode.frequency_model, "measured": mode.frequency_measured, "measured_std": mode.frequency_std}
            for mode in fit.modes
        ],
        "damping_ratios": [{"model": mode.damping_model, "measured": mode.damping_measured} for mode in fit.modes],
        "mode_shape_mac": [mode.mac for mode in fit.modes],
        "objective": {
            "torque": fit.objective,
            "trajectory_chi2_per_sample": fit.trajectory.misfit**2 if fit.trajectory else None,
        },
        "recordings": [
            {**_recording(comparison), "whiteness": whiteness.get(comparison.recording.file)}
            for comparison in fit.recordings
        ],
        "status": fit.status,
        "remedy": fit.remedy,
        "identifiable": _estimates(fit.parameters, *_IDENTIFIABLE),
        "estimates": _estimates(fit.parameters, *_ESTIMATED),
    }


def _comparison(comparison: Comparison) -> _Result:
    model = comparison.model
    return {
        "model": _model_object(model.chain, model.estimates, comparison.covariance),
        "frequencies_hz": [{"model": frequency, "measured": None} for frequency in model.modes().frequencies],
        "effects": [{**_place(effect, model), "parameters": effect.values} for effect in model.effects],
        "recordings": [_recording(item) for item in comparison.recordings],
    }


def _recording(comparison: RecordingComparison) -> _Result:
    return {
        "file": comparison.recording.file,
        "role": comparison.recording.role,
        "marker_rms_m": _rms(comparison.simulated),
        "theta_rms_rad": comparison.simulated.theta_rms if comparison.simulated else None,
        "noise_m": comparison.noise[0],
        "nominal_marker_rms_m": _rms(comparison.reference),
        "torque_marker_rms_m": _rms(comparison.alternative),
        "left_out": comparison.left_out,
        "problem": comparison.problem,
    }


def _rms(simulated: SimulatedRecording | None) -> float | None:
    return simulated.marker_rms if simulated else None


def _estimates(estimates: Sequence[Estimate], *names: str) -> list[_Result]:
    return [{"parameter": estimate.name, **{name: getattr(estimate, name) for name in names}} for estimate in estimates]


def _check(check: Check) -> _Result:
    rig = check.experiment.rig
    joints = check.virtual_joints or (None,) * len(rig.links)  # none where nothing can be identified
    return {
        "problem": check.problem,
        "links": [{"name": link.name, "virtual_joints": count} for link, count in zip(rig.links, joints, strict=True)],
        "frequencies_hz": [{"model": frequency, "measured": None} for frequency in check.modes],
        "recordings": [
            {
                **{"file": overview.recording.file, "kind": overview.recording.kind, "role": overview.recording.role},
                **{"duration_s": overview.duration, "frames": overview.frames, "missing_cells": overview.missing},
                **{"frames_per_s": overview.frame_rate, "encoder_samples_per_s": overview.sensor_rate},
                **{"noise_m": overview.noise, "motion_over_noise": overview.motion, "modes_hz": overview.modes},
            }
            for overview in check.overviews
        ],
        "identifiable": {kind: _estimates(estimates, *_IDENTIFIABLE) for kind, estimates in check.identifiable.items()},
    }


def _diagnosis(diagnosis: Diagnosis) -> _Result:
    model, symptoms, gain = diagnosis.model, diagnosis.symptoms, diagnosis.gain
    return {
        "notes": diagnosis.notes,
        "verdict": diagnosis.verdict,
        "causes": [_cause(cause, model) for cause in diagnosis.causes],
        "recordings": [
            {
                "file": comparison.recording.file,
                "role": comparison.recording.role,
                "marker_rms_before_m": _rms(comparison.reference),
                "marker_rms_after_m": _rms(comparison.simulated),
                "marker_rms_next_best_m": _rms(comparison.alternative),
                "noise_m": comparison.noise[0],
            }
            for comparison in diagnosis.recordings
        ],
        "gain": gain
        and {
            "holdout_rms_before_m": gain.before,
            "holdout_rms_after_m": gain.after,
            "holdout_rms_next_best_m": gain.next_best,
            "noise_m": gain.noise,
            "reduction": gain.reduction,
            "ci95": gain.interval,
        },
        "candidates": [_candidate(candidate, diagnosis) for candidate in diagnosis.candidates],
        "remaining": vars(diagnosis.remaining),
        "next_experiment": diagnosis.next_experiment,
        "symptoms": [] if symptoms is None else [symptom.sentence for symptom in symptoms.headlines()],
        "noise": diagnosis.noise,
        "budget": vars(diagnosis.budget),
        "recommended": "without causes" if diagnosis.recommended is diagnosis.reference else "with causes",
        "model": _model_object(model.chain, diagnosis.parameters),
        "estimates": _estimates(diagnosis.parameters, *_ESTIMATED),
    }


def _place(effect: Effect, model: Model) -> _Result:
    return {"effect": effect.id, "link": place(effect, model) or None}


def _cause(cause: Cause, model: Model) -> _Result:
    return {
        **_place(cause.effect, model),
        "parameters": {
            name: {field: getattr(size, field) for field in _ESTIMATED} for name, size in cause.parameters.items()
        },
        "p_value": cause.p_value,
        "chi2_gain": cause.decrease,
        "indistinguishable_from": list(dict.fromkeys(alternative.effect.id for alternative in cause.alternatives)),
        "alternatives": [
            {
                **_place(alternative.effect, model),
                "parameters": alternative.effect.values,
                "chi2_increase": alternative.chi2_increase,
            }
            for alternative in cause.alternatives
        ],
        "evidence": cause.evidence,
        "role": cause.role,
        "holdout_gain_m": cause.holdout_gain,
    }


def _candidate(candidate: Candidate, diagnosis: Diagnosis) -> _Result:
    return {
        **_place(candidate.effect, diagnosis.model),
        "z": candidate.z,
        "p_value": candidate.p_value,
        "size": candidate.sizes,
        "smallest_detectable": candidate.smallest_detectable,
        "residual": candidate.misfit,
        "residual_bound": candidate.bound,
        "holdout_rms_m": diagnosis.held_out_alone.get(candidate.effect.key),
        "testable": candidate.testable,
        "reason": candidate.reason,
    }
