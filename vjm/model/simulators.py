"""Files for simulators beside a chain's URDF, which has no springs: MJCF, SDF, or a script that sets the springs up."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from vjm.chain.virtual_links import Chain
from vjm.errors import ChoiceError, ShapeError
from vjm.model.dynamics import Mechanism
from vjm.model.urdf import Body, Inertial, Joint, bodies_of, template
from vjm.records import Array

# Simulators and how the file that each reads beside the URDF ends.
SIMULATORS: Mapping[str, str] = {
    "pinocchio": ".py",
    "mujoco": ".xml",
    "gazebo": ".sdf",
    "drake": ".py",
    "pybullet": ".py",
}
_FRAME = 0.01  # s; between positions of the tip that the scripts return; all steps are whole parts of it
_STEP = 0.25  # over the largest eigenvalue's inverse; Runge-Kutta's fourth-order error is then 4e-5 of that mode
_BULLET_SUBSTEPS = 4  # PyBullet's steps are of first order
_BEND = 0.1  # rad; of each link, from which the scripts and MuJoCo's keyframe release the arm


class _Movable(NamedTuple):
    """A joint that moves, with what acts there.

    Its spring is at rest at `reference` [rad or m]; its drive has an inertia of `armature`; below `slip_rate` [rad/s]
    a step of the simulation may bring its dry friction to rest.
    """

    joint: Joint
    active: bool
    stiffness: float
    reference: float
    damping: float
    armature: float
    slip_rate: float
    start: float


class _Site(NamedTuple):
    """A marker on the x axis of a body [m]."""

    name: str
    body: str
    x: float


def simulator_file(
    chain: Chain,
    simulator: str,
    urdf: str,
    friction: Mapping[str, float] | None = None,
    markers: Sequence[Sequence[float]] = (),
    left_out: Sequence[str] = (),
) -> str:
    """Return what a simulator reads beside the URDF of a chain, with springs, dampers, friction and gravity.

    MuJoCo gets MJCF and Gazebo SDF, each complete in itself; Pinocchio, Drake and PyBullet a Python script that loads
    the URDF and sets the springs up. Joints, bodies and coordinates are those of the URDF, every number exact.

    Args:
        chain: the arm.
        simulator: one of `SIMULATORS`.
        urdf: name of the URDF file beside it, which a script loads.
        friction: dry friction at active joints, by their link's name [N m].
        markers: for each link, arc lengths of its markers [m]. They lie on the virtual links, which are chords of the
            curve on which vjm has them: with the link bent, up to a hundredth of its length away.
        left_out: effects that it does not have, for a comment.

    Raises:
        ChoiceError: another simulator.
        ShapeError: as of `chain_to_urdf`; a base under load without a spring to carry it; drives whose inertia the
            simulator has no place for.
    """
    if simulator not in SIMULATORS:
        raise ChoiceError("simulator", simulator, SIMULATORS)
    if chain.armature and simulator in ("gazebo", "pybullet"):
        raise ShapeError("armature", chain.armature, f"zero, for {simulator}; a hub_inertia turns with the arm")
    base, joints = bodies_of(chain, friction or {})
    step, compliance = _step_and_compliance(chain)
    movable = _movable_joints(chain, joints, step * compliance)
    suffix = SIMULATORS[simulator]
    name = f"{simulator}.py.jinja" if suffix == ".py" else {".xml": "mjcf.xml.jinja", ".sdf": "world.sdf.jinja"}[suffix]
    return template(name).render(
        chain=chain,
        base=base,
        joints=_with_payloads(joints) if simulator == "gazebo" else joints,
        movable={one.joint.name: one for one in movable},
        sites=_sites(chain, markers),
        tip=f"{chain.links[-1].name}_tip",
        armature=[one.armature for one in movable] if chain.armature else None,
        step=step,
        substeps=_BULLET_SUBSTEPS,
        frame=_FRAME,
        urdf=urdf,
        left_out=[text.replace("--", "- -") for text in left_out],  # XML has no -- in a comment
    )


def _step_and_compliance(chain: Chain) -> tuple[float, Array]:
    """Time step [s] that resolves the fastest mode of the chain at zero, and (nv,) the inverse of what joints feel."""
    q = np.zeros((1, chain.size))
    inverse = np.linalg.inv(Mechanism(chain).mass_matrix(q)[0])
    zero, identity = np.zeros_like(inverse), np.eye(chain.size)
    slopes = np.block([[zero, identity], [-inverse * chain.stiffness, -inverse * chain.damping]])
    fastest = float(np.abs(np.linalg.eigvals(slopes)).max())
    return _FRAME / max(1, math.ceil(_FRAME * fastest / _STEP)), np.diag(inverse)


def _movable_joints(chain: Chain, joints: Sequence[Joint], slip: Array) -> list[_Movable]:
    """Joints of the coordinates, in their order; slip (nv,) is the change of rate in a step under a torque of one."""
    reference, armature, start = np.zeros(chain.size), np.zeros(chain.size), np.zeros(chain.size)
    armature[chain.active] = chain.armature
    for link, part in zip(chain.links, chain.passive_slices, strict=True):
        start[part] = _BEND / link.virtual_joints
    if chain.base is not None:
        weight = Mechanism(chain).base_weight
        if weight and not chain.base.stiffness:
            raise ShapeError("base.stiffness", 0.0, "a positive stiffness, since the base carries a weight")
        reference[0] = -weight / chain.base.stiffness if weight else 0.0
    moving = [joint for joint in joints if joint.type != "fixed"]
    return [
        _Movable(
            joint, bool(k in chain.active), float(chain.stiffness[k]), float(reference[k]), float(chain.damping[k]),
            float(armature[k]), float(joint.friction * slip[k]) or 1.0, float(start[k]),
        )
        for k, joint in enumerate(moving)
    ]  # fmt: skip


def _sites(chain: Chain, markers: Sequence[Sequence[float]]) -> list[_Site]:
    sites = []
    for link, arcs in zip(chain.links, markers, strict=False):
        starts = np.concatenate([[0.0], link.joint_arcs])
        for k, arc in enumerate(arcs, 1):
            j = int(np.searchsorted(link.joint_arcs, arc))
            sites.append(_Site(f"{link.name}.m{k}", f"{link.name}_virtual_{j}_link", float(arc - starts[j])))
    return sites


def _with_payloads(joints: Sequence[Joint]) -> list[Joint]:
    """Joints whose bodies have an inertia that SDF takes, which is positive: payloads are part of the link they are on.

    The payload's point mass m at the distance d from the composite's centre adds m d^2 to its moments.
    """
    at = {joint.body.name: joint for joint in joints}
    merged = dict(at)
    for joint in joints:
        point = joint.body.inertial
        if joint.type != "fixed" or not point.mass or point.izz:
            continue
        tip = at[joint.parent]
        carrier = merged[tip.parent]
        body = carrier.body.inertial
        mass = body.mass + point.mass
        center = (body.mass * body.center + point.mass * tip.x) / mass
        added = body.mass * (body.center - center) ** 2 + point.mass * (tip.x - center) ** 2
        whole = Inertial(mass, center, body.ixx, body.iyy + added, body.izz + added)
        merged[tip.parent] = carrier._replace(body=carrier.body._replace(inertial=whole))
        shown = Body(joint.body.name, shapes=joint.body.shapes)
        merged[joint.body.name] = joint._replace(body=shown)
    return list(merged.values())
