"""Identification of the chain's parameters from recordings."""

from vjm.identification.records import (
    METHODS,
    PARAMETERS,
    Identification,
    ModeComparison,
    RecordingFit,
    TorqueData,
)
from vjm.identification.run import fit_recordings, identify

__all__ = [
    "METHODS",
    "PARAMETERS",
    "Identification",
    "ModeComparison",
    "RecordingFit",
    "TorqueData",
    "fit_recordings",
    "identify",
]
