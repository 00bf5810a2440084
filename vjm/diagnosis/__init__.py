"""Diagnosis: what a model gets wrong, why, and what is gained by adding the cause."""

from vjm.diagnosis.check_effect import check_effect
from vjm.diagnosis.diagnose import diagnose
from vjm.diagnosis.records import Alternative, Candidate, Cause, Diagnosis, Gain, Remaining
from vjm.records import RecordingComparison

__all__ = [
    "Alternative",
    "Candidate",
    "Cause",
    "Diagnosis",
    "Gain",
    "RecordingComparison",
    "Remaining",
    "check_effect",
    "diagnose",
]
