"""What an effect is: parameters with null values, and hooks that default to nothing.

An effect is something that a model of an arm may lack: a mass on its tip, friction, a clock that runs ahead. It is a
frozen dataclass whose fields are its parameters; the instance with the default values changes nothing, exactly. The
hooks say what it changes: the chain, what drives it, the forces on it, what its sensors show.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import product
from typing import Any, ClassVar, Self

import numpy as np

from vjm.chain.virtual_links import Chain
from vjm.records import Array, Recording, Rig

Key = tuple[str, int | None]
# From time (...), q (..., nv), v (..., nv) and internal states z (..., nz) to forces (..., nv) or rates (..., nz).
Motion = Callable[[Array, Array, Array, Array], Array]
# From angles (..., nv) at which internal states (..., nz) were, those states and other angles to the states at these.
RateIndependentUpdate = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Attributes:
        name: as in the class.
        unit: SI; empty where it has none.
        null: value at which the effect is absent; NaN for an inner parameter, which means nothing then.
        typical_magnitude: difference from `null` (the value itself, where reciprocal or a shape parameter).
        lower, upper: bounds of the value.
        grid: of an inner parameter, the values from which searches start.
        reciprocal: whether the effect grows with one over the value, whose null is infinite.
        integer: whether it is a whole number, which is never varied in a fit.
    """

    name: str
    unit: str
    null: float
    typical_magnitude: float
    lower: float
    upper: float
    grid: tuple[float, ...]
    reciprocal: bool
    integer: bool

    @property
    def shape_parameter(self) -> bool:
        """Whether it says how the effect is, not how large."""
        return bool(np.isnan(self.null))

    def coordinate(self, value: float) -> float:
        """The number that a search varies: zero at the null, one at an everyday size; inner: a logarithm."""
        if self.reciprocal:
            return self.typical_magnitude / value
        return (
            float(np.log(value / self.typical_magnitude))
            if self.shape_parameter
            else (value - self.null) / self.typical_magnitude
        )

    def value(self, coordinate: float) -> float:
        """The value at a coordinate."""
        if self.reciprocal:
            return self.typical_magnitude / coordinate if coordinate > 0 else np.inf
        return (
            float(self.typical_magnitude * np.exp(coordinate))
            if self.shape_parameter
            else self.null + self.typical_magnitude * coordinate
        )

    @property
    def bounds(self) -> tuple[float, float]:
        """Of the coordinate."""
        if self.reciprocal:
            return 0.0, self.typical_magnitude / self.lower if self.lower > 0 else np.inf
        if self.shape_parameter:
            return (self.coordinate(self.lower) if self.lower > 0 else -np.inf), self.coordinate(self.upper)
        return tuple(sorted((self.coordinate(self.lower), self.coordinate(self.upper))))  # type: ignore[return-value]


def magnitude(
    unit: str,
    typical_magnitude: float,
    null: float = 0.0,
    lower: float = -np.inf,
    upper: float = np.inf,
    reciprocal: bool = False,
) -> Any:
    """A field that says how large an effect is; its default is the null value.

    Args:
        unit: SI; empty where it has none.
        typical_magnitude: an everyday size of the difference from the null (reciprocal: an everyday value).
        null: value at which the effect is absent.
        lower, upper: bounds.
        reciprocal: whether the effect grows with one over the value.
    """
    kept = Parameter("", unit, null, typical_magnitude, lower, upper, (), reciprocal, False)
    return field(default=null, metadata={_KEY: kept})


def shape_parameter(
    unit: str,
    typical_magnitude: float,
    lower: float = 0.0,
    upper: float = np.inf,
    grid: Sequence[float] = (),
    integer: bool = False,
) -> Any:
    """A field that says how an effect is, which means nothing where its size is null.

    Args:
        unit: SI; empty where it has none.
        typical_magnitude: an everyday value, the default.
        lower, upper: bounds.
        grid: values from which searches start; the everyday value where empty.
        integer: whether it is a whole number.
    """
    kept = Parameter(
        "", unit, np.nan, typical_magnitude, lower, upper, tuple(grid) or (typical_magnitude,), False, integer
    )
    return field(default=int(typical_magnitude) if integer else typical_magnitude, metadata={_KEY: kept})


_KEY = "vjm"


@dataclass(frozen=True)
class Effect:
    """Something that a model may lack. Subclasses add parameters and override hooks.

    Attributes:
        link: index of the link, or of the joint at its proximal end, where it acts; None for what is camera-wide.
    """

    link: int | None = field(default=None, kw_only=True)

    id: ClassVar[str] = ""
    # In the words of a mechanical engineer, as in "the data say: ...".
    description: ClassVar[str] = ""
    # Where the model is described.
    reference: ClassVar[str] = ""
    # Which recording tells it from what it looks like.
    distinguishing_experiment: ClassVar[str] = ""
    # Whether it can only take energy out of the arm.
    dissipative: ClassVar[bool] = False
    # Whether it is in the sensors, not in the arm.
    sensor: ClassVar[bool] = False
    # Whether a URDF can carry it.
    in_urdf: ClassVar[bool] = False
    # Whether motion depends on it abruptly, as on what sticks and slips: it is looked for with simulated joints held
    # near the angles that were measured, and what is left after a fit need not be noise.
    nonsmooth: ClassVar[bool] = False

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """Its parameters, in order."""
        return tuple(replace(each.metadata[_KEY], name=each.name) for each in fields(cls) if _KEY in each.metadata)

    @property
    def key(self) -> Key:
        """What it is known by beside other effects: its id and its place."""
        return self.id, self.link

    @property
    def values(self) -> Mapping[str, float]:
        """Its parameters' values."""
        return {each.name: getattr(self, each.name) for each in self.parameters()}

    @cached_property
    def is_null(self) -> bool:
        """Whether it is absent."""
        return all(getattr(self, each.name) == each.null for each in self.parameters() if not each.shape_parameter)

    @property
    def coordinates(self) -> Array:
        """(p,) numbers that a search varies: sizes, zero at the null and one at an everyday size; then inner ones."""
        return np.array([each.coordinate(getattr(self, each.name)) for each in self._varied()])

    def at(self, coordinates: Array) -> Self:
        """The same effect at other coordinates (p,)."""
        varied = zip(self._varied(), np.asarray(coordinates, dtype=float).tolist(), strict=True)
        changes: dict[str, Any] = {each.name: each.value(value) for each, value in varied}
        return replace(self, **changes)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (p,), (p,) of the coordinates."""
        found = np.array([each.bounds for each in self._varied()]).reshape(-1, 2)
        return found[:, 0], found[:, 1]

    @property
    def sizes(self) -> int:
        """Number of coordinates, the first ones, that say how large it is."""
        return sum(not each.shape_parameter for each in self.parameters())

    @classmethod
    def _varied(cls) -> tuple[Parameter, ...]:
        found = [each for each in cls.parameters() if not each.integer]
        return tuple(sorted(found, key=lambda each: each.shape_parameter))

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Links on which it can act; None alone for what is camera-wide."""
        return (None,)

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """Absent instances from which searches start: one for each place and each combination of inner values."""
        grids = [[(each.name, value) for value in each.grid] for each in self.parameters() if each.shape_parameter]
        return tuple(
            replace(self, link=link, **dict(chosen)) for link in self.places(rig) for chosen in product(*grids)
        )

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Why recordings cannot show it, whatever its size, as a clause; empty where they may."""
        return ""

    # Hooks. They must return what they were given, exactly, where the effect is absent.

    def chain(self, chain: Chain) -> Chain:
        """The chain that it makes of a chain."""
        return chain

    def inputs(self, recording: Recording) -> Recording:
        """What really drove the arm, given what was recorded: torque and gravity."""
        return recording

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Its generalised forces on the joints of a chain with a payload [kg] on the tip [N m].

        The function returned is given the time since the recording's start [s], angles [rad], rates [rad/s] and the
        internal states, with any leading axes.
        """
        return None

    def smooth(self) -> Effect:
        """What stands for it where derivatives are taken: itself, unless it has none at instants."""
        return self

    def states(self, chain: Chain) -> int:
        """Number of its internal states."""
        return 0

    def rates(self, chain: Chain) -> Motion | None:
        """Their rates of change; needed where there are any and `rate_independent_update` says nothing of them."""
        return None

    def rate_independent_update(self, chain: Chain) -> RateIndependentUpdate | None:
        """How its internal states follow the joints, where that depends on the way and not on the time it takes.

        What slips has no slope at instants: `smooth` then says what stands for it, without internal states.
        """
        return None

    def rest(self, chain: Chain, q: Array) -> Array:
        """(..., nz) internal states at a recording's start, at angles (..., nv) [rad]."""
        return np.zeros((*q.shape[:-1], self.states(chain)))

    def rest_state(self, chain: Chain, q: Array) -> Array:
        """Angles (..., nv) near the given ones [rad] at which an arm on which nothing acts would stay."""
        return q

    @property
    def longest_step(self) -> float:
        """Time step that a simulation may take [s]."""
        return np.inf

    def instants(self, time: Array, positions: Array) -> Array:
        """When markers were where a frame shows them.

        Args:
            time: (F,) the frames' time stamps since the recording's start [s].
            positions: (F, k, 2) where the markers truly were at these instants [m].

        Returns:
            (F,), or (F, k) where markers differ, since the recording's start [s].
        """
        return time

    def shown(self, positions: Array, headings: Array) -> Array:
        """What the camera shows of markers at positions (F, k, 2) [m] where the link has headings (F, k) [rad]."""
        return positions

    def encoder(self, theta: Array) -> Array:
        """What the encoders show of active joint angles (T, n_a) [rad]."""
        return theta


def is_nonsmooth(effects: Sequence[Effect]) -> bool:
    """Whether something among them sticks and slips, or rattles."""
    return any(effect.nonsmooth for effect in effects)


NO_JOINT = "the arm has no active joint"
NO_TORQUE = "no torque was recorded"
NO_ENCODER = "no encoder was recorded"
NO_CLOCK = "nothing but the camera was recorded, so there is no other clock"
LINK_FRAME = "marker coordinates are relative to a link that turns, not to the camera"


@dataclass(frozen=True)
class LinkEffect(Effect):
    """Acts on a link, the first one where none is named."""

    @property
    def index(self) -> int:
        """Of the link."""
        return self.link or 0

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Every link."""
        return tuple(range(len(rig.links)))


@dataclass(frozen=True)
class JointEffect(LinkEffect):
    """Acts at a link's active joint."""

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Links with an active joint."""
        return rig.active_links

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Nothing turns where every link is clamped."""
        return "" if rig.active_links else NO_JOINT


@dataclass(frozen=True)
class ColumnEffect(JointEffect):
    """Acts on an active joint's column of a recording.

    Attributes:
        column: of `Recording.tau` and `Recording.theta`; None: the link's index, right where no link before it is
            clamped.
    """

    column: int | None = field(default=None, kw_only=True)

    @property
    def own(self) -> int:
        """The joint's column."""
        return self.index if self.column is None else self.column

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """One for each active joint."""
        found = super().variants(rig, recordings)
        return tuple(replace(each, column=rig.active_links.index(each.index)) for each in found)

    def column_of(self, values: Array, gain: float, offset: float) -> Array:
        """The joint's column of values (T, n_a) times a gain, and an offset added."""
        changed = values.copy()
        changed[:, self.own] = gain * values[:, self.own] + offset
        return changed


@dataclass(frozen=True)
class TipEffect(Effect):
    """Acts at the distal end of the last link."""

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """The last link."""
        return (len(rig.links) - 1,)


def changed_link(chain: Chain, index: int, **changes: Any) -> Chain:
    """The chain with fields of one link replaced."""
    links = list(chain.links)
    links[index] = replace(links[index], **changes)
    return replace(chain, links=tuple(links))


def active_coordinate(chain: Chain, index: int) -> int:
    """Coordinate of a link's active joint."""
    return int(chain.passive_slices[index].stop) - chain.links[index].coordinates


def has_torque(recordings: Sequence[Recording]) -> bool:
    """Whether any torque was recorded."""
    return any(bool(np.isfinite(recording.tau).any()) for recording in recordings)


def has_encoder(recordings: Sequence[Recording]) -> bool:
    """Whether any active joint angle was recorded."""
    return any(bool(np.isfinite(recording.theta).any()) for recording in recordings)


def in_base_frame(rig: Rig) -> bool:
    """Whether all marker coordinates are as the camera sees them: the frame of a first, clamped link is the base's."""
    return all(
        link.markers_frame == "base" or (i == 0 and link.joint == "clamped")
        for i, link in enumerate(rig.links)
        if link.markers
    )
