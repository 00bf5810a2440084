"""Symptoms: what is wrong with the simulation of recordings, shown before any cause is named."""

from __future__ import annotations

from vjm.symptoms.find import Symptoms, symptoms
from vjm.symptoms.records import Estimate, Followed, Kind, Symptom

__all__ = ["Estimate", "Followed", "Kind", "Symptom", "Symptoms", "symptoms"]
