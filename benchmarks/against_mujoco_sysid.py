"""Identification of a hub-driven flexible link: vjm against MuJoCo's own toolbox, `mujoco.sysid`.

Needs `pip install -e ".[peer]"` (MuJoCo 4 or later). The recording, of 5 s, comes from the fine beam of
`tests.fine_beam`: markers, hub angle and torque at 100 Hz, the torque linear between samples. Both contenders get the
same arrays, the same chain of four virtual joints, the same start (0.8 times the true bending stiffness and hub
inertia) and the same free parameters: every joint's stiffness and damping, and the hub inertia.

MuJoCo runs as its manual recommends: the backend `mujoco` with its default tolerances, as many threads as there are
cores, the integrator `implicitfast` with MuJoCo's default time step (1 ms gives the same RMS in nearly twice the time),
residuals divided by the sensors' noise; markers are sites on the virtual links; it is told the true initial state,
rest. The goal is set by this run. Three more stand beside it, all of which are given vjm's own curve through the
virtual joints to put the markers on, in the toolbox's hook `modify_residual`:

- with everything else the same;
- with a step tolerance of 1e-4: the default, 1e-8, spends most of its rollouts on steps that no longer change anything;
- with its backend `scipy_parallel_fd`, SciPy's search with MuJoCo's rollouts, which needs fewer of them.

RMS is of all marker coordinates, open loop over the whole recording: MuJoCo's from rest, vjm's from the initial state
that it finds, as it is not told that the motion starts at rest. vjm is not asked to simulate its nominal and
torque-error models as well, which MuJoCo's toolbox does not do either. The limit of RMS is MuJoCo's to the micrometre,
or 0.311 mm where that is smaller. vjm's time is the whole of `vjm.identify`: reading the modes of the recording, the
torque method that it starts from, and the replay of the result included.
"""

import io
import os
import sys
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import mujoco
import numpy as np
from clock import ROOT, header, in_turns, line
from mujoco import sysid
from numpy.typing import NDArray

import vjm
from tests.simulation.integrators import simulate
from vjm.chain.curve import marker_poses
from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.chain.virtual_links import Chain, LinkChain
from vjm.records import Experiment, Recording
from vjm.simulation.model import Model

sys.path.append(str(ROOT))

from tests import fine_beam

METHOD = "trajectory"
JOINTS, REPEATS, SEED = 4, 3, 1
TRUTH = fine_beam.Beam(1.0, 0.44, 1.97, kelvin_voigt_time=1e-3, joint="revolute", hub_inertia=0.02)
START, START_DAMPING = 0.8, 1e-3  # of the true stiffness and hub inertia; Kelvin-Voigt time, s, vjm's own start
MARKERS = [0.2, 0.4, 0.6, 0.8, 1.0]
RATE, DURATION, MARKER_NOISE, ANGLE_NOISE = 100, 5, 3e-4, 1e-4
STEP = 2e-3
STEPS_A_SAMPLE = round(1 / (RATE * STEP))
RMS_LIMIT, TIME_LIMIT = 0.311, 0.2  # mm; of MuJoCo's time

Array: TypeAlias = NDArray[np.float64]
Look: TypeAlias = Callable[[Array, Array], Array]


class Fit(NamedTuple):
    """What a contender found: RMS of its markers, m, measured off the clock, and iterations (vjm: by stage)."""

    marker_rms: Callable[[], float]
    iterations: dict[str, int]
    model: Model | None = None


# The recording


def drive(time: Array) -> Array:
    """Hub torque, N m: a swing of 2 rad, and steps that bend the link by 5 cm."""
    return np.asarray(0.2 * np.sin(4.4 * time) + 0.08 * np.sign(np.sin(8.2 * time)))


def write(folder: Path) -> Path:
    """Simulate, film and write the experiment; returns its file."""
    knots, time = np.arange(DURATION * RATE + 1) / RATE, np.arange(DURATION * 500 + 1) / 500
    torque = drive(knots)
    motion = fine_beam.simulate(TRUTH, time, np.interp(time, knots, torque))
    frames = fine_beam.observe(motion, MARKERS, fine_beam.Camera(RATE, MARKER_NOISE), SEED)
    angle = fine_beam.read_encoder(motion, fine_beam.Encoder(RATE, ANGLE_NOISE), SEED)
    fine_beam.write_recording(folder / "driven.csv", "beam", frames, angle, (knots, torque))
    link: dict[str, str | float | list[float]] = {
        "name": "beam",
        "joint": "revolute",
        "length": TRUTH.length,
        "mass": TRUTH.mass,
        "bending_stiffness": START * TRUTH.bending_stiffness,
        "hub_inertia": START * TRUTH.hub_inertia,
        "markers": MARKERS,
    }
    sensors = {"marker_noise": MARKER_NOISE, "encoder_noise": ANGLE_NOISE}
    entries = [fine_beam.RecordingEntry("driven.csv", "driven", "train")]
    fine_beam.write_experiment(folder / "experiment.toml", "hub-driven link", link, sensors, entries)
    return folder / "experiment.toml"


def start_of(experiment: Experiment) -> Chain:
    """The chain that both searches start from."""
    return nominal_chain(experiment.rig, rig_layouts(experiment.rig, [JOINTS]), START_DAMPING)


# vjm


def with_vjm(experiment: Experiment) -> Fit:
    stages: dict[str, int] = {}

    def count(text: str, done: int, total: int) -> None:
        stages[text] = stages.get(text, 0) + 1

    found = vjm.identify(experiment, METHOD, JOINTS, "joints", baselines=False, progress=count)
    stages.pop("replaying recordings", None)
    replay = found.recordings[0].simulated
    return Fit(lambda: np.inf if replay is None else replay.marker_rms, stages, found.model)


def rms_from_rest(model: Model, recording: Recording) -> float:
    rest = np.zeros(model.chain.size)
    markers = simulate(model.chain, model.rig, recording, rest, rest).markers
    return float(np.sqrt(np.mean((recording.markers - markers) ** 2)))


# MuJoCo


def mjcf(link: LinkChain) -> str:
    """The chain as MJCF: one hinge a virtual link, the hub's inertia as its armature, markers as sites."""
    ends = np.cumsum(link.lengths)
    of_link = np.minimum(np.searchsorted(ends, np.array(MARKERS) - 1e-9), JOINTS)
    bodies = ""
    for i in reversed(range(JOINTS + 1)):
        proximal = ends[i] - link.lengths[i]
        spring = f'armature="{link.hub_inertia}"'
        if i:
            spring = f'stiffness="{link.stiffness[i - 1]}" damping="{link.damping[i - 1]}"'
        sites = "".join(f'<site name="m{k}" pos="{MARKERS[k] - proximal} 0 0"/>' for k in np.flatnonzero(of_link == i))
        bodies = f"""<body pos="{link.lengths[i - 1] if i else 0} 0 0">
            <inertial pos="{link.mass_centers[i]} 0 0" mass="{link.masses[i]}"
                diaginertia="{link.inertias[i]} {link.inertias[i]} {link.inertias[i]}"/>
            <joint name="j{i}" axis="0 0 1" {spring}/>{sites}{bodies}</body>"""
    sensors = "".join(f'<framepos name="m{k}" objtype="site" objname="m{k}"/>' for k in range(len(MARKERS)))
    return f"""<mujoco><compiler angle="radian"/>
        <option timestep="{STEP}" integrator="implicitfast" gravity="0 0 0"><flag contact="disable"/></option>
        <worldbody>{bodies}</worldbody>
        <actuator><motor name="hub" joint="j0"/></actuator>
        <sensor><jointpos name="theta" joint="j0"/>{sensors}</sensor></mujoco>"""


def parameters(link: LinkChain) -> sysid.ParameterDict:
    """Every joint's stiffness and damping, and the hub inertia, within a factor of ten of the start."""

    def set_stiffness(spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
        for i, value in enumerate(parameter.value, start=1):
            spec.joint(f"j{i}").stiffness[0] = value

    def set_damping(spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
        for i, value in enumerate(parameter.value, start=1):
            spec.joint(f"j{i}").damping[0] = value

    def set_hub(spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
        spec.joint("j0").armature = parameter.value[0]

    free = sysid.ParameterDict()
    hub = np.array([link.hub_inertia])
    for name, start, least, modifier in (
        ("stiffness", link.stiffness, 0.1, set_stiffness),
        ("damping", link.damping, 0.0, set_damping),
        ("hub_inertia", hub, 0.1, set_hub),
    ):
        free.add(sysid.Parameter(name, start, least * start, 10.0 * start, modifier=modifier))
    return free


def columns(theta: Array, markers: Array) -> Array:
    """(T, 1 + 3 k) in the order of the sensors: hub angle [rad], and each marker's x, y and z [m]."""
    return np.column_stack([theta, np.pad(markers, ((0, 0), (0, 0), (0, 1))).reshape(len(theta), -1)])


def look_at_sites(sensors: Array, state: Array) -> Array:
    """What MuJoCo's sensors saw at the samples; a rollout's row k is of before its step, so the last one is missing."""
    return sensors[::STEPS_A_SAMPLE]


def look_at_curve(chain: Chain, sensors: Array, state: Array) -> Array:
    """Markers on the curve through the virtual joints, from the states of after each step."""
    q = np.vstack([np.zeros(chain.size), state[STEPS_A_SAMPLE - 1 :: STEPS_A_SAMPLE, 1 : 1 + chain.size]])
    return columns(q[:, 0], marker_poses(chain, q, (np.array(MARKERS),), (False,))[0])


def sequences(spec: mujoco.MjSpec, recording: Recording) -> sysid.ModelSequences:
    """The recording as the toolbox wants it, with rest as its initial state."""
    model, rest = spec.compile(), np.zeros(JOINTS + 1)
    control = sysid.TimeSeries.from_control_names(recording.time, recording.tau, model)
    measured = columns(recording.theta[:, 0], recording.markers)
    sensors = sysid.TimeSeries.from_names(recording.time, measured, model)
    state = sysid.create_initial_state(model, rest, rest)
    return sysid.ModelSequences("beam", spec, recording.file, state, control, sensors)


def with_mujoco(experiment: Experiment, look: Look, backend: str = "mujoco", **options: Any) -> Fit:
    (recording,), (link,) = experiment.recordings, start_of(experiment).links
    noise = np.array([ANGLE_NOISE] + 3 * len(MARKERS) * [MARKER_NOISE])

    def weighted(_params: Any, seen: Any, measured: Any, _model: Any, _all: Any, state: Array, **_: Any) -> Any:
        predicted = look(seen.data, state)
        return (predicted - measured.data[: len(predicted)]) / noise, measured, measured

    given = sequences(mujoco.MjSpec.from_string(mjcf(link)), recording)
    residual = sysid.build_residual_fn(
        models_sequences=[given], modify_residual=weighted, n_threads=os.cpu_count() or 1
    )
    with redirect_stdout(io.StringIO()):
        found, result = sysid.optimize(parameters(link), residual, backend, verbose=False, **options)
    iterations = len(result.extras["objective"]) - 1 if backend == "mujoco" else int(result.njev)

    def marker_rms() -> float:
        left = np.reshape(residual(found.as_vector(), found)[0][0], (-1, noise.size))[:, 1:]
        coordinates = left.reshape(len(left), -1, 3)[..., :2]  # z is zero on both sides
        return MARKER_NOISE * float(np.sqrt(np.mean(coordinates**2)))

    return Fit(marker_rms, {"iterations": iterations})


# Side by side


def report(times: dict[str, Array], fits: dict[str, Fit], recording: Recording) -> None:
    header("identification of a hub-driven link, 5 s, 9 parameters")
    for name, seconds in times.items():
        line(f"{name}, median", float(np.median(seconds)), "s")
    for name in list(times)[1:]:
        ratio = float(np.median(times["vjm"] / times[name]))
        line(f"vjm as a multiple of {name}", ratio, "", TIME_LIMIT if name == "mujoco.sysid" else None)
    for name, fit in fits.items():
        for what, count in fit.iterations.items():
            line(f"{name}, {what}", count)
    rms = {name: round(1e3 * fit.marker_rms(), 3) for name, fit in fits.items()}
    best = min(RMS_LIMIT, rms["mujoco.sysid"])
    for name, value in rms.items():
        line(f"{name}, marker RMS", value, "mm", best if name == "vjm" else None)
    model = fits["vjm"].model
    if model is not None:
        line("vjm, marker RMS from rest, which it is not told", 1e3 * rms_from_rest(model, recording), "mm")
    kept = rms["vjm"] <= best and float(np.median(times["vjm"] / times["mujoco.sysid"])) <= TIME_LIMIT
    print(f"  goal, as good in a fifth of the time: {'kept' if kept else 'MISSED'}")


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        experiment = vjm.load_experiment(write(Path(folder)))
    curve = partial(look_at_curve, start_of(experiment))
    contenders: dict[str, Callable[[], Fit]] = {
        "vjm": partial(with_vjm, experiment),
        "mujoco.sysid": partial(with_mujoco, experiment, look_at_sites),
        "mujoco.sysid, vjm's curve": partial(with_mujoco, experiment, curve),
        "mujoco.sysid, vjm's curve, xtol 1e-4": partial(with_mujoco, experiment, curve, xtol=1e-4),
        "mujoco.sysid, vjm's curve, scipy_parallel_fd": partial(with_mujoco, experiment, curve, "scipy_parallel_fd"),
    }
    fits: dict[str, Fit] = {}

    def run(name: str) -> None:
        fits[name] = contenders[name]()

    times = in_turns({name: partial(run, name) for name in contenders}, REPEATS)
    report(times, fits, experiment.recordings[0])


if __name__ == "__main__":
    main()
