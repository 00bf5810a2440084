"""A robot of two motors and a tube that bends and twists: its URDF, and MuJoCo's simulation of a far finer chain.

Both descriptions are written by hand from the same numbers; MuJoCo's tube is cut evenly into twelve, by no code of vjm.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ARCS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)  # of the markers along the tube [m]
BESIDE = ((0.0, 0.09, 0.01), (0.0, -0.09, 0.01))  # of two markers on a bar across it, at each of them [m]
_FINE = 12


@dataclass(frozen=True)
class Tube:
    """The robot: a tube of length 0.6 m along x behind a yaw and a pitch joint, with a tool on its end."""

    length: float = 0.6
    mass: float = 0.25
    bending: tuple[float, float] = (45.0, 33.0)  # EI about y and z [N m^2]
    torsion: float = 15.0  # GJ [N m^2]
    kelvin_voigt: float = 3e-3  # [s]
    tool: float = 0.3  # [kg]
    beside: float = 0.1  # the tool's centre, along y [m]

    @property
    def section(self) -> Array:
        """Inertia of the section per mass about x, y, z [m^2]."""
        return np.array([2e-4, 1e-4, 1e-4])

    def inertia(self, length: float) -> Array:
        """Principal inertia of a piece of the tube [kg m^2]."""
        return self.mass * length / self.length * (self.section + np.array([0.0, length**2 / 12, length**2 / 12]))

    @property
    def urdf(self) -> str:
        """The robot with a stiff tube."""
        ixx, iyy, izz = (repr(float(value)) for value in self.inertia(self.length))
        return f"""<robot name="tube_robot">
  <link name="base"/>
  <joint name="yaw" type="revolute">
    <parent link="base"/><child link="shoulder"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="100" velocity="10"/>
  </joint>
  <link name="shoulder">
    <inertial>
      <mass value="1.5"/>
      <inertia ixx="0.004" ixy="0" ixz="0" iyy="0.004" iyz="0" izz="0.006"/>
    </inertial>
  </link>
  <joint name="pitch" type="revolute">
    <parent link="shoulder"/><child link="tube"/>
    <origin xyz="0.05 0 0.1"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="100" velocity="10"/>
  </joint>
  <link name="tube">
    <inertial>
      <origin xyz="{self.length / 2} 0 0"/>
      <mass value="{self.mass}"/>
      <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/>
    </inertial>
  </link>
  <joint name="flange" type="fixed">
    <parent link="tube"/><child link="tool"/><origin xyz="{self.length} 0 0"/>
  </joint>
  <link name="tool">
    <inertial>
      <origin xyz="0 {self.beside} 0"/>
      <mass value="{self.tool}"/>
      <inertia ixx="0.0006" ixy="0" ixz="0" iyy="0.0004" iyz="0" izz="0.0005"/>
    </inertial>
  </link>
</robot>
"""

    @property
    def markers(self) -> list[tuple[float, tuple[float, float, float]]]:
        """Arc length along the tube and offset there of every marker [m]."""
        return [(arc, offset) for arc in ARCS for offset in BESIDE]

    @property
    def mjcf(self) -> str:
        """The robot whose tube is cut into thirteen pieces, half ones at its ends."""
        h = self.length / _FINE
        pieces = np.array([h / 2, *[h] * (_FINE - 1), h / 2])
        # Midpoints miss 1 / 4n^2 of the integral of (L - s)^2, the deflection by a force on the tip.
        return self.mjcf_of(pieces, np.full(_FINE, h / (1 - 1 / (4 * _FINE**2))), np.full(_FINE, h))

    def mjcf_of(self, lengths: Array, cells: Array, twist_cells: Array) -> str:
        """The robot whose tube is cut into n + 1 pieces, joined by hinges that stand for cells (n,) of it."""
        pieces = lengths.tolist()
        text, closing, arc = "", "", 0.0
        for number, piece in enumerate(pieces):
            if number:
                j = number - 1
                stiffness = np.array([*self.bending, self.torsion]) / (cells[j], cells[j], twist_cells[j])
                text += f'<body pos="{pieces[number - 1]!r} 0 0">'
                closing += "</body>"
                for name, axis, value in zip("yzx", ("0 1 0", "0 0 1", "1 0 0"), stiffness.tolist(), strict=True):
                    text += (
                        f'<joint name="{name}{number}" axis="{axis}" stiffness="{value!r}" '
                        f'damping="{self.kelvin_voigt * value!r}"/>'
                    )
            mass = self.mass * piece / self.length
            inertia = " ".join(repr(float(value)) for value in self.inertia(piece))
            text += f'<inertial pos="{piece / 2!r} 0 0" mass="{mass!r}" diaginertia="{inertia}"/>'
            for m, (place, offset) in enumerate(self.markers):
                if arc - 1e-9 <= place < arc + piece - 1e-9 or (
                    number == len(pieces) - 1 and place >= self.length - 1e-9
                ):
                    text += f'<site name="m{m}" pos="{place - arc!r} {offset[1]} {offset[2]}"/>'
            arc += piece
        text += (
            f'<body pos="{pieces[-1]!r} 0 0"><inertial pos="0 {self.beside} 0" mass="{self.tool}" '
            'diaginertia="0.0006 0.0004 0.0005"/></body>'
        )
        return f"""<mujoco><compiler angle="radian"/>
  <option timestep="5e-5" integrator="implicitfast" gravity="0 0 -9.81"/>
  <worldbody><body pos="0 0 0.3"><joint name="yaw" axis="0 0 1" armature="0.02"/>
    <inertial pos="0 0 0" mass="1.5" diaginertia="0.004 0.004 0.006"/>
    <body pos="0.05 0 0.1"><joint name="pitch" axis="0 1 0" armature="0.02"/>{text}{closing}</body></body></worldbody>
  <actuator><position joint="yaw" kp="200" kv="8"/><position joint="pitch" kp="200" kv="8"/></actuator></mujoco>"""


@dataclass(frozen=True)
class Motion:
    """A simulated motion at the camera's instants."""

    time: Array  # (T,) [s]
    q: Array  # (T, 2) of the motors [rad]
    v: Array
    a: Array
    torque: Array  # (T, 2) [N m]
    markers: Array  # (T, k, 3) [m]
    passive: Array  # (T, n) angles of the springs, in MuJoCo's order [rad]


def simulate(robot: str | mujoco.MjModel, motors: list[str], targets: Array, rate: float, markers: int) -> Motion:
    """Integrate a robot whose motors follow targets (T, n) given at the camera's rate [Hz], linear between them."""
    model = mujoco.MjModel.from_xml_string(robot) if isinstance(robot, str) else robot
    data = mujoco.MjData(model)
    dofs = [model.joint(name).dofadr[0] for name in motors]
    sites = [model.site(f"m{m}").id for m in range(markers)]
    steps = round(1 / rate / model.opt.timestep)
    split = max(1, steps // 10)  # targets are linear in ten pieces a frame
    data.qpos[dofs] = targets[0]
    rows = []
    for k in range(len(targets)):
        data.ctrl[:] = targets[k]
        mujoco.mj_forward(model, data)
        torque = data.actuator_force + 0.0
        springs = np.delete(data.qpos, dofs)
        rows.append((data.qpos[dofs], data.qvel[dofs], data.qacc[dofs], torque, data.site_xpos[sites], springs))
        after = targets[min(k + 1, len(targets) - 1)]
        for part in range(0, steps, split):
            data.ctrl[:] = targets[k] + (after - targets[k]) * part / steps
            mujoco.mj_step(model, data, nstep=min(split, steps - part))
    q, v, a, torque, places, springs = (np.array(column) for column in zip(*rows, strict=True))
    return Motion(np.arange(len(targets)) / rate, q, v, a, torque, places, springs)


def wandering(
    duration: float,
    rate: float,
    seed: int,
    highest: float = 15.0,
    size: float = 0.04,
    around: tuple[float, ...] = (0.0, -0.3),
) -> Array:
    """Targets (T, n) of all motors [rad] around a posture: sums of tones up to a frequency [Hz], faded in."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * rate)) / rate
    tones = np.linspace(0.5, highest, 24)
    phases = rng.uniform(0, 2 * np.pi, (len(around), tones.size))
    weights = size / tones
    signal = np.sin(2 * np.pi * tones * t[:, None, None] + phases) @ weights
    return signal * np.minimum(t / 0.5, 1.0)[:, None] + np.array(around)
