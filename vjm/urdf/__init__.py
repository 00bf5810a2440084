"""The virtual-joint chain as URDF, written from `urdf_templates` and read back exactly."""

from vjm.urdf.read import chain_from_urdf, friction_from_urdf
from vjm.urdf.write import chain_to_urdf

__all__ = ["chain_from_urdf", "chain_to_urdf", "friction_from_urdf"]
