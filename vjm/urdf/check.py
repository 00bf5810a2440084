"""A second opinion on a URDF: another parser must see the same arm."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import yourdfpy
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.errors import ModelFileError
from vjm.urdf.elements import tip_name
from vjm.urdf.read import chain_from_urdf

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
