"""Virtual-joint angles read off the markers."""

from vjm.angles.estimate import ANGLE_METHODS, Angles, ShapeSettings, estimate_angles
from vjm.angles.points import chord_angles, representative_points

__all__ = ["ANGLE_METHODS", "Angles", "ShapeSettings", "chord_angles", "estimate_angles", "representative_points"]
