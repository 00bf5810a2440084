"""Files that simulators read, written from the templates in `urdf_templates`: a virtual-joint chain's URDF and more.

URDF has no springs: beside it goes MJCF, SDF, or a script that sets the springs up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup

from vjm.chain.virtual_links import Chain, LinkChain
from vjm.errors import ShapeError, printable, require_choice
from vjm.files import GENERATED, check_no_folder
from vjm.model.dynamics import Mechanism
from vjm.records import Array

_FOLDER = "urdf_templates"
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
_HUB_MASS = 1e-14  # kg; a hub before a root joint has none, but MuJoCo takes no moving body of less than 1e-15 kg


class _Inertial(NamedTuple):
    """Mass [kg], its centre on the x axis [m] and principal moments of inertia about the centre [kg m^2]."""

    mass: float
    center: float
    ixx: float
    iyy: float
    izz: float


class _Shape(NamedTuple):
    """Visual shape at x [m]: `box` (x, y, z), `cylinder` about z (radius, length) or `sphere` (radius,) [m]."""

    kind: str
    size: tuple[float, ...]
    x: float
    material: str


# Of the ground and of frames: without an inertial element PyBullet would give them 1 kg; with one of no mass, none, and
# a base of no mass stands still.
_NO_MASS = _Inertial(0.0, 0.0, 0.0, 0.0, 0.0)


class _Body(NamedTuple):
    """URDF link; without mass it is a bare frame."""

    name: str
    inertial: _Inertial = _NO_MASS
    shapes: tuple[_Shape, ...] = ()


class _Joint(NamedTuple):
    """URDF joint at x on its parent's x axis [m], and the body that it carries, turned by yaw [rad].

    It turns about z, or slides along `axis` by no more than `reach` [m].
    """

    name: str
    type: str
    parent: str
    x: float
    body: _Body
    damping: float | None = None
    yaw: float = 0.0
    friction: float = 0.0
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    reach: float = 0.0


def chain_to_urdf(chain: Chain, friction: Mapping[str, float] | None = None) -> str:
    """Return the whole arm as URDF.

    Standard elements hold lengths, masses, centres, inertias, damping, friction, payloads and curvature at rest. What
    URDF has no element for, stiffness first of all, is in a `vjm:model` element under `robot`, which other parsers pass
    over. Every number is written exactly.

    The movable joints are `chain.joint_names`, in this order; each flexible link ends in a frame `NAME_tip`.

    Args:
        chain: the arm, with at least one link.
        friction: dry friction at active joints, by their link's name [N m].

    Returns:
        The XML text; to be saved as UTF-8.

    Raises:
        ShapeError: no link, two links of one name, a name that XML cannot hold, a hub inertia, payload or friction
            below zero, a curvature that is not finite, or something at a joint that is not there.
    """
    base, joints = _bodies_of(chain, friction or {})
    return template("chain.urdf.jinja").render(chain=chain, base=base, joints=joints)


def _bodies_of(chain: Chain, friction: Mapping[str, float]) -> tuple[_Body, list[_Joint]]:
    """Return the arm's base, and all joints with the bodies that they carry, from the base outwards.

    Raises:
        ShapeError: as of `chain_to_urdf`.
    """
    _check(chain, friction)
    foot = 0.02 * chain.links[0].length
    base = _Body("base", shapes=(_Shape("cylinder", (2 * foot, foot), 0.0, "vjm_base"),))
    return base, list(_joints(chain, base.name, friction))


def template(name: str) -> Template:
    """Return a template of `urdf_templates`, which writes floats so that they are read back exactly."""
    return _environment().get_template(name)


@cache
def _environment() -> Environment:
    """Environment that escapes text for XML, and writes floats so that they are read back exactly."""
    package = Path(__file__).parents[1]
    environment = Environment(
        loader=FileSystemLoader([package / _FOLDER, package.parent / _FOLDER]),  # installed, and in a checkout
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: repr(float(value)) if isinstance(value, float | np.floating) else value,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals["generated"] = GENERATED
    environment.filters["literal"] = lambda text: Markup(repr(text))  # of Python; JSON's differs beyond 16 bits
    return environment


def _joints(chain: Chain, parent: str, friction: Mapping[str, float]) -> Iterator[_Joint]:
    """Yield all joints with the bodies that they carry, from the base, their parent, outwards."""
    if chain.base is not None:
        radius, mass, axis = 0.1 * chain.links[0].length, chain.base.mass, chain.base.axis
        transverse = mass * radius**2 / 4  # a disc's; nothing turns it
        table = _Body("base_table", _Inertial(mass, 0.0, transverse, transverse, 2 * transverse))
        slide = (float(axis[0]), float(axis[1]), 0.0)
        yield _Joint("base_slide", "prismatic", parent, 0.0, table, chain.base.damping, 0.0, 0.0, slide, radius)
        parent = table.name
    for link in chain.links:
        name, dry = link.name, friction.get(link.name, 0.0)
        body = _virtual_link(link, 0)
        carried_body = body if link.root_stiffness is None else _hub(link)
        kind = "continuous" if link.joint == "revolute" else "fixed"
        damping = link.joint_damping if link.joint_damping or dry else None
        yield _Joint(f"{name}_joint", kind, parent, 0.0, carried_body, damping, friction=dry)
        if link.root_stiffness is not None:
            yield _Joint(f"{name}_root", "revolute", carried_body.name, link.radii[0], body, link.root_damping)
        for j in range(1, link.virtual_joints + 1):
            parent, body, x = body.name, _virtual_link(link, j), _start(link, j - 1) + link.lengths[j - 1]
            yaw = link.rest_curvature * link.cells[j - 1]
            yield _Joint(f"{name}_virtual_{j}", "revolute", parent, x, body, link.damping[j - 1], yaw)
        parent = f"{name}_tip"
        yield _Joint(f"{name}_tip_mount", "fixed", body.name, link.lengths[-1], _Body(parent))
        if link.payload:
            # The same about every axis, as a ball's; zero is a point mass's, exact and physically valid.
            mass, inertia = float(link.payload), float(link.payload_inertia)
            ball = _Inertial(mass, link.payload_offset, inertia, inertia, inertia)
            steel = (3 * mass / (4 * math.pi * 7850.0)) ** (1 / 3)  # radius of a ball of steel
            radius = max(steel, math.sqrt(2.5 * inertia / mass))  # the latter of a uniform ball of this inertia
            body = _Body(f"{name}_payload", ball, (_Shape("sphere", (radius,), link.payload_offset, "vjm_payload"),))
            yield _Joint(f"{name}_payload_mount", "fixed", parent, 0.0, body)


def _hub(link: LinkChain) -> _Body:
    """Return the body between active joint and root joint; a bare frame where nothing turns."""
    name, inertia = f"{link.name}_hub", float(link.hub_inertia)
    if link.joint == "clamped" and not inertia:
        return _Body(name)
    disc = _Inertial(_HUB_MASS, 0.0, inertia / 2, inertia / 2, inertia)
    return _Body(name, disc, (_hub_shape(link),) if link.joint == "revolute" else ())


def _virtual_link(link: LinkChain, j: int) -> _Body:
    """Return virtual link j; virtual link 0 includes what turns with it about the joint's axis.

    izz is the chain's moment of inertia, plus that of hub and root for virtual link 0: these carry no mass here, so
    their inertia is the same about every point. ixx and iyy follow from second moments of mass along x, y and z, none
    negative, which is what makes the tensor physically valid: along z the link's width, along y its thickness as far
    as izz allows, along x the rest; hub and root count half along x and half along y, like a disc.
    """
    width, thickness = _section(link)
    mass, inertia, length = link.masses[j], link.inertias[j], link.lengths[j]
    along_z = mass * width**2 / 12
    along_y = min(mass * thickness**2 / 12, inertia / 2)
    along_x = inertia - along_y
    disc = link.carried_inertia if j == 0 else 0.0
    ixx, iyy = along_y + along_z + disc / 2, along_x + along_z + disc / 2
    start = _start(link, j)
    inertial = _Inertial(mass, start + link.mass_centers[j], ixx, iyy, inertia + disc)
    shapes = [_Shape("box", (length, thickness, width), start + length / 2, "vjm_even" if j % 2 == 0 else "vjm_odd")]
    if j:
        radius = max(0.6 * thickness, 0.008 * link.length)
        shapes.append(_Shape("cylinder", (radius, 1.1 * width), 0.0, "vjm_virtual_joint"))
    elif link.joint == "revolute" and link.root_stiffness is None:
        shapes.append(_hub_shape(link))
    return _Body(f"{link.name}_virtual_{j}_link", inertial, tuple(shapes))


def _start(link: LinkChain, j: int) -> float:
    """Return where virtual link j begins in its body's frame [m], which is that of the joint that carries it."""
    return link.radii[link.root_stiffness is not None] if j == 0 else 0.0


def _hub_shape(link: LinkChain) -> _Shape:
    radius = link.hub_radius or 0.025 * link.length
    return _Shape("cylinder", (radius, 1.3 * _section(link)[0]), 0.0, "vjm_hub")


def _section(link: LinkChain) -> tuple[float, float]:
    """Return width (along z) and thickness (along y) [m]; 2 % of the length where unknown: the motion needs neither."""
    default = 0.02 * link.length
    return float(link.width or default), float(link.thickness or default)


def _check(chain: Chain, friction: Mapping[str, float]) -> None:
    """Refuse what the file would have no place for."""
    names = [link.name for link in chain.links]
    if not names:
        raise ShapeError("chain.links", "none", "at least one")
    if len(set(names)) < len(names):
        raise ShapeError("chain.links", f"names {names}", "names that differ")
    for name in (chain.name, *names):
        if not name or printable(name) != name:
            raise ShapeError("name", repr(name), "a name without control characters, for XML")
    active = [link.name for link in chain.links if link.joint == "revolute"]
    for name in friction:
        if name not in active:
            raise ShapeError("friction", f"link {name!r}", f"links with an active joint: {active}")
    sizes = {f"friction[{name!r}]": value for name, value in friction.items()}
    for link in chain.links:
        sizes |= {f"{link.name}.hub_inertia": link.hub_inertia, f"{link.name}.payload": link.payload}
        for field in ("hub_radius", "rest_curvature", "payload_offset"):
            if not math.isfinite(getattr(link, field)):
                raise ShapeError(f"{link.name}.{field}", getattr(link, field), "a finite number")
        if link.joint == "clamped" and (link.joint_damping or link.joint_stiffness):
            raise ShapeError(f"{link.name}.joint", "a spring or damper at a clamped joint", "an active joint")
        if link.root_stiffness is None and link.root_damping:
            raise ShapeError(f"{link.name}.root_damping", link.root_damping, "zero, without a root joint")
    for field, value in sizes.items():
        if not 0 <= value < math.inf:
            raise ShapeError(field, value, "zero or a positive number")


class _Movable(NamedTuple):
    """A joint that moves, with what acts there.

    Its spring is at rest at `reference` [rad or m]; its drive has an inertia of `armature`; below `slip_rate` [rad/s]
    a step of the simulation may bring its dry friction to rest.
    """

    joint: _Joint
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


def simulator_path(path: Path | str, simulator: str) -> Path:
    """Return where the file that a simulator reads stands: beside the URDF `path`, with a suffix of its own.

    Raises:
        ChoiceError: another simulator.
        FolderError: `path` is a folder.
        ShapeError: `path` ends as the file beside it does.
    """
    require_choice("simulator", simulator, SIMULATORS)
    file, suffix = check_no_folder(path), SIMULATORS[simulator]
    if file.suffix == suffix:
        raise ShapeError("path", str(file), f"a file that does not end in {suffix}, as the one beside it does")
    return file.with_suffix(suffix)


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
    require_choice("simulator", simulator, SIMULATORS)
    if chain.armature and simulator in ("gazebo", "pybullet"):
        raise ShapeError("armature", chain.armature, f"zero, for {simulator}; a hub_inertia turns with the arm")
    base, joints = _bodies_of(chain, friction or {})
    step, compliance = _step_and_compliance(chain)
    movable = _movable_joints(chain, joints, step * compliance)
    suffix = SIMULATORS[simulator]
    name = f"{simulator}.py.jinja" if suffix == ".py" else {".xml": "mjcf.xml.jinja", ".sdf": "world.sdf.jinja"}[suffix]
    return template(name).render(
        chain=chain,
        base=base,
        joints=_with_payloads(joints) if simulator == "gazebo" else joints,
        movable={entry.joint.name: entry for entry in movable},
        sites=_sites(chain, markers),
        tip=f"{chain.links[-1].name}_tip",
        armature=[entry.armature for entry in movable] if chain.armature else None,
        step=step,
        substeps=_BULLET_SUBSTEPS,
        frame=_FRAME,
        urdf=urdf,
        left_out=[text.replace("--", "- -") for text in left_out],  # XML has no -- in a comment
    )


def _step_and_compliance(chain: Chain) -> tuple[float, Array]:
    """Return a time step [s] for the fastest mode of the chain at zero, and the joints' compliance diag(M^-1) (nv,)."""
    q = np.zeros((1, chain.size))
    inverse = np.linalg.inv(Mechanism(chain).mass_matrix(q)[0])
    zero, identity = np.zeros_like(inverse), np.eye(chain.size)
    slopes = np.block([[zero, identity], [-inverse * chain.stiffness, -inverse * chain.damping]])
    fastest = float(np.abs(np.linalg.eigvals(slopes)).max())
    return _FRAME / max(1, math.ceil(_FRAME * fastest / _STEP)), np.diag(inverse)


def _movable_joints(chain: Chain, joints: Sequence[_Joint], slip: Array) -> list[_Movable]:
    """Return the movable joints in the coordinates' order; slip (nv,): change of rate in a step under 1 N m [rad/s]."""
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
            place = _start(link, j) + float(arc - starts[j])
            sites.append(_Site(f"{link.name}.m{k}", f"{link.name}_virtual_{j}_link", place))
    return sites


def _with_payloads(joints: Sequence[_Joint]) -> list[_Joint]:
    """Return the joints with payloads merged into the links they are on, as SDF takes only positive inertias.

    The payload's point mass m at the distance d from the composite's centre adds m d^2 to its moments.
    """
    by_body = {joint.body.name: joint for joint in joints}
    merged = dict(by_body)
    for joint in joints:
        point = joint.body.inertial
        if joint.type != "fixed" or not point.mass or point.izz:
            continue
        tip = by_body[joint.parent]
        carrier = merged[tip.parent]
        body = carrier.body.inertial
        mass, x = body.mass + point.mass, tip.x + point.center
        center = (body.mass * body.center + point.mass * x) / mass
        added = body.mass * (body.center - center) ** 2 + point.mass * (x - center) ** 2
        combined = _Inertial(mass, center, body.ixx, body.iyy + added, body.izz + added)
        merged[tip.parent] = carrier._replace(body=carrier.body._replace(inertial=combined))
        massless = _Body(joint.body.name, shapes=joint.body.shapes)
        merged[joint.body.name] = joint._replace(body=massless)
    return list(merged.values())
