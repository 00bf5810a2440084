"""Positions of markers on a tree of joints, and their derivatives, for whole batches of postures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vjm.chain.curve import curve_map
from vjm.chain.layout import Layout, layout
from vjm.errors import ChoiceError, ShapeError
from vjm.model.flexible import FlexibleModel
from vjm.model.urdf_document import FlexibleLink
from vjm.records import Array, Record


@dataclass(frozen=True)
class _TreeJoint:
    """A joint of one coordinate: where it stands on its parent, and its screw.

    Attributes:
        parent: number of the parent joint in the tree, -1 for the world.
        rotation, translation: (3, 3) and (3,) [m], of the joint's frame at zero in its parent's.
        axis: (3,) unit vector it turns about, or slides along.
        slides: whether it slides.
    """

    parent: int
    rotation: Array
    translation: Array
    axis: Array
    slides: bool = False


@dataclass(frozen=True, repr=False)
class MarkerTree(Record):
    """Markers on a tree of joints.

    A marker may stand on a curve through virtual joints, beside the rigid link that carries it: its offset then changes
    with the angles, to first order.

    Attributes:
        joints: parents before their children, one for each coordinate.
        bodies: (k,) for each marker, the joint that carries it, -1 for the world.
        offsets: (k, 3) places in the joints' frames [m].
        slopes: (k, 3, nv) derivatives of the offsets by the coordinates [m/rad].
    """

    joints: tuple[_TreeJoint, ...]
    bodies: tuple[int, ...]
    offsets: Array
    slopes: Array

    def positions(self, q: Array) -> tuple[Array, Array]:
        """Return positions (T, k, 3) in the world [m] and their derivatives (T, k, 3, nv) by q (T, nv)."""
        count = len(q)
        orientations: dict[int, Array] = {-1: np.broadcast_to(np.eye(3), (count, 3, 3))}
        origins: dict[int, Array] = {-1: np.zeros((count, 3))}
        axes = []
        for k, joint in enumerate(self.joints):
            base = orientations[joint.parent] @ joint.rotation
            origin = origins[joint.parent] + orientations[joint.parent] @ joint.translation
            axes.append(base @ joint.axis)
            if joint.slides:
                orientations[k], origins[k] = base, origin + q[:, [k]] * axes[k]
            else:
                orientations[k], origins[k] = base @ _rotations(joint.axis, q[:, k]), origin
        places = np.empty((count, len(self.bodies), 3))
        slopes = np.zeros((*places.shape, len(self.joints)))
        for m, body in enumerate(self.bodies):
            offset = self.offsets[m] + q @ self.slopes[m].T
            places[:, m] = origins[body] + np.einsum("tij,tj->ti", orientations[body], offset)
            slopes[:, m] = orientations[body] @ self.slopes[m]
            while body >= 0:
                joint = self.joints[body]
                arm = places[:, m] - origins[body]
                slopes[:, m, :, body] += axes[body] if joint.slides else np.cross(axes[body], arm)
                body = joint.parent
        return places, slopes


def _rotations(axis: Array, angles: Array) -> Array:
    """Return rotations (T, 3, 3) about a unit vector by angles (T,) [rad] (Rodrigues)."""
    cross = np.cross(np.eye(3), axis)
    return np.asarray(
        np.eye(3) + np.sin(angles)[:, None, None] * cross + (1 - np.cos(angles))[:, None, None] * (cross @ cross)
    )


def marker_tree(model: FlexibleModel, places: Sequence[tuple[str, Array]]) -> MarkerTree:
    """Return markers given as frame and offset in it [m] (3,).

    Markers on a link that is cut into virtual links stand on the curve through its joints, whichever of its virtual
    links they are given in.

    Raises:
        ChoiceError: no such frame.
        ShapeError: a joint of several coordinates.
    """
    robot = model.model
    data = robot.createData()
    joints = []
    for number in range(1, robot.njoints):
        joint, placement = robot.joints[number], robot.jointPlacements[number]
        if joint.nv != 1:
            raise ShapeError(f"joint {robot.names[number]}", f"{joint.nv} coordinates", "joints of one coordinate each")
        screw = np.asarray(data.joints[number].S).ravel()  # linear part first
        slides = not screw[3:].any()
        axis = screw[:3] if slides else screw[3:]
        joints.append(_TreeJoint(robot.parents[number] - 1, placement.rotation, placement.translation, axis, slides))
    bodies, offsets, slopes = [], [], []
    for frame, offset in places:
        if not robot.existFrame(frame):
            raise ChoiceError("frame", frame, [known.name for known in robot.frames])
        frame, offset, slope = _on_curve(model, frame, np.asarray(offset, dtype=float))
        carrier = robot.frames[robot.getFrameId(frame)]
        bodies.append(carrier.parentJoint - 1)
        offsets.append(carrier.placement.translation + carrier.placement.rotation @ offset)
        slopes.append(carrier.placement.rotation @ slope)
    shape = len(places), 3, model.model.nv
    return MarkerTree(tuple(joints), tuple(bodies), np.array(offsets).reshape(shape[:2]), np.reshape(slopes, shape))


def _on_curve(model: FlexibleModel, frame: str, offset: Array) -> tuple[str, Array, Array]:
    """Return the virtual link that carries a marker, the offset in it (3,), and the offset's slope by q (3, nv)."""
    slope, data = np.zeros((3, model.model.nv)), model.model.createData()
    for link in model.links:
        bent = next(names for axis, names in link.joints.items() if axis != "torsion")
        names = [link.name, *(f"{link.name}_virtual_{j}_link" for j in range(1, len(bent) + 1))]
        if frame not in names:
            continue
        cuts = _cuts(model, link, bent)
        arcs = np.cumsum(cuts.lengths)[:-1]
        origins = np.vstack([np.zeros(3), link.start + arcs[:, None] * link.direction])
        place = offset + origins[names.index(frame)]
        arc = float((place - link.start) @ link.direction)
        piece, on_beam = int(np.searchsorted(arcs, arc)), float(np.clip(arc, 0.0, link.length))
        lateral = place - link.start - on_beam * link.direction
        curve = curve_map(cuts, [on_beam])
        for axis, joints in link.joints.items():
            if axis == "torsion":
                # Twist is constant over the cells of a joint, which meet midway between the joints.
                cells = np.array([model.cells[name] for name in joints])
                heading = np.clip((on_beam - np.r_[0.0, np.cumsum(cells)[:-1]]) / cells, 0.0, 1.0)
                shift = np.zeros(len(joints))
            else:
                heading, shift = curve.heading[0], (curve.weights @ curve.node_heading)[0]
                shift = shift - np.maximum(on_beam - arcs, 0.0)
            heading = heading - (arcs < on_beam)
            for name, turn, move in zip(joints, heading, shift, strict=True):
                k = model.indices([name])[0]
                # In the frames of the virtual links, which are all parallel at rest.
                axis_vector = np.asarray(data.joints[model.model.getJointId(name)].S).ravel()[3:]
                slope[:, k] += move * np.cross(axis_vector, link.direction) + turn * np.cross(axis_vector, lateral)
        return names[piece], place - origins[piece], slope
    return frame, offset, slope


def _cuts(model: FlexibleModel, link: FlexibleLink, joints: Sequence[str]) -> Layout:
    """Return where a link was cut: as for a free end or for one that carries a moment."""
    cells = np.array([model.cells[name] for name in joints])
    free, joined = (layout(link.length, len(joints), distal=distal) for distal in ("free", "joined"))
    return joined if np.allclose(cells, joined.cells) else free
