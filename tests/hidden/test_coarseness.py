"""What the few joints of the search's chain do is known before anything is looked for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vjm
from tests.fine_beam.extended import Extended
from tests.hidden.conftest import Plant
from tests.hidden.rigs import Conditions, physics_of, write_hidden
from tests.hidden.severities import draw
from tests.hidden.test_finding import assert_sizes, diagnosed, with_few
from vjm.diagnosis.baseline import fit_baseline
from vjm.diagnosis.screen import Screen
from vjm.effects import CubicStiffness
from vjm.identification.discretization import with_offset
from vjm.identification.trajectory_fit import Point


def cubic(point: Point) -> float:
    """Standard errors at which a cubic stiffness seems to be needed."""
    return float(np.sqrt(Screen.of(point, (), [CubicStiffness(link=0)]).statistics[0]))


def test_coarseness_is_no_effect_and_no_error_of_the_parameters(plant: Plant) -> None:
    """The drives of this seed are large: a cubic stiffness would explain a fifth of chi^2."""
    file, truth = plant("hub", seed=3)
    base = fit_baseline(with_few(file))
    assert base.fit.shift is not None
    plain = with_offset(base.fit.point, None)
    assert plain.misfit > 1.05
    assert cubic(plain) > 50
    assert base.fit.point.misfit < 1.005
    assert cubic(base.fit.point) < 4
    found = base.fit.estimate
    physical = base.fit.point.problem.parametrisation.physical(found)
    assert physical[0] == pytest.approx(truth.setting.beam.bending_stiffness, rel=3e-4)
    assert physical[2] == pytest.approx(truth.setting.beam.hub_inertia, rel=3e-4)


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["clamp_compliance", "cubic_stiffness", "gear_elasticity", "marker_mass"])
def test_sizes_have_no_more_than_their_errors_with_sensors_ten_times_as_good(tmp_path: Path, effect: str) -> None:
    """Errors of fourth order in the number of joints, extrapolated as of second order, made them ten off."""
    truth = write_hidden(tmp_path, "hub", [draw(effect, 921)], 921, Conditions(noise=0.1))
    diagnosis = diagnosed(tmp_path / "experiment.toml", [effect])
    assert [cause.effect.id for cause in diagnosis.causes] == [effect]
    assert_sizes(diagnosis, truth)


@pytest.mark.slow
def test_corrections_settle_where_many_samples_tell_much(plant: Plant) -> None:
    """At 144 frames/s a standard error is small beside what the first correction leaves."""
    file, truth = plant("clamped_arm", seed=5)
    base = fit_baseline(vjm.load_experiment(file)).fit
    assert base.shift is not None
    assert base.misfit == pytest.approx(1.0, abs=0.01)
    physical = base.point.problem.parametrisation.physical(base.estimate)
    stiffness = truth.setting.units.of(3, 1, -2) * truth.setting.beam.bending_stiffness
    assert physical[0] == pytest.approx(stiffness, rel=3e-4)


@pytest.mark.slow
def test_steps_that_are_long_beside_a_rough_start_hide_no_mode_of_a_release(plant: Plant) -> None:
    """The third mode swings as fast as the camera looks, and is seen in a few frames."""
    file, _ = plant("clamped_arm", seed=10153)
    base = fit_baseline(vjm.load_experiment(file)).fit
    for run in base.point.runs:
        assert run.chi2 < run.expected_chi2 + 5 * np.sqrt(2 * run.observed.count), run.observed.recording.file


@pytest.mark.slow
@pytest.mark.parametrize("seed", [901, 902, 903, 904])
def test_the_discretization_error_is_that_of_the_model_with_the_causes(plant: Plant, seed: int) -> None:
    """Without them, initial states of fast modes take part of what is missing, and those of a finer chain do not."""
    file, truth = plant("clamped", "structural_damping", seed=seed)
    diagnosis = vjm.diagnose(vjm.load_experiment(file), effects=["structural_damping"])
    (cause,) = diagnosis.causes
    loss, damping = cause.parameters["loss_factor"], diagnosis.model.estimates[1]
    assert loss.std is not None
    assert damping.std is not None
    # The simulated beam's own loss is not the same in all modes.
    without = replace(truth.setting.beam, kelvin_voigt_time=0.0)
    roots = np.linalg.eigvals(Extended(without, physics_of(truth.effects)[0]).linear(0))
    vibrations = sorted(roots[roots.imag > np.abs(roots.real)], key=abs)[:3]
    true = np.array([-2 * root.real / abs(root) for root in vibrations])
    assert true == pytest.approx(truth.effects[0].parameters["loss_factor"], rel=0.03)
    assert true.min() - 3 * loss.std < loss.value < true.max() + 3 * loss.std
    assert abs(damping.value - truth.setting.beam.kelvin_voigt_time) < 3 * damping.std


@pytest.mark.slow
def test_the_discretization_error_is_measured_again_where_causes_change(plant: Plant) -> None:
    """Two bodies look like a mass on the tip at first; an error measured beside that looks like a taper."""
    file, truth = plant("hub", "marker_mass", "payload_body", seed=941)
    diagnosis = diagnosed(file)
    assert {cause.effect.id for cause in diagnosis.causes} == {"marker_mass", "payload_body"}
    assert_sizes(diagnosis, truth)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "effects"),
    [
        (951, ("coulomb_friction", "tip_payload")),  # stopped where a step gained little, it stayed in segments
        (961, ("backlash", "tip_payload")),  # the first correction leaves many errors, and took a size off its bound
        (961, ("stribeck", "in_plane_gravity")),  # friction that changes within a step
    ],
)
def test_sizes_beside_friction_and_play_have_no_more_than_their_errors(
    plant: Plant, seed: int, effects: tuple[str, str]
) -> None:
    file, truth = plant("hub", *effects, seed=seed)
    diagnosis = diagnosed(file, effects)
    assert {cause.effect.id for cause in diagnosis.causes} == set(effects)
    assert_sizes(diagnosis, truth)
