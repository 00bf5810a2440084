"""Identification of the chain's parameters from recordings."""

from vjm.identification.assess import fit_recordings
from vjm.identification.records import (
    METHODS,
    PARAMETERS,
    Identification,
    ModeComparison,
    RecordingFit,
    TorqueData,
)
from vjm.identification.run import identify

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
