"""What a model says of its arm beside simulations: modes, a Pinocchio model, and a flexible one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.simulation.setups import arm_of, rig_of, steel_link, two_link_arm
from vjm.chain.virtual_links import Chain
from vjm.effects import ActuatorLag, InPlaneGravity, TorqueGain
from vjm.simulation.model import Model

BESIDE = (TorqueGain(gain=0.9, link=0), ActuatorLag(time_constant=0.01, link=0))


@pytest.mark.parametrize("chain", [arm_of(steel_link(3)), two_link_arm()], ids=["clamped", "two links"])
def test_gravity_that_was_found_acts_wherever_known_gravity_does(chain: Chain) -> None:
    """A base found to be tilted is one that was known to be."""
    beside = BESIDE if chain.active.size else ()
    known = replace(chain, gravity=(0.5, -0.1))
    tilted = replace(chain, gravity=(3.0, -0.4))
    found = Model(known, rig_of(chain), 1e-4, 1e-4, effects=(*beside, InPlaneGravity(gx=2.5, gy=-0.3)))
    same = Model(tilted, rig_of(chain), 1e-4, 1e-4, effects=beside)
    unknown = replace(found, effects=beside)
    for payload in (0.0, 0.2):
        frequencies = found.modes(payload).frequencies
        assert frequencies == pytest.approx(same.modes(payload).frequencies)
        assert np.abs(frequencies[0] / unknown.modes(payload).frequencies[0] - 1) > 0.01
    assert found.pinocchio().model.gravity.linear == pytest.approx([3.0, -0.4, 0.0])
    rests = [model.flexible_model().static_equilibrium(np.zeros(chain.size)).q for model in (found, same, unknown)]
    assert rests[0] == pytest.approx(rests[1])
    assert np.abs(rests[0] - rests[2]).max() > 1e-3
    files = [model.arm.simulator_file("mujoco", "arm.urdf") for model in (found, same)]
    assert files[0] == files[1]
