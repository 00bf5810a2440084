"""result.json: the keys of the interface, finite numbers, and standard errors that follow from the covariance."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.report.fits import demo_fit, elbow_fit, torque_fit
from tests.report.schema import CheckResult, IdentifyResult, SimulateResult, UrdfResult
from vjm.files import json_text
from vjm.identification.check import Check
from vjm.identification.comparison import Comparison
from vjm.identification.records import Identification
from vjm.model.urdf import chain_to_urdf
from vjm.records import Estimate
from vjm.report.result_json import (
    _model_object,
    result_object,
    urdf_result,
)


def test_identification_has_the_keys_of_the_interface(fit: Identification) -> None:
    text = json_text(result_object(fit))
    result = IdentifyResult.model_validate_json(text)
    assert [each.file for each in result.recordings] == [each.file for each in fit.experiment.recordings]
    assert len(result.frequencies_hz) == len(result.damping_ratios) == len(fit.modes)
    for link, chain in zip(result.model.links, fit.model.chain.links, strict=True):
        assert [each.length for each in link.virtual_links] == chain.lengths.tolist()
        assert [each.stiffness.value for each in link.virtual_joints] == chain.stiffness.tolist()


def test_encoder_and_simulation_are_null_where_there_are_none() -> None:
    elbow = result_object(elbow_fit())["recordings"]
    assert elbow[-1]["marker_rms_m"] is None
    assert elbow[-1]["problem"] == "no torque was measured"
    assert elbow[0]["theta_rms_rad"] > 0
    assert result_object(demo_fit())["recordings"][0]["theta_rms_rad"] is None


def test_trajectory_fit_beside_the_torque_method() -> None:
    fit = demo_fit()
    fitted = tuple(replace(each, left_out=k) for k, each in enumerate(fit.recordings))
    result = IdentifyResult.model_validate_json(json_text(result_object(replace(fit, recordings=fitted))))
    assert result.method == "trajectory"
    assert fit.trajectory is not None
    point = fit.trajectory.point
    squares = sum(float(np.sum(run.residual**2)) for run in point.runs)
    assert result.objective.trajectory_chi2_per_sample == pytest.approx(
        squares / sum(run.residual.size for run in point.runs)
    )
    assert result.mode_shape_mac == [0.9987, 0.9987, None]
    for each, shown in zip(fit.recordings, result.recordings, strict=True):
        assert each.alternative is not None
        assert shown.torque_marker_rms_m == each.alternative.marker_rms
    assert [each.left_out for each in result.recordings] == [0, 1, 2, 3]
    white = {each.file: each.whiteness for each in result.recordings}
    assert white["both_modes.csv"] is None  # held out
    assert white["second_mode.csv"] is not None
    assert white["second_mode.csv"].model_dump() == {
        "chi2_per_sample": 1.2,
        "largest_correlation": 0.35,
        "coloured": True,
    }


def test_torque_fit_has_no_trajectories() -> None:
    result = IdentifyResult.model_validate_json(json_text(result_object(torque_fit())))
    assert result.objective.trajectory_chi2_per_sample is None
    assert {each.torque_marker_rms_m for each in result.recordings} == {None}
    assert {each.whiteness for each in result.recordings} == {None}


def test_what_is_not_determined_comes_with_a_remedy() -> None:
    result = IdentifyResult.model_validate_json(json_text(result_object(elbow_fit())))
    remedies = {each.parameter: each.remedy for each in result.identifiable}
    assert remedies["upper.hub_inertia"] == "a driven recording whose torque changes faster"
    assert remedies["upper.bending_stiffness"] == ""


def test_what_is_not_finite_becomes_null() -> None:
    fit = demo_fit()
    lost = replace(fit.parameters[0], std=math.inf, identifiable=False, reason="nothing moves")
    modes = (replace(fit.modes[0], frequency_measured=math.nan), *fit.modes[1:])
    broken = replace(fit, parameters=(lost, *fit.parameters[1:]), objective=math.nan, modes=modes, torque_data=())
    result = IdentifyResult.model_validate_json(json_text(result_object(broken)))
    assert result.objective.torque is None
    assert result.estimates[0].std is None
    assert result.frequencies_hz[0].measured is None
    assert result.model.links[0].bending_stiffness.std is None


def test_joint_errors_follow_from_correlated_link_parameters() -> None:
    fit = demo_fit()
    stds = np.array([estimate.std or 0.0 for estimate in fit.parameters])
    covariance = np.outer(stds, stds) * np.array([[1.0, -0.6], [-0.6, 1.0]])
    joint = result_object(replace(fit, covariance=covariance))["model"]["links"][0]["virtual_joints"][1]
    means = [estimate.value for estimate in fit.parameters]
    drawn = np.random.default_rng(1).multivariate_normal(means, covariance, 200_000)
    cell = fit.model.chain.links[0].cells[1]
    assert joint["stiffness"]["std"] == pytest.approx(np.std(drawn[:, 0] / cell), rel=0.01)
    assert joint["damping"]["std"] == pytest.approx(np.std(drawn[:, 0] * drawn[:, 1] / cell), rel=0.01)


def test_bending_stiffness_of_free_joints_is_their_mean() -> None:
    link = demo_fit().model.chain.links[0]
    n = link.virtual_joints
    joints = tuple(Estimate(f"beam.stiffness_{j + 1}", k, 0.1, "N m/rad") for j, k in enumerate(link.stiffness))
    covariance = 0.01 * (0.5 * np.eye(n) + 0.5)
    chain = demo_fit().model.chain
    value, std, *_ = _model_object(chain, joints, covariance)["links"][0]["bending_stiffness"].values()
    drawn = np.random.default_rng(1).multivariate_normal(link.stiffness, covariance, 200_000)
    assert value == pytest.approx(float(np.mean(link.stiffness * link.cells)))
    assert std == pytest.approx(np.std(np.mean(drawn * link.cells, axis=1)), rel=0.01)
    assert _model_object(chain, ())["links"][0]["bending_stiffness"]["std"] is None


def test_results_of_the_other_commands() -> None:
    fit = elbow_fit()
    comparison = Comparison(fit.experiment, fit.model, fit.nominal, fit.covariance, fit.recordings, ("careful",))
    simulated = SimulateResult.model_validate_json(json_text(result_object(comparison)))
    assert simulated.warnings == ["careful"]
    check = Check(fit.experiment, (), np.array([1.0, 2.0]), (3, 4), {"uniform": fit.parameters})
    assert [link.virtual_joints for link in parse_check(check).links] == [3, 4]
    hopeless = Check(fit.experiment, (), np.array([1.0]), (), {}, "nothing moves")
    assert [link.virtual_joints for link in parse_check(hopeless).links] == [None, None]
    text = chain_to_urdf(fit.model.chain)
    assert UrdfResult.model_validate_json(json_text(urdf_result(fit.model.chain, text, None))).urdf == text
    assert json.loads(json_text(urdf_result(fit.model.chain, text, "arm.urdf")))["urdf"] is None


def parse_check(check: Check) -> CheckResult:
    return CheckResult.model_validate_json(json_text(result_object(check)))
