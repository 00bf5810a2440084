"""Open-loop simulation of recordings, its derivatives, and replay from the most likely initial state."""

from vjm.simulation.initial_state import Replay, replay, replays
from vjm.simulation.integrate import INTEGRATORS, Simulation, default_step, rollout, rollouts, simulate

__all__ = [
    "INTEGRATORS",
    "Replay",
    "Simulation",
    "default_step",
    "replay",
    "replays",
    "rollout",
    "rollouts",
    "simulate",
]
