"""Reading XML elements: what is missing or malformed becomes a fault that says what was expected."""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element, ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring


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
    """A required attribute that is `size` finite numbers."""
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
