"""Small rigs on which an effect is tried: chains of three virtual joints, and what is recorded on them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vjm.chain.layout import layout, uniform_chain
from vjm.chain.records import Chain, Distal
from vjm.effects.effect import Effect
from vjm.experiment.records import Kind, Link, Recording, Rig
from vjm.simulate.arm import Arm
from vjm.simulate.observation import Arcs
from vjm.simulate.rollout import Simulation, default_step, rollouts, simulation
from vjm.simulate.run import transferred
from vjm.simulate.steps import Steps

Array = NDArray[np.float64]

_JOINTS = 3
_KELVIN_VOIGT = 5e-4  # s
_RATE = 50.0  # frames and encoder readings a second
_HANGING = (9.81, 0.0)  # m/s^2; the arm hangs along its x axis
_INNER = 0.1  # logarithm of an inner parameter over its everyday value: no search starts right there

_DRIVEN = Link("beam", "revolute", 1.0, 0.44, 1.9, (0.2, 0.4, 0.6, 0.8, 1.0), hub_inertia=0.02)
_CLAMPED = replace(_DRIVEN, joint="clamped", hub_inertia=0.0)
_POST = replace(_CLAMPED, name="post", length=0.6, markers=(0.3, 0.6))


@dataclass(frozen=True)
class Trial:
    """One recording to be made.

    Attributes:
        recording: instants, torques and gravity; all measurements are zero.
        state: (2 nv,) initial angles [rad] and rates [rad/s] of the chain without effects.
    """

    recording: Recording
    state: Array


@dataclass(frozen=True)
class Bench:
    """A rig, its chain, and what is recorded on it.

    Attributes:
        rig: the arm.
        chain: of its true values, without effects.
        trials: recordings, the one with the widest motion first.
    """

    rig: Rig
    chain: Chain
    trials: tuple[Trial, ...]

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """Of the trials, with zeros for measurements."""
        return tuple(trial.recording for trial in self.trials)

    def refusal(self, effect: Effect) -> str:
        """Why the effect cannot be tried here, in its own words; empty where it can."""
        reason = effect.untestable(self.rig, self.recordings)
        return reason or ("" if effect.places(self.rig) else "there is no place for it")

    def placed(self, effect: Effect) -> Effect:
        """The last variant here, with everyday sizes, and inner parameters a little off their everyday values."""
        absent = effect.variants(self.rig, self.recordings)[-1]
        coordinates = np.full(absent.coordinates.size, _INNER)
        coordinates[: absent.sizes] = 1.0
        return absent.at(np.clip(coordinates, *absent.bounds))

    def states(self, arm: Arm) -> list[Array]:
        """(2 nv,) initial state of each trial, in the joints of an arm made of this chain."""
        return [transferred(self.chain, arm.chain, trial.state) for trial in self.trials]

    def steps(self, arm: Arm, step: float | None = None) -> list[Steps]:
        """Trajectories of all trials, by an arm made of this chain.

        Args:
            arm: the chain with effects.
            step: [s]; None: the integrator's default.

        Raises:
            SimulationDivergedError: one of them diverged.
        """
        q, v = zip(*(np.split(state, 2) for state in self.states(arm)), strict=True)
        return rollouts([arm] * len(self.trials), self.recordings, q, v, step=step)

    def simulate(self, arm: Arm, step: float | None = None) -> list[Simulation]:
        """The same at the recordings' instants, as the sensors show them."""
        arcs, runs = Arcs.of(self.rig), self.steps(arm, step)
        return [simulation(arm, arcs, *each) for each in zip(self.recordings, runs, strict=True)]

    def beginning(self, duration: float) -> Bench:
        """The first trial alone, and of that the first seconds."""
        trial = self.trials[0]
        recording = trial.recording
        rows = int(np.searchsorted(recording.time, duration, side="right"))
        columns = {name: getattr(recording, name)[:rows] for name in ("time", "theta", "tau", "markers")}
        return replace(self, trials=(replace(trial, recording=replace(recording, **columns)),))

    def undamped(self) -> Bench:
        """The free decays without gravity, of a chain that loses no energy."""
        links = tuple(replace(link, damping=np.zeros(link.damping.size)) for link in self.chain.links)
        free = [each for each in self.trials if each.recording.kind == "decay" and not any(each.recording.gravity)]
        return replace(self, chain=replace(self.chain, links=links), trials=tuple(free))

    def step(self, arm: Arm) -> float:
        """Step [s] with which both an arm and its chain without effects can be simulated."""
        return min(default_step(self.chain), default_step(arm.chain), arm.longest_step)


class _Plan(NamedTuple):
    """One recording: how long [s], driven by which sines (N m, Hz), let go with which bends of the tip [m]."""

    file: str
    kind: Kind
    duration: float
    sines: tuple[tuple[float, float], ...] = ()
    gravity: tuple[float, float] = (0.0, 0.0)
    bends: tuple[float, float] = (0.0, 0.0)


@cache
def benches() -> tuple[Bench, ...]:
    """A driven link with torque and encoder, with and without gravity; and a clamped one, let go from far and near."""
    driven = (
        _Plan("large.csv", "driven", 2.0, ((0.4, 0.7), (0.2, 1.9), (0.1, 5.3)), _HANGING),
        _Plan("small.csv", "driven", 2.0, ((0.06, 0.9), (0.04, 2.3), (0.03, 6.1))),
        _Plan("decay.csv", "decay", 2.0, bends=(0.1, 0.03)),
        _Plan("quiet.csv", "quiet", 2.0),
    )
    clamped = (
        _Plan("large.csv", "decay", 2.0, bends=(0.12, 0.03)),
        _Plan("small.csv", "decay", 2.0, (), _HANGING, (0.03, 0.02)),
        _Plan("quiet.csv", "quiet", 2.0),
    )
    return _bench("driven", (_DRIVEN,), driven), _bench("clamped", (_CLAMPED,), clamped)


@cache
def arm_bench() -> Bench:
    """A driven link on a flexible post, which makes the numbers of links and of active joints differ."""
    return _bench("arm", (_POST, _DRIVEN), (_Plan("drive.csv", "driven", 0.5, ((0.1, 0.9), (0.05, 2.3))),))


def _bench(name: str, links: tuple[Link, ...], plans: tuple[_Plan, ...]) -> Bench:
    rig, parts = Rig(name, links), []
    for link in links:
        distal: Distal = "free" if link is links[-1] else "joined"
        cuts = layout(link.length, _JOINTS, distal=distal)
        parts.append(uniform_chain(link, cuts, kelvin_voigt=_KELVIN_VOIGT, distal=distal))
    chain = Chain(name, tuple(parts))
    return Bench(rig, chain, tuple(Trial(_recording(rig, plan), _bent(chain, *plan.bends)) for plan in plans))


def _recording(rig: Rig, plan: _Plan) -> Recording:
    time = np.arange(round(plan.duration * _RATE) + 1) / _RATE
    joints, markers = len(rig.active_links), sum(len(link.markers) for link in rig.links)
    wave = sum((size * np.sin(2 * np.pi * rate * time + rate) for size, rate in plan.sines), np.zeros(time.size))
    tau = np.repeat((wave * np.minimum(4 * time, 1.0))[:, None], joints, axis=1)
    theta, shown = np.zeros((time.size, joints)), np.zeros((time.size, markers, 2))
    return Recording(plan.file, plan.kind, "train", time, theta, tau, shown, plan.gravity)


def _bent(chain: Chain, first: float, second: float) -> Array:
    """(2 nv,) the last link at rest, bent as by a force on its tip and, on top, about as in its second mode [m]."""
    link, state = chain.links[-1], np.zeros(2 * chain.size)
    arcs = link.joint_arcs / link.length
    curvature = 3 * first * (1 - arcs) + 22 * second * (np.cos(np.pi * arcs * 1.2))
    state[chain.passive_slices[-1]] = curvature * link.cells / link.length**2
    return state
