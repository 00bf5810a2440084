"""Effects that a model may lack: candidate physics and sensor faults, one small class each."""

from vjm.effects import actuator, bending, camera, joint, loads, sensors
from vjm.effects.actuator import ActuatorLag as ActuatorLag
from vjm.effects.actuator import Cogging as Cogging
from vjm.effects.actuator import TorqueSaturation as TorqueSaturation
from vjm.effects.bending import CubicStiffness as CubicStiffness
from vjm.effects.bending import Hysteresis as Hysteresis
from vjm.effects.bending import RestCurvature as RestCurvature
from vjm.effects.bending import StiffnessAsymmetry as StiffnessAsymmetry
from vjm.effects.bending import StiffnessDrift as StiffnessDrift
from vjm.effects.bending import StructuralDamping as StructuralDamping
from vjm.effects.bending import Taper as Taper
from vjm.effects.bending import UnmodelledMode as UnmodelledMode
from vjm.effects.bending import ViscoelasticCreep as ViscoelasticCreep
from vjm.effects.camera import CameraRotation as CameraRotation
from vjm.effects.camera import CameraScale as CameraScale
from vjm.effects.camera import CameraTilt as CameraTilt
from vjm.effects.camera import CameraTranslation as CameraTranslation
from vjm.effects.camera import CameraVibration as CameraVibration
from vjm.effects.camera import LensDistortion as LensDistortion
from vjm.effects.camera import RollingShutter as RollingShutter
from vjm.effects.effect import Effect as Effect
from vjm.effects.effect import Parameter as Parameter
from vjm.effects.effect import StateFunction as StateFunction
from vjm.effects.effect import magnitude as magnitude
from vjm.effects.effect import shape_parameter as shape_parameter
from vjm.effects.joint import Backlash as Backlash
from vjm.effects.joint import BaseCompliance as BaseCompliance
from vjm.effects.joint import ClampCompliance as ClampCompliance
from vjm.effects.joint import CoulombFriction as CoulombFriction
from vjm.effects.joint import GearElasticity as GearElasticity
from vjm.effects.joint import HubRadius as HubRadius
from vjm.effects.joint import JointSpring as JointSpring
from vjm.effects.joint import Stribeck as Stribeck
from vjm.effects.joint import TorqueGain as TorqueGain
from vjm.effects.joint import TorqueOffset as TorqueOffset
from vjm.effects.joint import ViscousFriction as ViscousFriction
from vjm.effects.loads import ExternalTone as ExternalTone
from vjm.effects.loads import InPlaneGravity as InPlaneGravity
from vjm.effects.loads import LinearDrag as LinearDrag
from vjm.effects.loads import MarkerMass as MarkerMass
from vjm.effects.loads import PayloadBody as PayloadBody
from vjm.effects.loads import QuadraticDrag as QuadraticDrag
from vjm.effects.loads import TipPayload as TipPayload
from vjm.effects.sensors import ClockScale as ClockScale
from vjm.effects.sensors import EncoderEccentricity as EncoderEccentricity
from vjm.effects.sensors import EncoderOffset as EncoderOffset
from vjm.effects.sensors import MarkerDatum as MarkerDatum
from vjm.effects.sensors import MarkerOffset as MarkerOffset
from vjm.effects.sensors import TimeOffset as TimeOffset
from vjm.effects.sensors import TimestampJitter as TimestampJitter

# One absent instance of each public effect in these modules.
BUILTIN: tuple[Effect, ...] = tuple(
    kind()
    for module in (loads, joint, actuator, bending, camera, sensors)
    for name, kind in vars(module).items()
    if isinstance(kind, type) and issubclass(kind, Effect) and kind.__module__ == module.__name__ and name[0] != "_"
)
