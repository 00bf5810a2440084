"""The score screen, against whole simulations: directions, sizes, and statistics under noise alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from scipy import stats

from tests.diagnosis.rigs import RIG, chain_of, in_segments, point_of, recorded
from vjm.chain.curve import transfer_state
from vjm.chain.virtual_links import Chain
from vjm.diagnosis.alternatives import _substitute_sizes
from vjm.diagnosis.screen import CandidateSet, Directions, FamilyTest, Screen
from vjm.diagnosis.search_starts import _explained, _fourier_transform, temporal_peaks
from vjm.effects import (
    BaseCompliance,
    CameraRotation,
    CameraScale,
    ClampCompliance,
    Cogging,
    CoulombFriction,
    CubicStiffness,
    Effect,
    EncoderOffset,
    ExternalTone,
    GearElasticity,
    InPlaneGravity,
    JointSpring,
    LinearDrag,
    MarkerOffset,
    RollingShutter,
    StateFunction,
    StiffnessAsymmetry,
    StiffnessDrift,
    Taper,
    TimeOffset,
    TipPayload,
    TorqueGain,
    TorqueOffset,
    ViscoelasticCreep,
    ViscousFriction,
)
from vjm.identification.trajectory_fit import Point
from vjm.simulation.arm import Arm
from vjm.simulation.run import InitialStatePrior, by_recording, linearize, simulate_runs

EFFECTS: tuple[Effect, ...] = (
    TipPayload(),
    InPlaneGravity(),
    ViscousFriction(),
    JointSpring(),
    TorqueGain(),
    ClampCompliance(),
    LinearDrag(),
    CubicStiffness(),
    StiffnessDrift(),
    Taper(),
    StiffnessAsymmetry(),
    ViscoelasticCreep(),
    TimeOffset(),
    CameraScale(),
    CameraRotation(),
    EncoderOffset(),
    RollingShutter(),
    MarkerOffset(),
)


# Noise so small that every effect stands out of it.
FINE = (3e-6, 1e-6)


def bound(effect: Effect) -> Effect:
    return effect.variants(RIG, [])[0]


def sized(variant: Effect, size: float) -> Effect:
    coordinates = variant.coordinates.copy()
    coordinates[: variant.magnitude_count] = size
    return variant.at(coordinates)


def residuals(arm: Arm, point: Point, changes: Sequence[np.ndarray]) -> np.ndarray:
    """Of all recordings, simulated from their initial states and changes of these."""
    observed = [run.observed for run in point.runs]
    starts = [InitialStatePrior.of(arm, each.recording) for each in observed]
    states = [
        transfer_state(point.chain, arm.chain, run.state + change)
        for run, change in zip(point.runs, changes, strict=True)
    ]
    runs = simulate_runs([arm] * len(states), observed, starts, states, 1.0)
    return np.concatenate([run.residual for run in runs])


def nuisances(point: Point) -> np.ndarray:
    """What the chain's parameters and the initial states do, by whole simulations."""
    parametrisation, count = point.problem.parametrisation, 2 * point.chain.size
    still = [np.zeros(count)] * len(point.runs)
    typical_magnitude = residuals(Arm(point.chain), point, still)
    columns = []
    for k, value in enumerate(point.x):
        by = 1e-4 * max(abs(value), 1e-2)
        moved = np.where(np.arange(point.x.size) == k, value + by, point.x)
        columns.append((residuals(Arm(parametrisation.chain(moved)), point, still) - typical_magnitude) / by)
    for k in range(len(point.runs)):
        for state in range(count):
            changes = [1e-5 * (np.arange(count) == state) * (k == run) for run in range(len(point.runs))]
            columns.append((residuals(Arm(point.chain), point, changes) - typical_magnitude) / 1e-5)
    return np.column_stack(columns)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
def test_what_an_effect_explains_is_what_whole_simulations_say(effect: Effect) -> None:
    """Its direction, and what of it and of the residuals is left beside parameters and initial states."""
    chain, variant = chain_of(2), bound(effect)
    planted = Arm.of(chain, (sized(variant, 1.0),))
    point = point_of(chain, (), recorded(planted, 1, duration=1.0, noise=FINE), FINE)
    seen = Screen.of(point, (), [variant])
    still = [np.zeros(2 * chain.size)] * len(point.runs)
    residual = residuals(Arm(chain), point, still)
    only_first = sized(variant, 0.0).coordinates
    only_first[0] = 0.02
    change = (residual - residuals(Arm.of(chain, (variant.at(only_first),)), point, still)) / 0.02
    if not variant.adds_joint(chain):  # a joint starts where the motion holds it, here about there
        assert np.sqrt(seen.unprojected[0]) == pytest.approx(np.linalg.norm(change), rel=0.03)
    basis = np.linalg.qr(nuisances(point))[0]
    left, rest = (each - basis @ (basis.T @ each) for each in (change, residual))
    assert abs(left @ rest) > 0.3 * np.linalg.norm(left) * np.linalg.norm(rest)  # there is something to explain
    # What differs in the third digit before may differ in the second of the little that is left.
    near = 0.05 * np.linalg.norm(left) + 0.003 * np.linalg.norm(change)
    assert np.sqrt(seen.products[0, 0]) == pytest.approx(np.linalg.norm(left), abs=near)
    assert seen.products[0, -1] == pytest.approx(left @ rest, rel=0.1)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
def test_the_size_of_what_is_there_is_guessed(effect: Effect) -> None:
    chain, variant = chain_of(), bound(effect)
    size = 0.1
    point = point_of(chain, (), recorded(Arm.of(chain, (sized(variant, size),)), 2, noise=FINE), FINE)
    seen = Screen.of(point, (), [variant])
    assert (np.abs(seen.best_sizes([0]) - size) < 4 * seen.std(0) + 0.15 * size).all()


def test_the_size_of_dry_friction_is_guessed() -> None:
    """Though at its null, where it has no direction, and in what sticks."""
    chain, variants = chain_of(), [bound(each) for each in (CoulombFriction(), ViscousFriction(), JointSpring())]
    for seed, size in ((4, 0.1), (5, 0.5)):
        point = point_of(chain, (), recorded(Arm.of(chain, (sized(variants[0], size),)), seed, noise=FINE), FINE)
        seen = Screen.of(point, (), variants)
        assert np.argmax(seen.statistics) == 0
        assert seen.best_sizes([0]) == pytest.approx(size, rel=0.3)


def noise_alone(correlation: float, assumed: float) -> list[float]:
    """For each of four effects, how likely statistics of noise alone are, if they are chi-square."""
    chain = chain_of(2)
    variants = [bound(each) for each in (TorqueGain(), CubicStiffness(), TimeOffset(), MarkerOffset())]
    found = []
    for seed in range(30):
        recordings = recorded(Arm(chain), seed, duration=1.0, correlation=correlation)
        found.append(Screen.of(point_of(chain, (), recordings, correlation=assumed), (), variants).statistics)
    columns = zip(np.array(found).T, (1, 1, 1, 2), strict=True)
    return [float(stats.kstest(column, stats.chi2(freedom).cdf).pvalue) for column, freedom in columns]


@pytest.mark.parametrize("correlation", [pytest.param(0.0, marks=pytest.mark.slow), 0.8])
def test_statistics_of_noise_alone_are_chi_square(correlation: float) -> None:
    assert min(noise_alone(correlation, correlation)) > 1e-3


def test_statistics_of_coloured_noise_taken_as_white_are_not() -> None:
    assert min(noise_alone(0.8, 0.0)) < 1e-6


class Wild(CubicStiffness):
    """A spring that explodes."""

    id = "wild"

    def force(self, chain: Chain, payload: float) -> StateFunction | None:
        typical_magnitude = super().force(chain, payload)
        if typical_magnitude is None:
            return None
        return lambda time, q, v, z: typical_magnitude(time, q, v, z) * np.exp(400 * time)[:, None]


def test_an_effect_whose_slope_has_no_end_says_nothing() -> None:
    chain = chain_of()
    spring, wild = bound(JointSpring()), bound(Wild())
    point = point_of(chain, (), recorded(Arm.of(chain, (sized(spring, 0.1),)), 6))
    with np.errstate(all="ignore"):
        seen = Screen.of(point, (), [wild, spring])
    assert seen.absorbed.tolist() == [True, False]
    assert seen.statistics[0] == 0
    alone = Screen.of(point, (), [spring])
    assert seen.statistics[1] == pytest.approx(alone.statistics[0], rel=1e-6)


def test_the_family_is_as_large_as_its_candidates_differ() -> None:
    chain = chain_of()
    point = point_of(chain, (), recorded(Arm(chain), 3))
    one = Screen.of(point, (), [bound(TimeOffset())])
    twins = Screen.of(point, (), [bound(CameraRotation()), bound(EncoderOffset())])
    several = Screen.of(point, (), [bound(each) for each in EFFECTS])
    looks = [FamilyTest.of(seen, np.ones(len(seen.effects)), 0.01, 0).tests for seen in (one, twins, several)]
    assert looks[0] == pytest.approx(1.0, abs=0.5)
    assert looks[1] < 1.8
    assert 6 < looks[2] < len(EFFECTS)


def test_what_other_parameters_do_as_well_is_absorbed() -> None:
    """With the hub locked in one pose, and no encoder to say so, an encoder's offset is nothing."""
    chain = chain_of()
    blind = [replace(each, theta=np.full_like(each.theta, np.nan)) for each in recorded(Arm(chain), 4)]
    seen = Screen.of(point_of(chain, (), blind), (), [bound(EncoderOffset()), bound(TimeOffset())])
    assert seen.absorbed.tolist() == [True, False]
    assert seen.statistics[0] == 0


def test_coordinates_at_a_bound_explain_nothing() -> None:
    rows = np.random.default_rng(1).standard_normal((30, 5))
    effect, parts, unprojected = (JointSpring(),), (slice(0, 1),), np.ones(1)
    held = Directions(effect, parts, rows, np.array([False, True, False]), unprojected).screen()
    without = Directions(effect, parts, np.delete(rows, 1, axis=1), np.zeros(2, dtype=bool), unprojected).screen()
    free = Directions(effect, parts, rows, np.zeros(3, dtype=bool), unprojected).screen()
    assert held.products == pytest.approx(without.products)
    assert (np.diag(held.products) > np.diag(free.products)).all()


def test_a_table_has_two_sizes_along_and_across_its_start() -> None:
    """A candidate whose direction is that of both sizes together replaces it."""
    table = BaseCompliance(stiffness=500.0, mass=1.0, direction=0.7, start=0.2).placed(RIG, None)
    sizes = table.coordinates[[0, 3]]
    assert (np.abs(sizes) > 0.01).all()
    rows = np.random.default_rng(1).standard_normal((30, 6))
    rows[:, 4] = rows[:, [0, 3]] @ sizes
    directions = Directions((JointSpring(),), (slice(0, 1),), rows, np.zeros(4, dtype=bool), np.ones(1))
    seen = directions.screen(present=(table, slice(0, 4)))
    assert seen.parts == (slice(0, 2), slice(2, 3))
    assert _substitute_sizes(seen, table, 0.0)[1] == pytest.approx(1.0)


def test_reference_recordings_say_nothing_of_an_effect() -> None:
    chain = chain_of()
    point = point_of(chain, (), recorded(Arm(chain), 5, condition="reference"))
    assert Screen.of(point, (), [bound(TipPayload())]).unprojected[0] == 0


@pytest.mark.parametrize("noise", [(3e-6, 1e-2), (1e-1, 1e-6)], ids=["markers", "encoder"])
def test_a_tone_is_looked_for_where_either_sensor_shows_one(noise: tuple[float, float]) -> None:
    chain = chain_of()
    tone = replace(sized(bound(ExternalTone()), 1.0), frequency=9.3)
    point = point_of(chain, (), recorded(Arm.of(chain, (tone,)), 7, noise=noise), noise)
    candidate_set = CandidateSet.of([ExternalTone()], RIG, [run.observed.recording for run in point.runs], point.runs)
    frequencies = [effect.values["frequency"] for effect in candidate_set.variants]
    assert min(abs(frequency - 9.3) for frequency in frequencies) < 0.25
    # A force that takes longer than the recordings is another cause, and no search may end there.
    for effect in candidate_set.variants:
        typical = effect.parameters[1].typical_magnitude
        assert effect.bounds[0][2] == pytest.approx(np.log(0.5 / typical), rel=1e-3)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("frequency", [1.7, *(pytest.param(each, marks=pytest.mark.slow) for each in (2.6, 3.4)), 7.7])
def test_a_tone_explains_more_than_its_images_by_the_initial_states_of_segments(frequency: float, seed: int) -> None:
    """In segments of half a second the residuals of all but the first have a higher peak 2 or 4 Hz away."""
    tone = replace(sized(bound(ExternalTone()), 1.0), frequency=frequency)
    recordings = recorded(Arm.of(chain_of(), (tone,)), seed, duration=4.0)
    runs = in_segments(recordings).point.runs
    assert len(runs) == 16
    peaks, _ = temporal_peaks(recordings, runs)
    assert abs(peaks[0] - frequency) <= 1 / 16  # a quarter of the resolution of four seconds
    assert all(abs(peak - other) > 0.5 for k, peak in enumerate(peaks) for other in peaks[:k])


def test_what_sines_explain_is_what_least_squares_say_of_them() -> None:
    """With each segment's initial state free, and Hann's window over the recording; some markers are hidden."""
    tone = replace(sized(bound(ExternalTone()), 1.0), frequency=3.4)
    recordings = recorded(Arm.of(chain_of(), (tone,)), 3)
    hidden = np.random.default_rng(1).random((recordings[0].time.size, 5, 1)) < 0.2
    recordings = [replace(each, markers=np.where(hidden, np.nan, each.markers)) for each in recordings]
    (parts, *_) = by_recording(in_segments(recordings).point.runs).values()
    frequencies = np.array([0.7, 3.4, 11.0])
    end = max(run.observed.recording.time[-1] for run in parts)
    total = sum(run.residual.size for run in parts)
    channels = parts[0].observed.channel_count
    for found, frequency in zip(_explained(parts, frequencies), frequencies, strict=True):
        columns, residuals, first = np.zeros((total, 2 * channels)), np.zeros(total), 0
        for run, linearization in zip(parts, linearize(parts, [()] * len(parts)), strict=True):
            observed = run.observed
            time = observed.recording.time[observed.instants]
            phase, window = 2 * np.pi * frequency * time, np.sin(np.pi * time / end)
            slopes = np.zeros((time.size, 2 * run.basis.slow_count))
            for measured, chunk in run.jacobian(linearization):
                slopes[measured] = chunk
            waves = np.zeros((time.size, 2 * channels))
            waves[np.arange(time.size), observed.channels] = np.cos(phase)
            waves[np.arange(time.size), channels + observed.channels] = np.sin(phase)
            moved = waves - slopes @ np.linalg.lstsq(slopes, waves, rcond=None)[0]
            left = run.residual - slopes @ np.linalg.lstsq(slopes, run.residual, rcond=None)[0]
            rows = slice(first, first + time.size)
            columns[rows], residuals[rows], first = window[:, None] * moved, window * left, rows.stop
        fitted = columns @ np.linalg.lstsq(columns, residuals, rcond=None)[0]
        assert found == pytest.approx(fitted @ fitted, rel=1e-6)


@pytest.mark.parametrize("noise", [(3e-6, 1e-2), (1e-1, 1e-6)], ids=["markers", "encoder"])
@pytest.mark.parametrize("count", [23.0, 41.0])
def test_cogging_is_looked_for_at_the_count_that_either_sensor_shows(noise: tuple[float, float], count: float) -> None:
    chain = chain_of()
    wave = replace(sized(bound(Cogging()), 0.3), count=count)
    point = point_of(chain, (), recorded(Arm.of(chain, (wave,)), 7, noise=noise, factor=3.0), noise)
    candidate_set = CandidateSet.of([Cogging()], RIG, [run.observed.recording for run in point.runs], point.runs)
    counts = [effect.values["count"] for effect in candidate_set.variants]
    turn = max(float(np.ptp(run.trajectory.q[:, 0])) for run in point.runs)
    resolution = 2 * np.pi / turn
    assert min(abs(each - count) for each in counts) < 0.3 * resolution < 0.15 * count
    seen = Screen.of(point, (), candidate_set.variants)
    assert abs(counts[int(np.argmax(seen.statistics))] - count) < 0.3 * resolution
    assert (candidate_set.multiplicity >= 1).all()


def test_a_joint_that_hardly_turns_shows_no_cogging() -> None:
    chain = chain_of()
    point = point_of(chain, (), recorded(Arm(chain), 7, factor=1e-3))
    candidate_set = CandidateSet.of([Cogging()], RIG, [run.observed.recording for run in point.runs], point.runs)
    assert candidate_set.variants == ()
    assert "turn too little" in candidate_set.untestable[0].reason


def test_beside_a_fit_without_a_hub_a_gear_is_no_candidate() -> None:
    """A wrong model's hub may shrink to nothing; a joint before it moves nothing then, and no search may end there."""
    chain = chain_of()
    light = replace(chain, links=(replace(chain.links[0], hub_inertia=0.0),))
    seen = Screen.of(point_of(light, (), recorded(Arm(chain), 3)), (), [bound(GearElasticity()), bound(JointSpring())])
    assert seen.absorbed.tolist() == [True, False]
    assert seen.statistics[0] == 0.0


@pytest.mark.parametrize("seed", [1, 2])
def test_a_fit_is_judged_as_a_screen_is(seed: int) -> None:
    """By the fall of chi^2, whose limit the score statistic is; more freedom and more looks make it less certain."""
    chain, variants = chain_of(), [bound(TorqueGain()), bound(JointSpring())]
    seen = Screen.of(point_of(chain, (), recorded(Arm(chain), seed)), (), variants)
    family = FamilyTest.of(seen, np.ones(2), 0.01, 0)
    gain = variants[0]
    assert family.p_of_fit(gain, float(seen.statistics[0])) == pytest.approx(family.p_values[0])
    assert family.p_of_fit(gain, 30.0) < family.p_of_fit(gain, 20.0) < 0.01
    often = replace(family, multiplicity=np.array([50.0, 1.0]))
    assert often.p_of_fit(gain, 20.0) == pytest.approx(50 * family.p_of_fit(gain, 20.0), rel=0.01)
    freer = FamilyTest.of(
        Screen.of(point_of(chain, (), recorded(Arm(chain), seed)), (), [bound(InPlaneGravity())]), np.ones(1), 0.01, 0
    )
    assert freer.p_of_fit(bound(InPlaneGravity()), 20.0) > stats.chi2.sf(20.0, 1) * freer.tests


@pytest.mark.parametrize("count", [1, 2, 3, 16, 101])
def test_fourier_sums_of_coarse_and_fine_frequencies_are_the_direct_ones(count: int) -> None:
    """At uneven instants, as those of a camera that loses frames."""
    random = np.random.default_rng(count)
    time, values = np.sort(random.uniform(0.0, 5.0, 200)), random.standard_normal((200, 3))
    frequencies = 0.2 + 0.05 * np.arange(count)
    direct = np.exp(-2j * np.pi * np.outer(frequencies, time)) @ values
    np.testing.assert_allclose(_fourier_transform(time, values, frequencies), direct, rtol=0, atol=1e-10)


def test_of_three_effects_those_with_feasible_signs_count_together() -> None:
    effects = (ViscousFriction(link=0), TorqueOffset(link=0), TorqueGain(link=0))
    R = np.eye(4)
    R[:, -1] = [-1.0, 2.0, 3.0, 0.5]  # friction would have to be negative
    screen = Screen(effects, (slice(0, 1), slice(1, 2), slice(2, 3)), R, np.ones(3), cast(Any, None))
    assert screen.one_sided.tolist() == [True, False, False]
    assert screen.decrease([0, 1, 2]) == pytest.approx(13.0)
    assert screen.decrease([0]) == 0.0
