"""Real robots of PyPI's example-robot-data, and robots of known beams."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from vjm.chain.body_inertia import BodyInertia
from vjm.model.flexify import _inertia
from vjm.model.urdf_document import UrdfDocument

Array = NDArray[np.float64]

UR5 = "ur_description/urdf/ur5_robot.urdf"
# A link of each robot with the options that its geometry asks for.
LINKS: dict[str, tuple[str, dict[str, object]]] = {
    "ur5 forearm": (UR5, {"link": "forearm_link"}),
    "ur5 upper arm": (UR5, {"link": "upper_arm_link", "axis": "z"}),
    "panda shoulder": ("panda_description/urdf/panda.urdf", {"link": "panda_link2", "axis": "y"}),
    "panda forearm": ("panda_description/urdf/panda.urdf", {"link": "panda_link4", "bending": "x,z"}),
    "talos forearm": ("talos_data/robots/talos_left_arm.urdf", {"link": "arm_left_4_link"}),
    "anymal thigh": ("anymal_b_simple_description/robots/anymal.urdf", {"link": "LF_THIGH", "axis": "z"}),
    "anymal foot": ("anymal_b_simple_description/robots/anymal.urdf", {"link": "LF_ADAPTER"}),
}


def robot(path: str) -> Path:
    """The file of a robot; skips the test where the package is absent."""
    try:
        package = metadata.distribution("example-robot-data")
    except metadata.PackageNotFoundError:
        pytest.skip("needs example-robot-data")
    return Path(str(package.locate_file("cmeel.prefix/share/example-robot-data/robots"))) / path


def inertia_of(text: str, name: str) -> BodyInertia:
    """The inertia of a link in its own frame."""
    document = UrdfDocument.read(text)
    link = next(link for link in document.robot.all("link") if link.attributes["name"] == name)
    body = _inertia(document, link)
    assert body is not None
    return body


def box_beam(length: float, mass: float, width: float, height: float, tip: float = 0.0) -> str:
    """A uniform bar of `width` along y and `height` along z, from a revolute joint along x, with a mass on its tip."""
    ixx, iyy, izz = mass / 12 * np.array([width**2 + height**2, length**2 + height**2, length**2 + width**2])
    return f"""<robot name="beam">
  <link name="base"/>
  <joint name="motor" type="revolute">
    <parent link="base"/>
    <child link="bar"/>
    <axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="10" velocity="10"/>
  </joint>
  <link name="bar">
    <inertial>
      <origin xyz="{length / 2} 0 0"/>
      <mass value="{mass}"/>
      <inertia ixx="{float(ixx)!r}" ixy="0" ixz="0" iyy="{float(iyy)!r}" iyz="0" izz="{float(izz)!r}"/>
    </inertial>
  </link>
  <joint name="flange" type="fixed">
    <parent link="bar"/>
    <child link="tool"/>
    <origin xyz="{length} 0 0"/>
  </joint>
  <link name="tool">
    <inertial>
      <mass value="{tip}"/>
      <inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>
    </inertial>
  </link>
</robot>
"""


def mass_matrix(model: pin.Model, q: Array) -> Array:
    """M(q), (nv, nv)."""
    upper = np.triu(pin.crba(model, model.createData(), q))
    return upper + np.triu(upper, 1).T


def mujoco_mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """M(q) of MuJoCo's model where its data stand, (nv, nv)."""
    M = np.zeros((model.nv, model.nv))
    for row, unit in zip(M, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    return M
