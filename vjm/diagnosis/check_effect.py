"""The contract of effects: what every one must keep, so that simulations, fits and searches may rely on it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass, replace
from functools import cache
from itertools import product
from types import MappingProxyType
from typing import Any, NamedTuple, NoReturn

import numpy as np
from scipy.integrate import cumulative_trapezoid

from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.diagnosis.candidate_fit import Extension, adds_joint
from vjm.diagnosis.candidates import CandidateSet
from vjm.diagnosis.screen import Screen
from vjm.effects.effect import Effect, Parameter
from vjm.errors import EffectError, SimulationDivergedError
from vjm.identification.parameters import Parametrisation
from vjm.identification.trajectory_fit import Point, TrajectoryProblem, fit_trajectory
from vjm.model import dynamics
from vjm.records import Array, Kind, Link, Recording, Rig, Simulation
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import default_step, sensor_readings, simulate_trajectories
from vjm.simulation.measurement import MarkerArcs, Observations
from vjm.simulation.run import InitialStatePrior, simulate_runs, transfer_state
from vjm.simulation.sensitivity import MotionSamples, follow_internal_states
from vjm.simulation.system import Trajectory


@dataclass(frozen=True)
class Clause:
    """One clause of the contract, as an effect is held to it.

    Attributes:
        effect: the effect's id, or its class where it has none.
        name: of the clause.
    """

    effect: str
    name: str

    def broken(self, found: str, expected: str) -> NoReturn:
        """Say so.

        Raises:
            EffectError: always.
        """
        raise EffectError(self.effect, self.name, found, expected)

    def holds(self, condition: object, found: str, expected: str) -> None:
        """Nothing, where a condition holds.

        Raises:
            EffectError: it does not hold.
        """
        if not condition:
            self.broken(found, expected)

    @contextmanager
    def running(self, what: str) -> Iterator[None]:
        """While something that an effect's author wrote is running: whatever goes wrong there breaks the clause.

        Raises:
            EffectError: it has raised an error; of the clause `inputs` where it wrote into an array that it was given.
        """
        try:
            yield
        except EffectError:
            raise
        except SimulationDivergedError as error:
            raise EffectError(self.effect, self.name, f"{what} diverges: {error}", "finite motion") from error
        except Exception as error:
            if isinstance(error, ValueError) and "read-only" in str(error):
                found = f"{what} writes into an array that it was given"
                raise EffectError(self.effect, "inputs", found, "a new array") from error
            found = f"{what} raises {type(error).__name__}: {error}"
            raise EffectError(self.effect, self.name, found, "no error") from error


_JOINTS = 3
_KELVIN_VOIGT = 5e-4  # s
_RATE = 50.0  # frames and encoder readings a second
_HANGING = (9.81, 0.0)  # m/s^2; the arm hangs along its x axis
_INNER = 0.1  # logarithm of an inner parameter over its everyday value: no search starts right there

_DRIVEN = Link("beam", "revolute", 1.0, 0.44, 1.9, (0.2, 0.4, 0.6, 0.8, 1.0), hub_inertia=0.02)
_CLAMPED = replace(_DRIVEN, joint="clamped", hub_inertia=0.0)
_POST = replace(_CLAMPED, name="post", length=0.6, markers=(0.3, 0.6))


@dataclass(frozen=True)
class Trial:
    """One recording to be made.

    Attributes:
        recording: instants, torques and gravity; all measurements are zero.
        state: (2 nv,) initial angles [rad] and rates [rad/s] of the chain without effects.
    """

    recording: Recording
    state: Array


@dataclass(frozen=True)
class Bench:
    """A rig, its chain, and what is recorded on it.

    Attributes:
        rig: the arm.
        chain: of its true values, without effects.
        trials: recordings, the one with the widest motion first.
    """

    rig: Rig
    chain: Chain
    trials: tuple[Trial, ...]

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """Of the trials, with zeros for measurements."""
        return tuple(trial.recording for trial in self.trials)

    def refusal(self, effect: Effect) -> str:
        """Why the effect cannot be tried here, in its own words; empty where it can."""
        reason = effect.untestable(self.rig, self.recordings)
        return reason or ("" if effect.places(self.rig) else "there is no place for it")

    def placed(self, effect: Effect) -> Effect:
        """The last variant here, with everyday sizes, and inner parameters a little off their everyday values."""
        absent = effect.variants(self.rig, self.recordings)[-1]
        coordinates = np.full(absent.coordinates.size, _INNER)
        coordinates[: absent.magnitude_count] = 1.0
        return absent.at(np.clip(coordinates, *absent.bounds))

    def states(self, arm: Arm) -> list[Array]:
        """(2 nv,) initial state of each trial, in the joints of an arm made of this chain."""
        return [transfer_state(self.chain, arm.chain, trial.state) for trial in self.trials]

    def steps(self, arm: Arm, step: float | None = None) -> list[Trajectory]:
        """Trajectories of all trials, by an arm made of this chain.

        Args:
            arm: the chain with effects.
            step: [s]; None: the integrator's default.

        Raises:
            SimulationDivergedError: one of them diverged.
        """
        q, v = zip(*(np.split(state, 2) for state in self.states(arm)), strict=True)
        return simulate_trajectories([arm] * len(self.trials), self.recordings, q, v, step=step)

    def simulate(self, arm: Arm, step: float | None = None) -> list[Simulation]:
        """The same at the recordings' instants, as the sensors show them."""
        arcs, runs = MarkerArcs.of(self.rig), self.steps(arm, step)
        return [sensor_readings(arm, arcs, *each) for each in zip(self.recordings, runs, strict=True)]

    def beginning(self, duration: float) -> Bench:
        """The first trial alone, and of that the first seconds."""
        trial = self.trials[0]
        recording = trial.recording
        rows = int(np.searchsorted(recording.time, duration, side="right"))
        columns = {name: getattr(recording, name)[:rows] for name in ("time", "theta", "tau", "markers")}
        return replace(self, trials=(replace(trial, recording=replace(recording, **columns)),))

    def undamped(self) -> Bench:
        """The free decays without gravity, of a chain that loses no energy."""
        links = tuple(replace(link, damping=np.zeros(link.damping.size)) for link in self.chain.links)
        free = [each for each in self.trials if each.recording.kind == "decay" and not any(each.recording.gravity)]
        return replace(self, chain=replace(self.chain, links=links), trials=tuple(free))

    def step(self, arm: Arm) -> float:
        """Step [s] with which both an arm and its chain without effects can be simulated."""
        return min(default_step(self.chain), default_step(arm.chain), arm.longest_step)


class _Plan(NamedTuple):
    """One recording: how long [s], driven by which sines (N m, Hz), let go with which bends of the tip [m]."""

    file: str
    kind: Kind
    duration: float
    sines: tuple[tuple[float, float], ...] = ()
    gravity: tuple[float, float] = (0.0, 0.0)
    bends: tuple[float, float] = (0.0, 0.0)


@cache
def benches() -> tuple[Bench, ...]:
    """A driven link with torque and encoder, with and without gravity; and a clamped one, let go from far and near."""
    driven = (
        _Plan("large.csv", "driven", 2.0, ((0.4, 0.7), (0.2, 1.9), (0.1, 5.3)), _HANGING),
        _Plan("small.csv", "driven", 2.0, ((0.06, 0.9), (0.04, 2.3), (0.03, 6.1))),
        _Plan("decay.csv", "decay", 2.0, bends=(0.1, 0.03)),
        _Plan("quiet.csv", "quiet", 2.0),
    )
    clamped = (
        _Plan("large.csv", "decay", 2.0, bends=(0.12, 0.03)),
        _Plan("small.csv", "decay", 2.0, (), _HANGING, (0.03, 0.02)),
        _Plan("quiet.csv", "quiet", 2.0),
    )
    return _bench("driven", (_DRIVEN,), driven), _bench("clamped", (_CLAMPED,), clamped)


@cache
def arm_bench() -> Bench:
    """A driven link on a flexible post, which makes the numbers of links and of active joints differ."""
    return _bench("arm", (_POST, _DRIVEN), (_Plan("drive.csv", "driven", 0.5, ((0.1, 0.9), (0.05, 2.3))),))


def _bench(name: str, links: tuple[Link, ...], plans: tuple[_Plan, ...]) -> Bench:
    rig, parts = Rig(name, links), []
    for link in links:
        cuts = layout(link.length, _JOINTS, distal="free" if link is links[-1] else "joined")
        parts.append(uniform_chain(link, cuts, kelvin_voigt=_KELVIN_VOIGT))
    chain = Chain(name, tuple(parts))
    return Bench(rig, chain, tuple(Trial(_recording(rig, plan), _bent(chain, *plan.bends)) for plan in plans))


def _recording(rig: Rig, plan: _Plan) -> Recording:
    time = np.arange(round(plan.duration * _RATE) + 1) / _RATE
    joints, markers = len(rig.active_links), sum(len(link.markers) for link in rig.links)
    wave = sum((size * np.sin(2 * np.pi * rate * time + rate) for size, rate in plan.sines), np.zeros(time.size))
    tau = np.repeat((wave * np.minimum(4 * time, 1.0))[:, None], joints, axis=1)
    theta, shown = np.zeros((time.size, joints)), np.zeros((time.size, markers, 2))
    return Recording(time, shown, theta, tau, kind=plan.kind, role="train", file=plan.file, gravity=plan.gravity)


def _bent(chain: Chain, first: float, second: float) -> Array:
    """(2 nv,) the last link at rest, bent as by a force on its tip and, on top, about as in its second mode [m]."""
    link, state = chain.links[-1], np.zeros(2 * chain.size)
    arcs = link.joint_arcs / link.length
    curvature = 3 * first * (1 - arcs) + 22 * second * (np.cos(np.pi * arcs * 1.2))
    state[chain.passive_slices[-1]] = curvature * link.cells / link.length**2
    return state


_SENSING = ("camera_instants", "marker_positions", "encoder_angles")
_ACTING = ("chain", "true_inputs", "force")
_ROUNDING = 1e-9
_WIDEST = 3.0  # everyday sizes, or logarithms of an inner parameter, where there is no nearer bound
_INSIDE = 1e-3  # of the way from one bound to the other


def check_form(effect: Effect) -> None:
    """Clause `form`: a frozen dataclass whose parameters are declared and absent by default, and that says what it is.

    Raises:
        EffectError: it is not.
    """
    clause = Clause(name_of(effect), "form")
    _dataclass(clause, effect)
    kind = type(effect)
    named = isinstance(kind.id, str) and re.fullmatch(r"[A-Za-z0-9_]+", kind.id)
    clause.holds(named, f"the id {kind.id!r}", "letters, digits and _")
    clause.holds(
        kind.description, "nothing in `description`", "its meaning in a few words, as in 'friction at the joint'"
    )
    clause.holds(kind.reference, "no `reference`", "where the model is described")
    for field in fields(effect):
        declared = any(each.name == field.name for each in effect.parameters())
        clause.holds(
            declared or field.kw_only,
            f"the field `{field.name}` is neither a parameter nor keyword-only",
            "size(...) or inner(...) for a parameter; field(kw_only=True) for what `variants` fills in",
        )
    for parameter in effect.parameters():
        _parameter(clause, parameter, next(field for field in fields(effect) if field.name == parameter.name))
    clause.holds(effect.is_null, f"{effect!r} is present", "an instance at its null, as the default values make it")
    _hooks(clause, effect)


def name_of(effect: object) -> str:
    """The effect's id; its class where it has none."""
    found = getattr(effect, "id", "")
    return found if isinstance(found, str) and found else type(effect).__name__


def overridden(
    effect: Effect,
    hooks: tuple[str, ...] = (*_ACTING, *_SENSING, "state_count", "state_rates", "rate_independent_update"),
) -> list[str]:
    """Hooks that the effect's class defines itself."""
    return [name for name in hooks if getattr(type(effect), name) is not getattr(Effect, name)]


def _dataclass(clause: Clause, effect: object) -> None:
    expected = "an instance of a class derived from vjm.effects.Effect"
    clause.holds(not isinstance(effect, type), f"the class {effect!r}", expected)
    clause.holds(isinstance(effect, Effect), f"an object of {type(effect)}", expected)
    # Without a decorator of its own, a subclass has its parent's fields only, whatever it declares.
    decorated = is_dataclass(effect) and "__dataclass_params__" in vars(type(effect))
    clause.holds(decorated, "the class is not a dataclass", "@dataclass(frozen=True) above it")


def _parameter(clause: Clause, parameter: Parameter, field: Field[object]) -> None:
    """One that is absent by default, and whose everyday value lies inside its bounds."""
    name, default = parameter.name, field.default
    clause.holds(default is not MISSING, f"`{name}` has no default", "its null value")
    if parameter.shape_parameter:
        inside = all(
            parameter.lower <= each <= parameter.upper for each in (parameter.typical_magnitude, *parameter.grid)
        )
        clause.holds(inside, f"everyday value or grid of `{name}` beyond its bounds", "values inside")
        return
    clause.holds(default == parameter.null, f"`{name}` is {default} by default", f"its null, {parameter.null}")
    wanted = np.isfinite(parameter.typical_magnitude) and parameter.typical_magnitude != 0
    clause.holds(
        wanted, f"an everyday size of {parameter.typical_magnitude} for `{name}`", "a finite number other than zero"
    )
    typical_magnitude = parameter.value(1.0)
    inside = parameter.lower <= typical_magnitude <= parameter.upper
    clause.holds(inside, f"the everyday value {typical_magnitude:g} of `{name}` beyond its bounds", "one inside")


def _hooks(clause: Clause, effect: Effect) -> None:
    """Hooks that can ever be used."""
    own = overridden(effect)
    sizes = [each for each in effect.parameters() if not each.shape_parameter]
    clause.holds(
        sizes or not own,
        f"{_listed(own)} but no size, so that it is always absent",
        "a parameter declared with size(...)",
    )
    clause.holds(own or not sizes, "a size but no hook that uses it", f"one of {', '.join((*_ACTING, *_SENSING))}")
    sensing = overridden(effect, _SENSING)
    clause.holds(
        effect.sensor or not sensing, f"{_listed(sensing)} but `sensor` is False: it is never asked", "sensor = True"
    )


def _listed(names: list[str]) -> str:
    return "it defines " + ", ".join(f"`{name}`" for name in names)


def check_coordinates(effect: Effect) -> None:
    """Clause `coordinates`: zero at the null, one at an everyday size, and back to the values they came from.

    Raises:
        EffectError: they are not.
    """
    clause = Clause(effect.id, "coordinates")
    with clause.running("`coordinates`"):
        start = effect.coordinates
    with clause.running("`bounds`"):
        lower, upper = effect.bounds
    alike = start.shape == lower.shape == upper.shape and start.ndim == 1
    clause.holds(alike, f"shapes {start.shape}, {lower.shape}, {upper.shape}", "(p,) coordinates with as many bounds")
    clause.holds((lower < upper).all(), f"bounds {lower} and {upper}", "lower ones below upper ones")
    clause.holds(not start[: effect.magnitude_count].any(), f"coordinates {start} at the null", "zeros for its sizes")
    for wanted in trial_coordinates(effect):
        with clause.running(f"`at({wanted})`"):
            there = effect.at(wanted)
            found = there.coordinates
            values: dict[str, Any] = {**there.values}
            again = replace(there, **values)
        clause.holds(type(there) is type(effect), f"`at` gives {there!r}", f"a {type(effect).__name__}")
        same = found.shape == wanted.shape and np.allclose(found, wanted, rtol=_ROUNDING, atol=_ROUNDING)
        clause.holds(same, f"coordinates {found} of the effect at {wanted}", "the same")
        clause.holds(again == there, f"{again!r} from the values of {there!r}", "the same")
    clause.holds(effect.at(start).is_null, f"at its own coordinates {start} it is present", "absent, as it was")


def trial_coordinates(effect: Effect) -> list[Array]:
    """Coordinates (p,) to try: everyday ones, and each near either of its bounds while the others are everyday ones."""
    lower, upper = effect.bounds
    # Without a bound, as far as a search may stray.
    low = np.where(np.isfinite(lower), lower, np.minimum(-_WIDEST, upper - _WIDEST))
    high = np.where(np.isfinite(upper), upper, np.maximum(_WIDEST, lower + _WIDEST))
    typical_magnitude = np.where(np.arange(low.size) < effect.magnitude_count, 1.0, effect.coordinates)
    typical_magnitude = np.clip(typical_magnitude, low + _INSIDE * (high - low), high - _INSIDE * (high - low))
    found = [typical_magnitude]
    for k, share in product(range(low.size), (_INSIDE, 1 - _INSIDE)):
        moved = typical_magnitude.copy()
        moved[k] = low[k] + share * (high[k] - low[k])
        found.append(moved)
    return found


_PAYLOAD = 0.05  # kg
_ANGLES = 0.3  # rad, and rad/s
_SHORT = 1.0  # s
_FRAMES = 5
_COPIES = 2


@dataclass(frozen=True)
class Given:
    """What hooks are given, none of it writeable.

    Attributes:
        chain: the arm's.
        recording: with something measured.
        stamps: (F,) frames' time stamps since the start [s].
        positions: (F, k, 2) of markers [m].
        headings: (F, k) of the link there [rad].
        theta: (T, n_a) active joint angles [rad].
    """

    chain: Chain
    recording: Recording
    stamps: Array
    positions: Array
    headings: Array
    theta: Array

    @classmethod
    def of(cls, bench: Bench, seed: int) -> Given:
        """Random values for a bench's rig."""
        random, recording = np.random.default_rng(seed), bench.recordings[0]
        rows, markers, joints = recording.time.size, recording.markers.shape[1], recording.tau.shape[1]
        made = replace(
            recording,
            time=still(recording.time.copy()),
            tau=still(0.1 * random.normal(size=(rows, joints))),
            theta=still(_ANGLES * random.normal(size=(rows, joints))),
            markers=still(random.normal(size=(rows, markers, 2))),
        )
        return cls(
            bench.chain,
            made,
            still(np.linspace(0.3, 0.4, _FRAMES)),
            still(random.normal(size=(_FRAMES, markers, 2))),
            still(_ANGLES * random.normal(size=(_FRAMES, markers))),
            made.theta,
        )


def still(values: Array) -> Array:
    """The same array, no longer writeable."""
    values.setflags(write=False)
    return values


def check_null(effect: Effect, seed: int) -> None:
    """Clause `null`: an absent effect changes nothing at all, to the last bit.

    Raises:
        EffectError: it does.
    """
    clause = Clause(effect.id, "null")
    for bench, given, absent in _placed(effect, seed):
        clause.holds(absent.is_null, f"{absent!r} among the variants", "absent ones only")
        _nothing(clause, absent, given, seed)
        clause.holds(Arm.of(bench.chain, (absent,)).effects == (), "a null that stays on the arm", "one left out")
    for bench in benches():
        short = bench.beginning(_SHORT)
        for absent in effect.variants(bench.rig, bench.recordings)[:1]:
            with clause.running("a simulation with it absent"):
                # With the effect as it is, though an arm made in the usual way would have dropped it.
                plain, other = short.simulate(Arm(short.chain)), short.simulate(Arm(short.chain, (absent,)))
            clause.holds(
                all(map(same, plain, other)), "a simulation with it absent is not that without", "the same bits"
            )


def _placed(effect: Effect, seed: int) -> Iterator[tuple[Bench, Given, Effect]]:
    """Each rig, what hooks are given there, and each variant of the effect."""
    clause = Clause(effect.id, "hooks")
    for bench in (*benches(), arm_bench()):
        given = Given.of(bench, seed)
        with clause.running("`variants`"):
            places, variants = effect.places(bench.rig), effect.variants(bench.rig, (given.recording,))
        clause.holds(variants or not places, f"no variant for the places {places}", "one for each, at least")
        where = {each.link for each in variants}
        clause.holds(where <= set(places), f"variants on the links {where}", f"on those of `places`, {places}")
        known = {None, *range(len(bench.rig.links))}
        clause.holds(
            set(places) <= known, f"places {places} on {len(bench.rig.links)} links", "indices of links, or None"
        )
        for variant in variants:
            yield bench, given, variant


def _nothing(clause: Clause, absent: Effect, given: Given, seed: int) -> None:
    """Every hook of an absent effect returns what it was given."""
    calls = {
        "chain": (given.chain,),
        "true_inputs": (given.recording,),
        "camera_instants": (given.stamps, given.positions),
        "marker_positions": (given.positions, given.headings),
        "encoder_angles": (given.theta,),
    }
    for name, arguments in calls.items():
        with clause.running(f"`{name}` at the null"):
            found = getattr(absent, name)(*arguments)
        clause.holds(
            same(found, arguments[0]), f"`{name}` changes what it is given at the null", "the very same values"
        )
    with clause.running("`force` at the null"):
        force, count = absent.force(given.chain, _PAYLOAD), absent.state_count(given.chain)
        if force is not None:
            random = np.random.default_rng(seed)
            q, v, z = (random.normal(size=(_FRAMES, n)) for n in (given.chain.size, given.chain.size, count))
            clause.holds(not np.any(force(given.stamps, q, v, z)), "a force at the null", "none")
    with clause.running("`rest_angles` at the null"):
        q = still(np.random.default_rng(seed).normal(size=(_FRAMES, given.chain.size)))
        clause.holds(
            same(absent.rest_angles(given.chain, q), q), "`rest_angles` changes angles at the null", "the very same"
        )
    step = absent.max_step
    clause.holds(step == np.inf, f"at the null no time step longer than {step:g} s", "no limit, np.inf")


def check_hooks(effect: Effect, seed: int) -> None:
    """Clauses `hooks` and `inputs`: finite values of the right shape, any leading axes; what is given stays as it is.

    Raises:
        EffectError: it is not so.
    """
    clause, untouched = Clause(effect.id, "hooks"), Clause(effect.id, "inputs")
    for _, given, absent in _placed(effect, seed):
        for coordinates in trial_coordinates(absent):
            present, before = absent.at(coordinates), deepcopy(given)
            _records(clause, present, given)
            _sensors(clause, present, given)
            _motions(clause, present, given, seed)
            clause.holds(present.max_step > 0, f"a longest step of {present.max_step} s", "a positive one")
            untouched.holds(same(given, before), f"{present!r} changes what its hooks are given", "new records")


def _records(clause: Clause, present: Effect, given: Given) -> None:
    """Chain and recording that it makes of others."""
    with clause.running(f"`chain` of {present!r}"):
        chain = present.chain(given.chain)
    alike = isinstance(chain, Chain) and [each.joint for each in chain.links] == [
        each.joint for each in given.chain.links
    ]
    clause.holds(alike, f"`chain` gives {type(chain).__name__}", "a Chain with the same links and joints")
    with clause.running(f"`true_inputs` of {present!r}"):
        driven = present.true_inputs(given.recording)
    clause.holds(isinstance(driven, Recording), f"`true_inputs` gives {type(driven).__name__}", "a Recording")
    for name in ("time", "tau"):
        _array(clause, f"`true_inputs(...).{name}`", getattr(driven, name), getattr(given.recording, name).shape)
    _array(clause, "`true_inputs(...).gravity`", np.asarray(driven.gravity), (2,))


def _sensors(clause: Clause, present: Effect, given: Given) -> None:
    """What it makes of measurements."""
    frames, markers, _ = given.positions.shape
    with clause.running(f"`camera_instants` of {present!r}"):
        seen = present.camera_instants(given.stamps, given.positions)
    _array(clause, "`camera_instants`", seen, (frames,), (frames, markers))
    with clause.running(f"`marker_positions` of {present!r}"):
        shown = present.marker_positions(given.positions, given.headings)
    _array(clause, "`marker_positions`", shown, given.positions.shape)
    with clause.running(f"`encoder_angles` of {present!r}"):
        theta = present.encoder_angles(given.theta)
    _array(clause, "`encoder_angles`", theta, given.theta.shape)


def _motions(clause: Clause, present: Effect, given: Given, seed: int) -> None:
    """Force, rates or way, and rest, for states with several leading axes."""
    chain = present.chain(given.chain)
    with clause.running(f"`force`, `state_rates`, `rate_independent_update` or `state_count` of {present!r}"):
        force, rates, count = present.force(chain, _PAYLOAD), present.state_rates(chain), present.state_count(chain)
        rate_independent_update = present.rate_independent_update(chain)
    clause.holds(isinstance(count, int) and count >= 0, f"{count!r} states", "a number of them")
    told = sum(each is not None for each in (rates, rate_independent_update))
    expected = "one of `state_rates` and `rate_independent_update` where there are states"
    clause.holds(told == (count > 0), f"{count} states, rates {rates} and way {rate_independent_update}", expected)
    with clause.running(f"`smoothed` of {present!r}"):
        smooth = present.smoothed()
        alike = same(smooth.chain(given.chain), chain) and smooth.values == present.values
        kept = smooth.state_count(chain)
    clause.holds(alike, f"`smoothed` gives {smooth!r}", "the same parameters and the same chain")
    allowed = {0} if rate_independent_update is not None else {0, count}
    expected = (
        f"{count}, or none" if rate_independent_update is None else "none, where `rate_independent_update` carries them"
    )
    clause.holds(kept in allowed, f"`smoothed` gives an effect with {kept} states", expected)
    random = np.random.default_rng(seed)
    for leading in ((), (_FRAMES,), (_COPIES, _FRAMES)):
        q, v = (still(_ANGLES * random.normal(size=(*leading, chain.size))) for _ in range(2))
        time = still(np.abs(random.normal(size=leading)))
        with clause.running(f"`initial_states` of {present!r}"):
            rest = present.initial_states(chain, q)
        _array(clause, f"`initial_states` at angles {q.shape}", rest, (*leading, count))
        with clause.running(f"`rest_angles` of {present!r}"):
            rest_state = present.rest_angles(chain, q)
        _array(clause, f"`rest_angles` at angles {q.shape}", rest_state, q.shape)
        z = still(rest + 0.1 * _ANGLES * random.normal(size=rest.shape))
        for name, motion, shape in (("force", force, q.shape), ("state_rates", rates, z.shape)):
            if motion is not None:
                _motion(clause, f"`{name}` of {present!r}", motion, (time, q, v, z), shape)
        if rate_independent_update is not None:
            to = still(q + _ANGLES * random.normal(size=q.shape))
            _motion(clause, f"`rate_independent_update` of {present!r}", rate_independent_update, (q, z, to), z.shape)
            with clause.running(f"`rate_independent_update` of {present!r}"):
                stays = np.allclose(rate_independent_update(q, rest, q), rest, rtol=0.0, atol=_ROUNDING)
            clause.holds(
                stays,
                "`rate_independent_update` changes states at rest where the joints stay",
                "states that follow the joints",
            )


def _motion(
    clause: Clause, what: str, motion: Callable[..., Array], given: tuple[Array, ...], shape: tuple[int, ...]
) -> None:
    """A function of what the arm does, given many at once and each alone."""
    with clause.running(f"{what} at {shape[:-1]} instants"):
        found = motion(*given)
    _array(clause, f"{what} at {shape[:-1]} instants", found, shape)
    for index in np.ndindex(shape[:-1]):
        with clause.running(f"{what} at one instant"):
            alone = motion(*(each[index] for each in given))
        same = np.allclose(alone, found[index], rtol=_ROUNDING, atol=_ROUNDING * max(1.0, float(np.abs(found).max())))
        clause.holds(same, f"{what} at many instants is not what it is at each alone", "each row for itself")


def _array(clause: Clause, what: str, found: object, *shapes: tuple[int, ...]) -> None:
    wanted = " or ".join(str(shape) for shape in shapes)
    given = found.shape if isinstance(found, np.ndarray) else type(found).__name__
    clause.holds(given in shapes, f"{what} is {given}", f"shape {wanted}")
    clause.holds(np.isfinite(found).all(), f"{what} is not finite", "finite values")  # type: ignore[call-overload]


def same(one: object, other: object) -> bool:
    """Whether two values, or all that is in two records, are the same to the last bit."""
    if one is other:
        return True
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.shape == other.shape and one.tobytes() == other.tobytes()
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if is_dataclass(one) and not isinstance(one, type):
        return all(same(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))
    return one == other


_SHORT_ACTION = 0.5  # s
_STATES = 400
_FASTEST = 3.0  # decimal orders between the slowest random rates and the fastest, 1 rad/s
_MOTION, _INSTANTS = 2.0, 20001  # s; so many that internal states are followed closely
_STEPWISE = 1e-3  # of the work in both directions, that following internal states step by step may add
_FINE = 0.25  # of the usual step, whose own error would look like a gain
_GROWTH = 1e-6  # of the energy at the start, that integration may add


def shown_by(effect: Effect) -> tuple[Bench, Effect]:
    """Clause `action`: at an everyday size, some rig's markers or encoders show something else than without it.

    Returns:
        The first such rig, and the effect with everyday sizes on it.

    Raises:
        EffectError: there is none.
    """
    clause, refusals, tried = Clause(effect.id, "action"), [], False
    for bench in benches():
        with clause.running("`untestable`"):
            refusal = bench.refusal(effect)
        if refusal:
            refusals.append(f"on the {bench.rig.name} link: {refusal}")
            continue
        tried = True
        present = bench.placed(effect)
        with clause.running(f"a simulation with {present!r}"):
            # A short one is often enough.
            if any(_difference(each, present) > _ROUNDING for each in (bench.beginning(_SHORT_ACTION), bench)):
                return bench, present
    clause.holds(tried, f"it says that nothing can show it ({'; '.join(refusals)})", "a rig on which it is testable")
    clause.broken("at its everyday size no marker and no encoder shows anything of it", "something beyond rounding")


def _difference(bench: Bench, present: Effect) -> float:
    """Largest difference that it makes to markers [m] and encoders [rad]."""
    arm = Arm.of(bench.chain, (present,))
    step = bench.step(arm)
    pairs = zip(bench.simulate(arm, step), bench.simulate(Arm(bench.chain), step), strict=True)
    return max(
        float(np.abs(one - two).max(initial=0.0))
        for with_it, without in pairs
        for one, two in ((with_it.markers, without.markers), (with_it.theta, without.theta))
    )


def check_energy(effect: Effect, seed: int) -> None:
    """Clause `energy`: what is called dissipative takes power at every state, and a free decay only loses energy.

    Internal states may hold energy for a while: of an effect that has some, a motion from rest never gets more than it
    gave.

    Raises:
        EffectError: it adds some.
    """
    clause = Clause(effect.id, "energy")
    for bench in benches():
        if bench.refusal(effect):
            continue
        present = bench.placed(effect)
        with clause.running(f"{present!r}"):
            arm = Arm.of(bench.chain, (present,))
            power, size = (_work if any(arm.states) else _power)(bench.chain, arm, seed)
        worst = int(np.argmax(power - _ROUNDING * size))
        given = f"{power[worst]:.3g} " + ("J by then" if any(arm.states) else "W")
        clause.holds(
            power[worst] <= _ROUNDING * size[worst],
            f"at a random state its forces give the arm {given}",
            "none of them positive, since `dissipative` is True",
        )
        with clause.running(f"a simulation with {present!r}"):
            growth = _growth(bench, present)
        found = f"a free decay of the {bench.rig.name} link gains {100 * growth:.3g} % of its energy"
        clause.holds(growth <= _GROWTH, found, "a loss, since `dissipative` is True")


def _power(chain: Chain, arm: Arm, seed: int) -> tuple[Array, Array]:
    """(S,) power [W] that forces and dampers of the effect give, and the sum of its parts' sizes."""
    random, n = np.random.default_rng(seed), arm.chain.size
    q = random.normal(size=(_STATES, n))
    v = random.normal(size=(_STATES, n)) * 10 ** -random.uniform(0, _FASTEST, (_STATES, 1))
    rest = arm.initial_states(q)
    z, time = rest + 0.1 * random.normal(size=rest.shape), random.uniform(0, 10, _STATES)
    force, found = arm.forces(_PAYLOAD), np.zeros((_STATES, n))
    if force is not None:
        found += force(time, q, v, z)
    if n == chain.size:
        found -= (arm.chain.damping - chain.damping) * v
    parts = found * v
    return parts.sum(axis=1), np.abs(parts).sum(axis=1)


def _work(chain: Chain, arm: Arm, seed: int) -> tuple[Array, Array]:
    """(S,) work [J] that forces of the effect have given over a random motion from rest, and the sum of its sizes."""
    random, n = np.random.default_rng(seed), arm.chain.size
    time = np.linspace(0.0, _MOTION, _INSTANTS)
    pulsation, phase = random.uniform(1.0, 8.0, (4, n)), random.uniform(0.0, 2 * np.pi, (4, n))
    angle = time[:, None, None] * pulsation + phase
    q, v = 0.3 * (np.sin(angle) - np.sin(phase)).sum(axis=1), 0.3 * (pulsation * np.cos(angle)).sum(axis=1)
    path = MotionSamples(time, q, v, np.zeros_like(q), np.zeros((time.size, 0)))
    force = arm.forces(_PAYLOAD)
    found = np.zeros_like(q) if force is None else force(time, q, v, follow_internal_states(arm, path))
    if n == chain.size:
        found -= (arm.chain.damping - chain.damping) * v
    power = found * v
    work: Array = cumulative_trapezoid(power.sum(axis=1), time, initial=0)
    size: Array = cumulative_trapezoid(np.abs(power).sum(axis=1), time, initial=0)
    return work, _STEPWISE / _ROUNDING * size


def _growth(bench: Bench, present: Effect) -> float:
    """Largest growth of the energy in a free decay of a link without any other loss, over the energy at its start.

    Beyond the least energy so far; beyond that at the start where internal states may have held some in between.
    """
    free = bench.undamped()
    arm = Arm.of(free.chain, (present,))
    (run,) = free.steps(arm, _FINE * default_step(free.chain))
    q, v = run.q[:, 0], run.v[:, 0]
    M = dynamics.mass_matrix(dynamics.build(arm.chain), q)
    energy = 0.5 * np.einsum("ti,tij,tj->t", v, M, v) + 0.5 * (q * q) @ arm.chain.stiffness
    least = energy[0] if any(arm.states) else np.minimum.accumulate(energy)
    return float((energy - least).max() / energy[0])


_NOISE = (5e-5, 5e-5)  # m of a marker coordinate, rad of an encoder
_RUN_UP = 0.1  # s at either end in which a late camera would show the arm outside of the recording
_OFF = 1.03  # what the chain's parameters are off at the start of the search

# The recordings are made with the very chain that is fitted, so noise is all that may keep a size from coming back: it
# does so by less than four standard errors, once in 16,000 times. Where the noise is next to nothing the search's own
# tolerance counts, and five hundredths of an everyday size are as close as anyone needs; what sticks and slips leaves
# searches among small bumps, and ten.
_STANDARD_ERRORS = 4.0
_CLOSE = 0.05
_CLOSE_IF_ABRUPT = 0.10
_LARGEST_ERROR = 0.1  # standard error, everyday sizes: with more, nothing said of the size would mean much
_ABRUPT = 1.5  # s of the first recording are enough for what takes short steps
_ABSORBED = 3e-4  # share of what an effect does, left when all else has made up for it, below which it is rounding
_NOTHING = 1e-12
_ENOUGH = 0.1  # fall of chi^2 that is not worth another step
_FIRST_STEPS = 4  # of the fit without the effect, which is only a start
_WRONG, _LITTLE = 1.5, 1e-2  # a misfit that is no noise, and a share of chi^2 that is no progress
_NOISY = 5.0  # standard deviations of chi^2 that noise explains


@dataclass(frozen=True)
class _Case:
    """Recordings made with an effect, and what is to come back from them.

    Attributes:
        clause: for messages.
        bench: the rig.
        true: the effect that they were made with.
        problem: the recordings, without the effect.
    """

    clause: Clause
    bench: Bench
    true: Effect
    problem: TrajectoryProblem

    @property
    def free(self) -> int:
        """Number of the chain's own coordinates."""
        return len(self.problem.parametrisation.coordinates)


def check_recovery(bench: Bench, true: Effect, seed: int) -> None:
    """Clause `recovery`: a fit that starts without the effect finds its sizes, the chain's parameters being free.

    Args:
        bench: a rig that shows it.
        true: the effect there, at an everyday size.
        seed: of the sensors' noise.

    Raises:
        EffectError: it finds others, or nothing can.
    """
    clause = Clause(true.id, "recovery")
    with clause.running(f"a fit of recordings with {true!r}"):
        if true.nonsmooth:
            bench = bench.beginning(_ABRUPT)
        case = _Case(clause, bench, true, _problem(bench, true, seed))
        errors = _standard_errors(case)
        found = _fitted(case)
    off = np.abs(found.coordinates - true.coordinates)[: true.magnitude_count]
    close = _CLOSE_IF_ABRUPT if true.nonsmooth else _CLOSE
    allowed = np.maximum(close, _STANDARD_ERRORS * errors)
    worst = int(np.argmax(off / allowed))
    clause.holds(
        (off <= allowed).all(),
        f"a fit of recordings that were simulated with {_told(true)} finds {_told(found)}",
        f"no more than {allowed[worst]:.2g} everyday sizes between them ({off[worst]:.2g} found)",
    )


def _told(effect: Effect) -> str:
    units = {each.name: each.unit for each in effect.parameters()}
    return ", ".join(f"{name} {value:.4g} {units[name]}".rstrip() for name, value in effect.values.items())


def _problem(bench: Bench, true: Effect, seed: int) -> TrajectoryProblem:
    """What is measured with the effect present."""
    random = np.random.default_rng(seed)
    observed = []
    for recording, shown in zip(bench.recordings, bench.simulate(Arm.of(bench.chain, (true,))), strict=True):
        time = recording.time
        inside = (time >= time[0] + _RUN_UP) & (time <= time[-1] - _RUN_UP)
        markers = shown.markers + _NOISE[0] * random.normal(size=shown.markers.shape)
        theta = shown.theta + _NOISE[1] * random.normal(size=shown.theta.shape)
        made = replace(recording, markers=np.where(inside[:, None, None], markers, np.nan), theta=theta)
        observed.append(Observations.of(bench.rig, made, _NOISE))
    return TrajectoryProblem(Parametrisation(bench.chain, "uniform", bench.rig.active_links), tuple(observed))


def _standard_errors(case: _Case) -> Array:
    """(s,) of the sizes at their true values, everything else being free."""
    true, base = case.true, case.problem.parametrisation
    problem = replace(case.problem, extension=Extension(base, (true,)))
    x = np.concatenate([base.start, true.coordinates])
    arms = problem.arms(x)
    starts = [InitialStatePrior.of(arm, seen.recording) for arm, seen in zip(arms, problem.observed, strict=True)]
    states = case.bench.states(arms[0])
    point = Point(problem, x, tuple(simulate_runs(arms, problem.observed, starts, states, problem.step_multiple)))
    return _known(case, point.gathered()[0].R[:, :-1])


def _known(case: _Case, R: Array) -> Array:
    """Standard errors (s,) that follow from the linearised problem's triangle R (p, p); none of them large."""
    lengths = np.maximum(np.linalg.norm(R, axis=0), 1e-300)
    silent = np.flatnonzero(lengths[case.free :] <= _NOTHING * lengths.max()).tolist()
    case.clause.holds(
        not silent, f"nothing that is measured depends on {_named(case.true, silent)}", "something that does"
    )
    _, sizes, directions = np.linalg.svd(R / lengths)
    spread = directions.T / np.maximum(sizes, _NOTHING * sizes[0])
    shares = (
        1 / np.linalg.norm(spread, axis=1)[case.free :][: case.true.magnitude_count]
    )  # what nothing else can stand in for
    errors: Array = 1 / (shares * lengths[case.free :][: case.true.magnitude_count])
    case.clause.holds(
        (errors < _LARGEST_ERROR).all() and (shares > _ABSORBED).all(),
        f"on the {case.bench.rig.name} link the chain's own parameters can stand in for all but {shares.min():.1g} of "
        f"what it does, so that its size has a standard error of {errors.max():.2g} everyday ones",
        f"a standard error below {_LARGEST_ERROR:g}: a larger everyday size, or something that is no other stiffness, "
        "damping, hub inertia or initial state",
    )
    return errors


def _named(effect: Effect, coordinates: Sequence[int]) -> str:
    """Parameters by their coordinates' numbers, which stand for themselves where the effect has its own coordinates."""
    if type(effect).coordinates is not Effect.coordinates:
        return ", ".join(f"coordinate {k}" for k in coordinates)
    varied = sorted((each for each in effect.parameters() if not each.integer), key=lambda each: each.shape_parameter)
    return ", ".join(f"`{varied[k].name}`" for k in coordinates)


def _fitted(case: _Case) -> Effect:
    """The effect that the recordings tell, searched for from its absence."""
    start, states = case.problem.parametrisation.start, [trial.state for trial in case.bench.trials]
    base = fit_trajectory(case.problem, _OFF * start, None, states, hopeless=_Patience(_FIRST_STEPS))
    best: Point | None = None
    for variant, sizes in _starts(case, base.point):
        extension = Extension(case.problem.parametrisation, (variant,))
        problem = replace(case.problem, extension=extension)
        x = np.concatenate([base.point.x, sizes, variant.coordinates[variant.magnitude_count :]])
        x = np.clip(x, *extension.bounds)
        arms = zip(base.point.runs, problem.arms(x), strict=True)
        states = [transfer_state(run.chain, arm.chain, run.state) for run, arm in arms]
        try:
            point = fit_trajectory(problem, x, None, states, hopeless=_Patience(nonsmooth=case.true.nonsmooth)).point
        except SimulationDivergedError:
            continue
        if best is None or point.chi2 < best.chi2:
            best = point
        if _is_noise(best):
            break
    if best is None:
        case.clause.broken("no fit that starts with one of its variants can be simulated", "finite motion")
    return case.true.at(best.x[case.free :])


def _starts(case: _Case, point: Point) -> Iterator[tuple[Effect, Array]]:
    """Variants at the true place, the most promising first, with sizes to start from."""
    true, integer = case.true, [each.name for each in case.true.parameters() if each.integer]
    variants = [
        each
        for each in CandidateSet.of([true], case.bench.rig, point).variants
        if each.link == true.link and all(each.values[name] == true.values[name] for name in integer)
    ]
    case.clause.holds(variants, f"no variant like {true!r}", "one at each of its `places`")
    seen = Screen.of(point, (), variants)
    order: Sequence[int] = np.argsort(-seen.statistics, kind="stable").tolist()
    # A joint of its own, infinitely stiff at the null, has no slope there that could tell a size.
    if not adds_joint(true, point.chain):
        yield from ((variants[k], seen.guess([k])) for k in order[:2])
    yield from ((variants[k], np.full(true.magnitude_count, size)) for k in order[:1] for size in (2.0, 0.5))


def _is_noise(point: Point) -> bool:
    """Whether noise explains all that is left."""
    return point.chi2 < point.count + _NOISY * float(np.sqrt(2 * point.count))


class _Patience:
    """Ends a fit after some steps, when it has found what there is, or when it is stuck far from there."""

    def __init__(self, steps: float = np.inf, nonsmooth: bool = False) -> None:
        self.left = steps
        self.nonsmooth = nonsmooth

    def __call__(self, point: Point, predicted: float) -> bool:
        self.left -= 1
        done = predicted < _ENOUGH or (self.nonsmooth and _is_noise(point))
        stuck = point.misfit > _WRONG and predicted < _LITTLE * point.chi2
        return self.left < 0 or done or stuck


CLAUSES: Mapping[str, str] = MappingProxyType(
    {
        "form": "a frozen dataclass derived from Effect, with an id, what it says and a reference; its parameters are "
        "declared with size() and inner(), and null by default",
        "coordinates": "coordinates are zero at the null, and values that are made coordinates come back",
        "null": "at the null every hook returns what it was given, to the last bit, and no simulation changes",
        "hooks": "hooks return finite values of the right shape, for states with any leading axes, within all bounds",
        "inputs": "arrays and records that hooks are given stay as they were",
        "action": "at an everyday size, markers or encoders of a rig on which it is testable show it",
        "energy": "what is called dissipative takes energy at every state, and a free decay only loses some",
        "recovery": "its sizes come back from recordings simulated with it, the chain's parameters being free",
    }
)


def check_effect(effect: Effect, seed: int = 0) -> None:
    """Check whether an effect keeps the contract of effects, clause by clause; it takes a second or a few.

    The effect is tried on small simulated rigs: a driven link with torque and encoder and a clamped one, with five
    markers each; its hooks on a driven link upon a flexible post as well.

    Args:
        effect: absent, as its class makes it by default.
        seed: of random states and of the sensors' noise.

    Raises:
        EffectError: the first of `CLAUSES` that is broken, what was found and what was expected.
    """
    check_form(effect)
    if not overridden(effect):
        return  # a name for something that is no physics
    check_coordinates(effect)
    check_null(effect, seed)
    check_hooks(effect, seed)
    bench, present = shown_by(effect)
    if effect.dissipative:
        check_energy(effect, seed)
    check_recovery(bench, present, seed)
