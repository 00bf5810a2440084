"""Write an identified chain as URDF, read it with Pinocchio, and let it swing.

A virtual joint's stiffness K and damping D are torques that the user of a URDF applies: tau = -K q - D v.

python examples/urdf_in_pinocchio.py [model.json]       (without it: vjm-out/model.json, which `vjm demo` writes)
"""

import sys
from pathlib import Path

import numpy as np
import pinocchio as pin

from vjm.model.modes import modes
from vjm.model.urdf import chain_to_urdf
from vjm.report.model_json import read_model

STEP = 1e-4  # s


def main(file: Path | str = "vjm-out/model.json") -> None:
    chain, _ = read_model(file)
    Path("arm.urdf").write_text(chain_to_urdf(chain), encoding="utf-8")

    model = pin.buildModelFromUrdf("arm.urdf")
    model.gravity.linear = np.array([*chain.gravity, 0.0])  # a URDF cannot say where down is
    assert tuple(model.names)[1:] == chain.joint_names
    data, rest = model.createData(), pin.neutral(model)
    tip = model.getFrameId(f"{chain.links[-1].name}_tip")

    found = modes(chain)
    shape = found.shapes[:, 0]
    q, v = pin.integrate(model, rest, 0.02 * shape / np.abs(shape).max()), np.zeros(model.nv)
    period = 1 / found.frequencies[0]
    heights = []
    for _ in range(int(2.25 * period / STEP)):
        pin.framesForwardKinematics(model, data, q)
        heights.append(data.oMf[tip].translation[1])
        # `difference` and `integrate` instead of - and +: an active joint, `continuous` in URDF, has two numbers in q.
        torque = -chain.stiffness * pin.difference(model, rest, q) - chain.damping * v
        v = v + STEP * pin.aba(model, data, q, v, torque)
        q = pin.integrate(model, q, STEP * v)

    falls = np.flatnonzero(np.diff(np.sign(heights)) == -2 * np.sign(heights[0])) * STEP
    print(f"arm.urdf: {model.nv} joints")
    print(f"first mode: {1 / np.diff(falls).mean():.4f} Hz in Pinocchio, {found.frequencies[0]:.4f} Hz by vjm.modes")


if __name__ == "__main__":
    main(*sys.argv[1:])
