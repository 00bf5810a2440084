"""Identification of the chain's parameters from recordings."""

from vjm.identification.assess import fit_recordings
from vjm.identification.identify import identify
from vjm.identification.parameters import PARAMETRISATIONS
from vjm.identification.records import METHODS, Identification, ModeComparison, TorqueData
from vjm.identification.resampling import ProfileInterval, Resampled, bootstrap, profile_interval
from vjm.records import RecordingComparison

__all__ = [
    "METHODS",
    "PARAMETRISATIONS",
    "Identification",
    "ModeComparison",
    "ProfileInterval",
    "RecordingComparison",
    "Resampled",
    "TorqueData",
    "bootstrap",
    "fit_recordings",
    "identify",
    "profile_interval",
]
