"""Where something acts that no candidate explains, and what it looks like: generic forces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.diagnosis.directions import screen
from vjm.effects.effect import Effect, Motion, inner, size
from vjm.experiment.records import Rig
from vjm.identification.trajectory_problem import Point

Array = NDArray[np.float64]

_SOME = 1.0  # per cent; what explains less says nothing

_Shape = Callable[[Array, Array, Array], Array]

# In words, and as functions of time [s], angle [rad] and rate [rad/s].
_SHAPES: tuple[tuple[str, _Shape], ...] = (
    ("constant", lambda t, q, v: np.ones_like(q)),
    ("odd in position (a spring)", lambda t, q, v: q),
    ("even in position", lambda t, q, v: q**2),
    ("odd in position (a spring that stiffens or softens)", lambda t, q, v: q**3),
    ("odd in velocity (a damper)", lambda t, q, v: v),
    ("even in velocity", lambda t, q, v: v**2),
    ("odd in velocity (growing with its square)", lambda t, q, v: v * np.abs(v)),
    ("odd in velocity (as friction: it follows its sign)", lambda t, q, v: np.tanh(v / 0.02)),
    ("growing with time", lambda t, q, v: t[..., None] * q),
)


@dataclass(frozen=True)
class JointProbe(Effect):
    """A torque of a given shape at the active joint."""

    torque: float = size("N m", 0.01)
    shape: int = inner("", 0, whole=True, grid=tuple(range(len(_SHAPES))))

    id = "joint_probe"

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Active joints."""
        return rig.active_links

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Of that shape."""
        names = [f"{link.name}_joint" for link in chain.links]
        joint = chain.joint_names.index(names[self.link or 0])
        shape = _SHAPES[self.shape][1]

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            found = np.zeros(q.shape)
            found[..., joint] = self.torque * shape(time, q[..., [joint]], v[..., [joint]])[..., 0]
            return found

        return force


@dataclass(frozen=True)
class BendingProbe(Effect):
    """A bending moment of a given shape in all of a link."""

    moment: float = size("N m", 0.01)
    shape: int = inner("", 0, whole=True, grid=tuple(range(len(_SHAPES))))

    id = "bending_probe"

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Every link."""
        return tuple(range(len(rig.links)))

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Of that shape, in the link's curvature times its length."""
        part, link = chain.passive_slices[self.link or 0], chain.links[self.link or 0]
        scale = link.length / link.cells
        shape = _SHAPES[self.shape][1]

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            found = np.zeros(q.shape)
            found[..., part] = self.moment * shape(time, q[..., part] * scale, v[..., part] * scale)
            return found

        return force


def described(point: Point, present: tuple[Effect, ...], rig: Rig) -> str:
    """Where what is left acts and what it looks like, in words: the probe that explains most of it."""
    variants = [v for probe in (JointProbe(), BendingProbe()) for v in probe.variants(rig, [])]
    seen = screen(point, present, variants)
    best = int(np.argmax(seen.statistics))
    probe = seen.effects[best]
    if seen.statistics[best] <= 0:
        return ""
    shape = _SHAPES[int(probe.values["shape"])][0]
    name = rig.links[probe.link or 0].name
    where = f"a torque at the joint of {name}" if isinstance(probe, JointProbe) else f"a bending moment in {name}"
    share = 100 * seen.statistics[best] / max(point.chi2 - point.count, 1.0)
    return f"most like {where}, {shape}, which would explain {min(share, 100):.0f} % of it" if share >= _SOME else ""
