"""What is decided before anything is fitted: shape functions, numbers of joints, cuts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from vjm.angles.estimate import AngleMethod, ShapeSettings
from vjm.chain.layout import Layout
from vjm.experiment.records import Experiment, Link, Recording
from vjm.identification.prepare import choose_orders
from vjm.identification.select import JointChoice, choose_virtual_joints, cuts_of


@dataclass(frozen=True)
class Plan:
    """Decisions for every link.

    Attributes:
        shape: shape functions and how angles are read off them.
        joints: numbers of virtual joints, and what they cost.
        cuts: virtual links and cells.
    """

    shape: ShapeSettings
    joints: tuple[JointChoice, ...]
    cuts: tuple[Layout, ...]


def make_plan(
    experiment: Experiment,
    recordings: Sequence[Recording],
    parameters: str,
    virtual_joints: int | None,
    layout: str,
    family: str,
    angles: AngleMethod | None,
) -> Plan:
    """Choose the shape functions' orders by cross-validation, and from them the numbers of joints.

    Args:
        experiment: the rig.
        recordings: those to be fitted.
        parameters: parametrisation; with parameters of their own, there are no more joints than can be told apart.
        virtual_joints: n of every link where it is given.
        layout: where the links are cut.
        family: of the shape functions.
        angles: how angles are read off them; None: for uniform links by the curvature of the shape functions, for
            joints with parameters of their own by the chain's own curve, where there are markers enough.
    """
    rig = experiment.rig
    provisional = cuts_of(rig, [3] * len(rig.links), layout)
    orders = choose_orders(rig, provisional, recordings, family)
    joints = tuple(
        _choose_joints(link, order, parameters, virtual_joints or link.virtual_joints)
        for link, order in zip(rig.links, orders, strict=True)
    )
    if angles is None:
        placed = all(len(link.markers) >= choice.joints for link, choice in zip(rig.links, joints, strict=True))
        angles = "curve" if parameters != "uniform" and placed else "curvature"
    robust = all(len(link.markers) >= order + 2 for link, order in zip(rig.links, orders, strict=True))
    shape = ShapeSettings(family, orders, angles, robust)
    return Plan(shape, joints, tuple(cuts_of(rig, [choice.joints for choice in joints], layout)))


def _choose_joints(link: Link, order: int, parameters: str, asked: int | None) -> JointChoice:
    choice = choose_virtual_joints(link, order, asked or _joints_told(link, order, parameters))
    return replace(choice, asked=asked is not None)


def _joints_told(link: Link, order: int, parameters: str) -> int | None:
    """Number of joints whose own parameters the markers can tell apart; None: as many as accuracy asks.

    Fixed lengths need two joints more than there are modes to carry those modes well; free lengths need none.
    """
    if parameters == "uniform":
        return None
    return min(order + 2 if parameters == "joints" else order, len(link.markers))
