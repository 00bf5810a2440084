"""Fits of models with effects."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.diagnosis.rigs import chain_of, point_of, recorded
from vjm.diagnosis.refit import Explanation, refit
from vjm.effects import ViscoelasticCreep
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.simulate.arm import Arm


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("time_constant", [0.02, 1.0])
def test_a_time_constant_does_not_run_away(seed: int, time_constant: float) -> None:
    truth = ViscoelasticCreep(link=0, ratio=0.04, time_constant=0.12)
    recordings = recorded(Arm.of(chain_of(), (truth,)), seed, duration=4.0)
    start = Explanation(TrajectoryFit(point_of(chain_of(), (), recordings), False, 0))
    near, far = (refit(start, [each]) for each in (truth, replace(truth, time_constant=time_constant)))
    assert near is not None
    assert far is not None
    assert near.point.misfit == pytest.approx(1.0, abs=0.03)
    assert far.chi2 == pytest.approx(near.chi2, abs=0.5)
