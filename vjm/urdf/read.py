"""From a URDF that vjm wrote back to the virtual-joint chain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

from vjm.chain.records import Chain, Distal, LinkChain, frozen
from vjm.errors import ModelFileError, ShapeError
from vjm.urdf import elements
from vjm.urdf.tags import FaultError, along_x, by_name, described, known, number, only_child, parse, place, text, vector
from vjm.urdf.write import NAMESPACE, SCHEMA

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
