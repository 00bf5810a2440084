"""What other programs read from a URDF of a chain."""

from __future__ import annotations

import io
from pathlib import Path
from xml.etree import ElementTree

import yourdfpy

NAMESPACE = "{urn:vjm:urdf}"


def text_of(source: Path | str) -> str:
    """The XML itself, given as text or as a file."""
    return source.read_text(encoding="utf-8") if isinstance(source, Path) else source


def robot_from(source: Path | str) -> yourdfpy.URDF:
    """The robot as yourdfpy reads it."""
    return yourdfpy.URDF.load(io.BytesIO(text_of(source).encode()), load_meshes=False)


def extension_from(source: Path | str) -> ElementTree.Element:
    """The element that holds what URDF has no word for."""
    model = ElementTree.fromstring(text_of(source).encode()).find(f"{NAMESPACE}model")
    assert model is not None
    return model


def springs_from(source: Path | str) -> dict[str, float]:
    """Stiffness of every root joint and virtual joint by name [N m/rad]."""
    tags = (f"{NAMESPACE}root_joint", f"{NAMESPACE}virtual_joint")
    model = extension_from(source)
    return {element.attrib["name"]: float(element.attrib["stiffness"]) for tag in tags for element in model.iter(tag)}
