"""What a model gets wrong, why, and what is gained by adding the cause."""

from vjm.diagnosis.contract import check_effect
from vjm.diagnosis.records import Candidate, Cause, Diagnosis, Followed, Gain, Remaining, Rival, Size
from vjm.diagnosis.run import diagnose

__all__ = [
    "Candidate",
    "Cause",
    "Diagnosis",
    "Followed",
    "Gain",
    "Remaining",
    "Rival",
    "Size",
    "check_effect",
    "diagnose",
]
