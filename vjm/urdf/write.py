"""From a virtual-joint chain to URDF."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Mapping

from vjm.chain.records import Chain
from vjm.errors import ShapeError
from vjm.urdf.elements import base_body, joints, root_name, springs
from vjm.urdf.templates import render

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
