"""Open-loop simulation of recordings, its derivatives, and replay from the most likely initial state."""

from vjm.records import SimulatedRecording, Simulation
from vjm.simulation.initial_state import replay, replays
from vjm.simulation.integrate import INTEGRATORS, default_step, rollout, rollouts, simulate

__all__ = [
    "INTEGRATORS",
    "SimulatedRecording",
    "Simulation",
    "default_step",
    "replay",
    "replays",
    "rollout",
    "rollouts",
    "simulate",
]
