"""Virtual joint models of flexible robot arms, identified from camera markers."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vjm import effects
    from vjm.diagnosis import Diagnosis, diagnose
    from vjm.diagnosis.check_effect import check_effect
    from vjm.errors import InputError, VjmError
    from vjm.experiment.load import load_experiment
    from vjm.identification import Identification, bootstrap, identify, profile_interval
    from vjm.identification.check import Check, check
    from vjm.identification.comparison import compare
    from vjm.identification.records import Comparison
    from vjm.records import Experiment, Link, Recording, Rig
    from vjm.report.model_json import load_model
    from vjm.report.output import save
    from vjm.simulation.model import Model

__all__ = [
    "Check",
    "Comparison",
    "Diagnosis",
    "Experiment",
    "Identification",
    "InputError",
    "Link",
    "Model",
    "Recording",
    "Rig",
    "VjmError",
    "bootstrap",
    "check",
    "check_effect",
    "compare",
    "diagnose",
    "effects",
    "identify",
    "load_experiment",
    "load_model",
    "profile_interval",
    "save",
]

# Imported when first used: `import vjm` and `vjm --help` stay quick.
_HOMES = {
    name: module
    for module, names in {
        "vjm.diagnosis": "Diagnosis diagnose",
        "vjm.diagnosis.check_effect": "check_effect",
        "vjm.errors": "InputError VjmError",
        "vjm.experiment.load": "load_experiment",
        "vjm.identification": "Identification bootstrap identify profile_interval",
        "vjm.identification.check": "Check check",
        "vjm.identification.comparison": "Comparison compare",
        "vjm.records": "Experiment Link Recording Rig",
        "vjm.report.model_json": "load_model",
        "vjm.report.output": "save",
        "vjm.simulation.model": "Model",
    }.items()
    for name in names.split()
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("vjm")
    if name == "effects":
        return import_module("vjm.effects")
    if name not in _HOMES:
        raise AttributeError(f"module 'vjm' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
