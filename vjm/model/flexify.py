"""Links and joints of any robot's URDF made flexible: rigid pieces joined by springs, everything else as it was."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import NoneType
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from vjm.chain.body_inertia import BodyInertia, split_inertia
from vjm.chain.layout import layout, layout_of_lengths
from vjm.errors import ChoiceError, ShapeError, is_number, is_whole, require, require_choice, require_kind
from vjm.experiment.arrays import number_array
from vjm.model.urdf import template
from vjm.model.urdf_document import NAMESPACE, Edit, Element, UrdfDocument, exact, positive
from vjm.records import Array

# Share of a body's inertia that goes to a body between joints at one place, which has none of its own: programs refuse
# an empty body that moves, or invent an inertia for it. Frequencies change by half of this share at most.
_SHARE_BETWEEN = 1e-6
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_STEEPEST = math.sqrt(0.5)  # cosine of 45 degrees: what is nearer to the link's axis than that is no axis across it
_MOVING = ("revolute", "continuous", "prismatic")
_EXPLAINED = (
    "<!-- What URDF has no element for. stiffness: K of a joint's spring [N m/rad], prismatic [N/m], at rest at zero.",
    "     cell: length of link whose bending or twist the joint stands for [m]; strain at distance d: d angle / cell.",
    "     rotor_inertia: acts on the joint's own angle alone [kg m^2], prismatic [kg]. -->",
)
_SECTIONS = {"tube": "tube:DIAMETER,WALL", "rod": "rod:DIAMETER", "box": "box:WIDTH,HEIGHT"}


class _Axis(NamedTuple):
    """A direction about which a virtual joint turns, with the stiffness of the beam: EI or GJ [N m^2]."""

    name: str
    direction: Array
    stiffness: float
    twists: bool = False


class _Body(NamedTuple):
    """A further link of the file: its inertia as elements and attributes, and the shapes moved to it, as they were."""

    name: str
    inertial: Mapping[str, Mapping[str, str]] | None
    shapes: tuple[str, ...] = ()


class _Joint(NamedTuple):
    """A further joint of the file, as its attributes."""

    name: str
    type: str
    origin: str
    parent: str
    child: str
    axis: str
    reach: str
    damping: str


class _LinkOptions(NamedTuple):
    """Options of `flexify` that concern the link."""

    joints: int | None
    bending_stiffness: float | Sequence[float] | None
    bending: Sequence[str] | str | None
    torsion: float | None
    axis: str | Sequence[float] | None
    child: str | None
    ends: Sequence[Sequence[float]] | None
    section: str | None
    youngs_modulus: float | None
    shear_modulus: float | None
    density: float | None


@dataclass(frozen=True)
class _Beam:
    """A link as a beam in the link's frame: where it lies, where it is cut and about what it bends and twists."""

    start: Array  # (3,) [m]
    direction: Array  # (3,) unit vector
    lengths: Array  # (n + 1,) of the virtual links [m]
    cells: Array  # (n,) [m]
    twist_cells: Array  # (n,) [m]
    axes: tuple[_Axis, ...]

    def cells_of(self, axis: _Axis) -> Array:
        """Return the lengths of beam (n,) that each joint stands for [m]."""
        return self.twist_cells if axis.twists else self.cells

    @property
    def length(self) -> float:
        """Length [m]."""
        return float(self.lengths.sum())

    @property
    def origins(self) -> Array:
        """Origins of the virtual links' frames (n + 1, 3) in the link's frame [m]; the first frame is the link's."""
        joints = self.start + np.cumsum(self.lengths)[:-1, None] * self.direction
        return np.vstack([np.zeros(3), joints])

    def piece_at(self, point: Array) -> int:
        """Return the virtual link that a point of the link's frame belongs to, by its place along the axis."""
        arcs = np.cumsum(self.lengths)[:-1]
        return int(np.searchsorted(arcs, (point - self.start) @ self.direction * (1 - 1e-12)))


def flexify(
    urdf: Path | str,
    *,
    link: str | None = None,
    joints: int | None = None,
    bending_stiffness: float | Sequence[float] | None = None,
    bending: Sequence[str] | str | None = None,
    torsion: float | None = None,
    axis: str | Sequence[float] | None = None,
    child: str | None = None,
    ends: Sequence[Sequence[float]] | None = None,
    section: str | None = None,
    youngs_modulus: float | None = None,
    shear_modulus: float | None = None,
    density: float | None = None,
    kelvin_voigt: float = 0.0,
    joint: str | None = None,
    stiffness: float | None = None,
    rotor_inertia: float | None = None,
) -> str:
    """Return a URDF with a link, a joint or both made flexible.

    The link becomes n + 1 rigid virtual links joined by n virtual joints with springs, K = EI / cell about each axis
    across the link and GJ / cell along it, laid out as `vjm.chain.layout` does (bending to fourth order, twist to
    second). Their masses, centres and inertias add up to the link's own (`vjm.chain.body_inertia.split_inertia`). The
    first one keeps the link's name and frame; visuals, collisions and joints go to the virtual link where their origin
    is. An elastic joint (M. W. Spong, Modeling and Control of Elastic Joint Robots, ASME J. Dyn. Syst. Meas. Control
    109, 1987) is the motor's, which keeps its name and limits, and a spring `NAME_spring` about the same axis; the
    rotor's inertia acts on the motor's angle alone. Stiffness, cells and rotor inertia, for which URDF has no element,
    are in an element `vjm:model`; `FlexibleModel.from_urdf` reads them. A comment above says that vjm wrote
    the file. Every other byte stays as it is.

    Args:
        urdf: a file, or its text.
        link: to be made flexible.
        joints: number n of virtual joints along the link.
        bending_stiffness: EI [N m^2], one value or one for each axis of `bending`.
        bending: axes of the link's frame about which it bends, as "y" or "y,z"; turned square to the link where they
            are not (default: the two that are most nearly across it).
        torsion: GJ [N m^2]; None: the link does not twist.
        axis: of the link, "x", "y", "z" or a vector in its frame, from its origin to where the child joint is along it
            (default: from its origin to its child joint's).
        child: the joint at the link's far end, where it carries several.
        ends: two points [m] of the link's frame instead of axis and child.
        section: instead of stiffness, "tube:DIAMETER,WALL", "rod:DIAMETER" or "box:WIDTH,HEIGHT" [m], WIDTH along the
            first bending axis; with `youngs_modulus`, and with `shear_modulus` if the link twists too.
        youngs_modulus: E [Pa].
        shear_modulus: G [Pa].
        density: of the section [kg/m^3]: its mass is uniform along the link, what remains of the link's is at two
            places (default: as much of the link's mass is uniform as its moments allow).
        kelvin_voigt: damping D over stiffness K of all springs [s].
        joint: to be made flexible; revolute, continuous or prismatic.
        stiffness: K of its spring [N m/rad], prismatic [N/m].
        rotor_inertia: of its motor, seen at the joint (gear ratio squared times the rotor's) [kg m^2], prismatic [kg].

    Returns:
        The XML text; to be saved as UTF-8.

    Raises:
        ModelFileError: no URDF.
        ChoiceError: no such link, joint, axis or section.
        ShapeError: values out of range, a link without inertia, a link that branches, an inertia that cannot be cut.
    """
    link_options = _LinkOptions(
        joints, bending_stiffness, bending, torsion, axis, child, ends, section, youngs_modulus, shear_modulus, density
    )
    joint_options = {"stiffness": stiffness, "rotor_inertia": rotor_inertia}
    _check_places((("link", link, link_options._asdict()), ("joint", joint, joint_options)), kelvin_voigt)
    document = UrdfDocument.read(urdf)
    if link is not None:
        document = _with_flexible_link(document, _named(document, "link", link), link_options, kelvin_voigt)
    if joint is not None:
        springs = positive("stiffness", stiffness), positive("rotor_inertia", rotor_inertia)
        document = _with_flexible_joint(document, _named(document, "joint", joint), *springs, kelvin_voigt)
    return document.generated_text


def _check_places(places: Sequence[tuple[str, str | None, Mapping[str, object]]], kelvin_voigt: float) -> None:
    """Refuse options given without the name of their link or joint; places are its kind, its name and its options."""
    if all(name is None for _, name, _ in places):
        raise ShapeError("link, joint", "neither", "the name of a link or of a joint to make flexible")
    valid = is_number(kelvin_voigt) and kelvin_voigt >= 0
    require("kelvin_voigt", kelvin_voigt, valid, "zero or a positive number [s]")
    for kind, name, options in places:
        require_kind(kind, name, (str, NoneType), f"the name of a {kind}")
        loose = [option for option, value in options.items() if name is None and value is not None]
        if loose:
            raise ShapeError(kind, None, f"the name of the {kind} that {loose[0]} is of")


def _named(document: UrdfDocument, tag: str, name: str) -> Element:
    elements = {element.attributes.get("name", ""): element for element in document.robot.all(tag)}
    require_choice(tag, name, elements)
    return elements[name]


def _end(joint: Element, tag: str) -> str:
    """Return the name of a joint's parent or child link."""
    element = joint.first(tag)
    return "" if element is None else element.attributes.get("link", "")


def _inertia(document: UrdfDocument, link: Element) -> BodyInertia | None:
    """Return the inertia of a link in its own frame, or None where it has no mass."""
    inertial = link.first("inertial")
    mass, tensor = (None, None) if inertial is None else (inertial.first("mass"), inertial.first("inertia"))
    if inertial is None or mass is None or tensor is None:
        return None
    value = float(document.numbers(mass.attributes.get("value", ""), "mass value", 1)[0])
    if value == 0:
        return None
    center, rotation = document.pose(inertial)
    matrix = np.zeros((3, 3))
    for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
        i, j = "xyz".index(key[1]), "xyz".index(key[2])
        matrix[i, j] = matrix[j, i] = document.numbers(tensor.attributes.get(key, "0"), key, 1)[0]
    return BodyInertia(value, center, rotation @ matrix @ rotation.T)


def _inertial(body: BodyInertia, origin: Array) -> dict[str, dict[str, str]]:
    """Return the children of `inertial` of a body given in another frame, whose axes are the same."""
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    tensor = {key: exact(body.tensor["xyz".index(key[1]), "xyz".index(key[2])]) for key in keys}
    return {
        "origin": {"xyz": exact(body.center - origin), "rpy": "0 0 0"},
        "mass": {"value": exact(body.mass)},
        "inertia": tensor,
    }


def _inertial_edits(document: UrdfDocument, link: Element, body: BodyInertia) -> list[Edit]:
    """Return the edits that give a link another inertia."""
    inertial = link.first("inertial")
    assert inertial is not None
    parts = _inertial(body, np.zeros(3)).items()
    return [edit for tag, values in parts for edit in document.child(inertial, tag, values)]


def _carries_mass(document: UrdfDocument, name: str) -> bool:
    """Return True if a link, or any link that it carries, has mass."""
    pending, visited = [name], set()
    while pending:
        current = pending.pop()
        if current in visited:
            continue
        visited.add(current)
        if _inertia(document, _named(document, "link", current)) is not None:
            return True
        pending += [_end(joint, "child") for joint in document.robot.all("joint") if _end(joint, "parent") == current]
    return False


def _children(document: UrdfDocument, link: Element) -> list[Element]:
    """Return the joints that a link carries."""
    return [joint for joint in document.robot.all("joint") if _end(joint, "parent") == link.attributes["name"]]


def _tip(document: UrdfDocument, link: Element, child: str | None) -> Element | None:
    """Return the joint at a link's far end: the only one that moves, or the only one; None where there is none."""
    children = {joint.attributes.get("name", ""): joint for joint in _children(document, link)}
    if child is not None:
        require_choice(f"child joint of {link.attributes['name']}", child, children or ["none"])
        return children[child]
    moving = {name: joint for name, joint in children.items() if joint.attributes.get("type") != "fixed"}
    candidates = moving or children
    if len(candidates) > 1:
        raise ShapeError(
            f"link {link.attributes['name']}", "a link that branches", f"child, one of: {', '.join(candidates)}"
        )
    return next(iter(candidates.values()), None)


def _placed(document: UrdfDocument, link: Element, options: _LinkOptions) -> tuple[Array, Array, float]:
    """Return where the beam starts (3,) [m], its direction (3,) and its length [m], in the link's frame."""
    axis, ends = options.axis, options.ends
    if ends is not None:
        points = number_array("ends", ends)
        if (
            axis is not None
            or points.shape != (2, 3)
            or not np.isfinite(points).all()
            or (points[0] == points[1]).all()
        ):
            raise ShapeError("ends", f"{np.shape(ends)}{' and an axis' * (axis is not None)}", "two points, no axis")
        length = float(np.linalg.norm(points[1] - points[0]))
        return points[0], (points[1] - points[0]) / length, length
    tip = _tip(document, link, options.child)
    if tip is None:
        raise ShapeError(
            f"link {link.attributes['name']}", "no child joint", "ends: two points of the link's frame [m]"
        )
    place = document.pose(tip)[0]
    offset_text = ", ".join(f"{name} {value:g} m" for name, value in zip(_AXES, place, strict=True))
    if axis is None:
        length = float(np.linalg.norm(place))
        if length == 0:
            raise ShapeError("axis", f"child joint {tip.attributes['name']} at the link's origin", "ends [m]")
        return np.zeros(3), place / length, length
    direction = _vector(axis)
    length = float(place @ direction)
    if abs(length) <= 1e-6 * np.linalg.norm(place):
        raise ShapeError("axis", axis, f"one along which child joint {tip.attributes['name']} is away ({offset_text})")
    return np.zeros(3), math.copysign(1.0, length) * direction, abs(length)


def _vector(axis: str | Sequence[float]) -> Array:
    """Return the unit vector of an axis."""
    if isinstance(axis, str):
        if axis.lstrip("+-") not in _AXES:
            raise ChoiceError("axis", axis, _AXES)
        return np.array(_AXES[axis.lstrip("+-")])
    vector = number_array("axis", axis)
    norm = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not 0 < norm < math.inf:
        raise ShapeError("axis", axis, "x, y, z or a vector of three numbers, not zero")
    return vector / norm


def _stiffness(direction: Array, options: _LinkOptions) -> tuple[tuple[_Axis, ...], float | None]:
    """Return the axes with their stiffness, and the mass per length [kg/m] of a section with a density."""
    across = _across(direction, options.bending)
    bending_stiffness, torsion, line_density = options.bending_stiffness, options.torsion, None
    if options.section is not None:
        if bending_stiffness is not None or torsion is not None:
            raise ShapeError("section", options.section, "no stiffness beside it: it follows from the section")
        area, seconds, polar = _section(options.section)
        modulus = positive("youngs_modulus", options.youngs_modulus)
        bending_stiffness = [modulus * second for second in seconds[: len(across)]]
        if options.shear_modulus is not None:
            torsion = positive("shear_modulus", options.shear_modulus) * polar
        if options.density is not None:
            line_density = positive("density", options.density) * area
    else:
        for name in ("youngs_modulus", "shear_modulus", "density"):
            if getattr(options, name) is not None:
                raise ShapeError("section", None, f"a section beside {name}: {', '.join(_SECTIONS.values())}")
    if bending_stiffness is None:
        raise ShapeError("bending_stiffness", None, "EI [N m^2], or section and youngs_modulus")
    values = np.atleast_1d(number_array("bending_stiffness", bending_stiffness))
    if values.size not in (1, len(across)):
        raise ShapeError("bending_stiffness", f"{values.size} values", f"one, or one for each of {len(across)} axes")
    stiffness = [positive("bending_stiffness", value) for value in np.broadcast_to(values, len(across)).tolist()]
    axes = [_Axis(name, vector, value) for (name, vector), value in zip(across.items(), stiffness, strict=True)]
    if torsion is not None:
        axes.append(_Axis("torsion", direction, positive("torsion", torsion), twists=True))
    return tuple(axes), line_density


def _across(direction: Array, bending: Sequence[str] | str | None) -> dict[str, Array]:
    """Return the bending axes by name: unit vectors square to the link, near those of its frame."""
    nearness = {name: abs(float(direction @ vector)) for name, vector in _AXES.items()}
    names = bending.split(",") if isinstance(bending, str) else bending
    are_names = names is None or (isinstance(names, Sequence) and all(isinstance(name, str) for name in names))
    require("bending", bending, are_names, "axes of the link's frame, as y,z")
    chosen = sorted(sorted(_AXES, key=lambda name: nearness[name])[:2]) if names is None else [n.strip() for n in names]
    for name in chosen:
        if name not in _AXES:
            raise ChoiceError("bending axis", name, _AXES)
    if not 1 <= len(set(chosen)) == len(chosen) <= 2:
        raise ShapeError("bending", ",".join(chosen), "one axis of the link's frame, or two, as y,z")
    for name in chosen:
        if nearness[name] > _STEEPEST + 1e-9:
            valid = [key for key in _AXES if nearness[key] <= _STEEPEST + 1e-9]
            raise ShapeError("bending", name, f"axes across the link, which lies along {name}: {', '.join(valid)}")
    first = _AXES[chosen[0]] - direction * (direction @ _AXES[chosen[0]])
    axes = {chosen[0]: first / np.linalg.norm(first)}
    if len(chosen) == 2:
        second = np.cross(direction, axes[chosen[0]])
        axes[chosen[1]] = math.copysign(1.0, float(second @ _AXES[chosen[1]])) * second
    return axes


def _section(text: str) -> tuple[float, tuple[float, float], float]:
    """Return area [m^2], second moments of area about both bending axes and torsion constant [m^4] of a section.

    The rectangle's torsion constant is Saint-Venant's series (S. P. Timoshenko and J. N. Goodier, Theory of Elasticity,
    3rd ed. 1970, section 109).
    """
    require_kind("section", text, str, f"one of: {', '.join(_SECTIONS.values())}")
    kind, _, numbers = text.partition(":")
    try:
        sizes = [positive("section", float(number)) for number in numbers.split(",")]
    except ValueError:
        sizes = []
    if kind not in _SECTIONS or len(sizes) != (1 if kind == "rod" else 2):
        raise ChoiceError("section", text, _SECTIONS.values())
    if kind == "box":
        width, height = sizes
        wide, thin = max(sizes), min(sizes)
        odd = np.arange(1, 40, 2)
        series = float(np.sum(np.tanh(odd * np.pi * wide / (2 * thin)) / odd**5.0))
        polar = wide * thin**3 / 3 * (1 - 192 / np.pi**5 * thin / wide * series)
        return width * height, (width * height**3 / 12, height * width**3 / 12), polar
    outer, wall = sizes[0], sizes[-1] if kind == "tube" else sizes[0] / 2
    if wall > outer / 2:
        raise ShapeError("section", text, "a wall of at most half the diameter")
    inner = outer - 2 * wall
    second = np.pi * (outer**4 - inner**4) / 64
    return np.pi * (outer**2 - inner**2) / 4, (second, second), 2 * second


def _beam(document: UrdfDocument, link: Element, options: _LinkOptions) -> tuple[_Beam, float | None]:
    """Return the beam with its cuts, and the mass of its section [kg] if a density gives it.

    Its far end carries a moment where anything with mass is mounted there.
    """
    start, direction, length = _placed(document, link, options)
    axes, line_density = _stiffness(direction, options)
    joints = options.joints
    require("joints", joints, is_whole(joints, 1), "at least 1 virtual joint")
    assert joints is not None
    children = [
        child
        for child in _children(document, link)
        if (document.pose(child)[0] - start) @ direction > length / 2 and _carries_mass(document, _end(child, "child"))
    ]
    cuts = layout(length, int(joints), distal="joined" if children else "free")
    # A rod twists: each joint stands for what is between the middles of its links (finite volumes, second order).
    twist = layout_of_lengths(cuts.lengths, cuts.distal).cells
    beam = _Beam(start, direction, cuts.lengths, cuts.cells, twist, axes)
    return beam, None if line_density is None else line_density * length


def _with_flexible_link(
    document: UrdfDocument, link: Element, options: _LinkOptions, kelvin_voigt: float
) -> UrdfDocument:
    """Return the file with virtual links and joints in a link's place."""
    name, body = link.attributes["name"], _inertia(document, link)
    if body is None:
        with_mass = [e.attributes["name"] for e in document.robot.all("link") if _inertia(document, e) is not None]
        raise ShapeError(f"link {name}", "no mass", f"a link with mass, one of: {', '.join(with_mass) or 'none'}")
    beam, section_mass = _beam(document, link, options)
    pieces = split_inertia(body, beam.start, beam.direction, beam.lengths, section_mass)
    links = [name, *(f"{name}_virtual_{j}_link" for j in range(1, len(pieces)))]
    edits = _inertial_edits(document, link, pieces[0])
    shapes: list[list[str]] = [[] for _ in pieces]
    for shape in (*link.all("visual"), *link.all("collision")):
        place = document.pose(shape)[0]
        j = beam.piece_at(place)
        if j:
            moved = document.child(shape, "origin", {"xyz": exact(place - beam.origins[j])})
            shapes[j].append(document.edited(moved, shape).decode())
            edits.append(document.without(shape))
    for joint in _children(document, link):
        place = document.pose(joint)[0]
        j = beam.piece_at(place)
        if j:
            edits += document.child(joint, "origin", {"xyz": exact(place - beam.origins[j])})
            edits += document.child(joint, "parent", {"link": links[j]})
    parts: list[_Joint | _Body] = []
    for j in range(1, len(pieces)):
        parts += _virtual_joint(beam, links, j, pieces[j], tuple(shapes[j]), kelvin_voigt)
    springs = [
        (f"{name}_virtual_{j}_{axis.name}", {"stiffness": exact(axis.stiffness / cell), "cell": exact(cell)})
        for j in range(1, len(pieces))
        for axis, cell in ((axis, beam.cells_of(axis)[j - 1]) for axis in beam.axes)
    ]
    attributes = {"name": name, "start": exact(beam.start), "axis": exact(beam.direction), "length": exact(beam.length)}
    edits += [
        _inserted(document, link, parts),
        _extension(document, "flexible_link", attributes, "virtual_joint", springs),
    ]
    return UrdfDocument.read(document.edited(edits).decode())


def _virtual_joint(
    beam: _Beam, links: Sequence[str], j: int, piece: BodyInertia, shapes: tuple[str, ...], kelvin_voigt: float
) -> list[_Joint | _Body]:
    """Return virtual joint j, from 1: a revolute joint for each axis, all at one place, and the bodies they carry."""
    count, stem = len(beam.axes), f"{links[0]}_virtual_{j}"
    names = [links[j - 1], *(f"{stem}_{axis.name}_link" for axis in beam.axes[:-1]), links[j]]
    parts: list[_Joint | _Body] = []
    for k, (axis, (parent, child)) in enumerate(zip(beam.axes, pairwise(names), strict=True)):
        origin = np.zeros(3) if k else beam.origins[j] - beam.origins[j - 1]
        damping = kelvin_voigt * axis.stiffness / beam.cells_of(axis)[j - 1]
        numbers = exact(axis.direction), exact(math.pi), exact(damping)
        parts.append(_Joint(f"{stem}_{axis.name}", "revolute", exact(origin), parent, child, *numbers))
        share = _SHARE_BETWEEN if k < count - 1 else 1 - (count - 1) * _SHARE_BETWEEN
        inertial = _inertial(piece.scaled(share), beam.origins[j])
        parts.append(_Body(child, inertial, shapes if k == count - 1 else ()))
    return parts


def _with_flexible_joint(
    document: UrdfDocument, joint: Element, stiffness: float, rotor_inertia: float, kelvin_voigt: float
) -> UrdfDocument:
    """Return the file with a joint's motor side, a spring and its link side in its place."""
    name, kind = joint.attributes["name"], joint.attributes.get("type", "")
    if kind not in _MOVING:
        moving = [
            e.attributes.get("name", "") for e in document.robot.all("joint") if e.attributes.get("type") in _MOVING
        ]
        raise ShapeError(f"joint {name}", f"type {kind!r}", f"one that turns or slides: {', '.join(moving) or 'none'}")
    link = _named(document, "link", _end(joint, "child"))
    body, axis, limit = _inertia(document, link), joint.first("axis"), joint.first("limit")
    reach = math.pi
    if kind == "prismatic" and limit is not None:
        bounds = [document.numbers(limit.attributes.get(key, "0"), key, 1)[0] for key in ("lower", "upper")]
        reach = bounds[1] - bounds[0] or 1.0
    motor = f"{name}_motor"
    edits = document.child(joint, "child", {"link": motor})
    inertial = None
    if body is not None:
        inertial = _inertial(body.scaled(_SHARE_BETWEEN), np.zeros(3))
        edits += _inertial_edits(document, link, body.scaled(1 - _SHARE_BETWEEN))
    direction = "1 0 0" if axis is None else axis.attributes.get("xyz", "1 0 0")
    numbers = direction, exact(reach), exact(kelvin_voigt * stiffness)
    kind = "prismatic" if kind == "prismatic" else "revolute"
    spring = _Joint(f"{name}_spring", kind, exact(np.zeros(3)), motor, link.attributes["name"], *numbers)
    attributes = {"name": name, "rotor_inertia": exact(rotor_inertia)}
    springs = [(spring.name, {"stiffness": exact(stiffness)})]
    edits += [
        _inserted(document, joint, [_Body(motor, inertial), spring]),
        _extension(document, "flexible_joint", attributes, "spring_joint", springs),
    ]
    return UrdfDocument.read(document.edited(edits).decode())


def _inserted(document: UrdfDocument, element: Element, parts: Sequence[_Joint | _Body]) -> Edit:
    """Return the edit that writes further joints and links behind an element."""
    existing = {child.attributes.get("name") for child in document.robot.children if child.tag in ("link", "joint")}
    duplicates = [part.name for part in parts if part.name in existing]
    if duplicates:
        name = element.attributes["name"]
        raise ShapeError(
            f"{element.tag} {name}", f"a file that has {duplicates[0]} already", "one that is not flexible yet"
        )
    lines = template("flexible.urdf.jinja").render(parts=parts).splitlines()
    start = document.newline + document.indentation(element)
    return Edit(element.stop, element.stop, "".join(start + line for line in lines).encode())


def _extension(
    document: UrdfDocument,
    tag: str,
    attributes: Mapping[str, str],
    spring: str,
    springs: Sequence[tuple[str, Mapping[str, str]]],
) -> Edit:
    """Return the edit that adds to `vjm:model`, which is made where it is absent, what URDF has no element for."""

    def tag_start(name: str, values: Mapping[str, str]) -> str:
        return f"<vjm:{name} " + " ".join(f"{key}={quoteattr(value)}" for key, value in values.items())

    lines = [f"  {tag_start(tag, attributes)}>"]
    lines += [f"    {tag_start(spring, {'name': name, **values})}/>" for name, values in springs]
    lines += [f"  </vjm:{tag}>"]
    model = document.robot.first("vjm:model")
    if model is None:
        lines = [*_EXPLAINED, f'<vjm:model xmlns:vjm="{NAMESPACE}" schema="1">', *lines, "</vjm:model>"]
        lines = [f"  {line}" for line in lines]
    else:
        indentation = document.indentation(model)
        if b"xmlns:vjm" not in document.data:  # another program has chosen another prefix
            lines[0] = lines[0].replace(f"<vjm:{tag} ", f'<vjm:{tag} xmlns:vjm="{NAMESPACE}" ')
        lines = [indentation + line for line in lines]
    place = document.before_end(document.robot if model is None else model)
    return Edit(place, place, "".join(line + document.newline for line in lines).encode())
