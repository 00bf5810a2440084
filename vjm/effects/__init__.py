"""What a model may lack: candidate physics and sensor faults, one small class each."""

from vjm.effects.bending import (
    CubicStiffness,
    Hysteresis,
    RestCurvature,
    StiffnessDrift,
    StructuralDamping,
    UnmodelledMode,
    ViscoelasticCreep,
)
from vjm.effects.drag import LinearDrag, QuadraticDrag
from vjm.effects.effect import Effect, Motion, Parameter, RateIndependentUpdate, magnitude, shape_parameter
from vjm.effects.joint import CoulombFriction, JointSpring, TorqueGain, TorqueOffset, ViscousFriction
from vjm.effects.root import Backlash, ClampCompliance, GearElasticity
from vjm.effects.sensors import (
    CameraRotation,
    CameraScale,
    ClockScale,
    EncoderOffset,
    LensDistortion,
    MarkerOffset,
    RollingShutter,
    TimeOffset,
)
from vjm.effects.tip import ExternalTone, InPlaneGravity, TipPayload
from vjm.errors import ChoiceError

# All that comes with vjm, absent: mechanics first, then sensors.
BUILTIN: tuple[Effect, ...] = (
    TipPayload(),
    InPlaneGravity(),
    CoulombFriction(),
    ViscousFriction(),
    JointSpring(),
    TorqueGain(),
    TorqueOffset(),
    GearElasticity(),
    Backlash(),
    ClampCompliance(),
    LinearDrag(),
    QuadraticDrag(),
    StructuralDamping(),
    ViscoelasticCreep(),
    Hysteresis(),
    CubicStiffness(),
    StiffnessDrift(),
    RestCurvature(),
    ExternalTone(),
    UnmodelledMode(),
    TimeOffset(),
    ClockScale(),
    CameraScale(),
    CameraRotation(),
    EncoderOffset(),
    LensDistortion(),
    RollingShutter(),
    MarkerOffset(),
)
_KNOWN = {effect.id: effect for effect in BUILTIN}


def by_id(identifier: str) -> Effect:
    """The built-in effect with an id, absent.

    Raises:
        ChoiceError: there is none.
    """
    if identifier not in _KNOWN:
        raise ChoiceError("effect", identifier, _KNOWN)
    return _KNOWN[identifier]


__all__ = [
    "BUILTIN",
    "Backlash",
    "CameraRotation",
    "CameraScale",
    "ClampCompliance",
    "ClockScale",
    "CoulombFriction",
    "CubicStiffness",
    "Effect",
    "EncoderOffset",
    "ExternalTone",
    "GearElasticity",
    "Hysteresis",
    "InPlaneGravity",
    "JointSpring",
    "LensDistortion",
    "LinearDrag",
    "MarkerOffset",
    "Motion",
    "Parameter",
    "QuadraticDrag",
    "RateIndependentUpdate",
    "RestCurvature",
    "RollingShutter",
    "StiffnessDrift",
    "StructuralDamping",
    "TimeOffset",
    "TipPayload",
    "TorqueGain",
    "TorqueOffset",
    "UnmodelledMode",
    "ViscoelasticCreep",
    "ViscousFriction",
    "by_id",
    "magnitude",
    "shape_parameter",
]
