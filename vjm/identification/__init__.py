"""Identification of the chain's parameters from recordings."""

from vjm.identification.assess import fit_recordings
from vjm.identification.parametrisation import PARAMETRISATIONS
from vjm.identification.records import (
    METHODS,
    Identification,
    ModeComparison,
    RecordingFit,
    TorqueData,
)
from vjm.identification.run import identify

__all__ = [
    "METHODS",
    "PARAMETRISATIONS",
    "Identification",
    "ModeComparison",
    "RecordingFit",
    "TorqueData",
    "fit_recordings",
    "identify",
]
