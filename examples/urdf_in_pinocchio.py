"""Write an identified chain as URDF, read it with Pinocchio, and let it swing.

A virtual joint's stiffness K and damping D are torques that the user of a URDF applies: tau = -K q - D v. D is in the
joints' own elements; K, for which URDF has none, is in the element `vjm:model`.

python examples/urdf_in_pinocchio.py [model.json]       (without it: vjm-out/model.json, which `vjm demo` writes)
"""

import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from scipy.linalg import eigh

from vjm.cli import main as vjm

STEP = 1e-4  # s
VJM = "{urn:vjm:urdf}"


def main(file: Path | str = "vjm-out/model.json") -> None:
    vjm(["urdf", str(file), "-o", "arm.urdf", "-q"])

    model = pin.buildModelFromUrdf("arm.urdf")
    data, rest, size = model.createData(), pin.neutral(model), model.nv
    stiffness, damping = np.zeros(size), model.damping
    extension = ElementTree.parse("arm.urdf").find(f"{VJM}model")
    gravity = [float(component) for component in extension.get("gravity").split()]
    model.gravity.linear = np.array([*gravity, 0.0])  # a URDF cannot say where down is
    for element in (*extension.iter(f"{VJM}root_joint"), *extension.iter(f"{VJM}virtual_joint")):
        joint = model.joints[model.getJointId(element.get("name"))]
        stiffness[joint.idx_v] = float(element.get("stiffness"))

    mass_matrix = np.triu(pin.crba(model, data, rest))
    mass_matrix += np.triu(mass_matrix, 1).T
    squares, shapes = eigh(np.diag(stiffness), mass_matrix)
    first = int(np.argmax(squares > 1e-9 * squares[-1]))  # a hub that turns freely has no frequency
    frequency, shape = np.sqrt(squares[first]) / (2 * np.pi), shapes[:, first]

    tip = model.getFrameId(f"{extension[-1].get('name')}_tip")
    q, v = pin.integrate(model, rest, 0.02 * shape / np.abs(shape).max()), np.zeros(size)
    heights = []
    for _ in range(int(2.25 / frequency / STEP)):
        pin.framesForwardKinematics(model, data, q)
        heights.append(data.oMf[tip].translation[1])
        # `difference` and `integrate` instead of - and +: an active joint, `continuous` in URDF, has two numbers in q.
        torque = -stiffness * pin.difference(model, rest, q) - damping * v
        v = v + STEP * pin.aba(model, data, q, v, torque)
        q = pin.integrate(model, q, STEP * v)

    falls = np.flatnonzero(np.diff(np.sign(heights)) == -2 * np.sign(heights[0])) * STEP
    print(f"arm.urdf: {size} joint{'s' * (size > 1)}")
    print(f"first mode: {1 / np.diff(falls).mean():.4f} Hz as it swings, {frequency:.4f} Hz of M and K")


if __name__ == "__main__":
    main(*sys.argv[1:])
