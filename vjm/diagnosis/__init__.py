"""What a model gets wrong, why, and what is gained by adding the cause."""

from vjm.diagnosis.contract import check_effect
from vjm.diagnosis.records import Candidate, Cause, Diagnosis, Gain, Remaining, Replayed, Rival, Size
from vjm.diagnosis.run import diagnose

__all__ = [
    "Candidate",
    "Cause",
    "Diagnosis",
    "Gain",
    "Remaining",
    "Replayed",
    "Rival",
    "Size",
    "check_effect",
    "diagnose",
]
