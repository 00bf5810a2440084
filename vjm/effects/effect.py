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
from typing import Any, ClassVar, Literal, Self

import numpy as np

from vjm.chain.virtual_links import Chain
from vjm.records import Array, Recording, Rig

Key = tuple[str, int | None]
# From time (...), q (..., nv), v (..., nv) and internal states z (..., nz) to forces (..., nv) or rates (..., nz).
Motion = Callable[[Array, Array, Array, Array], Array]
# From angles (..., nv) at which internal states (..., nz) were, those states and other angles to the states at these.
RateIndependentUpdate = Callable[[Array, Array, Array], Array]
# What the residual is drawn against: time, the local amplitude of the motion, a marker's velocity or coordinate, the
# distance from the base (of residuals along the radius, or across it), the marker's number, the frequency, or, as a
# missing torque, the active joint's angle or rate.
Abscissa = Literal[
    "time",
    "amplitude",
    "velocity",
    "position",
    "radial",
    "tangential",
    "marker",
    "frequency",
    "joint_angle",
    "joint_rate",
]


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
        from_spectrum: whether searches start from peaks of the residuals' spectrum instead of the grid [Hz].
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
    from_spectrum: bool

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
    kept = Parameter("", unit, null, typical_magnitude, lower, upper, (), reciprocal, False, False)
    return field(default=null, metadata={_KEY: kept})


def shape_parameter(
    unit: str,
    typical_magnitude: float,
    lower: float = 0.0,
    upper: float = np.inf,
    grid: Sequence[float] = (),
    integer: bool = False,
    from_spectrum: bool = False,
) -> Any:
    """A field that says how an effect is, which means nothing where its size is null.

    Args:
        unit: SI; empty where it has none.
        typical_magnitude: an everyday value, the default.
        lower, upper: bounds.
        grid: values from which searches start; the everyday value where empty.
        integer: whether it is a whole number.
        from_spectrum: whether searches start from peaks of the residuals' spectrum instead of the grid.
    """
    values = tuple(grid) or (typical_magnitude,)
    kept = Parameter("", unit, np.nan, typical_magnitude, lower, upper, values, False, integer, from_spectrum)
    return field(default=int(typical_magnitude) if integer else typical_magnitude, metadata={_KEY: kept})


_KEY = "vjm"


@dataclass(frozen=True)
class Effect:
    """Something that a model may lack; a subclass adds parameters and overrides the hooks it needs.

    Attributes:
        link: index of the link, or of the joint at its proximal end, where it acts; None for what is camera-wide.
    """

    link: int | None = field(default=None, kw_only=True)

    id: ClassVar[str] = ""
    # The effect in a few words, as a noun phrase.
    description: ClassVar[str] = ""
    # The same with its numbers, as the verdict states it: "{link}" stands for the link's name and each parameter's
    # name for its value in an everyday unit. Without one, the description is followed by the values.
    clause: ClassVar[str] = ""
    # The publication in which the model is described.
    reference: ClassVar[str] = ""
    # The recording that distinguishes it from effects that look alike.
    distinguishing_experiment: ClassVar[str] = ""
    # Abscissa of the picture that shows the residual without and with it.
    abscissa: ClassVar[Abscissa] = "time"
    # It is a frequent cause, whose smallest detectable magnitude is reported first.
    common: ClassVar[bool] = False
    # It can only take energy out of the arm.
    dissipative: ClassVar[bool] = False
    # It is in the sensors, not in the arm.
    sensor: ClassVar[bool] = False
    # A URDF can carry it.
    in_urdf: ClassVar[bool] = False
    # It makes the motion nonsmooth, as sticking or rattling does: searches for it hold simulated joints near their
    # measured angles, and what remains after a fit need not be noise.
    nonsmooth: ClassVar[bool] = False

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """Return its parameters, in order."""
        return tuple(replace(each.metadata[_KEY], name=each.name) for each in fields(cls) if _KEY in each.metadata)

    @property
    def key(self) -> Key:
        """Its id and its place, which identify it among other effects."""
        return self.id, self.link

    @property
    def values(self) -> Mapping[str, float]:
        """Its parameters' values by name."""
        return {each.name: getattr(self, each.name) for each in self.parameters()}

    @cached_property
    def is_null(self) -> bool:
        """True if it is absent: every magnitude is null."""
        return all(getattr(self, each.name) == each.null for each in self.parameters() if not each.shape_parameter)

    @property
    def coordinates(self) -> Array:
        """(p,) numbers that a search varies: magnitudes over typical ones, then logarithms of shape parameters."""
        return np.array([each.coordinate(getattr(self, each.name)) for each in self._varied()])

    def at(self, coordinates: Array) -> Self:
        """Return the same effect at other coordinates (p,)."""
        varied = zip(self._varied(), np.asarray(coordinates, dtype=float).tolist(), strict=True)
        changes: dict[str, Any] = {each.name: each.value(value) for each, value in varied}
        return replace(self, **changes)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (p,), (p,) of the coordinates."""
        pairs = np.array([each.bounds for each in self._varied()]).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    @property
    def magnitude_count(self) -> int:
        """Number of coordinates, the first ones, that are magnitudes."""
        return sum(not each.shape_parameter for each in self.parameters())

    @classmethod
    def _varied(cls) -> tuple[Parameter, ...]:
        varied = [each for each in cls.parameters() if not each.integer]
        return tuple(sorted(varied, key=lambda each: each.shape_parameter))

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Return the indices of the links on which it can act; None alone for what is camera-wide."""
        return (None,)

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """Return absent instances from which searches start: one for each place and combination of shape parameters."""
        grids = [[(each.name, value) for value in each.grid] for each in self.parameters() if each.shape_parameter]
        return tuple(
            replace(self, link=link, **dict(chosen)) for link in self.places(rig) for chosen in product(*grids)
        )

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Return the reason, as a clause, why recordings cannot show it whatever its magnitude; empty if they may."""
        return ""

    # Hooks. They must return their argument itself where the effect is absent.

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with the changes that it makes to masses, springs, dampers and joints."""
        return chain

    def true_inputs(self, recording: Recording) -> Recording:
        """Return the recording with the torque and the gravity that really acted on the arm."""
        return recording

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Return the function that gives its generalised forces [N m] on the joints, or None without any.

        The function takes the time since the recording's start (...) [s], angles (..., nv) [rad], rates (..., nv)
        [rad/s] and internal states (..., nz), with any leading axes, and returns (..., nv).

        Args:
            chain: of the arm, with all effects' changes.
            payload: known mass on the tip [kg].
        """
        return None

    def smoothed(self) -> Effect:
        """Return the effect from which derivatives by the parameters are taken: itself, if the motion is smooth."""
        return self

    def state_count(self, chain: Chain) -> int:
        """Return the number nz of its internal states, such as the deflection of a bristle."""
        return 0

    def state_rates(self, chain: Chain) -> Motion | None:
        """Return the function, as of `force`, that gives the internal states' rates of change (..., nz).

        It is needed where there are states and `rate_independent_update` returns None.
        """
        return None

    def rate_independent_update(self, chain: Chain) -> RateIndependentUpdate | None:
        """Return the function that moves internal states along with the joints, whatever time that takes.

        It takes angles (..., nv) [rad], the states (..., nz) there and other angles, and returns the states at these.
        States that slip have no derivatives: `smoothed` must then return an effect without internal states.
        """
        return None

    def initial_states(self, chain: Chain, q: Array) -> Array:
        """Return internal states (..., nz) at a recording's start, where the angles are q (..., nv) [rad]."""
        return np.zeros((*q.shape[:-1], self.state_count(chain)))

    def rest_angles(self, chain: Chain, q: Array) -> Array:
        """Return angles (..., nv) near q (..., nv) [rad] at which an arm without load would stay at rest."""
        return q

    @property
    def max_step(self) -> float:
        """Longest time step [s] with which a simulation resolves it."""
        return np.inf

    @property
    def joint_friction(self) -> float:
        """Dry friction torque at the active joint [N m], as a URDF has it."""
        return 0.0

    def camera_instants(self, time: Array, positions: Array) -> Array:
        """Return the instants [s] at which the camera really saw what its frames show.

        Args:
            time: (F,) the frames' time stamps since the recording's start [s].
            positions: (F, k, 2) true positions of the markers at these time stamps [m].

        Returns:
            (F,), or (F, k) if markers differ, since the recording's start [s].
        """
        return time

    def marker_positions(self, positions: Array, headings: Array) -> Array:
        """Return the positions (F, k, 2) [m] that the camera reports.

        Args:
            positions: (F, k, 2) true positions of the markers [m].
            headings: (F, k) direction of the link's tangent at each marker [rad].
        """
        return positions

    def encoder_angles(self, theta: Array) -> Array:
        """Return the angles (T, n_a) [rad] that the encoders report of active joint angles theta (T, n_a) [rad]."""
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
