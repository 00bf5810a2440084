"""The score screen, against whole simulations: directions, sizes, and statistics under noise alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from tests.diagnosis.rigs import RIG, chain_of, point_of, recorded
from vjm.diagnosis.candidates import Family
from vjm.diagnosis.screen import screen
from vjm.effects import (
    CameraRotation,
    CameraScale,
    ClampCompliance,
    CubicStiffness,
    Effect,
    EncoderOffset,
    InPlaneGravity,
    JointSpring,
    LinearDrag,
    MarkerOffset,
    RollingShutter,
    StiffnessDrift,
    TimeOffset,
    TipPayload,
    TorqueGain,
    ViscoelasticCreep,
    ViscousFriction,
)
from vjm.simulate.arm import Arm
from vjm.simulate.run import Start, run_all, transferred

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
    ViscoelasticCreep(),
    TimeOffset(),
    CameraScale(),
    CameraRotation(),
    EncoderOffset(),
    RollingShutter(),
    MarkerOffset(),
)


def bound(effect: Effect) -> Effect:
    return effect.variants(RIG, [])[0]


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
def test_a_direction_is_what_a_little_of_the_effect_does(effect: Effect) -> None:
    """Against the difference of two whole simulations, from the same initial states."""
    chain, variant = chain_of(), bound(effect)
    point = point_of(chain, (), recorded(Arm(chain), 1))
    seen = screen(point, (), [variant])
    coordinates = np.zeros(variant.coordinates.size)
    coordinates[variant.sizes :] = variant.coordinates[variant.sizes :]
    coordinates[0] = 0.02
    arm = Arm.of(chain, (variant.at(coordinates),))
    observed = [run.observed for run in point.runs]
    starts = [Start.of(arm, each.recording) for each in observed]
    states = [transferred(chain, arm.chain, run.state) for run in point.runs]
    runs = run_all([arm] * len(states), observed, starts, states, 1.0)
    change = np.concatenate([one.residual - two.residual for one, two in zip(point.runs, runs, strict=True)]) / 0.02
    assert np.sqrt(seen.whole[0]) == pytest.approx(np.linalg.norm(change), rel=0.03)
    residual = np.concatenate([run.residual for run in point.runs])
    assert abs(change @ residual) < 5 * np.linalg.norm(change)  # so that the next line tests something


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
def test_the_size_of_what_is_there_is_guessed(effect: Effect) -> None:
    chain, variant = chain_of(), bound(effect)
    size = 0.1
    coordinates = np.zeros(variant.coordinates.size)
    coordinates[variant.sizes :] = variant.coordinates[variant.sizes :]
    coordinates[: variant.sizes] = size
    point = point_of(chain, (), recorded(Arm.of(chain, (variant.at(coordinates),)), 2))
    seen = screen(point, (), [variant])
    # Slopes are taken at rest's side of a large step, and the chain's own parameters shift with the effect.
    tolerance = 5 * seen.std(0) + 0.15 * size
    assert (np.abs(seen.guess([0]) - size) < tolerance).all()


def test_statistics_of_noise_alone_are_chi_square() -> None:
    chain = chain_of()
    variants = [bound(each) for each in (TorqueGain(), CubicStiffness(), TimeOffset(), MarkerOffset())]
    found = np.array(
        [screen(point_of(chain, (), recorded(Arm(chain), s, duration=1.0)), (), variants).statistics for s in range(30)]
    )
    for column, freedom in zip(found.T, (1, 1, 1, 2), strict=True):
        assert stats.kstest(column, stats.chi2(freedom).cdf).pvalue > 1e-3


def test_the_family_is_as_large_as_its_candidates_differ() -> None:
    chain = chain_of()
    point = point_of(chain, (), recorded(Arm(chain), 3))
    one = screen(point, (), [bound(TimeOffset())])
    twins = screen(point, (), [bound(CameraRotation()), bound(EncoderOffset())])
    several = screen(point, (), [bound(each) for each in EFFECTS])
    looks = [Family.of(seen, np.ones(len(seen.effects)), 0.01, 0).looks for seen in (one, twins, several)]
    assert looks[0] == pytest.approx(1.0, abs=0.5)
    assert looks[1] < 1.8
    assert 6 < looks[2] < len(EFFECTS)


def test_what_other_parameters_do_as_well_is_absorbed() -> None:
    """With the hub locked in one pose, and no encoder to say so, an encoder's offset is nothing."""
    chain = chain_of()
    blind = [replace(each, theta=np.full_like(each.theta, np.nan)) for each in recorded(Arm(chain), 4)]
    seen = screen(point_of(chain, (), blind), (), [bound(EncoderOffset()), bound(TimeOffset())])
    assert seen.absorbed.tolist() == [True, False]
    assert seen.statistics[0] == 0


def test_reference_recordings_say_nothing_of_an_effect() -> None:
    chain = chain_of()
    point = point_of(chain, (), recorded(Arm(chain), 5, condition="reference"))
    assert screen(point, (), [bound(TipPayload())]).whole[0] == 0
