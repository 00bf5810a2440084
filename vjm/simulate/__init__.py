"""Open-loop simulation of recordings, and replay from the most likely initial state."""

from vjm.simulate.initial_state import Replay, replay
from vjm.simulate.integrators import INTEGRATORS
from vjm.simulate.rollout import Simulation, default_step, rollout, simulate

__all__ = ["INTEGRATORS", "Replay", "Simulation", "default_step", "replay", "rollout", "simulate"]
