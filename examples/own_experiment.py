"""Write an experiment as a lab's camera and drive give it, identify the arm, and find what nobody wrote down.

python examples/own_experiment.py [folder]      (without it: my_experiment)

What is recorded here is simulated, by the small beam solver below, which shares nothing with vjm: a motor turns an
Euler-Bernoulli beam with large deflections, and on its tip sit 12 g that the experiment file does not know of.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.polynomial import legendre

import vjm

EXPERIMENT = """\
schema = 1
name = "my beam"

[base]
gravity = [0.0, 0.0]

[[link]]
name = "beam"
joint = "revolute"
hub_inertia = 0.012
length = 0.8
mass = 0.31
bending_stiffness = 1.7
markers = [0.2, 0.4, 0.6, 0.8]

[units]
length = "mm"
angle = "deg"
time = "ms"

[columns]
t = "Time [ms]"
"beam.theta" = "Angle [deg]"
"beam.tau" = "Torque [N m]"
"""
RECORDING = """
[[recording]]
file = "{name}.csv"
motors_file = "{name}_drive.csv"
kind = "driven"
role = "{role}"
"""
RECORDINGS = {  # role, and sines of the torque: N m, Hz
    "slow": ("train", ((0.10, 0.7), (0.03, 5.1))),
    "fast": ("train", ((0.08, 1.3), (0.04, 3.4))),
    "both": ("holdout", ((0.09, 0.9), (0.05, 4.2))),
}
MARKERS = np.array([0.2, 0.4, 0.6, 0.8])  # m along the beam
LENGTH, MASS, HUB, STIFFNESS, DAMPING_TIME, TIP_MASS = 0.8, 0.31, 0.012, 1.62, 6e-4, 0.012  # SI; what is true
DURATION, CAMERA_RATE, DRIVE_RATE = 2.0, 50.0, 200.0  # s, Hz, Hz
SUBSTEPS = 3  # of the simulation, in a sample of the drive


def simulate(time: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles of the hub (B, T) [rad] and marker positions (B, T, k, 2) [m] of a beam driven from rest B times.

    The beam's heading is phi(s) = theta + sum_i q_i b_i(s), b_i' being Legendre polynomials (Galerkin's method), and
    its positions are integrals of (cos phi, sin phi): inextensible, exact for large deflections. Between its samples
    the torque (B, T) [N m] is linear.
    """
    functions, points = 4, 12
    nodes, weights = legendre.leggauss(points)
    masses = np.append(0.5 * MASS * weights, TIP_MASS)  # at the nodes, and on the tip
    to_coefficients = np.linalg.inv(legendre.legvander(nodes, points - 1))

    def integrals_to(arcs: np.ndarray) -> np.ndarray:
        primitives = legendre.legint(np.eye(points), lbnd=-1)
        return 0.5 * LENGTH * legendre.legval(2 * arcs / LENGTH - 1, primitives).T @ to_coefficients

    curvature = legendre.legvander(nodes, functions - 1)
    inner = integrals_to(0.5 * LENGTH * (nodes + 1))
    heading = np.column_stack([np.ones(points), inner @ curvature])  # phi = heading @ (theta, q)
    to_masses = np.vstack([inner, integrals_to(np.array([LENGTH]))])
    stiffness = np.zeros((functions + 1, functions + 1))
    stiffness[1:, 1:] = 0.5 * LENGTH * STIFFNESS * (curvature.T * weights) @ curvature

    def rates(state: np.ndarray, torque: np.ndarray) -> np.ndarray:
        q, v = state
        phi, turning = q @ heading.T, v @ heading.T
        forces = -(q + DAMPING_TIME * v) @ stiffness
        forces[:, 0] += torque
        inertia = np.zeros((len(q), *stiffness.shape))
        inertia[:, 0, 0] = HUB
        for along, across in ((np.cos(phi), -np.sin(phi)), (np.sin(phi), np.cos(phi))):  # x and y
            jacobian = to_masses @ (across[..., None] * heading)
            inertia += np.swapaxes(jacobian, 1, 2) * masses @ jacobian
            forces += np.einsum("bpi,bp->bi", jacobian, masses * ((along * turning**2) @ to_masses.T))
        return np.stack([v, np.linalg.solve(inertia, forces[..., None])[..., 0]])

    state, motion = np.zeros((2, len(torque), functions + 1)), []
    for k, at in enumerate(torque.T):
        motion.append(state[0])
        after = torque[:, min(k + 1, time.size - 1)]
        step = (time[1] - time[0]) / SUBSTEPS
        for i in range(SUBSTEPS):  # Runge-Kutta of fourth order
            begin, middle, end = (at + (i + part) / SUBSTEPS * (after - at) for part in (0.0, 0.5, 1.0))
            one = rates(state, begin)
            two = rates(state + 0.5 * step * one, middle)
            three = rates(state + 0.5 * step * two, middle)
            four = rates(state + step * three, end)
            state = state + step / 6 * (one + 2 * two + 2 * three + four)
    q = np.stack(motion, axis=1)  # (B, T, functions + 1)
    phi = q @ heading.T
    to_markers = integrals_to(MARKERS).T
    return q[..., 0], np.stack([np.cos(phi) @ to_markers, np.sin(phi) @ to_markers], axis=-1)


def record(folder: Path) -> None:
    """Write what camera and drive recorded; here both are simulated: replace this by the files that yours write."""
    noise = np.random.default_rng(1)
    time = np.arange(round(DURATION * DRIVE_RATE) + 1) / DRIVE_RATE
    torque = np.array(
        [sum(size * np.sin(2 * np.pi * rate * time) for size, rate in sines) for _, sines in RECORDINGS.values()]
    )
    every = round(DRIVE_RATE / CAMERA_RATE)
    for name, tau, theta, places in zip(RECORDINGS, torque, *simulate(time, torque), strict=True):
        angle = np.rad2deg(theta + noise.normal(scale=1e-4, size=theta.shape))
        drive = pd.DataFrame({"Time [ms]": 1e3 * time, "Angle [deg]": angle, "Torque [N m]": tau})
        drive.round(4).to_csv(folder / f"{name}_drive.csv", index=False)

        seen = 1e3 * (places[::every] + noise.normal(scale=3e-4, size=places[::every].shape))
        seen[60:63, 2] = np.nan  # three frames in which something hid marker 3: their cells stay empty
        camera = pd.DataFrame({"Frame": np.arange(len(seen)), "Time [ms]": 1e3 * time[::every]})
        for k in range(seen.shape[1]):
            camera[f"LED{k + 1} X [mm]"], camera[f"LED{k + 1} Y [mm]"] = seen[:, k].T
        camera.round(2).to_csv(folder / f"{name}.csv", index=False)


def describe(folder: Path) -> Path:
    """Write the experiment file; `vjm init` writes one for CSV files that it looks at."""
    text = EXPERIMENT
    for k in range(1, MARKERS.size + 1):
        text += f'"beam.m{k}.x" = "LED{k} X [mm]"\n"beam.m{k}.y" = "LED{k} Y [mm]"\n'
    text += "".join(RECORDING.format(name=name, role=role) for name, (role, _) in RECORDINGS.items())
    file = folder / "experiment.toml"
    file.write_text(text, encoding="utf-8")
    return file


def main(folder: str = "my_experiment") -> None:
    here = Path(folder)
    here.mkdir(exist_ok=True)
    record(here)
    file = describe(here)

    # These are what one may suspect of such an arm; all the effects that are built in take three times as long.
    suspects = ["tip_payload", "viscous_friction", "coulomb_friction", "torque_gain", "time_offset"]
    diagnosis = vjm.diagnose(vjm.load_experiment(file), effects=suspects)
    print(diagnosis.summary())
    for cause in diagnosis.causes:
        print(*cause.parameters.values(), sep=", ")
    print(*diagnosis.parameters, sep="\n")
    print(f"True: mass on the tip {TIP_MASS} kg, bending stiffness {STIFFNESS} N m². A report of all this writes:")
    print(f"  vjm diagnose {file}")


if __name__ == "__main__":
    main(*sys.argv[1:])
