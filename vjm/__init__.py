"""Virtual joint models of flexible robot arms, identified from camera markers."""

from __future__ import annotations

TYPE_CHECKING = False  # `typing` itself is as slow to import as the rest of this
if TYPE_CHECKING:
    from typing import Any

    from vjm import effects
    from vjm.diagnosis import Diagnosis, diagnose
    from vjm.diagnosis.check_effect import check_effect
    from vjm.errors import InputError, VjmError
    from vjm.experiment.load import load_experiment
    from vjm.identification import Identification, bootstrap, identify, profile_interval
    from vjm.identification.check import Check, check
    from vjm.identification.comparison import compare
    from vjm.identification.records import Comparison
    from vjm.identification.robot import RobotIdentification, identify_stiffness
    from vjm.model.flexible import FlexibleModel
    from vjm.model.flexify import flexify
    from vjm.records import Experiment, Link, Recording, Rig
    from vjm.report.model_json import load_model
    from vjm.report.output import save
    from vjm.simulation.model import Model

__all__ = [
    "Check",
    "Comparison",
    "Diagnosis",
    "Experiment",
    "FlexibleModel",
    "Identification",
    "InputError",
    "Link",
    "Model",
    "Recording",
    "Rig",
    "RobotIdentification",
    "VjmError",
    "bootstrap",
    "check",
    "check_effect",
    "compare",
    "diagnose",
    "effects",
    "flexify",
    "identify",
    "identify_stiffness",
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
        "vjm.identification.robot": "RobotIdentification identify_stiffness",
        "vjm.model.flexible": "FlexibleModel",
        "vjm.model.flexify": "flexify",
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
    from importlib import import_module

    if name == "effects":
        return import_module("vjm.effects")
    if name not in _HOMES:
        raise AttributeError(f"module 'vjm' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
