"""From a virtual-joint chain to URDF."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Literal

import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined

from vjm.chain.virtual_links import Chain, LinkChain
from vjm.errors import ShapeError, VjmError

_FOLDER = "urdf_templates"


def template_folder() -> Traversable:
    """The templates: inside an installed package, or next to it in a checkout.

    Raises:
        VjmError: they are in neither place; the installation is broken.
    """
    package = resources.files("vjm")
    places = [package / _FOLDER, Path(str(package)).parent / _FOLDER]
    for place in places:
        if place.is_dir():
            return place
    raise VjmError(f"vjm's URDF templates are missing: looked in {' and '.join(map(str, places))}; reinstall vjm")


def render(template: str, **values: object) -> str:
    """Fill in a template: text is escaped for XML, floats are written so that they come back exactly."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> Environment:
    folder = template_folder()
    return Environment(
        loader=FunctionLoader(lambda name: folder.joinpath(name).read_text(encoding="utf-8")),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_exact,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def _exact(value: object) -> object:
    return repr(float(value)) if isinstance(value, float | np.floating) else value


BASE = "base"
JointType = Literal["continuous", "revolute", "fixed"]

# For pictures, and for the out-of-plane inertia no planar motion can tell: width and thickness where unknown.
_DEFAULT_SECTION = 0.02  # of the link's length
_STEEL = 7850.0  # [kg/m^3], for the payload's radius

# [kg]; a hub before a root joint has none, but MuJoCo takes no moving body of less than 1e-15 kg.
_HUB_MASS = 1e-14


@dataclass(frozen=True)
class Inertial:
    """Mass [kg], its centre on the x axis [m] and principal inertia about the centre [kg m^2]."""

    mass: float
    center: float
    ixx: float
    iyy: float
    izz: float


@dataclass(frozen=True)
class Shape:
    """A shape to look at.

    Attributes:
        kind: `box` of size (x, y, z), `cylinder` about z of (radius, length), `sphere` of (radius,) [m].
        size: see `kind` [m].
        x: its centre on the x axis [m].
        material: its colour's name.
    """

    kind: Literal["box", "cylinder", "sphere"]
    size: tuple[float, ...]
    x: float
    material: str


@dataclass(frozen=True)
class Body:
    """A URDF link; without `inertial` it is a bare frame."""

    name: str
    inertial: Inertial | None = None
    shapes: tuple[Shape, ...] = ()


@dataclass(frozen=True)
class Joint:
    """A URDF joint and the body it carries.

    Attributes:
        name: of the joint.
        type: of the joint; the axis is z.
        parent: name of the body it starts from.
        x: where, on the parent's x axis [m].
        body: the body it carries.
        damping: viscous [N m s/rad]; None for a joint without any.
        yaw: angle of the body against the parent at zero [rad].
        friction: dry [N m].
    """

    name: str
    type: JointType
    parent: str
    x: float
    body: Body
    damping: float | None = None
    yaw: float = 0.0
    friction: float = 0.0


@dataclass(frozen=True)
class Spring:
    """What URDF cannot say of a virtual joint: stiffness [N m/rad] and cell [m]."""

    joint: str
    stiffness: float
    cell: float


def joint_name(link: str) -> str:
    """The joint at the proximal end of flexible link `link`, active or fixed."""
    return f"{link}_joint"


def root_name(link: str) -> str:
    """The passive joint between the hub, or the ground, and virtual link 0."""
    return f"{link}_root"


def hub_name(link: str) -> str:
    """The body before a root joint; a bare frame where nothing turns."""
    return f"{link}_hub"


def virtual_joint_name(link: str, j: int) -> str:
    """Virtual joint j, from 1."""
    return f"{link}_virtual_{j}"


def virtual_link_name(link: str, j: int) -> str:
    """Virtual link j, from 0."""
    return f"{link}_virtual_{j}_link"


def tip_name(link: str) -> str:
    """The frame at the distal end."""
    return f"{link}_tip"


def tip_mount_name(link: str) -> str:
    """The fixed joint that carries the tip."""
    return f"{link}_tip_mount"


def payload_name(link: str) -> str:
    """The point mass at the distal end."""
    return f"{link}_payload"


def payload_mount_name(link: str) -> str:
    """The fixed joint that carries the payload."""
    return f"{link}_payload_mount"


def base_body(chain: Chain) -> Body:
    """The root, with a foot to look at."""
    length = chain.links[0].length
    return Body(BASE, shapes=(Shape("cylinder", (0.04 * length, 0.02 * length), 0.0, "vjm_base"),))


def joints(chain: Chain, friction: Mapping[str, float] | None = None) -> Iterator[Joint]:
    """All joints with their bodies, from the base outwards; with dry friction [N m] at links' active joints."""
    parent = BASE
    for link in chain.links:
        yield from _proximal_joints(link, parent, (friction or {}).get(link.name, 0.0))
        for j in range(1, link.virtual_joints + 1):
            yield Joint(
                virtual_joint_name(link.name, j),
                "revolute",
                virtual_link_name(link.name, j - 1),
                float(link.lengths[j - 1]),
                virtual_link(link, j),
                damping=float(link.damping[j - 1]),
                yaw=yaw(link.rest_curvature, float(link.cells[j - 1])),
            )
        last = virtual_link_name(link.name, link.virtual_joints)
        parent = tip_name(link.name)
        yield Joint(tip_mount_name(link.name), "fixed", last, float(link.lengths[-1]), Body(parent))
        if link.payload:
            yield Joint(payload_mount_name(link.name), "fixed", parent, 0.0, payload(link))


def _proximal_joints(link: LinkChain, parent: str, friction: float) -> Iterator[Joint]:
    """What carries virtual link 0: the active or fixed joint, then the root joint where there is one."""
    first = virtual_link(link, 0)
    carried = first if link.root_stiffness is None else hub(link)
    if link.joint == "revolute":
        damping = link.joint_damping if link.joint_damping or friction else None
        yield Joint(joint_name(link.name), "continuous", parent, 0.0, carried, damping, friction=friction)
    else:
        yield Joint(joint_name(link.name), "fixed", parent, 0.0, carried)
    if link.root_stiffness is not None:
        yield Joint(root_name(link.name), "revolute", carried.name, 0.0, first, link.root_damping)


def yaw(rest_curvature: float, cell: float) -> float:
    """Angle between the virtual links at a joint of an unloaded link [rad]."""
    return float(rest_curvature * cell)


def springs(link: LinkChain) -> tuple[Spring, ...]:
    """The springs of one flexible link, in order."""
    return tuple(
        Spring(virtual_joint_name(link.name, j), float(link.stiffness[j - 1]), float(link.cells[j - 1]))
        for j in range(1, link.virtual_joints + 1)
    )


def virtual_link(link: LinkChain, j: int) -> Body:
    """Virtual link j, from 0, as a body; what turns with virtual link 0 about the joint's axis is part of it."""
    return Body(virtual_link_name(link.name, j), inertial(link, j), _shapes(link, j))


def hub(link: LinkChain) -> Body:
    """What is between the active joint and the root joint."""
    if link.joint == "clamped" and not link.hub_inertia:
        return Body(hub_name(link.name))
    turning = float(link.hub_inertia)
    disc = Inertial(_HUB_MASS, 0.0, turning / 2, turning / 2, turning)
    return Body(hub_name(link.name), disc, (_hub_shape(link),) if link.joint == "revolute" else ())


def payload(link: LinkChain) -> Body:
    """The payload, a point mass: an inertia of zero keeps M(q) exact, and is physically valid."""
    point = Inertial(float(link.payload), 0.0, 0.0, 0.0, 0.0)
    radius = (3 * link.payload / (4 * math.pi * _STEEL)) ** (1 / 3)
    return Body(payload_name(link.name), point, (Shape("sphere", (radius,), 0.0, "vjm_payload"),))


def inertial(link: LinkChain, j: int) -> Inertial:
    """Inertia of virtual link j with a third dimension.

    izz is the chain's moment of inertia, plus that of hub and root for virtual link 0: these carry no mass here, so
    their inertia is the same about every point. ixx and iyy follow from second moments of mass along x, y and z, none
    negative, which is what makes the tensor physically valid: along z the link's width, along y its thickness as far
    as izz allows, along x the rest; hub and root count half along x and half along y, like a disc.
    """
    width, thickness = section(link)
    mass, turning = float(link.masses[j]), float(link.inertias[j])
    along_z = mass * width**2 / 12
    along_y = min(mass * thickness**2 / 12, turning / 2)
    along_x = turning - along_y
    disc = beyond_joint(link.hub_inertia, link.root_stiffness, link.root_inertia) if j == 0 else 0.0
    center = float(link.mass_centers[j])
    return Inertial(mass, center, along_y + along_z + disc / 2, along_x + along_z + disc / 2, turning + disc)


def beyond_joint(hub_inertia: float, root_stiffness: float | None, root_inertia: float) -> float:
    """Inertia of what turns with virtual link 0 [kg m^2]: the root's, and the hub's where no joint is between."""
    return float(root_inertia + hub_inertia if root_stiffness is None else root_inertia)


def section(link: LinkChain) -> tuple[float, float]:
    """Width (along z) and thickness (along y) [m]; 2 % of the length where unknown."""
    default = _DEFAULT_SECTION * link.length
    width = default if link.width is None else float(link.width)
    return width, default if link.thickness is None else float(link.thickness)


def _shapes(link: LinkChain, j: int) -> tuple[Shape, ...]:
    width, thickness = section(link)
    length = float(link.lengths[j])
    rod = Shape("box", (length, thickness, width), length / 2, "vjm_even" if j % 2 == 0 else "vjm_odd")
    if j:
        radius = max(0.6 * thickness, 0.008 * link.length)
        return rod, Shape("cylinder", (radius, 1.1 * width), 0.0, "vjm_virtual_joint")
    hub_here = link.joint == "revolute" and link.root_stiffness is None
    return (rod, _hub_shape(link)) if hub_here else (rod,)


def _hub_shape(link: LinkChain) -> Shape:
    return Shape("cylinder", (0.025 * link.length, 1.3 * section(link)[0]), 0.0, "vjm_hub")


NAMESPACE = "urn:vjm:urdf"
SCHEMA = 1
# Of virtual joints: angle [rad], effort [N m] and velocity [rad/s]; wider than any arm bends.
LIMITS = {"angle": math.pi, "effort": 1e4, "velocity": 1e3}


def chain_to_urdf(chain: Chain, friction: Mapping[str, float] | None = None) -> str:
    """The whole arm as URDF.

    Standard elements hold lengths, masses, centres, inertias, damping, friction, payloads and curvature at rest. What
    URDF has no word for, stiffness first of all, is in a `vjm:model` element under `robot`, which other parsers pass
    over. Every number is written exactly, so `chain_from_urdf` returns the same chain, and `friction_from_urdf` the
    same friction.

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
    _check(chain)
    _check_joints(chain, friction or {})
    return render(
        "chain.urdf.jinja",
        chain=chain,
        base=base_body(chain),
        joints=joints(chain, friction),
        springs=springs,
        root_name=root_name,
        namespace=NAMESPACE,
        schema=SCHEMA,
        limits=LIMITS,
    )


def _check(chain: Chain) -> None:
    names = [link.name for link in chain.links]
    if not names:
        raise ShapeError("chain.links", "none", "at least one")
    if len(set(names)) < len(names):
        raise ShapeError("chain.links", f"names {names}", "names that differ")
    for name in (chain.name, *names):
        if not name or not all(map(_fits, name)):
            raise ShapeError("name", repr(name), "a name without control characters, for XML")
    for link in chain.links:
        for field in ("hub_inertia", "payload"):
            value = getattr(link, field)
            if not 0 <= value < math.inf:
                raise ShapeError(f"{link.name}.{field}", value, "zero or a positive number")


def _check_joints(chain: Chain, friction: Mapping[str, float]) -> None:
    """Refuse what the file would have no place for."""
    active = [link.name for link in chain.links if link.joint == "revolute"]
    for name, value in friction.items():
        if name not in active:
            raise ShapeError("friction", f"link {name!r}", f"links with an active joint: {active}")
        if not 0 <= value < math.inf:
            raise ShapeError(f"friction[{name!r}]", value, "zero or a positive number")
    for link in chain.links:
        if not math.isfinite(link.rest_curvature):
            raise ShapeError(f"{link.name}.rest_curvature", link.rest_curvature, "a finite number")
        if link.joint == "clamped" and (link.joint_damping or link.joint_stiffness):
            raise ShapeError(f"{link.name}.joint", "a spring or damper at a clamped joint", "an active joint")
        if link.root_stiffness is None and link.root_damping:
            raise ShapeError(f"{link.name}.root_damping", link.root_damping, "zero, without a root joint")


def _fits(character: str) -> bool:
    return unicodedata.category(character) not in ("Cc", "Cs") and character not in "\ufffe\uffff"
