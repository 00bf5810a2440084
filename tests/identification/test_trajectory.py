"""The trajectory method: what is put in comes out, as sharply as the noise allows, from far away."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import vjm
from tests.diagnosis.rigs import first_seconds
from tests.fine_beam.make_hub import SLEW, TRUTH, write_hub_experiment
from tests.identification.test_recovery import SHARED, chain_recordings, demo
from tests.simulation.setups import arm_of, end_load_shape, jerky_torque, recording_of, rig_of, steel_link
from vjm.errors import SimulationDivergedError
from vjm.identification import Identification, identify
from vjm.identification.identify import _marker_deflections, _modal_assurance
from vjm.identification.parameters import Parametrisation
from vjm.identification.trajectory_fit import Point, TrajectoryProblem, fit_trajectory
from vjm.identification.trajectory_method import _largest_step_multiple, search_step_multiple
from vjm.identification.uncertainty import Information, _resampled, trajectory_information
from vjm.model.modes import modes
from vjm.records import Experiment, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.least_squares import LossName
from vjm.simulation.measurement import Observations
from vjm.simulation.run import InitialStatePrior, simulate_runs

Array = NDArray[np.float64]
NOISE = 3e-4
ENCODER_NOISE = 1e-4

# Without noise


@pytest.mark.parametrize(
    ("joint", "n"),
    [
        pytest.param("clamped", 2, marks=pytest.mark.slow),
        ("revolute", 2),
        pytest.param("revolute", 3, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("parameters", ["joints", "lengths"])
def test_noise_free_chain_comes_back_from_twice_its_stiffness(joint: str, n: int, parameters: str) -> None:
    # Free lengths have cells of their own, and so has what they are to find.
    experiment, truth = chain_recordings(joint, n, 0, free=parameters == "lengths")
    experiment = replace(experiment, rig=replace(experiment.rig, marker_noise=1e-6, encoder_noise=1e-6))
    fit = identify(experiment, parameters=parameters, baselines=False)
    found, true = fit.model.chain.links[0], truth.links[0]
    assert fit.status == "converged"
    assert found.stiffness == pytest.approx(true.stiffness, rel=1e-3)
    assert found.damping == pytest.approx(true.damping, rel=5e-3)
    assert found.lengths == pytest.approx(true.lengths, rel=1e-3)
    assert found.hub_inertia == pytest.approx(true.hub_inertia, rel=1e-3)


def test_a_torque_that_is_unknown_for_a_while_costs_information_and_no_more() -> None:
    experiment, truth = chain_recordings("revolute", 2, 0)
    rig = replace(experiment.rig, marker_noise=1e-6, encoder_noise=1e-6)

    def gapped(recording: Recording) -> Recording:
        unknown = (recording.time > 0.5) & (recording.time < 0.65)
        return replace(recording, tau=np.where(unknown[:, None], np.nan, recording.tau))

    recordings = tuple(gapped(recording) for recording in experiment.recordings)
    fit = identify(Experiment(rig, recordings), parameters="joints", baselines=False)
    found, true = fit.model.chain.links[0], truth.links[0]
    assert fit.status == "converged"
    assert found.stiffness == pytest.approx(true.stiffness, rel=1e-3)
    assert found.damping == pytest.approx(true.damping, rel=5e-3)


@pytest.mark.slow
def test_every_parameter_at_once_finds_a_model_that_fits_as_well_as_the_truth() -> None:
    experiment, _ = chain_recordings("revolute", 2, 1)
    experiment = replace(experiment, rig=replace(experiment.rig, marker_noise=1e-5, encoder_noise=1e-5))
    fit = identify(experiment, parameters="full", baselines=False)
    assert fit.trajectory is not None
    assert fit.trajectory.misfit**2 < 0.1
    assert fit.model.chain.links[0].masses.sum() == pytest.approx(0.44)
    assert fit.model.chain.links[0].lengths.sum() == pytest.approx(1.0)


# At the statistical limit


def truth_point(joint: str, n: int, kind: str) -> Point:
    """Two recordings of a chain, with the chain itself as what is looked for."""
    chain = arm_of(steel_link(n, joint))  # type: ignore[arg-type]
    time = np.arange(301) / 100.0
    if joint == "revolute":
        recordings = [recording_of(chain, time, jerky_torque(1, seed)) for seed in (1, 2)]
        states = [np.zeros(2 * chain.size) for _ in recordings]
    else:
        recordings = [recording_of(chain, time)] * 2
        bends = (end_load_shape(chain, 0.05), end_load_shape(chain, 0.02) * np.linspace(1, -3, n))
        states = [np.r_[bend, np.zeros(n)] for bend in bends]
    observed = tuple(
        Observations.of(
            rig_of(chain),
            replace(r, markers=np.zeros_like(r.markers), theta=np.zeros_like(r.theta)),
            (NOISE, ENCODER_NOISE),
        )
        for r in recordings
    )
    parametrisation = Parametrisation(chain, kind, (0,) if joint == "revolute" else ())
    starts = [InitialStatePrior.of(Arm(chain), each.recording) for each in observed]
    runs = simulate_runs([Arm(chain)] * len(observed), observed, starts, states, 1.0)
    return Point(TrajectoryProblem(parametrisation, observed), parametrisation.start, tuple(runs))


def bound_of(point: Point) -> Array:
    """Cramer and Rao's: no unbiased estimate has a smaller standard deviation."""
    R = point.reduced()[0].R[:-1, :-1]
    return np.sqrt(np.diag(point.problem.parametrisation.physical_covariance(point.x, np.linalg.inv(R.T @ R))))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("joint", "n", "kind"),
    [
        ("clamped", 3, "uniform"),
        ("clamped", 2, "uniform"),
        ("revolute", 3, "uniform"),
        ("revolute", 3, "joints"),
    ],
)
def test_a_hundred_fits_scatter_as_little_as_any_can(joint: str, n: int, kind: str) -> None:
    point = truth_point(joint, n, kind)
    with ProcessPoolExecutor(2) as pool:
        values, std = _resampled(point, 100, "noise", pool, 1)
    bound, scatter = bound_of(point), values.std(axis=0, ddof=1)
    inside = np.abs(values - point.problem.parametrisation.physical(point.x)) < 1.96 * std
    assert len(values) == 100
    assert (scatter < 1.15 * bound).all(), scatter / bound
    assert 0.91 <= inside.mean() <= 0.98
    assert (inside.mean(axis=0) > 0.88).all(), inside.mean(axis=0)


def estimates(point: Point, seed: int) -> Array:
    """(2, p) parameters found under a draw of noise and under its negative: their mean has no first-order scatter."""
    rng = np.random.default_rng(seed)
    noise = [rng.standard_normal(run.observed.count) for run in point.runs]
    found = []
    for sign in (1.0, -1.0):
        observed = tuple(
            replace(
                run.observed,
                values=run.observed.predicted(run.arm, run.trajectory) + sign * each / run.observed.weights,
            )
            for run, each in zip(point.runs, noise, strict=True)
        )
        fit = fit_trajectory(replace(point.problem, observed=observed), point.x, states=[r.state for r in point.runs])
        found.append(point.problem.parametrisation.physical(fit.point.x))
    return np.array(found)


@pytest.mark.parametrize(("joint", "n", "kind"), [("clamped", 3, "uniform"), ("revolute", 3, "joints")])
def test_estimates_are_not_biased(joint: str, n: int, kind: str) -> None:
    point = truth_point(joint, n, kind)
    with ProcessPoolExecutor(2) as pool:
        pairs = np.array(list(pool.map(partial(estimates, point), range(6))))
    truth = point.problem.parametrisation.physical(point.x)
    bias = (pairs.mean(axis=(0, 1)) - truth) / bound_of(point)
    assert (np.abs(bias) < 0.2).all(), bias
    scatter = np.std(pairs.mean(axis=1), axis=0, ddof=1) / bound_of(point) / np.sqrt(len(pairs))
    assert scatter.max() < 0.1  # of the bias itself


@pytest.mark.slow
def test_coloured_noise_widens_the_standard_errors() -> None:
    """Noise that lasts ten frames: the plain Fisher information would promise three times too much."""
    point = truth_point("revolute", 2, "uniform")
    rng = np.random.default_rng(3)
    values, errors = [], []
    for _ in range(30):
        observed = []
        for run in point.runs:
            seen = run.observed
            rows = [len(series) for series in run.residual_series()]
            sizes = [10, 1]
            noise = [_coloured(rng, count, size).ravel() for count, size in zip(rows, sizes, strict=True)]
            predicted = seen.predicted(run.arm, run.trajectory)
            observed.append(replace(seen, values=predicted + np.concatenate(noise) / seen.weights))
        problem = replace(point.problem, observed=tuple(observed))
        fit = fit_trajectory(problem, point.x, states=[run.state for run in point.runs])
        values.append(problem.parametrisation.physical(fit.point.x))
        errors.append(_std(fit))
    scatter, promised = np.std(values, axis=0, ddof=1), np.median(errors, axis=0)
    assert (promised > 0.65 * scatter).all(), promised / scatter
    assert (promised < 1.8 * scatter).all(), promised / scatter
    assert (bound_of(point) < 0.65 * scatter).any()


def _coloured(rng: np.random.Generator, count: int, size: int) -> Array:
    """(count, size) noise of unit variance whose neighbours correlate by 0.9."""
    white = rng.standard_normal((count, size))
    noise = np.empty_like(white)
    noise[0] = white[0]
    for k in range(1, count):
        noise[k] = 0.9 * noise[k - 1] + np.sqrt(1 - 0.81) * white[k]
    return noise


def _std(fit: object) -> Array:
    information, whiteness = trajectory_information(fit, noise_known=True)  # type: ignore[arg-type]
    assert all(one.correlated for one in whiteness)
    point = fit.point  # type: ignore[attr-defined]
    return np.sqrt(np.diag(point.problem.parametrisation.physical_covariance(point.x, information.covariance)))


def test_errors_are_those_of_an_estimate_without_what_is_at_its_bound() -> None:
    """A nuisance parameter that cannot be negative and is zero: half of the estimates have it there."""
    random = np.random.default_rng(1)
    jacobian = random.standard_normal((40, 3))
    jacobian[:, 2] += jacobian[:, :2].sum(axis=1)
    others, normal = jacobian[:, :2], jacobian.T @ jacobian
    noise = random.standard_normal((4000, 40))
    at_bound = (noise @ np.linalg.pinv(jacobian).T)[:, 2] < 0
    assert at_bound.mean() == pytest.approx(0.5, abs=0.03)
    scatter = (noise[at_bound] @ np.linalg.pinv(others).T).std(axis=0)
    held, free = (Information(normal, normal, np.array([False, False, bound])).covariance for bound in (True, False))
    assert np.sqrt(np.diag(held)[:2]) == pytest.approx(scatter, rel=0.05)
    assert (np.sqrt(np.diag(free)[:2]) > 1.2 * scatter).all()
    assert held[2] == pytest.approx([0, 0, free[2, 2]])


def test_chi2_of_models_differs_by_as_much_more_as_the_noise_is_correlated() -> None:
    """What further parameters take off chi^2 of noise alone, on average, by drawing; of white noise it is one each."""
    random = np.random.default_rng(1)
    jacobian = np.cumsum(random.standard_normal((60, 3)), axis=0)
    normal, free = jacobian.T @ jacobian, np.zeros(3, dtype=bool)
    correlation = 0.9 ** np.abs(np.subtract.outer(np.arange(60), np.arange(60)))
    noise = random.standard_normal((4000, 60)) @ np.linalg.cholesky(correlation).T
    decreases = np.sum((noise @ np.linalg.qr(jacobian)[0]) ** 2, axis=1)
    inflation = Information(normal, jacobian.T @ correlation @ jacobian, free).inflation
    assert decreases.mean() == pytest.approx(3 * inflation, rel=0.05)
    assert inflation > 5
    assert Information(normal, normal, free).inflation == pytest.approx(1)
    units = np.diag([1e-8, 1.0, 1e6])  # in other units, and beside a coordinate that nothing responds to
    scaled = [np.pad(units @ each @ units, (0, 1)) for each in (normal, jacobian.T @ correlation @ jacobian)]
    assert Information(*scaled, np.zeros(4, dtype=bool)).inflation == pytest.approx(inflation)


def test_where_all_coordinates_are_at_bounds_each_has_an_error_of_its_own() -> None:
    normal = np.diag([4.0, 25.0])
    assert Information(normal, normal, np.ones(2, dtype=bool)).covariance == pytest.approx(np.linalg.inv(normal))


# On an executor


def test_an_executor_changes_nothing() -> None:
    point = truth_point("clamped", 2, "uniform")
    here, _ = _resampled(point, 4, "noise", None, 7)
    with ProcessPoolExecutor(2) as pool:
        there, _ = _resampled(point, 4, "noise", pool, 7)
    np.testing.assert_array_equal(here, there)
    assert not np.array_equal(here, _resampled(point, 4, "noise", None, 8)[0])


@pytest.mark.slow
def test_blocks_of_residuals_scatter_the_estimates_as_the_noise_does(two_seconds: Identification) -> None:
    fit = two_seconds
    calls: list[int] = []
    values, errors = vjm.bootstrap(fit, 12, seed=3, progress=lambda _, done, total: calls.append(total - done))
    std = np.median(errors, axis=0)  # of the noise alone: data of the fitted chain have no discretization error
    assert calls == list(range(11, -1, -1))
    scatter, truth = values.std(axis=0, ddof=1), np.array([estimate.value for estimate in fit.parameters])
    assert (scatter > 0.4 * std).all()
    assert (scatter < 2.0 * std).all()
    assert np.abs((values.mean(axis=0) - truth) / std).max() < 1.5


@pytest.mark.slow
def test_a_dask_cluster_is_an_executor_too() -> None:
    distributed = pytest.importorskip("dask.distributed")
    point = truth_point("clamped", 2, "uniform")
    cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None)
    with cluster, distributed.Client(cluster) as client:
        found, _ = _resampled(point, 4, "noise", client.get_executor(), 7)
    np.testing.assert_allclose(found, _resampled(point, 4, "noise", None, 7)[0], rtol=1e-12)


# Another model's data


@cache
def hub_fit(seed: int, folder: str) -> Identification:
    return identify(vjm.load_experiment(write_hub_experiment(Path(folder), seed)), baselines=seed == 1)


@pytest.fixture(scope="module")
def two_seconds(tmp_path_factory: pytest.TempPathFactory) -> Identification:
    """A fit of two seconds of the same rig, which takes a fifth of the time to fit again."""
    experiment = vjm.load_experiment(write_hub_experiment(tmp_path_factory.mktemp("two_seconds"), 1))
    short = tuple(first_seconds(each, 2.0) for each in experiment.recordings if each.role == "train")
    return identify(replace(experiment, recordings=short), virtual_joints=4, baselines=False)


@pytest.fixture(scope="module")
def hub(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Identification]:
    return lambda seed: hub_fit(
        seed, str(tmp_path_factory.getbasetemp() / f"hub{seed}" / _made(tmp_path_factory, seed))
    )


def _made(factory: pytest.TempPathFactory, seed: int) -> str:
    (factory.getbasetemp() / f"hub{seed}").mkdir(exist_ok=True)
    return "."


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_a_geometrically_exact_beam_is_followed_to_the_noise(hub: Callable[[int], Identification], seed: int) -> None:
    """Held out: a slew with corners, which bends the beam by more than a tenth of its length."""
    fit = hub(seed)
    assert fit.status == "converged"
    assert fit.parameters[0].value == pytest.approx(TRUTH.bending_stiffness, rel=1e-3)
    assert fit.model.chain.links[0].hub_inertia == pytest.approx(TRUTH.hub_inertia, rel=3e-3)
    assert fit.parameters[1].value == pytest.approx(TRUTH.kelvin_voigt_time, rel=0.01)
    for one in fit.recordings:
        assert one.simulated is not None
        assert one.simulated.marker_rms < 1.03 * NOISE
        assert one.simulated.theta_rms is not None
        assert one.simulated.theta_rms < 1.3 * ENCODER_NOISE
    assert fit.recordings[-1].recording.file == SLEW
    assert fit.warnings == ()


@pytest.mark.slow
def test_the_number_of_joints_does_not_depend_on_the_noise_s_seed(hub: Callable[[int], Identification]) -> None:
    assert {hub(seed).model.chain.links[0].virtual_joints for seed in (1, 2, 3)} == {4}
    assert any("one more virtual joint" in note for note in hub(1).notes)


def test_the_torque_method_s_model_is_simulated_to_compare_with(hub: Callable[[int], Identification]) -> None:
    for one in hub(1).recordings[:2]:
        assert one.alternative is not None
        assert one.simulated is not None
        chi2, by_torques = (
            np.nansum((each.marker_residual / each.noise[0]) ** 2)
            + np.nansum((each.theta_residual / each.noise[1]) ** 2)
            for each in (one.simulated, one.alternative)
        )
        assert chi2 < by_torques


@pytest.mark.slow
def test_demo_comes_out_as_it_was_put_in() -> None:
    fit = identify(demo(), baselines=False)
    stiffness, time = fit.parameters
    assert stiffness.value == pytest.approx(1.973629, rel=5e-4)
    assert time.value == pytest.approx(3.07e-4, rel=0.02)
    assert fit.trajectory is not None
    assert fit.trajectory.misfit**2 == pytest.approx(1.0, abs=0.05)
    held_out = next(one for one in fit.recordings if one.recording.role == "holdout")
    assert held_out.simulated is not None
    assert held_out.simulated.marker_rms < 1.04 * NOISE
    for mode, frequency in zip(fit.modes, (1.18516, 7.42727), strict=False):
        assert mode.frequency_model == pytest.approx(frequency, rel=5e-4)
        assert mode.mac is not None
        assert mode.mac > 0.999


@cache
def torque_fit() -> Identification:
    return identify(demo(), "torque", baselines=False)


def test_measured_shapes_tell_modes_apart() -> None:
    """MAC of the first mode with the second's shape is small."""
    model = torque_fit().model
    first, second = _marker_deflections(model.chain, model.rig, modes(model.chain).shapes)[:2]
    assert _modal_assurance(first, second.astype(complex)) < 0.3
    assert _modal_assurance(first, (2 - 1j) * first) == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.skipif(not (SHARED / "hub_rig").exists(), reason="the shared recordings are absent")
def test_hub_rig_of_another_simulator() -> None:
    fit = identify(vjm.load_experiment(SHARED / "hub_rig" / "experiment.toml"), baselines=False)
    for one in fit.recordings:
        assert one.simulated is not None
        assert one.simulated.marker_rms < 1.02 * NOISE
    assert all(estimate.identifiable for estimate in fit.parameters)


@pytest.mark.skipif(not (SHARED / "silicone_beam").exists(), reason="the shared recordings are absent")
def test_silicone_beam_fitted_on_one_recording_follows_the_other() -> None:
    experiment = vjm.load_experiment(SHARED / "silicone_beam" / "experiment.toml")
    unloaded = tuple(r for r in experiment.recordings if r.condition == "reference")
    fit = identify(replace(experiment, recordings=unloaded), baselines=False)
    held_out = next(one for one in fit.recordings if one.recording.role == "holdout")
    assert held_out.simulated is not None
    peak = float(np.nanmax(np.abs(held_out.recording.markers[:, -1, 1])))
    assert held_out.simulated.marker_rms < 0.03 * peak
    assert fit.modes[0].frequency_model == pytest.approx(7.745, rel=5e-3)
    assert any("unmodelled dynamics" in text for text in fit.warnings)


# Two flexible links


def test_two_flexible_links(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    from tests.mujoco_arm.two_links import TRUE_ARM, write_two_link_experiment

    write_two_link_experiment(tmp_path, seed=1)
    fit = identify(vjm.load_experiment(tmp_path / "experiment.toml"), virtual_joints=3, baselines=False)
    values = {estimate.name: estimate for estimate in fit.parameters}
    for link in TRUE_ARM.links:
        assert values[f"{link.name}.bending_stiffness"].value == pytest.approx(link.bending_stiffness, rel=5e-3)
        assert values[f"{link.name}.hub_inertia"].value == pytest.approx(link.hub_inertia, rel=5e-3)
    for one in fit.recordings:
        assert one.simulated is not None
        assert one.simulated.marker_rms < 1.1 * NOISE


# On request


def test_profile_interval_agrees_with_the_standard_error_where_the_likelihood_is_a_parabola(
    two_seconds: Identification,
) -> None:
    fit = two_seconds
    low, high = vjm.profile_interval(fit, "beam.bending_stiffness")
    estimate = fit.parameters[0]
    assert estimate.std is not None
    assert low == pytest.approx(estimate.value - 1.96 * estimate.std, abs=0.1 * estimate.std)
    assert high == pytest.approx(estimate.value + 1.96 * estimate.std, abs=0.1 * estimate.std)
    lowest, highest = vjm.profile_interval(fit, "beam.bending_stiffness", 0.99)
    assert lowest < low < high < highest


def test_what_cannot_be_resampled_or_profiled_is_said() -> None:
    fit = torque_fit()
    with pytest.raises(vjm.InputError, match="trajectory"):
        vjm.bootstrap(fit)
    with pytest.raises(vjm.InputError, match="trajectory"):
        vjm.profile_interval(fit, "beam.bending_stiffness")
    with pytest.raises(vjm.InputError, match=r"kelvin_voigt_time"):
        vjm.profile_interval(fit, "beam.mass")
    with pytest.raises(vjm.InputError, match="blocks"):
        vjm.bootstrap(fit, kind="pairs")
    with pytest.raises(vjm.InputError, match="two or more"):
        vjm.bootstrap(fit, 1)


def test_an_outlier_that_a_link_allows_is_found_by_its_residual() -> None:
    experiment = demo()
    changed: list[Recording] = []
    for recording in experiment.recordings:
        markers = recording.markers.copy()
        if recording.file == "first_mode.csv":
            markers[100, 2, 1] += 0.006
        changed.append(replace(recording, markers=markers))
    fit = identify(Experiment(experiment.rig, tuple(changed)), virtual_joints=4, baselines=False)
    assert fit.parameters[0].value == pytest.approx(1.973629, rel=5e-4)
    (text,) = (each for each in fit.warnings if "left out" in each)
    assert "first_mode.csv" in text
    assert "1 marker coordinate " in text


def with_short_sightings() -> Experiment:
    """The demo's, where early on every fourth sighting is a fifth short."""
    experiment = demo()
    rng = np.random.default_rng(4)
    spoilt = []
    for recording in experiment.recordings:
        early = recording.time < recording.time.mean()
        wrong = (rng.random(recording.markers.shape[:2]) < 0.25) & early[:, None]
        markers = recording.markers.copy()
        markers[..., 1] *= np.where(wrong, 0.8, 1.0)
        spoilt.append(replace(recording, markers=markers))
    return Experiment(replace(experiment.rig, marker_noise=NOISE), tuple(spoilt))


@pytest.mark.parametrize(
    "loss", ["huber", *(pytest.param(each, marks=pytest.mark.slow) for each in ("soft_l1", "cauchy"))]
)
def test_robust_losses_shrug_off_what_a_square_does_not(loss: LossName) -> None:
    """Too many sightings are wrong to be cut out, and the decay seems slower."""
    plain, robust = (
        identify(with_short_sightings(), loss=each, virtual_joints=4, baselines=False) for each in ("linear", loss)
    )
    error = abs(plain.parameters[1].value - 3.07e-4)
    assert error > 0.1 * 3.07e-4
    assert abs(robust.parameters[1].value - 3.07e-4) < 0.2 * error
    assert robust.parameters[0].value == pytest.approx(1.973629, rel=5e-4)


def test_without_torque_gravity_or_payload_the_mass_is_taken_on_trust(hub: Callable[[int], Identification]) -> None:
    assert any("stiffness to mass" in note for note in torque_fit().notes)
    assert not any("stiffness to mass" in note for note in hub(1).notes)
    loaded = tuple(replace(recording, payload=0.05) for recording in demo().recordings)
    fit = identify(replace(demo(), recordings=loaded), "torque", baselines=False)
    assert not any("stiffness to mass" in note for note in fit.notes)


@pytest.mark.parametrize("noise", [3e-4, 1e-6])
def test_searches_take_steps_as_long_as_the_noise_allows(noise: float) -> None:
    """What shorter steps change is a small part of the noise."""
    point = truth_point("revolute", 3, "uniform")
    states = [run.state for run in point.runs]
    observed = tuple(replace(run.observed, noise=(noise, noise)) for run in point.runs)
    problem = replace(point.problem, observed=observed)
    multiple = search_step_multiple(problem.point(point.x, states), 1.0)
    exact, found = (replace(problem, step_multiple=c).point(point.x, states) for c in (0.25, multiple))
    pairs = zip(exact.runs, found.runs, strict=True)
    error = sum(float(np.sum((one.residual - two.residual) ** 2)) for one, two in pairs)
    assert (multiple > 1.0) == (noise > 1e-5)
    assert multiple == 1.0 or error < 0.04**2 * point.count


@pytest.mark.parametrize("noise", [3e-4, 1e-6])
def test_steps_are_as_long_as_no_estimate_minds(noise: float) -> None:
    """What longer steps change is less than a tenth of a standard deviation, whatever is estimated."""
    point = truth_point("revolute", 3, "uniform")
    states = [run.state for run in point.runs]
    observed = [replace(run.observed, noise=(noise, noise)) for run in point.runs]
    step_multiple = _largest_step_multiple([run.arm for run in point.runs], observed, states, 1.0)
    starts = [run.prior for run in point.runs]
    exact, found = (
        simulate_runs([Arm(point.chain)] * len(observed), observed, starts, states, c) for c in (0.25, step_multiple)
    )
    error = sum(float(np.sum((a.residual - b.residual) ** 2)) for a, b in zip(exact, found, strict=True))
    assert (step_multiple > 1.0) == (noise > 1e-5)
    assert step_multiple == 1.0 or error < 0.02


def test_steps_so_long_that_the_simulation_diverges_are_not_taken() -> None:
    rig = vjm.Rig("spun", [vjm.Link("beam", "clamped", 1.0, 0.4, 2.0, (0.25, 0.5, 0.75, 1.0))])
    model = vjm.Model.nominal(rig, 4, 2e-3)
    at_rest = model.simulate(torque=np.zeros((21, 0)), duration=2.0)
    recording = Recording(at_rest.time, at_rest.markers, at_rest.theta, kind="decay")
    observed = [Observations.of(rig, recording, (NOISE, ENCODER_NOISE))]
    states = [np.r_[np.zeros(4), 90.0, -90.0, 90.0, -90.0]]
    simulate_runs([model.arm], observed, None, states, 1.0)
    with pytest.raises(SimulationDivergedError):
        simulate_runs([model.arm], observed, None, states, 2.0)
    assert _largest_step_multiple([model.arm], observed, states, 1.0) == 1.0
