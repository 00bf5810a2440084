"""What an effect does to a motion: something at least, and no energy where it says that it takes some."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from vjm import dynamics
from vjm.chain.records import Chain
from vjm.diagnosis.contract.bench import Bench, benches
from vjm.diagnosis.contract.faults import Clause
from vjm.effects.effect import Effect
from vjm.simulate.arm import Arm
from vjm.simulate.rollout import default_step
from vjm.simulate.sensitivity import Path, followed

Array = NDArray[np.float64]

_ROUNDING = 1e-9  # m or rad
_SHORT = 0.5  # s
_STATES = 400
_PAYLOAD = 0.05  # kg
_FASTEST = 3.0  # decimal orders between the slowest random rates and the fastest, 1 rad/s
_MOTION, _INSTANTS = 2.0, 20001  # s; so many that internal states are followed closely
_STEPWISE = 1e-3  # of the work in both directions, that following internal states step by step may add
_FINE = 0.25  # of the usual step, whose own error would look like a gain
_GROWTH = 1e-6  # of the energy at the start, that integration may add


def shown_by(effect: Effect) -> tuple[Bench, Effect]:
    """Clause `action`: at an everyday size, some rig's markers or encoders show something else than without it.

    Returns:
        The first such rig, and the effect with everyday sizes on it.

    Raises:
        EffectError: there is none.
    """
    clause, refusals, tried = Clause(effect.id, "action"), [], False
    for bench in benches():
        with clause.running("`untestable`"):
            refusal = bench.refusal(effect)
        if refusal:
            refusals.append(f"on the {bench.rig.name} link: {refusal}")
            continue
        tried = True
        present = bench.placed(effect)
        with clause.running(f"a simulation with {present!r}"):
            # A short one is often enough.
            if any(_difference(each, present) > _ROUNDING for each in (bench.beginning(_SHORT), bench)):
                return bench, present
    clause.holds(tried, f"it says that nothing can show it ({'; '.join(refusals)})", "a rig on which it is testable")
    clause.broken("at its everyday size no marker and no encoder shows anything of it", "something beyond rounding")


def _difference(bench: Bench, present: Effect) -> float:
    """Largest difference that it makes to markers [m] and encoders [rad]."""
    arm = Arm.of(bench.chain, (present,))
    step = bench.step(arm)
    pairs = zip(bench.simulate(arm, step), bench.simulate(Arm(bench.chain), step), strict=True)
    return max(
        float(np.abs(one - two).max(initial=0.0))
        for with_it, without in pairs
        for one, two in ((with_it.markers, without.markers), (with_it.theta, without.theta))
    )


def check_energy(effect: Effect, seed: int) -> None:
    """Clause `energy`: what is called dissipative takes power at every state, and a free decay only loses energy.

    Internal states may hold energy for a while: of an effect that has some, a motion from rest never gets more than it
    gave.

    Raises:
        EffectError: it adds some.
    """
    clause = Clause(effect.id, "energy")
    for bench in benches():
        if bench.refusal(effect):
            continue
        present = bench.placed(effect)
        with clause.running(f"{present!r}"):
            arm = Arm.of(bench.chain, (present,))
            power, size = (_work if any(arm.states) else _power)(bench.chain, arm, seed)
        worst = int(np.argmax(power - _ROUNDING * size))
        given = f"{power[worst]:.3g} " + ("J by then" if any(arm.states) else "W")
        clause.holds(
            power[worst] <= _ROUNDING * size[worst],
            f"at a random state its forces give the arm {given}",
            "none of them positive, since `dissipative` is True",
        )
        with clause.running(f"a simulation with {present!r}"):
            growth = _growth(bench, present)
        found = f"a free decay of the {bench.rig.name} link gains {100 * growth:.3g} % of its energy"
        clause.holds(growth <= _GROWTH, found, "a loss, since `dissipative` is True")


def _power(chain: Chain, arm: Arm, seed: int) -> tuple[Array, Array]:
    """(S,) power [W] that forces and dampers of the effect give, and the sum of its parts' sizes."""
    random, n = np.random.default_rng(seed), arm.chain.size
    q = random.normal(size=(_STATES, n))
    v = random.normal(size=(_STATES, n)) * 10 ** -random.uniform(0, _FASTEST, (_STATES, 1))
    rest = arm.rest(q)
    z, time = rest + 0.1 * random.normal(size=rest.shape), random.uniform(0, 10, _STATES)
    force, found = arm.forces(_PAYLOAD), np.zeros((_STATES, n))
    if force is not None:
        found += force(time, q, v, z)
    if n == chain.size:
        found -= (arm.chain.damping - chain.damping) * v
    parts = found * v
    return parts.sum(axis=1), np.abs(parts).sum(axis=1)


def _work(chain: Chain, arm: Arm, seed: int) -> tuple[Array, Array]:
    """(S,) work [J] that forces of the effect have given over a random motion from rest, and the sum of its sizes."""
    random, n = np.random.default_rng(seed), arm.chain.size
    time = np.linspace(0.0, _MOTION, _INSTANTS)
    pulsation, phase = random.uniform(1.0, 8.0, (4, n)), random.uniform(0.0, 2 * np.pi, (4, n))
    angle = time[:, None, None] * pulsation + phase
    q, v = 0.3 * (np.sin(angle) - np.sin(phase)).sum(axis=1), 0.3 * (pulsation * np.cos(angle)).sum(axis=1)
    path = Path(time, q, v, np.zeros_like(q), np.zeros((time.size, 0)))
    force = arm.forces(_PAYLOAD)
    found = np.zeros_like(q) if force is None else force(time, q, v, followed(arm, path))
    if n == chain.size:
        found -= (arm.chain.damping - chain.damping) * v
    power = found * v
    work: Array = cumulative_trapezoid(power.sum(axis=1), time, initial=0)
    size: Array = cumulative_trapezoid(np.abs(power).sum(axis=1), time, initial=0)
    return work, _STEPWISE / _ROUNDING * size


def _growth(bench: Bench, present: Effect) -> float:
    """Largest growth of the energy in a free decay of a link without any other loss, over the energy at its start.

    Beyond the least energy so far; beyond that at the start where internal states may have held some in between.
    """
    free = bench.undamped()
    arm = Arm.of(free.chain, (present,))
    (run,) = free.steps(arm, _FINE * default_step(free.chain))
    q, v = run.q[:, 0], run.v[:, 0]
    M = dynamics.mass_matrix(dynamics.build(arm.chain), q)
    energy = 0.5 * np.einsum("ti,tij,tj->t", v, M, v) + 0.5 * (q * q) @ arm.chain.stiffness
    least = energy[0] if any(arm.states) else np.minimum.accumulate(energy)
    return float((energy - least).max() / energy[0])
