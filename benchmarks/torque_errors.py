"""Torque errors of 100,000 samples at n = 6, against Pinocchio's bare batched RNEA on the same arrays."""

import numpy as np
import pinocchio as pin
from clock import header, in_turns, line

from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.model import dynamics
from vjm.model.dynamics import torque_errors
from vjm.records import Link

SAMPLES, JOINTS, THREADS = 100_000, 6, 2


def main() -> None:
    link = Link("beam", "clamped", 1.0, 0.44, 1.9, (0.2, 0.4, 0.6, 0.8, 1.0))
    chain = Chain("beam", (uniform_chain(link, layout(link.length, JOINTS), kelvin_voigt=3e-4),))
    random = np.random.default_rng(0)
    q, v, a = (size * random.standard_normal((SAMPLES, JOINTS)) for size in (0.05, 0.5, 10.0))
    no_torque, out = np.empty((SAMPLES, 0)), np.empty((SAMPLES, JOINTS))
    pool = pin.ModelPool(dynamics.Mechanism(chain).model, THREADS)

    times = in_turns(
        {
            "bare": lambda: pin.rneaInParallel(THREADS, pool, q.T, v.T, a.T, out.T),
            "vjm": lambda: torque_errors(chain, q, v, a, no_torque),
        },
        repeats=30,
    )
    header(f"torque errors of {SAMPLES:,} samples, n = {JOINTS}")
    line("pin.rneaInParallel, median", 1e3 * float(np.median(times["bare"])), "ms")
    line("vjm.model.dynamics.torque_errors, median", 1e3 * float(np.median(times["vjm"])), "ms")
    line("ratio, median over rounds", float(np.median(times["vjm"] / times["bare"])), "", 1.3)


if __name__ == "__main__":
    main()
