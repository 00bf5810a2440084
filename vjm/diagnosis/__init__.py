"""Diagnosis: what a model gets wrong, why, and what is gained by adding the cause."""

from vjm.diagnosis.diagnose import diagnose
from vjm.diagnosis.records import Diagnosis

__all__ = ["Diagnosis", "diagnose"]
