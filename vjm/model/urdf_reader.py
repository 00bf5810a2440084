"""A second opinion on a URDF: another parser must see the same arm."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element, ParseError

import numpy as np
import yourdfpy
from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring
from numpy.typing import NDArray

from vjm.chain.virtual_links import Chain, Distal, LinkChain, frozen
from vjm.errors import ModelFileError, ShapeError
from vjm.model import urdf as elements
from vjm.model.urdf import NAMESPACE, SCHEMA, tip_name


class FaultError(Exception):
    """A fault inside a file, raised where the file's name is not known."""

    def __init__(self, problem: str, expected: str) -> None:
        self.problem = problem
        self.expected = expected
        super().__init__(f"{problem}; expected {expected}")


def parse(content: bytes | str) -> Element:
    """The root element; refuses every DTD, and with it entities and external files."""
    try:
        root: Element = fromstring(content, forbid_dtd=True)
    except DefusedXmlException as error:
        raise FaultError(f"refused for safety: {error}", "XML without DTD and entities") from error
    except (ParseError, ValueError, LookupError) as error:
        raise FaultError(f"no well-formed XML: {error}", "a URDF written by vjm") from error
    return root


def by_name(parent: Element, tag: str) -> dict[str, Element]:
    """The children `tag` by their attribute `name`."""
    found: dict[str, Element] = {}
    for child in parent.findall(tag):
        name = text(child, "name")
        if name in found:
            raise FaultError(f"two elements {described(child)}", "names that differ")
        found[name] = child
    return found


def only_child(parent: Element, tag: str) -> Element:
    """The one child `tag`."""
    found = parent.findall(tag)
    if len(found) != 1:
        raise FaultError(f"{described(parent)} has {len(found)} elements <{short(tag)}>", "one")
    return found[0]


def text(element: Element, attribute: str) -> str:
    """A required attribute."""
    value = element.get(attribute)
    if not value:
        raise FaultError(f"{described(element)} has no {attribute}", f'{attribute}="..."')
    return value


def number(element: Element, attribute: str) -> float:
    """A required attribute that is one finite number, not negative."""
    value = vector(element, attribute, 1)[0]
    if value < 0:
        raise FaultError(f"{described(element)}: {attribute} is {value}", "zero or a positive number")
    return value


def vector(element: Element, attribute: str, size: int) -> tuple[float, ...]:
    """A required attribute that is `magnitude` finite numbers."""
    given = text(element, attribute)
    try:
        values = tuple(map(float, given.split()))
    except ValueError:
        values = ()
    if len(values) != size or not all(map(math.isfinite, values)):
        expected = "a finite number" if size == 1 else f"{size} finite numbers"
        raise FaultError(f"{described(element)}: {attribute} is {given[:60]!r}", expected)
    return values


def along_x(element: Element) -> float:
    """The x of the child `origin` [m], zero where there is none; there must be no other offset and no rotation."""
    x, yaw = place(element)
    if yaw:
        raise FaultError(f"{described(element)} is off the line or turned", 'xyz="X 0 0" rpy="0 0 0"')
    return x


def place(element: Element) -> tuple[float, float]:
    """The x [m] and the yaw [rad] of the child `origin`; the chain has no other offsets and rotations."""
    origin = element.find("origin")
    if origin is None:
        return 0.0, 0.0
    x, y, z = vector(origin, "xyz", 3) if "xyz" in origin.attrib else (0.0, 0.0, 0.0)
    roll, pitch, yaw = vector(origin, "rpy", 3) if "rpy" in origin.attrib else (0.0, 0.0, 0.0)
    if y or z or roll or pitch:
        raise FaultError(f"{described(element)} is off the line or turned", 'xyz="X 0 0" rpy="0 0 YAW"')
    return x, yaw


def known(element: Element, *attributes: str) -> None:
    """Refuse attributes other than these."""
    unknown = sorted(set(element.attrib) - set(attributes))
    if unknown:
        raise FaultError(f"{described(element)}: unknown attribute {unknown[0]}", " or ".join(attributes))


def described(element: Element) -> str:
    """`<tag> 'name'`, for messages."""
    name = element.get("name")
    return f"<{short(element.tag)}>" + (f" '{name}'" if name else "")


def short(tag: str) -> str:
    """A tag without its namespace's address."""
    return "vjm:" + tag.split("}")[-1] if tag.startswith("{") else tag


_TAG = f"{{{NAMESPACE}}}"
_SAME = 1e-12  # izz of a link with a hub against the sum of its parts, relative
_BLANK = "\ufeff \t\r\n"


def chain_from_urdf(source: Path | str) -> Chain:
    """Read a chain from a URDF that `chain_to_urdf` wrote.

    Lengths, masses, centres, inertias, damping and payloads come from the standard elements, so an edit made there
    counts; what a chain cannot hold (a further link, friction at virtual joints, an offset out of line) is refused.
    Friction at active joints is no part of a chain: see `friction_from_urdf`.

    Args:
        source: the file; or, as text that starts with `<`, the XML itself.

    Raises:
        ModelFileError: no such file, no XML, XML with a DTD or entities, or no URDF that makes a chain.
    """
    return _read(source)[0]


def friction_from_urdf(source: Path | str) -> dict[str, float]:
    """Dry friction at active joints, by their link's name [N m], from a URDF that `chain_to_urdf` wrote.

    Args:
        source: as of `chain_from_urdf`.

    Returns:
        Only those with friction.

    Raises:
        ModelFileError: as `chain_from_urdf`.
    """
    return _read(source)[1]


def _read(source: Path | str) -> tuple[Chain, dict[str, float]]:
    content: bytes | str
    if isinstance(source, str) and source.lstrip(_BLANK).startswith("<"):
        file, content = Path("URDF text"), source.lstrip(_BLANK)
    else:
        file, content = Path(source), _bytes(Path(source))
    try:
        return _parts(parse(content))
    except FaultError as fault:
        raise ModelFileError(file, fault.problem, fault.expected) from None
    except ShapeError as error:
        raise ModelFileError(file, f"{error.name}: got {error.given}", error.expected) from error


def _bytes(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except (OSError, ValueError) as error:
        raise ModelFileError(file, f"cannot be read: {error}", "a URDF file") from error


@dataclass(frozen=True)
class _Tags:
    """A URDF's standard elements by name."""

    joints: dict[str, Element]
    links: dict[str, Element]

    def joint(self, name: str) -> Element:
        return _found(self.joints, name, "joint")

    def link(self, name: str) -> Element:
        return _found(self.links, name, "link")


def _found(named: dict[str, Element], name: str, what: str) -> Element:
    if name not in named:
        raise FaultError(f"no {what} '{name}'", "all elements of the vjm:link")
    return named[name]


def _parts(robot: Element) -> tuple[Chain, dict[str, float]]:
    """The chain, and the friction at its active joints."""
    if robot.tag != "robot":
        raise FaultError(f"the root element is {described(robot)}", "<robot>")
    model = only_child(robot, f"{_TAG}model")
    known(model, "schema", "gravity")
    if text(model, "schema") != str(SCHEMA):
        raise FaultError(f"vjm:model has schema {text(model, 'schema')}", f"schema {SCHEMA}")
    tags = _Tags(by_name(robot, "joint"), by_name(robot, "link"))
    x, y = vector(model, "gravity", 2)
    links = by_name(model, f"{_TAG}link")
    if not links:
        raise FaultError("vjm:model has no vjm:link", "at least one")
    chain = Chain(text(robot, "name"), tuple(_link(name, entry, tags) for name, entry in links.items()), (x, y))
    friction = {name: _friction(tags.joint(elements.joint_name(name))) for name in links}
    _check_tree(chain, friction, tags)
    return chain, {name: value for name, value in friction.items() if value}


_ALWAYS = ("name", "distal", "hub_inertia", "first_inertia")
_WHERE_KNOWN = ("width", "thickness")
_WHERE_NOT_ZERO = ("joint_stiffness", "root_inertia", "rest_curvature")


def _link(name: str, entry: Element, tags: _Tags) -> LinkChain:
    known(entry, *_ALWAYS, *_WHERE_KNOWN, *_WHERE_NOT_ZERO)
    springs = by_name(entry, f"{_TAG}virtual_joint")
    joints = [tags.joint(spring) for spring in springs]
    bodies = [_inertial(tags.link(elements.virtual_link_name(name, j))) for j in range(len(joints) + 1)]
    ends = [*joints, tags.joint(elements.tip_mount_name(name))]
    proximal, root = tags.joint(elements.joint_name(name)), _root(name, entry, tags)
    return LinkChain(
        name=name,
        joint=_joint(proximal),
        lengths=frozen([place(joint)[0] for joint in ends]),
        masses=frozen([body.mass for body in bodies]),
        mass_centers=frozen([body.center for body in bodies]),
        inertias=frozen([_first_inertia(entry, bodies[0], root), *(body.izz for body in bodies[1:])]),
        stiffness=frozen([number(spring, "stiffness") for spring in springs.values()]),
        damping=frozen([_damping(joint) for joint in joints]),
        cells=frozen([number(spring, "cell") for spring in springs.values()]),
        hub_inertia=number(entry, "hub_inertia"),
        payload=_payload(tags.links.get(elements.payload_name(name))),
        distal=_distal(entry),
        joint_stiffness=_optional(entry, "joint_stiffness") or 0.0,
        joint_damping=_damping(proximal),
        root_stiffness=root[0],
        root_damping=root[1],
        root_inertia=_optional(entry, "root_inertia") or 0.0,
        rest_curvature=vector(entry, "rest_curvature", 1)[0] if "rest_curvature" in entry.attrib else 0.0,
        width=_optional(entry, "width"),
        thickness=_optional(entry, "thickness"),
    )


def _inertial(link: Element) -> elements.Inertial:
    inertial = only_child(link, "inertial")
    mass = number(only_child(inertial, "mass"), "value")
    tensor = only_child(inertial, "inertia")
    ixx, iyy, izz = (number(tensor, key) for key in ("ixx", "iyy", "izz"))
    return elements.Inertial(mass, along_x(inertial), ixx, iyy, izz)


def _root(name: str, entry: Element, tags: _Tags) -> tuple[float | None, float]:
    """Stiffness and damping of the root joint; none and zero where there is no such joint."""
    if entry.find(f"{_TAG}root_joint") is None:
        return None, 0.0
    spring, hub = only_child(entry, f"{_TAG}root_joint"), tags.link(elements.hub_name(name))
    known(spring, "name", "stiffness")
    turning = 0.0 if hub.find("inertial") is None else _inertial(hub).izz
    if turning != number(entry, "hub_inertia"):
        raise FaultError(f"izz of '{elements.hub_name(name)}' is {turning}", "hub_inertia of its vjm:link")
    return number(spring, "stiffness"), _damping(tags.joint(text(spring, "name")))


def _first_inertia(entry: Element, body: elements.Inertial, root: tuple[float | None, float]) -> float:
    first, hub = number(entry, "first_inertia"), number(entry, "hub_inertia")
    total = first + elements.beyond_joint(hub, root[0], _optional(entry, "root_inertia") or 0.0)
    if not math.isclose(body.izz, total, rel_tol=_SAME):
        problem = f"izz of '{elements.virtual_link_name(text(entry, 'name'), 0)}' is {body.izz}"
        parts = "first_inertia + hub_inertia" if root[0] is None else "first_inertia + root_inertia"
        raise FaultError(problem, f"{parts} of its vjm:link, {total}")
    return first


def _payload(link: Element | None) -> float:
    if link is None:
        return 0.0
    body = _inertial(link)
    if body.center or body.izz:
        raise FaultError(f"{described(link)} is no point mass", "its centre and its inertia at zero")
    return body.mass


def _joint(joint: Element) -> Literal["revolute", "clamped"]:
    kinds: dict[str, Literal["revolute", "clamped"]] = {"continuous": "revolute", "fixed": "clamped"}
    kind = text(joint, "type")
    if kind not in kinds:
        raise FaultError(f"{described(joint)} is {kind}", " or ".join(kinds))
    return kinds[kind]


def _distal(entry: Element) -> Distal:
    choices: dict[str, Distal] = {"free": "free", "joined": "joined"}
    given = text(entry, "distal")
    if given not in choices:
        raise FaultError(f"{described(entry)}: distal is {given!r}", " or ".join(choices))
    return choices[given]


def _optional(entry: Element, attribute: str) -> float | None:
    return number(entry, attribute) if attribute in entry.attrib else None


def _damping(joint: Element) -> float:
    dynamics = joint.find("dynamics")
    return _optional(dynamics, "damping") or 0.0 if dynamics is not None else 0.0


def _friction(joint: Element) -> float:
    dynamics = joint.find("dynamics")
    return _optional(dynamics, "friction") or 0.0 if dynamics is not None else 0.0


def _check_tree(chain: Chain, friction: dict[str, float], tags: _Tags) -> None:
    """Whatever the chain would write must be in the file, and nothing else."""
    expected = {joint.name: joint for joint in elements.joints(chain, friction)}
    for name, element in tags.joints.items():
        if name not in expected:
            raise FaultError(f"{described(element)} is not part of the chain", "the vjm:links' joints only")
    bodies = {joint.body.name: joint.body for joint in expected.values()} | {elements.BASE: elements.base_body(chain)}
    for name, element in tags.links.items():
        if name not in bodies:
            raise FaultError(f"{described(element)} is not part of the chain", "the vjm:links' links only")
        if (element.find("inertial") is None) != (bodies[name].inertial is None):
            raise FaultError(
                f"{described(element)} has or lacks inertia", "mass in virtual links, hubs and payloads only"
            )
    for name, joint in expected.items():
        _check_joint(joint, tags.joint(name))
        tags.link(joint.body.name)


def _check_joint(joint: elements.Joint, element: Element) -> None:
    given = [text(element, "type"), *(text(only_child(element, tag), "link") for tag in ("parent", "child"))]
    wanted = [joint.type, joint.parent, joint.body.name]
    if given != wanted:
        raise FaultError(f"{described(element)} is {' '.join(given)}", " ".join(wanted))
    x, turned = place(element)
    if x != joint.x:
        raise FaultError(f"{described(element)} is at x = {x}", f"x = {joint.x}")
    if turned != joint.yaw:
        raise FaultError(f"{described(element)} is off the line or turned by {turned}", f'rpy="0 0 {joint.yaw}"')
    if joint.type != "fixed" and vector(only_child(element, "axis"), "xyz", 3) != (0.0, 0.0, 1.0):
        raise FaultError(f"{described(element)} turns about another axis", 'axis xyz="0 0 1"')
    if _damping(element) != (joint.damping or 0.0):
        raise FaultError(f"{described(element)} is damped", "damping at movable joints only")
    if _friction(element) != joint.friction:
        raise FaultError(f"{described(element)} has friction", 'friction="0" but for active joints')


_TOLERANCE = 1e-9


def check_urdf(path: Path | str) -> Chain:
    """Read a URDF of vjm's, and compare with what yourdfpy makes of it.

    Compared are the movable joints and their order, the total mass, and the tips' places in a bent posture.

    Args:
        path: the file.

    Returns:
        The chain.

    Raises:
        ModelFileError: the file cannot be read, or the two readings differ.
    """
    chain = chain_from_urdf(Path(path))
    # Only now, and from memory: the first reading has refused DTDs, which this parser would follow.
    robot = yourdfpy.URDF.load(io.BytesIO(Path(path).read_bytes()), load_meshes=False)
    if not robot.validate():
        raise ModelFileError(path, f"yourdfpy finds {robot.errors[0]}", "valid URDF")
    if tuple(robot.actuated_joint_names) != chain.joint_names:
        raise ModelFileError(path, f"yourdfpy's joints are {robot.actuated_joint_names}", f"{chain.joint_names}")
    masses = [link.inertial.mass for link in robot.robot.links if link.inertial is not None]
    total = sum(float(link.masses.sum()) + link.payload for link in chain.links)
    if not np.isclose(sum(masses), total, rtol=_TOLERANCE, atol=0.0):
        raise ModelFileError(path, f"yourdfpy's mass is {sum(masses)} kg", f"{total} kg")
    posture = np.linspace(0.3, -0.2, chain.size)
    robot.update_cfg(posture)
    for link, place in zip(chain.links, _tips(chain, posture), strict=True):
        seen = robot.get_transform(tip_name(link.name), "base")[:2, 3]
        if not np.allclose(seen, place, rtol=0.0, atol=_TOLERANCE * link.length):
            raise ModelFileError(path, f"yourdfpy puts '{tip_name(link.name)}' at {seen}", f"{place}")
    return chain


def _tips(chain: Chain, q: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """(x, y) of each link's distal end [m] at q (nv,) [rad]."""
    angle, place, tips, start = 0.0, np.zeros(2), [], 0
    for link in chain.links:
        own = q[start : start + link.coordinates]
        start += link.coordinates
        n = link.virtual_joints
        turns = np.r_[own[:-n].sum(), own[-n:] + link.rest_curvature * link.cells]
        angles = angle + np.cumsum(turns)
        place = place + link.lengths @ np.column_stack((np.cos(angles), np.sin(angles)))
        angle = angles[-1]
        tips.append(place)
    return tips
