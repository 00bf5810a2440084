"""The contract of effects: what every one must keep, so that simulations, fits and searches may rely on it."""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass, replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from scipy.integrate import cumulative_trapezoid

from vjm.chain.curve import transfer_state
from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.chain.virtual_links import Chain
from vjm.diagnosis.candidate_fit import StoppingRule, refit, refit_other_frequencies
from vjm.diagnosis.screen import CandidateSet, Screen
from vjm.effects.effect import SENSING_HOOKS, Effect
from vjm.errors import EffectError, SimulationDivergedError, is_whole, require
from vjm.identification.parameters import Parametrisation
from vjm.identification.trajectory_fit import TrajectoryFit, TrajectoryProblem, fit_trajectory
from vjm.records import Array, Kind, Link, Payload, Recording, Rig, Simulation
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import default_step, simulate_trajectories
from vjm.simulation.measurement import MarkerArcs, Observations, sensor_readings
from vjm.threads import on_one_thread

_Checks = Iterator[tuple[object, str, str]]  # what must hold, what was found instead, what was expected
_HOOKS = (
    *("chain", "true_inputs", "force", "dry_friction", "contact", *SENSING_HOOKS, "timing_noise"),
    *("initial_states", "state_rates"),
)
_ROUNDING = 1e-9
_PAYLOAD = Payload(0.05, 0.01, 2e-5)  # kg, m, kg m^2
_NOISE = (5e-5, 5e-5)  # m of a marker coordinate, rad of an encoder


@on_one_thread
def check_effect(effect: Effect, seed: int = 0) -> None:
    """Check whether an effect keeps the contract of effects, clause by clause; it takes a second or a few.

    The clauses are `form`, `coordinates`, `null`, `hooks`, `inputs`, `action`, `energy` and `recovery`. The effect is
    tried on small simulated rigs: a driven link with torque and encoder and a clamped one, with five markers each; its
    hooks on a driven link upon a flexible post as well.

    Args:
        effect: absent, as its class makes it by default.
        seed: of random states and of the sensors' noise.

    Raises:
        EffectError: the first clause that is broken, what was found and what was expected.
    """
    require("seed", seed, is_whole(seed, 0), "a whole number, zero or more")
    for clause in _CLAUSES:
        _require(effect, clause.__name__.removeprefix("_"), clause(effect, seed))
        if not _overridden(effect):
            return  # a name for something that is no physics


def _require(effect: Effect, clause: str, checks: _Checks) -> None:
    """Raise an error at the first thing that does not hold, or at an error in what the effect's author wrote."""
    name = str(getattr(effect, "id", "")) or type(effect).__name__
    try:
        for holds, finding, expected in checks:
            if not holds:
                raise EffectError(name, clause, finding, expected)
    except EffectError:
        raise
    except SimulationDivergedError as error:
        raise EffectError(name, clause, f"a simulation with it diverges: {error}", "finite motion") from error
    except Exception as error:
        frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
        hooks = [frame for frame in frames if isinstance(frame.f_locals.get("self"), Effect)]
        source = f"`{hooks[-1].f_code.co_name}` of {hooks[-1].f_locals['self']!r}" if hooks else "what it does"
        if isinstance(error, ValueError) and "read-only" in str(error):
            finding = f"{source} writes into an array that it was given"
            raise EffectError(name, "inputs", finding, "a new array") from error
        raise EffectError(name, clause, f"{source} raises {type(error).__name__}: {error}", "no error") from error


@dataclass(frozen=True)
class _TrialRig:
    """A rig, its chain without effects, recordings without measurements and their initial states (2 nv,)."""

    rig: Rig
    chain: Chain
    recordings: tuple[Recording, ...]
    states: tuple[Array, ...]

    def simulate(self, arm: Arm, step: float | None = None, seed: int = 0) -> list[Simulation]:
        """Simulate all recordings with an arm made of this chain; the seed draws errors of the frames' instants."""
        q, v = zip(*(np.split(transfer_state(self.chain, arm.chain, state), 2) for state in self.states), strict=True)
        runs = simulate_trajectories([arm] * len(self.states), self.recordings, q, v, step=step)
        arcs, random, shown = MarkerArcs.of(self.rig), np.random.default_rng([seed, 1]), []
        for recording, run in zip(self.recordings, runs, strict=True):
            readings = sensor_readings(arm, arcs, recording, run)
            if arm.timing_variance:
                instants = recording.time + np.sqrt(arm.timing_variance) * random.normal(size=recording.time.size)
                readings = replace(readings, markers=arcs.positions_in_frames(arm, run, instants))
            shown.append(readings)
        return shown

    def typical(self, effect: Effect) -> Effect:
        """Return the last variant here with typical magnitudes; shape parameters are off by a tenth."""
        absent = effect.variants(self.rig, self.recordings)[-1]
        coordinates = np.where(np.arange(absent.coordinates.size) < absent.magnitude_count, 1.0, 0.1)
        return absent.at(np.clip(coordinates, *absent.bounds))

    def refusal(self, effect: Effect) -> str:
        """Return the effect's own reason why it cannot be tried here; empty where it can."""
        reason = effect.untestable(self.rig, self.recordings)
        return reason or ("" if effect.places(self.rig) else "there is no place for it")


@cache
def _trial_rigs() -> tuple[_TrialRig, ...]:
    """Return a driven link, a clamped one, and a driven one on a flexible post: fewer active joints than links."""
    beam = Link("beam", "revolute", 1.0, 0.44, 1.9, (0.2, 0.4, 0.6, 0.8, 1.0), hub_inertia=0.02)
    clamped = replace(beam, joint="clamped", hub_inertia=0.0)
    post = replace(clamped, name="post", length=0.6, markers=(0.3, 0.6))
    # For each recording the torque's factor, gravity along x [m/s^2], the bend of the tip [m], and a payload [kg].
    of_hub = [(1.0, 9.81, 0.0, 0.05), (0.2, 0.0, 0.0, 0.0), (0.0, 0.0, 0.1, 0.0), (0.0, 0.0, 0.0, 0.0)]
    of_clamp = [(0.0, 0.0, 0.12, 0.05), (0.0, 9.81, 0.04, 0.0), (0.0, 0.0, 0.0, 0.0)]
    driven, fixed = _trial_rig("driven", (beam,), of_hub), _trial_rig("clamped", (clamped,), of_clamp)
    return driven, fixed, _trial_rig("arm", (post, beam), [(1.0, 9.81, 0.0, 0.05)])


def _trial_rig(name: str, links: tuple[Link, ...], plans: Sequence[tuple[float, float, float, float]]) -> _TrialRig:
    rig, recordings, states = Rig(name, links), [], []
    chain = nominal_chain(rig, rig_layouts(rig, [3] * len(links)), kelvin_voigt=5e-4)
    time, last = np.arange(101) / 50, chain.links[-1]
    wave = sum(size * np.sin(2 * np.pi * rate * time + rate) for size, rate in ((0.4, 0.7), (0.2, 1.9), (0.1, 5.3)))
    tau = np.repeat((wave * np.minimum(4 * time, 1.0))[:, None], len(rig.active_links), axis=1)
    arcs = last.joint_arcs / last.length
    shape = (3 * (1 - arcs) + 7 * np.cos(1.2 * np.pi * arcs)) * last.cells / last.length**2  # about the first two modes
    for factor, gravity, bend, payload in plans:
        kind: Kind = "driven" if factor else "decay" if bend else "quiet"
        markers = np.zeros((time.size, rig.marker_slices[-1].stop, 2))
        readings = (time, markers, np.zeros_like(tau), factor * tau)
        recordings.append(Recording(*readings, kind=kind, role="train", gravity=(gravity, 0.0), payload=payload))
        states.append(np.zeros(2 * chain.size))
        states[-1][chain.passive_slices[-1]] = bend * shape
    return _TrialRig(rig, chain, tuple(recordings), tuple(states))


def _overridden(effect: Effect) -> str:
    """List the hooks that the effect's class defines itself."""
    return ", ".join(f"`{name}`" for name in _HOOKS if getattr(type(effect), name) is not getattr(Effect, name))


def _form(effect: Effect, seed: int) -> _Checks:
    """Require a frozen Effect dataclass that says what it is and assumes, its parameters null by default."""
    kind, derived = type(effect), "an instance of a class derived from vjm.effects.Effect"
    yield isinstance(effect, Effect), f"{effect!r}", derived
    # Without a decorator of its own, a subclass has its parent's fields only, whatever it declares.
    decorated = is_dataclass(effect) and "__dataclass_params__" in vars(kind)
    yield decorated, "the class is not a dataclass", "@dataclass(frozen=True) above it"
    yield re.fullmatch(r"[A-Za-z0-9_]+", str(kind.id)), f"the id {kind.id!r}", "letters, digits and _"
    yield kind.description, "no `description`", "its meaning in a few words, as in 'friction at the joint'"
    yield kind.reference, "no `reference`", "where the model is described"
    expected = "what its model takes for granted beyond its parameters, each as a noun phrase, or 'none'"
    yield kind.assumptions.strip(), "no `assumptions`", expected
    parameters = {parameter.name: parameter for parameter in effect.parameters}
    for field in fields(effect):
        declared = field.name in parameters or field.kw_only
        expected = "magnitude(...) or shape_parameter(...); field(kw_only=True) for what `variants` fills in"
        yield declared, f"the field `{field.name}` is neither a parameter nor keyword-only", expected
        yield field.default is not MISSING, f"`{field.name}` has no default", "its null value"
    for name, parameter in parameters.items():
        default, typical = getattr(effect, name), parameter.typical_magnitude
        null = parameter.shape_parameter or default == parameter.null
        yield null, f"`{name}` is {default} by default", f"its null, {parameter.null}"
        sized = parameter.shape_parameter or (np.isfinite(typical) and typical != 0)
        yield sized, f"a typical magnitude of {typical} for `{name}`", "a finite number other than zero"
        values = (typical, *parameter.grid) if parameter.shape_parameter else (parameter.value(1.0),)
        within_bounds = all(parameter.lower <= value <= parameter.upper for value in values)
        yield within_bounds, f"a typical value or grid {values} of `{name}` beyond its bounds", "values inside"
    sized = any(not parameter.shape_parameter for parameter in parameters.values())
    hooks = _overridden(effect)
    yield sized or not hooks, f"it defines {hooks} but no size, so that it is always absent", "a magnitude(...)"
    yield hooks or not sized, "a size but no hook that uses it", f"one of {', '.join(_HOOKS)}"


def _variants(effect: Effect) -> list[tuple[_TrialRig, Effect]]:
    """Return the absent effect wherever it can be, on each rig."""
    return [(trial, variant) for trial in _trial_rigs() for variant in effect.variants(trial.rig, trial.recordings)]


def _trial_coordinates(effect: Effect) -> list[Array]:
    """Return coordinates (p,) to try: typical ones, and each near either of its bounds while the others are typical."""
    lower, upper = effect.bounds
    # Without a bound, as far as a search may stray: three typical magnitudes, or logarithms of a shape parameter.
    low = np.where(np.isfinite(lower), lower, np.minimum(-3.0, upper - 3.0))
    high = np.where(np.isfinite(upper), upper, np.maximum(3.0, lower + 3.0))
    low, high = low + 1e-3 * (high - low), high - 1e-3 * (high - low)
    numbers = np.arange(low.size)
    typical = np.clip(np.where(numbers < effect.magnitude_count, 1.0, effect.coordinates), low, high)
    return [typical, *(np.where(numbers == k, bound, typical) for k, bound in product(numbers, (low, high)))]


def _coordinates(effect: Effect, seed: int) -> _Checks:
    """Require zeros at the null, ones at typical magnitudes, and back the values from which they came."""
    for _, absent in _variants(effect)[:1]:
        start, (lower, upper) = absent.coordinates, absent.bounds
        shapes = start.shape, lower.shape, upper.shape
        yield len(set(shapes)) == 1, f"shapes {shapes}", "(p,) coordinates with as many bounds"
        yield (lower < upper).all(), f"bounds {lower} and {upper}", "lower ones below upper ones"
        yield not start[: absent.magnitude_count].any(), f"coordinates {start} at the null", "zeros for magnitudes"
        yield absent.at(start).is_null, f"at its own coordinates {start} it is present", "absent, as it was"
        for wanted in _trial_coordinates(absent):
            present = absent.at(wanted)
            result, values = present.coordinates, dict[str, Any](present.values)
            yield type(present) is type(absent), f"`at` gives {present!r}", f"a {type(absent).__name__}"
            close = np.shape(result) == wanted.shape and np.allclose(result, wanted, rtol=_ROUNDING, atol=_ROUNDING)
            yield close, f"coordinates {result} of the effect at {wanted}", "the same"
            rebuilt = replace(present, **values)
            yield rebuilt == present, f"{rebuilt!r} from the values of {present!r}", "the same"


def _calls(trial: _TrialRig, seed: int) -> dict[str, tuple[Any, ...]]:
    """Return random arguments, none of them writeable, for hooks that return the first one if the effect is absent."""
    random, empty = np.random.default_rng(seed), trial.recordings[0]
    shapes = (5, *empty.markers.shape[1:]), (5, empty.markers.shape[1]), empty.theta.shape, empty.markers.shape
    positions, headings, angles, markers = (_read_only(0.3 * random.normal(size=shape)) for shape in shapes)
    driven = replace(empty, time=_read_only(empty.time.copy()), tau=angles, theta=angles, markers=markers)
    time = _read_only(np.linspace(0.3, 0.4, 5))
    sensed = (time, positions), (positions, headings, time), (angles,)
    return {"chain": (trial.chain,), "true_inputs": (driven,), **dict(zip(SENSING_HOOKS, sensed, strict=True))}


def _read_only(values: Array) -> Array:
    """Make an array read-only and return it."""
    values.setflags(write=False)
    return values


def _null(effect: Effect, seed: int) -> _Checks:
    """Require no change at all where it is absent, to the last bit."""
    for trial, absent in _variants(effect):
        yield absent.is_null, f"{absent!r} among the variants", "absent ones only"
        for name, arguments in _calls(trial, seed).items():
            unchanged = _same(getattr(absent, name)(*arguments), arguments[0])
            yield unchanged, f"`{name}` changes what it is given at the null", "the same values"
        chain, random = trial.chain, np.random.default_rng(seed)
        q, v = random.normal(size=(2, 5, chain.size))
        force, z = absent.force(chain, _PAYLOAD), random.normal(size=absent.initial_states(chain, q).shape)
        yield force is None or not np.any(force(np.arange(5.0), q, v, z)), "a force at the null", "none"
        yield absent.contact(chain) is None, f"{absent.contact(chain)} at the null", "no contact"
        yield absent.timing_noise == 0, f"`timing_noise` is {absent.timing_noise} at the null", "zero"
        yield _same(absent.rest_angles(chain, q), q), "`rest_angles` changes angles at the null", "the same values"


def _hooks(effect: Effect, seed: int) -> _Checks:
    """Require variants at all places of a rig only; finite values of the right shape, for any leading axes."""
    for trial in _trial_rigs():
        places, links = effect.places(trial.rig), len(trial.rig.links)
        covered = {variant.link for variant in effect.variants(trial.rig, trial.recordings)}
        yield covered or not places, f"no variant for the places {places}", "one for each, at least"
        yield covered <= set(places), f"variants on the links {covered}", f"on those of `places`, {places}"
        yield set(places) <= {None, *range(links)}, f"places {places} on {links} links", "indices of links, or None"
    for trial, absent in _variants(effect):
        calls, chain = _calls(trial, seed), trial.chain
        for present in map(absent.at, _trial_coordinates(absent)):
            modified, driven = present.chain(chain), present.true_inputs(*calls["true_inputs"])
            joints = [link.joint for link in chain.links]
            unchanged = isinstance(modified, Chain) and [link.joint for link in modified.links] == joints
            yield unchanged, f"`chain` gives {type(modified).__name__}", "a Chain with the same links and joints"
            yield isinstance(driven, Recording), f"`true_inputs` gives {type(driven).__name__}", "a Recording"
            yield from _array("`true_inputs(...).tau`", driven.tau, trial.recordings[0].tau.shape)
            yield from _array("`true_inputs(...).gravity`", np.asarray(driven.gravity), (2,))
            for name in SENSING_HOOKS:
                first, *remaining = (argument.shape for argument in calls[name])
                shapes = (first, remaining[0][:2]) if name == "camera_instants" else (first,)
                yield from _array(f"`{name}`", getattr(present, name)(*calls[name]), *shapes)
            timing = present.timing_noise
            yield 0 <= timing < np.inf, f"`timing_noise` is {timing} s", "a finite number that is not negative"
            yield present.max_step(modified) > 0, f"a longest step of {present.max_step(modified)} s", "a positive one"
            yield from _motions(present, modified, seed)
            smooth = replace(present, smooth=True)
            unchanged = smooth.values == present.values and _same(smooth.chain(chain), modified)
            yield unchanged, f"`smooth` makes it {smooth!r}", "the same parameters and the same chain"


def _motions(present: Effect, chain: Chain, seed: int) -> _Checks:
    """Require force, dry friction, rates of internal states, and rest, for states with several leading axes."""
    straight, smooth = np.zeros(chain.size), replace(present, smooth=True)
    count, reduced = present.initial_states(chain, straight).size, smooth.initial_states(chain, straight).size
    rates, friction, contact = present.state_rates(chain), present.dry_friction(chain), present.contact(chain)
    if contact is not None:
        joints, sizes = range(chain.size), contact[1:]
        yield contact.joint in joints, f"`contact` of coordinate {contact.joint}", f"one of the {chain.size} joints"
        yield min(sizes) >= 0 and max(sizes) < np.inf, f"`contact` gives {contact}", "finite sizes, none negative"
        own = chain.stiffness[contact.joint], chain.damping[contact.joint]
        held = np.all(np.array(sizes[1:]) <= np.array(own) * (1 + _ROUNDING))
        yield bool(held), f"its joint has a spring and damper of {own}", "flanks among the springs of `chain`"
    yield (rates is not None) == (count > 0), f"{count} states, `state_rates` {rates}", "rates where there are states"
    yield reduced == count, f"`smooth` makes it an effect with {reduced} states", f"{count}"
    yield smooth.dry_friction(chain) is None, "`smooth` leaves it dry friction", "a gradual `force` in its place"
    random = np.random.default_rng(seed)
    for leading in ((), (5,), (2, 5)):
        q, v = (_read_only(0.3 * random.normal(size=(*leading, chain.size))) for _ in range(2))
        rest = present.initial_states(chain, q)
        yield from _array(f"`initial_states` at angles {q.shape}", rest, (*leading, count))
        yield from _array(f"`rest_angles` at angles {q.shape}", present.rest_angles(chain, q), q.shape)
        if friction is not None:
            joint, torque = friction
            yield joint in chain.active, f"`dry_friction` of coordinate {joint}", f"an active joint, {chain.active}"
            yield from _array(f"`dry_friction` at rates {leading}", np.asarray(torque(v[..., joint])), leading)
            least = float(np.min(torque(v[..., joint])))
            yield least >= 0, f"`dry_friction` of {least} N m", "a torque that is not negative"
        z, time = (
            _read_only(rest + 0.03 * random.normal(size=rest.shape)),
            _read_only(np.abs(random.normal(size=leading))),
        )
        yield from _each_alone("force", present.force(chain, _PAYLOAD), (time, q, v, z), q.shape)
        yield from _each_alone("state_rates", rates, (time, q, v, z), z.shape)


def _each_alone(
    name: str, motion: Callable[..., Array] | None, arguments: tuple[Array, ...], shape: tuple[int, ...]
) -> _Checks:
    """Require the same of a function of the arm's motion for many instants at once and for each alone."""
    if motion is None:
        return
    result = motion(*arguments)
    yield from _array(f"`{name}` at {shape[:-1]} instants", result, shape)
    separate = [motion(*(argument[index] for argument in arguments)) for index in np.ndindex(shape[:-1])]
    tolerance = _ROUNDING * max(1.0, float(np.abs(result).max(initial=0.0)))
    equal = np.allclose(np.reshape(separate, shape), result, rtol=_ROUNDING, atol=tolerance)
    yield equal, f"`{name}` at many instants is not what it is at each alone", "each row for itself"


def _array(label: str, values: Any, *shapes: tuple[int, ...]) -> _Checks:
    """Require a finite array of one of some shapes."""
    shape = values.shape if isinstance(values, np.ndarray) else type(values).__name__
    yield shape in shapes, f"{label} is {shape}", f"shape {' or '.join(map(str, shapes))}"
    yield np.isfinite(values).all(), f"{label} is not finite", "finite values"


def _inputs(effect: Effect, seed: int) -> _Checks:
    """Require that hooks change nothing that they are given; arrays they cannot, as these are not writeable."""
    for trial, absent in _variants(effect):
        present, calls = trial.typical(absent), _calls(trial, seed)
        before = deepcopy(calls)
        for name, arguments in calls.items():
            getattr(present, name)(*arguments)
            unchanged = all(map(_same, arguments, before[name]))
            yield unchanged, f"{present!r} changes what `{name}` is given", "new records"


def _same(first: Any, second: Any) -> bool:
    """Return True if two arrays or records hold exactly the same numbers."""
    if is_dataclass(first) and not isinstance(first, type):
        return type(first) is type(second) and _same(asdict(first), asdict(second))
    try:
        np.testing.assert_equal(second, first)
    except AssertionError:
        return False
    return True


def _action(effect: Effect, seed: int) -> _Checks:
    """Require a typical magnitude that markers or encoders of some rig show."""
    reasons = {trial.rig.name: trial.refusal(effect) for trial in _trial_rigs()[:2]}
    finding = f"it says that nothing can show it ({'; '.join(f'{name} link: {why}' for name, why in reasons.items())})"
    yield not all(reasons.values()), finding, "a rig on which it is testable"
    finding = "at its typical magnitude no marker and no encoder shows anything of it"
    yield _shown_by(effect), finding, "something beyond rounding"


def _shown_by(effect: Effect) -> _TrialRig | None:
    """Return the first rig whose markers or encoders show something else at a typical magnitude than without it."""
    for trial in (trial for trial in _trial_rigs()[:2] if not trial.refusal(effect)):
        arm, nominal = Arm.of(trial.chain, (trial.typical(effect),)), Arm(trial.chain)
        step = min(default_step(nominal.chain), default_step(arm.chain), arm.longest_step)
        for one, two in zip(trial.simulate(arm, step), trial.simulate(nominal, step), strict=True):
            if max(np.abs(one.markers - two.markers).max(), np.abs(one.theta - two.theta).max(initial=0)) > _ROUNDING:
                return trial
    return None


def _energy(effect: Effect, seed: int) -> _Checks:
    """Require that dissipative effects take power at every state; with internal states, work since rest."""
    for trial in _trial_rigs()[:2]:
        if trial.refusal(effect) or not effect.dissipative:
            continue
        arm = Arm.of(trial.chain, (trial.typical(effect),))
        power, size = _power(trial, arm, seed)
        worst, unit = int(np.argmax(power - _ROUNDING * size)), "J by then" if any(arm.state_counts) else "W"
        finding = f"at a random state its forces give the arm {power[worst]:.3g} {unit}"
        yield power[worst] <= _ROUNDING * size[worst], finding, "none of them positive, since `dissipative` is True"


def _power(trial: _TrialRig, arm: Arm, seed: int) -> tuple[Array, Array]:
    """Return the power [W] of effects in a random motion from rest, or work [J] if they have states; and its size."""
    random, n, stateful = np.random.default_rng(seed), arm.chain.size, any(arm.state_counts)
    recording = trial.recordings[0]
    time = np.linspace(0.0, 2.0, 20001 if stateful else 401)  # so many that internal states are followed closely
    pulsation, phase = random.uniform(1.0, 8.0, (4, n)), random.uniform(0.0, 2 * np.pi, (4, n))
    angle = time[:, None, None] * pulsation + phase
    q, v = 0.3 * (np.sin(angle) - np.sin(phase)).sum(axis=1), 0.3 * (pulsation * np.cos(angle)).sum(axis=1)
    v *= 1.0 if stateful else 10 ** -random.uniform(0, 3, (time.size, 1))  # slow states too
    z = arm.follow(time, q, v)
    force = arm.forces(_PAYLOAD)
    torque = np.zeros_like(q) if force is None else force(time, q, v, z)
    for joint, change in zip(arm.chain.active, (arm.inputs(recording).tau - recording.tau).T, strict=True):
        torque[:, joint] += np.interp(time, recording.time, change)
    damping, joints = arm.chain.damping.copy(), np.arange(n)
    damping[joints if n == trial.chain.size else np.setdiff1d(joints, arm.chain.roots)] -= trial.chain.damping
    torque = torque - damping * v
    power, size = (torque * v).sum(axis=1), np.abs(torque * v).sum(axis=1)
    if not stateful:
        return power, size
    work, scale = (cumulative_trapezoid(values, time, initial=0) for values in (power, size))
    return work, 1e-3 / _ROUNDING * scale  # a thousandth is what following states step by step may add


def _recovery(effect: Effect, seed: int) -> _Checks:
    """Require magnitudes that a fit finds which starts without the effect, the chain's parameters being free."""
    trial = _shown_by(effect) or _trial_rigs()[0]
    if effect.nonsmooth:  # takes short steps
        trial = replace(trial, recordings=trial.recordings[:1], states=trial.states[:1])
    true = trial.typical(effect)
    problem = _problem(trial, true, seed)
    free = problem.parametrisation.start.size
    start = fit_trajectory(
        problem, 1.03 * problem.parametrisation.start, None, trial.states, stop=StoppingRule(max_steps=4)
    )
    # Standard errors of the magnitudes at their true values, everything else being free.
    at_truth = fit_trajectory(
        problem, problem.parametrisation.start, None, trial.states, stop=StoppingRule(max_steps=0)
    )
    extended = refit(at_truth, (true,), StoppingRule(max_steps=0))
    yield extended, f"with {_values(true)} nothing can be simulated", "finite motion"
    assert extended  # for type checkers: this is not reached otherwise
    R = extended.point.reduced()[0].R[:, :-1]
    lengths, magnitudes = np.maximum(np.linalg.norm(R, axis=0), 1e-300), range(free, free + true.magnitude_count)
    names, without = _magnitude_names(true), lengths[free:][: true.magnitude_count] <= 1e-12 * lengths.max()
    unobservable = dict.fromkeys(f"`{name}`" for name, unseen in zip(names, without, strict=True) if unseen)
    yield not unobservable, f"nothing that is measured depends on {', '.join(unobservable)}", "something that does"
    shares = np.array([_unexplained(R / lengths, k) for k in magnitudes])
    errors = 1 / np.maximum(shares * lengths[magnitudes], 1e-300)
    # Of a share below 3e-4 rounding is left; with an error above a tenth nothing said of a magnitude would mean much.
    finding = f"on the {trial.rig.name} link the chain's own parameters can stand in for all but {shares.min():.1g} of "
    finding += f"what it does, so that its magnitude has a standard error of {errors.max():.2g} typical ones"
    expected = "a standard error below 0.1: a larger typical magnitude, or no other stiffness, damping or initial state"
    yield (errors < 0.1).all() and (shares > 3e-4).all(), finding, expected
    fitted = _fitted(start, trial, true)
    yield fitted, "no fit that starts with one of its variants can be simulated", "finite motion"
    assert fitted
    deviations = np.abs(fitted.coordinates - true.coordinates)[: true.magnitude_count]
    # Noise moves an estimate by four standard errors once in 16,000 times; with next to none the search's own tolerance
    # counts, which is larger among the small bumps of what sticks and slips.
    allowed = np.maximum(0.10 if true.nonsmooth else 0.05, 4.0 * errors)
    worst = int(np.argmax(deviations / allowed))
    finding = f"a fit of recordings that were simulated with {_values(true)} finds {_values(fitted)}"
    expected = f"no more than {allowed[worst]:.2g} typical magnitudes between them ({deviations[worst]:.2g} found)"
    yield (deviations <= allowed).all(), finding, expected


def _magnitude_names(effect: Effect) -> list[str]:
    """Return the parameter of each coordinate that is a magnitude; all of them where they make other coordinates.

    A wave has two of its only one, the amplitude.
    """
    names = [parameter.name for parameter in effect.parameters if not parameter.shape_parameter]
    return names if len(names) == effect.magnitude_count else [" and ".join(names)] * effect.magnitude_count


def _values(effect: Effect) -> str:
    return ", ".join(
        f"{parameter.name} {effect.values[parameter.name]:.4g} {parameter.unit}".rstrip()
        for parameter in effect.parameters
    )


def _unexplained(columns: Array, k: int) -> float:
    """Return the length of the part of column k that no combination of the others gives."""
    remaining = np.delete(columns, k, axis=1)
    return float(np.linalg.norm(columns[:, k] - remaining @ np.linalg.lstsq(remaining, columns[:, k], rcond=1e-12)[0]))


def _problem(trial: _TrialRig, true: Effect, seed: int) -> TrajectoryProblem:
    """Return measurements with the effect present; none at the ends, where a late camera shows the arm outside."""
    random, observed = np.random.default_rng(seed), []
    simulated = trial.simulate(Arm.of(trial.chain, (true,)), seed=seed)
    for recording, shown in zip(trial.recordings, simulated, strict=True):
        interior = (recording.time >= recording.time[0] + 0.1) & (recording.time <= recording.time[-1] - 0.1)
        markers = shown.markers + _NOISE[0] * random.normal(size=shown.markers.shape)
        theta = shown.theta + _NOISE[1] * random.normal(size=shown.theta.shape)
        measured = replace(recording, markers=np.where(interior[:, None, None], markers, np.nan), theta=theta)
        observed.append(Observations.of(trial.rig, measured, _NOISE))
    return TrajectoryProblem(Parametrisation(trial.chain, "uniform", trial.rig.active_links), tuple(observed))


def _fitted(start: TrajectoryFit, trial: _TrialRig, true: Effect) -> Effect | None:
    """Fit the most promising variant at the true place, from half and twice its typical magnitudes."""
    fixed = ["link", *(parameter.name for parameter in true.parameters if parameter.integer)]
    variants = CandidateSet.of([true], trial.rig, trial.recordings, start.point.runs).variants
    variants = tuple(
        variant for variant in variants if all(getattr(variant, name) == getattr(true, name) for name in fixed)
    )
    variant = variants[int(np.argmax(Screen.of(start.point, (), variants).statistics))]
    best: TrajectoryFit | None = None
    for size in (0.5, 2.0):
        coordinates = np.r_[np.full(true.magnitude_count, size), variant.coordinates[true.magnitude_count :]]
        sized = variant.at(np.clip(coordinates, *variant.bounds))
        fit = refit(start, (sized,))
        if fit is not None and fit.chi2 > fit.point.noise_limit:
            fit = refit_other_frequencies(fit)
        best = min(filter(None, (best, fit)), key=lambda fit: fit.chi2, default=None)
        if best is not None and best.chi2 < best.point.noise_limit:
            break
    return None if best is None else best.effects[0]


_CLAUSES = (_form, _coordinates, _null, _hooks, _inputs, _action, _energy, _recovery)
