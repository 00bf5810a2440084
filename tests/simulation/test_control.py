"""Motion under a torque of one's own: against SciPy's integrator on the same equations, and against a pendulum's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tests.simulation.setups import arm_of, recording_of, rig_of, steel_link
from vjm.effects import ActuatorLag, Cogging, PayloadBody, TorqueGain, TorqueSaturation
from vjm.effects.effect import Effect
from vjm.errors import ShapeError, SimulationDivergedError
from vjm.model.dynamics import Mechanism
from vjm.records import Payload
from vjm.simulation.model import Model

Array = NDArray[np.float64]
NOISE = 1e-4


def model_of(*effects: Effect) -> Model:
    chain = arm_of(steel_link(3, "revolute"))
    return Model(chain, rig_of(chain), NOISE, NOISE, effects=effects)


def controller(time: float, theta: Array, rate: Array) -> Array:
    """Bring the hub to half a radian."""
    return np.asarray(2.0 * (0.5 - theta) - 0.3 * rate)


def by_scipy(model: Model, law: Callable[[float, Array, Array], Array], time: Array) -> Array:
    """Angles (T, nv) of the chain from rest at zero, by another integrator."""
    chain, mechanism = model.arm.chain, Mechanism(model.arm.chain)
    n, active = chain.size, chain.active

    def slope(t: float, x: Array) -> Array:
        q, v = x[:n], x[n:]
        torque = -chain.stiffness * q - chain.damping * v
        torque[active] += law(t, q[active], v[active])
        return np.concatenate([v, mechanism.forward_dynamics(q[None], v[None], torque[None])[0]])

    found = solve_ivp(slope, (0, time[-1]), np.zeros(2 * n), "LSODA", time, rtol=1e-7, atol=1e-9)
    return np.asarray(found.y[:n].T)


def test_a_control_law_closes_the_loop() -> None:
    model = model_of()
    motion = model.simulate(torque=controller, duration=0.8)
    expected = by_scipy(model, controller, motion.time)
    np.testing.assert_allclose(motion.q, expected, atol=0.2 * NOISE)
    assert abs(motion.theta[-1, 0] - 0.5) < 0.15


def test_a_payload_may_be_a_body() -> None:
    """It moves as the link's own, and effects say what it really is."""
    body = Payload(0.05, 0.04, 1e-4)
    chain = arm_of(steel_link(3, "revolute"))
    link = replace(chain.links[0], payload=body.mass, payload_offset=body.offset, payload_inertia=body.inertia)
    model, own = model_of(), replace(model_of(), chain=replace(chain, links=(link,)))
    taken = {"torque": np.full(41, 0.1), "duration": 0.8}
    np.testing.assert_allclose(model.simulate(**taken, payload=body).q, own.simulate(**taken).q, atol=1e-9)
    assert model.modes(body).frequencies == pytest.approx(own.modes().frequencies)
    wrong = model_of(PayloadBody(link=0, offset=0.04))
    known = (0.05, 0.0, 1e-4)
    np.testing.assert_allclose(wrong.simulate(**taken, payload=known).q, own.simulate(**taken).q, atol=1e-9)
    assert wrong.modes(known).frequencies == pytest.approx(own.modes().frequencies)
    assert wrong.modes().frequencies == pytest.approx(model.modes().frequencies)
    at_rest = wrong.simulate(duration=0.1, initial=[[0.1], [0.0]], payload=known)
    assert at_rest.theta[0, 0] == pytest.approx(0.1)


def test_a_law_of_time_alone_is_the_array_of_its_values() -> None:
    model, duration = model_of(), 1.2
    samples = np.sin(3 * np.linspace(0, duration, 601))
    one = model.simulate(torque=samples, duration=duration)
    assert one.time.size == 601
    knots = one.time
    two = model.simulate(torque=lambda t, theta, rate: np.interp(t, knots, samples), duration=duration)
    np.testing.assert_allclose(np.interp(two.time, one.time, one.theta[:, 0]), two.theta[:, 0], atol=2e-5)


def test_a_nominal_model_needs_no_recording() -> None:
    model = model_of()
    (link,) = model.rig.links
    rig = replace(model.rig, links=(replace(link, hub_inertia=0.02),))
    nominal = Model.nominal(rig, 6, 3e-4)
    assert nominal.chain.links[0].virtual_joints == 6
    np.testing.assert_allclose(nominal.modes().frequencies[1], model.modes().frequencies[1], rtol=0.01)
    motion = nominal.simulate(torque=controller, duration=0.3)
    np.testing.assert_allclose(motion.theta[-1], model.simulate(torque=controller, duration=0.3).theta[-1], atol=2e-3)
    with pytest.raises(ShapeError, match="virtual_joints"):
        Model.nominal(rig, 0)


def test_without_a_torque_the_arm_stays_or_swings_on_as_it_was_left() -> None:
    model = model_of()
    assert np.abs(model.simulate(duration=0.5).q).max() == 0
    turning = model.simulate(duration=0.5, initial=[[0.2], [1.0]])
    assert turning.theta[0, 0] == 0.2
    assert turning.v[0, 0] == 1.0
    on = model.simulate(duration=0.25, initial=[turning.q[-1], turning.v[-1]])
    whole = model.simulate(duration=0.75, initial=[[0.2], [1.0]])
    np.testing.assert_allclose(on.q[-1], whole.q[-1], atol=1e-5)


@pytest.mark.parametrize("effect", [TorqueGain(gain=0.5, link=0), TorqueSaturation(limit=0.4, link=0)])
def test_the_law_acts_through_the_actuator(effect: Effect) -> None:
    def limited(time: float, theta: Array, rate: Array) -> Array:
        asked = controller(time, theta, rate)
        return np.clip(asked, -0.4, 0.4) if isinstance(effect, TorqueSaturation) else 0.5 * asked

    motion = model_of(effect).simulate(torque=controller, duration=0.4)
    np.testing.assert_allclose(motion.q, by_scipy(model_of(), limited, motion.time), atol=0.5 * NOISE)


def test_what_remembers_earlier_torques_is_refused_beside_a_law() -> None:
    with pytest.raises(ShapeError, match="actuator_lag"):
        model_of(ActuatorLag(time_constant=0.02, link=0)).simulate(torque=controller, duration=0.4)


def test_steps_are_halved_beside_an_effect_that_shortens_them() -> None:
    """Instants a whole period apart do not show a wave, and effects may allow no longer steps than that."""
    model = model_of(Cogging(amplitude=1e-9, count=400.0, link=0))
    pulsation = 2 * np.pi / model.arm.longest_step

    def wave(time: float, theta: Array, rate: Array) -> Array:
        return 30.0 * np.sin(pulsation * time) * np.ones(1)

    motion = model.simulate(torque=wave, duration=0.1)
    expected = by_scipy(model_of(), wave, motion.time)
    assert np.abs(expected).max() > 50 * NOISE
    np.testing.assert_allclose(motion.q, expected, atol=0.2 * NOISE)


def test_an_unstable_law_is_named() -> None:
    with pytest.raises(SimulationDivergedError, match="control law"):
        model_of().simulate(torque=lambda t, theta, rate: 1e9 * (theta + 1e-3), duration=1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "duration"),
        ({"duration": -1.0}, "duration"),
        ({"duration": 1.0, "torque": np.zeros((5, 2))}, "torque"),
        ({"duration": 1.0, "torque": [0.0, np.nan]}, "torque"),
        ({"duration": 1.0, "torque": "strong"}, "torque: got 'strong'; expected an array of numbers"),
        ({"duration": 1.0, "initial": [[0.0], [0.0, 1.0]]}, "initial"),
        ({"duration": 1.0, "torque": lambda t, theta, rate: "strong"}, "torque"),
        ({"duration": 1.0, "torque": lambda t, theta, rate: [1.0, 2.0]}, "torque"),
        ({"duration": 1.0, "initial": [0.0, 0.0, 0.0]}, "initial"),
        ({"duration": 1.0, "payload": -1.0}, "payload"),
        ({"duration": 1.0, "payload": "heavy"}, "payload"),
        ({"duration": 1.0, "payload": (0.0, 0.1, 0.0)}, "payload"),
        ({"duration": 1.0, "payload": (0.1, 0.0, -1.0)}, "payload"),
        ({"duration": 1.0, "payload": (0.1, 0.0)}, "payload"),
        ({"duration": 1.0, "payload": (0.1, "far", 0.0)}, "payload"),
        ({"duration": 1.0, "payload": (0.1, np.nan, 0.0)}, "payload"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        model_of().simulate(**arguments)  # type: ignore[arg-type]


def test_a_recording_and_a_torque_of_ones_own_exclude_each_other() -> None:
    model = model_of()
    with pytest.raises(ShapeError, match="one of them"):
        model.simulate(recording_of(model.chain, np.linspace(0, 1, 20)), duration=1.0)
