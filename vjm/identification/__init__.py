"""Identification of the chain's parameters from recordings."""

from vjm.identification.assess import fit_recordings
from vjm.identification.parametrisation import PARAMETRISATIONS
from vjm.identification.profile import ProfileInterval, profile_interval
from vjm.identification.records import (
    METHODS,
    Identification,
    ModeComparison,
    RecordingFit,
    TorqueData,
)
from vjm.identification.resampling import Resampled, bootstrap
from vjm.identification.run import identify

__all__ = [
    "METHODS",
    "PARAMETRISATIONS",
    "Identification",
    "ModeComparison",
    "ProfileInterval",
    "RecordingFit",
    "Resampled",
    "TorqueData",
    "bootstrap",
    "fit_recordings",
    "identify",
    "profile_interval",
]
