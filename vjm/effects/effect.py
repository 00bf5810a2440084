"""The base of effects: parameters with null values, and hooks that default to nothing.

An effect is something that a model of an arm may lack: a mass on its tip, friction, a clock that runs ahead. It is a
frozen dataclass whose fields are its parameters; the instance with the default values changes nothing, exactly. The
hooks say what it changes: the chain, what drives it, the forces on it, what its sensors show.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import product
from typing import Any, ClassVar, Literal, Self

import numpy as np

from vjm.chain.virtual_links import Chain, LinkChain
from vjm.effects.contact import Contact
from vjm.errors import ShapeError
from vjm.records import Array, Payload, Recording, Rig

Key = tuple[str, int | None]
# From time (...), q (..., nv), v (..., nv) and internal states z (..., nz) to forces (..., nv) or rates (..., nz).
StateFunction = Callable[[Array, Array, Array, Array], Array]
SENSING_HOOKS = ("camera_instants", "marker_positions", "encoder_angles")
_METADATA = "vjm"
# Powers of length, mass and time in units.
_UNITS = {"m": (1, 0, 0), "kg": (0, 1, 0), "s": (0, 0, 1), "Hz": (0, 0, -1), "N": (1, 1, -2), "rad": (0, 0, 0)}
_PRODUCT = r"[A-Za-z]+(?:\^?\d+)?(?: [A-Za-z]+(?:\^?\d+)?)*"
_UNIT = re.compile(rf"(1|{_PRODUCT})?(?: ?/ ?({_PRODUCT}|\({_PRODUCT}\)))?")


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect."""

    unit: str  # SI; empty without one
    typical_magnitude: float  # difference from `null` (the value itself if reciprocal or a shape parameter)
    null: float  # value at which the effect is absent; NaN for a shape parameter, which is irrelevant then
    lower: float = -np.inf  # bounds of the value
    upper: float = np.inf
    grid: tuple[float, ...] = ()  # values of a shape parameter from which searches start
    reciprocal: bool = False  # the effect grows with one over the value, whose null is infinite
    threshold: float = np.inf  # of a reciprocal one: value below which it acts, where its coordinate is zero
    integer: bool = False  # it is a whole number, which is never varied in a fit
    # Of a shape parameter that may be zero: its coordinate is this power, in which the motion is about linear, of the
    # value over a typical one; an odd power has its sign. None: the logarithm, whose slope vanishes at zero.
    power: int | None = None
    # Searches start from peaks of the residuals' spectrum, over time or over the joint's angle, instead of the grid.
    from_spectrum: Literal["", "time", "joint_angle"] = ""
    # Typical magnitude, bounds and grid are multiples of the rig's own unit, made of the link's length l, its mass m
    # and the time (m l^3 / EI)^(1/2). In these units all uniform beams have the same equation of motion; the first
    # natural frequency of a clamped one is 0.56.
    in_rig_units: bool = False
    name: str = ""  # as in the class

    @property
    def shape_parameter(self) -> bool:
        """True if it says how the effect is, not how large."""
        return bool(np.isnan(self.null))

    def coordinate(self, value: float) -> float:
        """Return the number that a search varies: zero at the null, one at a typical magnitude.

        Of a shape parameter it is the logarithm of the value over a typical one, or a power of that.
        """
        with np.errstate(divide="ignore"):
            if self.reciprocal:
                excess = np.divide(self.typical_magnitude, max(value, 0.0)) - self.typical_magnitude / self.threshold
                return max(float(excess), 0.0)
            if self.power:
                return float((value / self.typical_magnitude) ** self.power)
            if self.shape_parameter:
                return float(np.log(value / self.typical_magnitude))
        return (value - self.null) / self.typical_magnitude

    def value(self, coordinate: float) -> float:
        """Return the value at a coordinate."""
        if self.reciprocal:
            inverse = coordinate + self.typical_magnitude / self.threshold
            return self.typical_magnitude / inverse if coordinate > 0 else np.inf
        if self.power:
            positive = self.power % 2 == 1 or coordinate > 0
            root = abs(coordinate) ** (1 / self.power) if positive else 0.0
            return self.typical_magnitude * float(np.copysign(root, coordinate))
        if self.shape_parameter:
            return float(self.typical_magnitude * np.exp(coordinate))
        return self.null + self.typical_magnitude * coordinate

    @property
    def bounds(self) -> tuple[float, float]:
        """Lower and upper bound of the coordinate."""
        low, high = sorted((self.coordinate(self.lower), self.coordinate(self.upper)))
        return low, high

    def on(self, rig_units: tuple[float, float, float] | None) -> Parameter:
        """Return the parameter in SI, from a rig's units of length [m], mass [kg], time [s]; None: bounds keep signs.

        Raises:
            ShapeError: a unit that is no product of powers of known ones.
        """
        if not self.in_rig_units:
            return self
        if rig_units is None:
            return replace(self, lower=0.0 if self.lower >= 0 else -np.inf, upper=np.inf, in_rig_units=False)
        unit = float(np.prod(np.array(rig_units) ** _powers(self.unit)))
        scaled = {name: unit * getattr(self, name) for name in ("typical_magnitude", "lower", "upper")}
        return replace(self, **scaled, grid=tuple(unit * value for value in self.grid), in_rig_units=False)


def _powers(unit: str) -> Array:
    """Return the (3,) powers of length, mass and time in a unit such as `N m s/rad` or `rad/(N m)`."""
    parts = _UNIT.fullmatch(unit)
    factors = [
        (sign * int(power or 1), name)
        for sign, part in zip((1, -1), parts.groups("") if parts else ("", ""), strict=True)
        for name, power in re.findall(r"([A-Za-z]+)\^?(\d*)", part)
    ]
    if not parts or any(name not in _UNITS for _, name in factors):
        raise ShapeError("unit", unit, f"powers of {', '.join(_UNITS)} such as `m^2`, one slash at most, or SI values")
    return sum((power * np.array(_UNITS[name]) for power, name in factors), start=np.zeros(3))


def _units(length: float, mass: float, bending_stiffness: float) -> tuple[float, float, float]:
    return length, mass, float(np.sqrt(mass * length**3 / bending_stiffness))


def magnitude(unit: str, typical_magnitude: float, null: float = 0.0, **attributes: Any) -> Any:
    """Declare a field that says how large an effect is; its default is the null value.

    Further attributes of `Parameter` that it may have: `lower`, `upper`, `reciprocal`, `in_rig_units`.
    """
    return field(default=null, metadata={_METADATA: Parameter(unit, typical_magnitude, null, **attributes)})


def shape_parameter(unit: str, typical_magnitude: float, lower: float = 0.0, **attributes: Any) -> Any:
    """Declare a field that says how an effect is, and is irrelevant where its magnitudes are null.

    The typical value is the default, zero if it has a power; the default is the grid if none is given. Further
    attributes of `Parameter` that it may have: `upper`, `grid`, `integer`, `power`, `from_spectrum`,
    `in_rig_units`.
    """
    usual = 0.0 if attributes.get("power") else typical_magnitude
    default = int(usual) if attributes.get("integer") else usual
    grid = attributes.pop("grid", (usual,))
    shape = Parameter(unit, typical_magnitude, np.nan, lower, grid=grid, **attributes)
    return field(default=default, metadata={_METADATA: shape})


@dataclass(frozen=True)
class Effect:
    """Something that a model may lack; a subclass adds parameters and overrides the hooks it needs."""

    # Index of the link, or of the joint at its proximal end, where it acts; None for what is camera-wide.
    link: int | None = field(default=None, kw_only=True)
    # Length [m], mass [kg] and time [s] of its place, which scale `coordinates`; None: on no rig yet.
    rig_units: tuple[float, float, float] | None = field(default=None, kw_only=True, compare=False, repr=False)
    # True in an arm whose derivatives are taken: dry friction then changes its sign gradually, not at once.
    smooth: bool = field(default=False, kw_only=True, repr=False)
    # Names of shape parameters that no search varies.
    fixed: tuple[str, ...] = field(default=(), kw_only=True, compare=False, repr=False)

    id: ClassVar[str] = ""  # the class's name in snake case where it is not given
    title: ClassVar[str] = ""  # its name in tables and sentences; the words of its id where it is not given
    description: ClassVar[str] = ""  # the effect in a few words, as a noun phrase
    # What the verdict says: "{link}" stands for the link's name and each parameter's name for its value in an everyday
    # unit; what is in square brackets is left out unless its parameter is known to differ from zero. Without a clause,
    # the description is followed by the values.
    clause: ClassVar[str] = ""
    # What its model takes for granted beyond its parameters: noun phrases separated by semicolons, or `none`.
    assumptions: ClassVar[str] = ""
    reference: ClassVar[str] = ""  # the publication in which the model is described
    distinguishing_experiment: ClassVar[str] = ""  # the recording that distinguishes it from effects that look alike
    # Abscissa of the picture that shows the residual without and with it: `time`; `amplitude`, the local one of the
    # motion; `velocity` or `position` of a marker's coordinate; `radial` or `tangential`, the distance from the base of
    # residuals along or across it; `marker`; `frequency`; of a missing torque `joint_angle` or `joint_rate`.
    abscissa: ClassVar[str] = "time"
    common: ClassVar[bool] = False  # it is a frequent cause, whose smallest detectable magnitude is reported first
    dissipative: ClassVar[bool] = False  # it can only take energy out of the arm
    in_urdf: ClassVar[bool] = False  # a URDF can carry it
    in_simulators: ClassVar[bool] = False  # a URDF cannot, but simulators' own files can: it is a spring, or gravity
    # Effects change what the camera sees in this order: the markers themselves, the perspective (1), the lens (2), the
    # picture's scale and turn (3), its shift (4). Otherwise their sizes would depend on which a search finds first.
    camera_order: ClassVar[int] = 0
    # It makes the motion nonsmooth, as sticking or rattling does: searches for it hold simulated joints near their
    # measured angles, and what remains after a fit need not be noise.
    nonsmooth: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        if "id" not in vars(cls):
            cls.id = re.sub("(?<!^)(?=[A-Z])", "_", cls.__name__).lower()
        if "title" not in vars(cls):
            cls.title = cls.id.replace("_", " ").capitalize()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its parameters, in order, on its rig."""
        declared = [(f.name, f.metadata[_METADATA]) for f in fields(self) if _METADATA in f.metadata]
        return tuple(replace(parameter, name=name).on(self.rig_units) for name, parameter in declared)

    @property
    def sensor(self) -> bool:
        """True if it is in the sensors: it has a hook that says what these show."""
        hooks = (*SENSING_HOOKS, "timing_noise")
        return any(getattr(type(self), hook) is not getattr(Effect, hook) for hook in hooks)

    @property
    def key(self) -> Key:
        """Its id and its place, which identify it among other effects."""
        return self.id, self.link

    @property
    def values(self) -> Mapping[str, float]:
        """Its parameters' values by name."""
        return {parameter.name: getattr(self, parameter.name) for parameter in self.parameters}

    @cached_property
    def is_null(self) -> bool:
        """True if it is absent: every magnitude is null."""
        return all(getattr(self, p.name) == p.null for p in self.parameters if not p.shape_parameter)

    @property
    def at_bounds(self) -> tuple[bool, ...]:
        """For each magnitude, whether it is at a bound: it is then no estimate, and stands in for something else."""
        magnitudes = [p for p in self.parameters if not p.shape_parameter and not p.integer]
        return tuple(
            any(
                np.isclose(parameter.coordinate(getattr(self, parameter.name)), bound, rtol=1e-6, atol=0.0)
                for bound in parameter.bounds
                if np.isfinite(bound) and bound != 0.0  # which is the null
            )
            for parameter in magnitudes
        )

    @property
    def coordinates(self) -> Array:
        """(p,) numbers that a search varies: magnitudes over typical ones, then shape parameters' coordinates."""
        return np.array([parameter.coordinate(getattr(self, parameter.name)) for parameter in self._varied])

    def at(self, coordinates: Array) -> Self:
        """Return the same effect at other coordinates (p,)."""
        varied = zip(self._varied, np.asarray(coordinates, dtype=float).tolist(), strict=True)
        changes: dict[str, Any] = {parameter.name: parameter.value(value) for parameter, value in varied}
        return replace(self, **changes)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (p,), (p,) of the coordinates."""
        pairs = np.array([parameter.bounds for parameter in self._varied]).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    @property
    def magnitude_count(self) -> int:
        """Number of coordinates, the first ones, that are magnitudes."""
        return sum(not parameter.shape_parameter for parameter in self.parameters)

    @property
    def size_coordinates(self) -> tuple[int, ...]:
        """Indices of the coordinates that are zero where it is absent: its magnitudes, unless a search varies more."""
        return tuple(range(self.magnitude_count))

    @property
    def root_coordinates(self) -> tuple[int, ...]:
        """Indices of the coordinates of which the parameter is a root: its slope is infinite where they are zero."""
        return tuple(k for k, parameter in enumerate(self._varied) if (parameter.power or 1) > 1)

    def scaled(self, factor: float) -> Self:
        """Return the effect with its magnitudes times a factor."""
        coordinates = self.coordinates
        coordinates[[*self.size_coordinates]] *= factor
        return self.at(coordinates)

    @property
    def _varied(self) -> tuple[Parameter, ...]:
        varied = [p for p in self.parameters if not p.integer and p.name not in self.fixed]
        return tuple(sorted(varied, key=lambda parameter: parameter.shape_parameter))

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Return the indices of the links on which it can act; None alone for what is camera-wide."""
        return (None,)

    def placed(self, rig: Rig, link: int | None) -> Self:
        """Return the effect on a link of a rig, or on the whole arm, whose units then scale its coordinates."""
        links = rig.links if link is None else (rig.links[link],)
        length, mass = sum(part.length for part in links), sum(part.mass for part in links)
        return replace(self, link=link, rig_units=_units(length, mass, min(part.bending_stiffness for part in links)))

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """Return absent instances from which searches start: one for each place and combination of shape parameters."""
        result: list[Self] = []
        for instance in (self.placed(rig, link) for link in self.places(rig)):
            grids = [[(p.name, value) for value in p.grid] for p in instance.parameters if p.shape_parameter]
            changes: list[dict[str, Any]] = [dict(values) for values in product(*grids)]
            result += [replace(instance, **change) for change in changes]
        return tuple(result)

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Return the reason, as a clause, why recordings cannot show it whatever its magnitude; empty if they may."""
        return ""

    def adds_joint(self, chain: Chain) -> bool:
        """Return True if the effect is a joint of its own, which the chain does not have at the effect's null."""
        coordinates = self.coordinates
        present = self.at(np.where(np.arange(coordinates.size) < self.magnitude_count, 1.0, 0.0))
        return present.chain(chain).size != chain.size

    def nested(self) -> Self:
        """Return the nested effect: shape parameters that start from zero, as a payload's offset, are fixed there."""
        fixed = tuple(p.name for p in self.parameters if p.shape_parameter and p.power and not any(p.grid))
        changes: dict[str, Any] = {"fixed": fixed, **dict.fromkeys(fixed, 0.0)}
        return replace(self, **changes)

    def with_softer_joint(self, factor: float) -> Self:
        """Return it with the compliance of a joint of its own times a factor, and shape parameters at coordinate zero.

        The joint's frequency falls by the factor's root; a search that found one such frequency tries others.
        """
        coordinates = np.where(np.arange(self.coordinates.size) < self.magnitude_count, self.coordinates, 0.0)
        coordinates[0] *= factor
        return self.at(coordinates)

    def recentred(self) -> Self:
        """Return it with its coordinates' origin moved here, if it is too far from there for them to lead a search."""
        return self

    def superposes(self, other: Effect) -> bool:
        """Return True if small sizes of it and of another variant do together what one instance does."""
        return False

    def superposition(self, variants: Sequence[Effect], sizes: Array) -> tuple[Self, Array]:
        """Return the absent instance that does what variants of it (V,) do together, and its sizes (s,).

        Args:
            variants: absent ones that superpose.
            sizes: (V,) of each, in typical magnitudes.
        """
        raise NotImplementedError

    # Hooks. Where the effect is absent they must change nothing, to the last bit.

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with the changes that it makes to masses, springs, dampers and joints."""
        return chain

    def true_inputs(self, recording: Recording) -> Recording:
        """Return the recording with the torque and the gravity that really acted on the arm."""
        return recording

    def force(self, chain: Chain, payload: Payload) -> StateFunction | None:
        """Return the function that gives its generalised forces (..., nv) [N m] on the joints, or None without any.

        The function takes the time since the recording's start (...) [s], angles (..., nv) [rad], rates (..., nv)
        [rad/s] and internal states (..., nz), with any leading axes. The chain is the arm's with all effects' changes,
        the payload what is known to be on the tip.
        """
        return None

    def initial_states(self, chain: Chain, q: Array) -> Array:
        """Return internal states (..., nz), such as those of a Maxwell arm, at a recording's start.

        The angles there are q (..., nv) [rad].
        """
        return np.zeros((*q.shape[:-1], 0))

    def state_rates(self, chain: Chain) -> StateFunction | None:
        """Return the function, as of `force`, that gives the internal states' rates of change (..., nz).

        It is needed where there are states.
        """
        return None

    def rest_angles(self, chain: Chain, q: Array) -> Array:
        """Return angles (..., nv) near q (..., nv) [rad] at which an arm without load would stay at rest."""
        return q

    def other_states(self, chain: Chain, state: Array) -> Array:
        """Return states (m, 2 nv) in which the arm may be instead of one (2 nv,), however far slopes lead from that.

        Searches for initial states where something sticks or rattles begin from these as well.
        """
        return np.zeros((0, state.size))

    def max_step(self, chain: Chain) -> float:
        """Return the longest time step [s] with which a simulation resolves it."""
        return np.inf

    def dry_friction(self, chain: Chain) -> tuple[int, Callable[[Array], Array]] | None:
        """Return the coordinate of an active joint that it brakes, and its dry friction; None without any.

        The friction is a function from rates (...) [rad/s] to the torque (...) [N m] against the motion, the largest
        that holds the joint at rest.
        """
        return None

    def contact(self, chain: Chain) -> Contact | None:
        """Return the gap of a joint, whose flanks are among the springs and dampers of `chain`; None without any."""
        return None

    def camera_instants(self, time: Array, positions: Array) -> Array:
        """Return the instants (F,), or (F, k) if markers differ, at which the camera saw what its frames show [s].

        Args:
            time: (F,) the frames' time stamps since the recording's start, as are the instants [s].
            positions: (F, k, 2) true positions of the markers when they were seen [m].
        """
        return time

    def longest_delay(self, rig: Rig) -> float:
        """Return how late [s] frames are at most, by the bound of what is looked for on a rig."""
        return 0.0

    @property
    def timing_noise(self) -> float:
        """Standard deviation of the instants at which the camera takes its frames, about those it should [s]."""
        return 0.0

    def marker_positions(self, positions: Array, headings: Array, time: Array) -> Array:
        """Return the positions (F, k, 2) [m] that the camera reports.

        Args:
            positions: (F, k, 2) true positions of the markers [m].
            headings: (F, k) direction of the link's tangent at each marker [rad].
            time: (F,) when the camera saw them, since the recording's start [s].
        """
        return positions

    def encoder_angles(self, theta: Array) -> Array:
        """Return the angles (T, n_a) [rad] that the encoders report of active joint angles theta (T, n_a) [rad]."""
        return theta


def is_nonsmooth(effects: Sequence[Effect]) -> bool:
    """Return True if one of the effects sticks and slips, or rattles."""
    return any(effect.nonsmooth for effect in effects)


def is_recorded(recordings: Sequence[Recording], name: Literal["tau", "theta"]) -> bool:
    """Return True if torques or active joint angles were recorded."""
    return any(bool(np.isfinite(getattr(recording, name)).any()) for recording in recordings)


@dataclass(frozen=True)
class WaveEffect(Effect):
    """A wave over time or a joint's angle, with a frequency or a number of waves that is found in a spectrum.

    Its magnitudes are amplitudes of cosine and sine, in which the motion is about linear. Unless a subclass says
    otherwise, the first three parameters are amplitude, frequency or number of waves, and phase.

    Attributes:
        lowest: frequency or number of waves to which searches may go; what takes longer than the recordings is no wave.
    """

    lowest: float = field(default=0.0, kw_only=True, compare=False)

    @property
    def coordinates(self) -> Array:
        """(3,) amplitudes of cosine and sine over a typical one, logarithm of the frequency over a typical one."""
        amplitude, frequency, phase = self.parameters
        radius, angle = amplitude.coordinate(getattr(self, amplitude.name)), getattr(self, phase.name)
        tone = frequency.coordinate(getattr(self, frequency.name))
        return np.array([radius * np.cos(angle), radius * np.sin(angle), tone])

    def at(self, coordinates: Array) -> Self:
        """Return the same effect at other coordinates (3,); without amplitude, at phase zero."""
        amplitude, frequency, phase = self.parameters
        cosine, sine, tone = np.asarray(coordinates, dtype=float).tolist()
        size, angle = amplitude.value(float(np.hypot(cosine, sine))), float(np.arctan2(sine, cosine))
        changes: dict[str, Any] = {amplitude.name: size, frequency.name: frequency.value(tone), phase.name: angle}
        return replace(self, **changes)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (p,), (p,) of the coordinates, of which only the frequency, the last, has any."""
        low, high = self._frequency.bounds
        low = max(low, self._frequency.coordinate(self.lowest)) if self.lowest > 0 else low
        unbounded = np.full(self.magnitude_count, np.inf)
        return np.r_[-unbounded, low], np.r_[unbounded, high]

    @property
    def magnitude_count(self) -> int:
        """Number of magnitudes: of cosine and sine."""
        return 2

    @property
    def _frequency(self) -> Parameter:
        return next(parameter for parameter in self.parameters if parameter.from_spectrum)

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """Return it with frequencies down to one period in the longest recording, where it is a wave over time."""
        variants = super().variants(rig, recordings)
        longest = max((float(np.ptp(recording.time)) for recording in recordings), default=0.0)
        if self._frequency.from_spectrum != "time" or longest == 0:
            return variants
        return tuple(replace(variant, lowest=1 / longest) for variant in variants)


@dataclass(frozen=True)
class LinkEffect(Effect):
    """An effect on a link, the first one if none is named."""

    @property
    def link_index(self) -> int:
        """Index of the link."""
        return self.link or 0

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Return every link."""
        return tuple(range(len(rig.links)))

    def link_of(self, chain: Chain) -> LinkChain:
        """Return its link."""
        return chain.links[self.link_index]

    def virtual_joints(self, chain: Chain) -> slice:
        """Return the coordinates of its link's virtual joints."""
        return chain.passive_slices[self.link_index]

    def units(self, chain: Chain) -> tuple[float, float, float]:
        """Return its units of length [m], mass [kg] and time [s]: its rig's, or else those of a chain's link."""
        link = self.link_of(chain)
        return self.rig_units or _units(link.length, float(link.masses.sum()), link.bending_stiffness)

    def with_link(self, chain: Chain, **changes: Any) -> Chain:
        """Return the chain with fields of its link replaced."""
        links = list(chain.links)
        links[self.link_index] = replace(self.link_of(chain), **changes)
        return replace(chain, links=tuple(links))

    @staticmethod
    def force_on(coordinates: slice | int, force: StateFunction) -> StateFunction:
        """Return generalised forces that act on some coordinates only, where they are what a function returns."""

        def on_all(time: Array, q: Array, v: Array, z: Array) -> Array:
            forces = np.zeros(q.shape)
            forces[..., coordinates] = force(time, q, v, z)
            return forces

        return on_all


@dataclass(frozen=True)
class JointEffect(LinkEffect):
    """An effect at a link's active joint."""

    # It acts on the joint's drive, and does nothing where the drive's motion is given.
    on_drive: ClassVar[bool] = True

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Return the links with an active joint."""
        return rig.active_links

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Return the reason if every link is clamped, or the motion that it would change is given."""
        if not rig.active_links:
            return "the arm has no active joint"
        prescribed = self.on_drive and all(recording.input == "motion" for recording in recordings)
        return "the motion of the joint is given, whatever acts on its drive" if prescribed else ""

    def active_joint(self, chain: Chain) -> int:
        """Return the coordinate of its joint."""
        return int(self.virtual_joints(chain).stop) - self.link_of(chain).coordinates


@dataclass(frozen=True)
class ColumnEffect(JointEffect):
    """An effect on an active joint's column of recorded torques or angles."""

    # Its number; None: the link's index, right if no link before it is clamped.
    column: int | None = field(default=None, kw_only=True)

    # The field of a recording that has the column.
    column_of: ClassVar[Literal["tau", "theta"]] = "tau"

    def placed(self, rig: Rig, link: int | None) -> Self:
        """Return the effect at a joint of a rig, with the joint's column."""
        return replace(super().placed(rig, link), column=rig.active_links.index(link or 0))

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Return the reason if every link is clamped, or nothing that could be wrong was recorded."""
        missing = f"no {'torque' if self.column_of == 'tau' else 'encoder'} was recorded"
        return super().untestable(rig, recordings) or ("" if is_recorded(recordings, self.column_of) else missing)

    @property
    def own_column(self) -> int:
        """Number of the joint's column."""
        return self.link_index if self.column is None else self.column

    def with_column(self, values: Array, gain: float = 1.0, offset: float | Array = 0.0) -> Array:
        """Return values (T, n_a) with the joint's column times a gain, and an offset added."""
        changed, column = values.copy(), self.own_column
        changed[:, column] = gain * values[:, column] + offset
        return changed
