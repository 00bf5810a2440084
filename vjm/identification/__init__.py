"""Identification of the chain's parameters from recordings."""

from vjm.identification.identify import identify
from vjm.identification.parameters import PARAMETRISATIONS
from vjm.identification.records import METHODS, Identification
from vjm.identification.uncertainty import bootstrap, profile_interval

__all__ = ["METHODS", "PARAMETRISATIONS", "Identification", "bootstrap", "identify", "profile_interval"]
