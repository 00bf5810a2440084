"""A step of the simulation, as a multiple of what Pinocchio takes for the accelerations of its five stages.

Of one copy and of eight, four virtual joints on a driven hub, without an effect and with some.
"""

from functools import partial

import numpy as np
import pinocchio as pin
from clock import header, in_turns, line

from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.effects import Backlash, CoulombFriction, ExternalTone, Hysteresis, LinearDrag
from vjm.model.dynamics import Mechanism
from vjm.records import Link, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import simulate_trajectories
from vjm.threads import use_one_thread

DURATION, RATE, JOINTS, STAGES, COPIES = 4.0, 250, 4, 5, (1, 8)
EFFECTS = {
    "no effect": (),
    "linear drag": (LinearDrag(link=0, coefficient=0.05),),
    "a tone": (ExternalTone(link=0, amplitude=0.005, frequency=2.5),),
    "hysteresis": (Hysteresis(link=0, ratio=0.05, yield_angle=0.05),),
    "backlash": (Backlash(link=0, gap=0.004),),
    "dry friction": (CoulombFriction(link=0, torque=0.01),),
}


def simulate(arm: Arm, recording: Recording, copies: int) -> int:
    """Simulate copies from rest, and return the number of steps."""
    rest = [np.zeros(arm.chain.size)] * copies
    return len(simulate_trajectories([arm] * copies, [recording] * copies, rest, rest)[0].time) - 1


def accelerate(pool: pin.ModelPool, q: np.ndarray, v: np.ndarray, tau: np.ndarray, a: np.ndarray) -> None:
    """Compute the accelerations (C, nv) of the stages of a thousand steps."""
    for _ in range(1000 * STAGES):
        pin.abaInParallel(1, pool, q.T, v.T, tau.T, a.T)


def main() -> None:
    link = Link("beam", "revolute", 1.0, 0.44, 1.9, (0.2, 0.4, 0.6, 0.8, 1.0), hub_inertia=0.02)
    chain = Chain("beam", (uniform_chain(link, layout(link.length, JOINTS), kelvin_voigt=3e-4),))
    time = np.arange(round(DURATION * RATE) + 1) / RATE
    torque = 0.1 * np.sin(6.0 * time) + 0.05 * np.sin(23.0 * time)
    unseen = np.full((time.size, 5, 2), np.nan)
    recording = Recording(time, unseen, tau=torque[:, None], kind="driven", gravity=(0.0, 0.0))
    pool = pin.ModelPool(Mechanism(chain).model, 1)
    header(f"steps of the simulation, {JOINTS} virtual joints and a hub")
    for copies in COPIES:
        bare = partial(accelerate, pool, *np.zeros((4, copies, chain.size)))
        for name, effects in EFFECTS.items():
            arm = Arm.of(chain, effects)
            times = in_turns({"bare": bare, "vjm": partial(simulate, arm, recording, copies)}, repeats=5)
            step = times["vjm"] / simulate(arm, recording, copies)
            line(f"{name}, copies at once: {copies}", 1e6 * float(np.median(step)), "us")
            line("  as a multiple of Pinocchio's accelerations", float(np.median(1000 * step / times["bare"])))


if __name__ == "__main__":
    with use_one_thread():
        main()
