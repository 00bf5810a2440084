"""Identifications put together from the real pieces, without a search: quick to make, and right in every field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

import vjm
from tests.simulation.integrators import simulate
from vjm.chain.layout import Layout, layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.experiment.load import load_experiment
from vjm.identification.parameters import Parametrisation
from vjm.identification.records import Identification, ModeComparison, Whiteness
from vjm.identification.training_data import PreparedRecording
from vjm.identification.trajectory_fit import Point, TrajectoryFit, TrajectoryProblem
from vjm.markers.angles import ShapeSettings, estimate_angles
from vjm.markers.smoothing import Smoother
from vjm.records import Estimate, Experiment, Link, Recording, RecordingComparison, Rig, SimulatedRecording
from vjm.report.figures.identification import identification_pictures
from vjm.report.figures.panels import Picture
from vjm.simulation.measurement import Observations
from vjm.simulation.model import Model
from vjm.simulation.run import InitialStatePrior, simulate_runs

Array = NDArray[np.float64]
Replayer = Callable[[Model, Recording], SimulatedRecording]
DEMO = Path(vjm.__file__).parent / "demo" / "experiment.toml"
SHARED = Path(__file__).parents[3] / "shared" / "data"


def quick_replay(model: Model, recording: Recording) -> SimulatedRecording:
    """A simulation from the state that the first frames show: not the most likely one, but a real one."""
    q, v = _first_state(model, recording)
    simulation = simulate(model.chain, model.rig, recording, q, v)
    noise = (model.marker_noise, model.encoder_noise)
    return SimulatedRecording(recording, simulation, noise, "converged")


def with_rms(simulated: SimulatedRecording, rms: float) -> SimulatedRecording:
    """The same recording, whose markers a simulation misses by an RMS [m]."""
    markers = simulated.recording.markers - simulated.marker_residual * (rms / simulated.marker_rms)
    return replace(simulated, simulation=replace(simulated.simulation, markers=markers))


def _first_state(model: Model, recording: Recording) -> tuple[Array, Array]:
    data = _prepared(model, recording)
    at = int(np.argmin(np.abs(data.derivatives.time - recording.time[0])))
    return data.derivatives.value[at], data.derivatives.rate[at]


def _shape(rig: Rig) -> ShapeSettings:
    return ShapeSettings("cantilever", tuple(min(3, max(1, len(link.markers) - 2)) for link in rig.links))


def _prepared(model: Model, recording: Recording) -> PreparedRecording:
    rig = model.rig
    cuts = [Layout(link.lengths, link.cells, link.distal) for link in model.chain.links]
    angles = estimate_angles(rig, cuts, recording, _shape(rig), model.marker_noise, model.encoder_noise)
    rows = np.isfinite(angles.q).all(axis=1)
    smoother = Smoother(angles.time[rows])
    derivatives = smoother.derivatives(angles.q[rows], angles.covariance)
    return PreparedRecording(recording, angles, derivatives, angles.torque[rows], smoother, np.eye(model.chain.size))


def make_fit(
    experiment: Experiment,
    joints: int,
    bending: float,
    time_constant: float,
    replayer: Replayer = quick_replay,
    marker_noise: float = 3e-4,
    torque: float | None = None,
) -> Identification:
    """An identification whose bending stiffness is `bending` times the nominal one.

    By the torque method; by the trajectory method where `torque` is given: what the torque method found before it.
    """
    rig = experiment.rig
    marker_noise = rig.marker_noise or marker_noise
    encoder_noise = rig.encoder_noise or 1e-4
    nominal = Model(_chain(rig, joints, 1.0, 0.0), rig, marker_noise, encoder_noise)
    estimates = _estimates(rig, bending, time_constant)
    model = Model(_chain(rig, joints, bending, time_constant), rig, marker_noise, encoder_noise, estimates)
    before = None
    if torque is not None:
        before = Model(_chain(rig, joints, torque, time_constant), rig, marker_noise, encoder_noise)
    train = [recording for recording in experiment.with_role("train") if recording.kind != "quiet"]
    return Identification(
        experiment=experiment,
        model=model,
        nominal=nominal,
        method="torque" if before is None else "trajectory",
        parametrisation="uniform",
        parameters=estimates,
        covariance=_covariance(estimates),
        modes=_modes(model),
        shape=_shape(rig),
        objective=1.2e-3,
        objective_nominal=2.3e-2,
        trajectory=None if before is None else _trajectory(model, train),
        whiteness=() if before is None else _whiteness(train),
        torque_data=tuple(_prepared(model, recording) for recording in train),
        recordings=tuple(_fit(model, nominal, before, recording, replayer) for recording in experiment.recordings),
        status="converged",
        remedy="",
        warnings=(*experiment.warnings, "beam: five markers show two bending modes; the third is not seen"),
        notes=("link beam: n = 4 virtual joints", "the bending stiffness is only as accurate as the given mass"),
    )


def _covariance(estimates: tuple[Estimate, ...], correlation: float = -0.6) -> Array:
    stds = np.array([estimate.std for estimate in estimates if estimate.std is not None])
    result: Array = np.outer(stds, stds) * ((1 - correlation) * np.eye(stds.size) + correlation)
    return result


def _trajectory(model: Model, train: list[Recording]) -> TrajectoryFit:
    """The training recordings simulated from rest, which is no minimum."""
    parametrisation = Parametrisation(model.chain, "uniform", ())
    noise = (model.marker_noise, model.encoder_noise)
    simulated = [each for each in train if not each.tau.size or np.isfinite(each.tau).any()]
    observed = tuple(Observations.of(model.rig, each, noise) for each in simulated)
    starts = [InitialStatePrior.of(model.arm, each.recording) for each in observed]
    runs = simulate_runs([model.arm] * len(observed), observed, starts, [start.rest for start in starts], 2.0)
    point = Point(TrajectoryProblem(parametrisation, observed), parametrisation.start, tuple(runs))
    return TrajectoryFit(point, True, 7)


def _whiteness(train: list[Recording]) -> tuple[Whiteness, ...]:
    return tuple(Whiteness(each.file, 1.0 + 0.2 * k, 0.05 + 0.3 * k, k > 0, False) for k, each in enumerate(train))


def _chain(rig: Rig, joints: int, bending: float, time_constant: float) -> Chain:
    links = []
    for i, link in enumerate(rig.links):
        distal: Literal["free", "joined"] = "free" if i == len(rig.links) - 1 else "joined"
        cuts = layout(link.length, joints, distal=distal)
        nominal = uniform_chain(link, cuts, time_constant)
        links.append(replace(nominal, stiffness=bending * nominal.stiffness, damping=bending * nominal.damping))
    return Chain(rig.name, tuple(links), rig.gravity)


def _estimates(rig: Rig, bending: float, time_constant: float) -> tuple[Estimate, ...]:
    estimates = []
    for link in rig.links:
        stiffness = bending * link.bending_stiffness
        estimates.append(Estimate(f"{link.name}.bending_stiffness", stiffness, 2e-3 * stiffness, "N m^2"))
        estimates.append(Estimate(f"{link.name}.kelvin_voigt_time", time_constant, 0.1 * time_constant, "s"))
        if link.joint == "revolute":
            reason = "no recording turns the joint fast enough to tell it from the link's own inertia"
            words = (reason, "a driven recording whose torque changes faster")
            estimates.append(Estimate(f"{link.name}.hub_inertia", link.hub_inertia, None, "kg m^2", False, *words))
    return tuple(estimates)


def _modes(model: Model) -> tuple[ModeComparison, ...]:
    found = model.modes()
    seen = 2 if len(model.rig.links[0].markers) > 1 else 1
    return tuple(
        ModeComparison(
            float(frequency),
            float(frequency) * 1.002 if i < seen else None,
            float(frequency) * 1e-3 if i < seen else None,
            float(ratio),
            float(ratio) * 1.1 if i < seen else None,
            0.9987 if i < seen else None,
        )
        for i, (frequency, ratio) in enumerate(zip(found.frequencies[:3], found.damping_ratios[:3], strict=True))
    )


def _fit(
    model: Model, nominal: Model, torque: Model | None, recording: Recording, replayer: Replayer
) -> RecordingComparison:
    noise = (model.marker_noise, model.encoder_noise)
    if recording.theta.size and not np.isfinite(recording.tau).any():
        return RecordingComparison(recording, noise, None, problem="no torque was measured")
    others = replayer(nominal, recording), None if torque is None else replayer(torque, recording)
    return RecordingComparison(recording, noise, replayer(model, recording), *others)


def two_link_experiment() -> Experiment:
    """An elbow: two driven links, the second with lateral deflections only, in its own frame."""
    links = (
        Link("upper", "revolute", 0.6, 0.3, 4.0, (0.2, 0.4, 0.6), hub_inertia=0.01),
        Link("fore", "revolute", 0.4, 0.1, 1.0, (0.1, 0.2, 0.3, 0.4), hub_inertia=2e-3, markers_frame="link"),
    )
    rig = Rig("elbow", links, (0.0, 0.0), 3e-4, 1e-4)
    recordings = tuple(_drive(rig, number) for number in range(3))
    unmeasured = replace(recordings[1], kind="decay", file="no_torque.csv", tau=np.full_like(recordings[1].tau, np.nan))
    return Experiment(rig, (*recordings, unmeasured))


def _drive(rig: Rig, number: int) -> Recording:
    time = np.arange(0, 1.5, 0.01)
    swing = np.array([0.4, 0.1]) * np.sin(2 * np.pi * (0.8 + 0.3 * number) * time)[:, None]
    blank = Recording(
        time,
        np.full((time.size, 7, 2), np.nan),
        np.full((time.size, 2), np.nan),
        swing,
        kind="driven",
        role="holdout" if number == 2 else "train",
        file=f"drive_{number}.csv",
    )
    chain = _chain(rig, 3, 1.05, 2e-3)
    moved = simulate(chain, rig, blank, np.zeros(chain.size), np.zeros(chain.size))
    noise = np.random.default_rng(number)
    markers = moved.markers + 3e-4 * noise.standard_normal(moved.markers.shape)
    markers[:, 3:, 0] = np.nan  # lateral only
    markers[50:55, 2] = np.nan  # occluded for a moment
    theta = moved.theta + 1e-4 * noise.standard_normal(moved.theta.shape)
    return replace(blank, theta=theta, markers=markers)


def hub_chain() -> Chain:
    """A driven steel link of four virtual joints."""
    link = Link("beam", "revolute", 1.0, 0.44, 1.9, (0.2, 0.4, 0.6, 0.8, 1.0), hub_inertia=0.02)
    return _chain(Rig("steel link", (link,), (0.0, 0.0), 3e-4, 1e-4), 4, 1.0, 3e-4)


@cache
def demo_fit() -> Identification:
    """The demo's beam."""
    return make_fit(load_experiment(DEMO), 4, 1.0388, 3.07e-4, torque=1.0375)


@cache
def torque_fit() -> Identification:
    """The same by the torque method alone."""
    return make_fit(load_experiment(DEMO), 4, 1.0388, 3.07e-4)


@cache
def hub_fit() -> Identification:
    """One driven link, eight recordings."""
    return make_fit(load_experiment(SHARED / "hub_rig" / "experiment.toml"), 4, 0.97, 1e-3, torque=0.96)


@cache
def silicone_fit() -> Identification:
    """One marker."""
    experiment = load_experiment(SHARED / "silicone_beam" / "experiment.toml")
    return make_fit(experiment, 1, 1.02, 4e-3, marker_noise=1.5e-4, torque=1.0)


@cache
def elbow_fit() -> Identification:
    """Two links, two frames, a recording that cannot be simulated."""
    return make_fit(two_link_experiment(), 3, 1.05, 2e-3, torque=1.04)


FITS = {"demo": demo_fit, "torque": torque_fit, "hub": hub_fit, "silicone": silicone_fit, "elbow": elbow_fit}


def pictures_of(fit: Identification) -> list[Picture]:
    """The pictures of one of these fits, drawn once."""
    if id(fit) not in _DRAWN:
        _DRAWN[id(fit)] = identification_pictures(fit)
    return _DRAWN[id(fit)]


_DRAWN: dict[int, list[Picture]] = {}
