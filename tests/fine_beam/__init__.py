"""A fine, geometrically exact beam: the independent source of truth behind the tests and the demo's data.

It imports nothing of vjm and is not a chain of rigid links: the heading of the centre line is a smooth function
of arc length.
"""

from tests.fine_beam.beam import Beam, Body, Numerics, State, Trajectory, simulate
from tests.fine_beam.hidden import Physics
from tests.fine_beam.motion import Motion, Run, simulate_runs
from tests.fine_beam.sensor_faults import Faults, shown_angle, shown_markers
from tests.fine_beam.sensors import Camera, Encoder, Frames, film, observe, read_encoder
from tests.fine_beam.states import Modes, linear_modes, modal_state, rest_state, static_state
from tests.fine_beam.write import LinkRecord, RecordingEntry, write_arm_recording, write_experiment, write_recording

__all__ = [
    "Beam",
    "Body",
    "Camera",
    "Encoder",
    "Faults",
    "Frames",
    "LinkRecord",
    "Modes",
    "Motion",
    "Numerics",
    "Physics",
    "RecordingEntry",
    "Run",
    "State",
    "Trajectory",
    "film",
    "linear_modes",
    "modal_state",
    "observe",
    "read_encoder",
    "rest_state",
    "shown_angle",
    "shown_markers",
    "simulate",
    "simulate_runs",
    "static_state",
    "write_arm_recording",
    "write_experiment",
    "write_recording",
]
