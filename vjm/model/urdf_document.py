"""URDF files read with the place of every element, so that changes leave every other byte as it was.

XML libraries that parse and write a file lose quotes, line ends, the spacing inside tags and entities; here the
parser only says where an element stands, and edits replace what lies between two places.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat
from xml.sax.saxutils import escape

import numpy as np

from vjm.errors import ModelFileError, ShapeError, is_number, shown
from vjm.files import GENERATED, as_path
from vjm.records import Array

NAMESPACE = "urn:vjm:urdf"  # of the elements for which URDF has no word
_XACRO = "xacro"
_DECLARATION = re.compile(rb"^\s*<\?xml[^>]*?encoding\s*=\s*[\"']([\w.:-]+)[\"']")
_PROLOGUE = re.compile(r"\ufeff?(<\?xml[^>]*>\s*)?")  # a comment may follow
_START_TAG = re.compile(rb"<[^\"'<>]*(?:\"[^\"]*\"[^\"'<>]*|'[^']*'[^\"'<>]*)*>")
_BOMS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}


class Edit(NamedTuple):
    """New bytes for those from `start` to `stop`."""

    start: int
    stop: int
    text: bytes


@dataclass(frozen=True)
class Element:
    """An element of a URDF and where it stands: its bytes are data[start:stop], its start tag data[start:inside]."""

    tag: str  # without a namespace's prefix, but `vjm:` for elements of vjm's own
    attributes: dict[str, str]
    start: int
    inside: int
    stop: int
    children: tuple[Element, ...]

    def all(self, tag: str) -> list[Element]:
        """Return the children of one tag."""
        return [child for child in self.children if child.tag == tag]

    def first(self, tag: str) -> Element | None:
        """Return the first child of one tag, or None."""
        return next(iter(self.all(tag)), None)

    def descendants(self) -> Iterator[Element]:
        """Yield every element inside, in the file's order."""
        for child in self.children:
            yield child
            yield from child.descendants()


@dataclass(frozen=True)
class UrdfDocument:
    """A URDF as UTF-8 bytes with its elements.

    Attributes:
        name: the file, or `URDF` for a text.
        data: the bytes, in UTF-8 whatever the file's encoding.
        robot: the root element.
    """

    name: str
    data: bytes
    robot: Element

    @classmethod
    def read(cls, source: Path | str) -> UrdfDocument:
        """Read a file, or parse a text, which begins with `<`.

        Raises:
            ModelFileError: no such file, no XML, no URDF, or one that xacro has not expanded.
            ShapeError: neither text nor path.
        """
        if isinstance(source, str) and source.lstrip("\ufeff \t\r\n").startswith("<"):
            name, data = "URDF", _declared_utf8(source).encode("utf-8", "surrogatepass")
        else:
            file = as_path("urdf", source, "a URDF file, or its text")
            name = str(file)
            try:
                data = _utf8(file.read_bytes())
            except (OSError, ValueError, LookupError) as error:
                problem = f"cannot be read ({getattr(error, 'strerror', None) or error})"
                raise ModelFileError(source, problem, "a URDF file") from error
        try:
            robot = _elements(data)
        except expat.ExpatError as error:
            raise ModelFileError(name, f"no usable XML ({error})", "a URDF file") from error
        if robot.tag != "robot":
            raise ModelFileError(name, f"its root element is {robot.tag!r}", "a URDF, whose root is 'robot'")
        document = cls(name, data, robot)
        if any(element.tag.startswith(f"{_XACRO}:") for element in robot.descendants()):
            raise document.fault("it holds xacro macros", "a plain URDF: run xacro first")
        return document

    def fault(self, problem: str, expected: str) -> ModelFileError:
        """Return an error that names the file."""
        return ModelFileError(self.name, problem, expected)

    def edited(self, edits: Sequence[Edit], element: Element | None = None) -> bytes:
        """Return the bytes of the file, or of one element, with the edits inside them."""
        start, stop = (0, len(self.data)) if element is None else (element.start, element.stop)
        parts, place = [], start
        for edit in sorted(edits):
            parts += [self.data[place : edit.start], edit.text]
            place = edit.stop
        return b"".join([*parts, self.data[place:stop]])

    @property
    def text(self) -> str:
        """The whole file."""
        return self.data.decode("utf-8")

    @property
    def generated_text(self) -> str:
        """The whole file, with a comment before its root that vjm wrote it."""
        before, text = self.data[: self.robot.start].decode(), self.text
        if GENERATED in before:
            return text
        prologue = _PROLOGUE.match(before)
        place = prologue.end() if prologue else 0
        return f"{text[:place]}<!-- {GENERATED} -->{self.newline}{text[place:]}"

    @property
    def newline(self) -> str:
        """The file's line end."""
        return "\r\n" if b"\r\n" in self.data else "\n"

    def indentation(self, element: Element) -> str:
        """Return the blanks before an element that is the first thing on its line."""
        line = self.data[self.data.rfind(b"\n", 0, element.start) + 1 : element.start]
        return line.decode() if not line.strip() else ""

    def attribute(self, element: Element, name: str, value: str) -> Edit:
        """Return the edit that sets an attribute, whether or not the element has it."""
        tag = self.data[element.start : element.inside]
        text = escape(value, {'"': "&quot;", "'": "&apos;"}).encode()
        match = re.search(rb"\s" + re.escape(name).encode() + rb"\s*=\s*(\"[^\"]*\"|'[^']*')", tag)
        if match is not None:
            return Edit(element.start + match.start(1) + 1, element.start + match.end(1) - 1, text)
        end = element.inside - (2 if tag.endswith(b"/>") else 1)
        while self.data[end - 1 : end].isspace():
            end -= 1
        return Edit(end, end, b" " + name.encode() + b'="' + text + b'"')

    def child(self, element: Element, tag: str, attributes: dict[str, str]) -> list[Edit]:
        """Return the edits that set attributes of an element's child, which is inserted first where it is absent."""
        child = element.first(tag)
        if child is not None:
            return [self.attribute(child, name, value) for name, value in attributes.items()]
        words = " ".join(f'{name}="{value}"' for name, value in attributes.items())
        if self.data[element.inside - 2 : element.inside] == b"/>":
            label = re.match(rb"<([^\s/>]+)", self.data[element.start : element.inside])
            assert label is not None
            closed = b"><" + tag.encode() + b" " + words.encode() + b"/></" + label.group(1) + b">"
            return [Edit(element.inside - 2, element.inside, closed)]
        first = element.children[0].start if element.children else element.inside
        blanks = self.data[element.inside : first] if not self.data[element.inside : first].strip() else b""
        return [Edit(element.inside, element.inside, blanks + f"<{tag} {words}/>".encode())]

    def without(self, element: Element) -> Edit:
        """Return the edit that takes an element out, with its line where it stands alone there."""
        before = self.data[: element.start].rstrip(b" \t")
        line = self.newline.encode()
        alone = before.endswith(line) and self.data[element.stop :].lstrip(b" \t").startswith(line)
        return Edit(len(before) - len(line) if alone else element.start, element.stop, b"")

    def before_end(self, element: Element) -> int:
        """Return where the line of an element's end tag begins, or the tag where it does not begin its line."""
        end = self.data.rindex(b"<", element.start, element.stop)
        before = self.data[:end].rstrip(b" \t")
        return len(before) if before.endswith(b"\n") else end

    def pose(self, element: Element) -> tuple[Array, Array]:
        """Return translation (3,) [m] and rotation (3, 3) of an element's `origin`; none is the identity."""
        origin = element.first("origin")
        attributes = {} if origin is None else origin.attributes
        xyz, rpy = (self.numbers(attributes.get(name, "0 0 0"), name, 3) for name in ("xyz", "rpy"))
        (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
        about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        return xyz, about_z @ about_y @ about_x

    def numbers(self, text: str, name: str, count: int) -> Array:
        """Return the finite numbers of an attribute.

        Raises:
            ModelFileError: another number of them, or no numbers.
        """
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.empty(0)
        if values.size != count or not np.isfinite(values).all():
            raise self.fault(f"{name}={text!r}", f"{count} finite number{'s' * (count > 1)}")
        return values


class Spring(NamedTuple):
    """Spring and damper of a joint of a URDF, by the joint's name."""

    joint: str
    stiffness: float  # K [N m/rad], prismatic [N/m]
    damping: float  # D [N m s/rad], prismatic [N s/m]
    cell: float | None = None  # length of link whose bending or twist the joint stands for [m]
    driven: bool = False  # by a motor beside the spring


class FlexibleLink(NamedTuple):
    """A link that `vjm flexify` has cut, in the link's frame at rest."""

    name: str
    start: Array  # (3,) where the beam begins [m]
    direction: Array  # (3,) unit vector along it
    length: float  # [m]
    joints: dict[str, tuple[str, ...]]  # by axis (x, y, z or torsion), the virtual joints' names from the base outwards


def flexible_links_of(document: UrdfDocument) -> tuple[FlexibleLink, ...]:
    """Return the flexible links in the file's `vjm:model`."""
    model = document.robot.first("vjm:model")
    links = []
    for element in () if model is None else model.all("vjm:flexible_link"):
        joints: dict[str, tuple[str, ...]] = {}
        for child in element.all("vjm:virtual_joint"):
            axis = child.attributes["name"].rpartition("_")[2]
            joints[axis] = (*joints.get(axis, ()), child.attributes["name"])
        start, direction = (document.numbers(element.attributes[key], key, 3) for key in ("start", "axis"))
        length = float(document.numbers(element.attributes["length"], "length", 1)[0])
        links.append(FlexibleLink(element.attributes["name"], start, direction, length, joints))
    return tuple(links)


def springs_of(document: UrdfDocument) -> list[Spring]:
    """Return the springs in the file's `vjm:model`, with the joints' dampers; none where it has no such element.

    Raises:
        ModelFileError: a spring of a joint that is not there, or a stiffness that is no number.
    """
    model = document.robot.first("vjm:model")
    joints = {joint.attributes.get("name", ""): joint for joint in document.robot.all("joint")}
    springs = []
    for element in () if model is None else model.descendants():
        attributes = element.attributes
        name, stiffness = attributes.get("name", "base_slide"), attributes.get("stiffness")
        if element.tag == "vjm:link" and "joint_stiffness" in attributes:  # of a flexible link's active joint
            name, stiffness = f"{name}_joint", attributes["joint_stiffness"]
        if stiffness is None:
            continue
        if name not in joints:
            raise document.fault(f"a spring at joint {name!r}, which is not there", f"one of: {', '.join(joints)}")
        dynamics = joints[name].first("dynamics")
        damping = "0" if dynamics is None else dynamics.attributes.get("damping", "0")
        cell = float(document.numbers(attributes["cell"], "cell", 1)[0]) if "cell" in attributes else None
        K, D = (document.numbers(text, key, 1)[0] for key, text in (("stiffness", stiffness), ("damping", damping)))
        springs.append(Spring(name, float(K), float(D), cell, element.tag == "vjm:link"))
    return springs


def exact(values: float | Sequence[float] | Array) -> str:
    """Return numbers as URDF holds them, so that they are read back exactly; zero has no sign."""
    return " ".join(repr(float(value) + 0.0) for value in np.atleast_1d(np.asarray(values, dtype=float)))


def positive(name: str, value: float | None) -> float:
    """Return a number that must be above zero.

    Raises:
        ShapeError: it is not.
    """
    if not is_number(value) or value <= 0:
        raise ShapeError(name, "nothing" if value is None else shown(value), "a positive number")
    return float(value)


def _utf8(raw: bytes) -> bytes:
    """Return a file's bytes in UTF-8, the declaration of another encoding with them."""
    declared = _DECLARATION.match(raw)
    encoding = _BOMS.get(raw[:2]) or (declared.group(1).decode() if declared else "utf-8")
    text = raw.decode(encoding)
    return _declared_utf8(text).encode("utf-8")


def _declared_utf8(text: str) -> str:
    pattern = _DECLARATION.pattern.decode()
    declared = re.match(pattern, text.lstrip("\ufeff"))
    if declared is None or declared.group(1).lower() in ("utf-8", "utf8", "us-ascii", "ascii"):
        return text
    text = text.lstrip("\ufeff")
    return text[: declared.start(1)] + "utf-8" + text[declared.end(1) :]


def _elements(data: bytes) -> Element:
    """Parse XML into elements with their places."""
    parser = expat.ParserCreate("utf-8")
    top: list[Element] = []
    opened: list[tuple[str, dict[str, str], int, int, list[Element]]] = []
    prefixes: set[str] = set()

    def begin(name: str, attributes: dict[str, str]) -> None:
        place = parser.CurrentByteIndex
        match = _START_TAG.match(data, place)
        assert match is not None  # expat has read it
        prefixes.update(key[6:] for key, value in attributes.items() if key.startswith("xmlns:") and value == NAMESPACE)
        prefix, _, local = name.rpartition(":")
        tag = f"vjm:{local}" if prefix in prefixes else name
        opened.append((tag, attributes, place, match.end(), []))

    def end(_: str) -> None:
        tag, attributes, start, content, children = opened.pop()
        empty = data[content - 2 : content] == b"/>"
        stop = content if empty else data.index(b">", parser.CurrentByteIndex) + 1
        (opened[-1][-1] if opened else top).append(Element(tag, attributes, start, content, stop, tuple(children)))

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.Parse(data, True)
    return top[0]
