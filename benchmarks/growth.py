"""How the trajectory fit grows with the recordings' length and with the number of virtual joints.

Each fit is a process of its own, so that its memory is its own. Data come from the chain itself: this is about time.
"""

import json
import subprocess
import sys
import time

import numpy as np
from clock import header, line

import vjm
from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.records import Experiment, Link, Recording, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import simulate_trajectories
from vjm.simulation.measurement import MarkerArcs

SAMPLES = (10_000, 100_000, 1_000_000)
JOINTS = (5, 10, 20, 40)
ROWS = 25_000  # of a recording: 25 s at 1 kHz, seen at 100 Hz
NOISE, ENCODER_NOISE = 3e-4, 1e-4
MARKERS = (0.2, 0.4, 0.6, 0.8, 1.0)
MOST_MEMORY = 2.0  # GiB


def experiment_of(rows: int) -> Experiment:
    """So many rows of a hub-driven beam, in recordings of at most 25 s."""
    link = Link("beam", "revolute", 1.0, 0.44, 1.97, MARKERS, hub_inertia=0.02)
    chain = Chain("rig", (uniform_chain(link, layout(1.0, 4), kelvin_voigt=1e-3),))
    rig = Rig("growth", (link,), marker_noise=NOISE, encoder_noise=ENCODER_NOISE)
    return Experiment(rig, tuple(recording_of(rig, chain, k, min(rows, ROWS)) for k in range(max(1, rows // ROWS))))


def recording_of(rig: Rig, chain: Chain, seed: int, rows: int) -> Recording:
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / 1000.0
    waves = 2 * np.pi * np.outer(t, [0.5, 1.3, 2.9, 6.1]) + rng.uniform(0, 6, 4)
    torque = (np.sin(waves) @ [0.05, 0.04, 0.02, 0.02])[:, None]
    markers = np.full((rows, len(MARKERS), 2), np.nan)
    empty = Recording(t, markers, np.zeros((rows, 1)), torque, kind="driven", role="train", file=f"r{seed}.csv")
    rest = np.zeros((1, chain.size))
    q = simulate_trajectories([Arm(chain)], [empty], rest, rest)[0].angles(t)
    markers[::10] = MarkerArcs.of(rig).positions(chain, q[::10]) + NOISE * rng.standard_normal(markers[::10].shape)
    theta = q[:, :1] + ENCODER_NOISE * rng.standard_normal((rows, 1))
    return Recording(t, markers, theta, torque, kind="driven", role="train", file=f"r{seed}.csv")


def fit(rows: int, joints: int) -> None:
    """One fit; prints its seconds and the process's peak memory."""
    import resource

    experiment = experiment_of(rows)
    start = time.perf_counter()
    found = vjm.identify(experiment, virtual_joints=joints)
    seconds = time.perf_counter() - start
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(json.dumps({"seconds": seconds, "memory": memory, "stiffness": found.parameters[0].value}))


def measured(rows: int, joints: int) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, __file__, str(rows), str(joints)], check=True, stdout=subprocess.PIPE, text=True
    )
    found: dict[str, float] = json.loads(done.stdout)
    return found


def power(sizes: tuple[int, ...], seconds: list[float]) -> float:
    """Exponent between the two largest sizes: what small ones cost anyway would flatter it."""
    return float(np.log(seconds[-1] / seconds[-2]) / np.log(sizes[-1] / sizes[-2]))


def main() -> None:
    by_samples = [measured(rows, 4) for rows in SAMPLES]
    by_joints = [measured(5_000, joints) for joints in JOINTS]
    header("growth of the trajectory fit")
    for rows, found in zip(SAMPLES, by_samples, strict=True):
        line(f"{rows:,} rows, n = 4", found["seconds"], "s")
        line("  peak memory", found["memory"], "GiB", MOST_MEMORY)
    line("time grows with the rows to the power", power(SAMPLES, [f["seconds"] for f in by_samples]), "", 1.1)
    for joints, found in zip(JOINTS, by_joints, strict=True):
        line(f"5,000 rows, n = {joints}", found["seconds"], "s")
    line("time grows with n to the power", power(JOINTS, [f["seconds"] for f in by_joints]), "", 2.0)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        fit(int(sys.argv[1]), int(sys.argv[2]))
    else:
        main()
