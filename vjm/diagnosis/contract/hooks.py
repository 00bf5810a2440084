"""What an effect's hooks return: the same where it is absent, finite values of the right shape where it is present."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, fields, is_dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.diagnosis.contract.bench import Bench, arm_bench, benches
from vjm.diagnosis.contract.faults import Clause
from vjm.diagnosis.contract.form import trial_coordinates
from vjm.effects.effect import Effect
from vjm.experiment.records import Recording
from vjm.simulate.arm import Arm

Array = NDArray[np.float64]

_PAYLOAD = 0.05  # kg
_ANGLES = 0.3  # rad, and rad/s
_SHORT = 1.0  # s
_FRAMES = 5
_COPIES = 2
_ROUNDING = 1e-9


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
        "inputs": (given.recording,),
        "instants": (given.stamps, given.positions),
        "shown": (given.positions, given.headings),
        "encoder": (given.theta,),
    }
    for name, arguments in calls.items():
        with clause.running(f"`{name}` at the null"):
            found = getattr(absent, name)(*arguments)
        clause.holds(
            same(found, arguments[0]), f"`{name}` changes what it is given at the null", "the very same values"
        )
    with clause.running("`force` at the null"):
        force, count = absent.force(given.chain, _PAYLOAD), absent.states(given.chain)
        if force is not None:
            random = np.random.default_rng(seed)
            q, v, z = (random.normal(size=(_FRAMES, n)) for n in (given.chain.size, given.chain.size, count))
            clause.holds(not np.any(force(given.stamps, q, v, z)), "a force at the null", "none")
    with clause.running("`settled` at the null"):
        q = still(np.random.default_rng(seed).normal(size=(_FRAMES, given.chain.size)))
        clause.holds(same(absent.settled(given.chain, q), q), "`settled` changes angles at the null", "the very same")
    step = absent.longest_step
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
            clause.holds(present.longest_step > 0, f"a longest step of {present.longest_step} s", "a positive one")
            untouched.holds(same(given, before), f"{present!r} changes what its hooks are given", "new records")


def _records(clause: Clause, present: Effect, given: Given) -> None:
    """Chain and recording that it makes of others."""
    with clause.running(f"`chain` of {present!r}"):
        chain = present.chain(given.chain)
    alike = isinstance(chain, Chain) and [each.joint for each in chain.links] == [
        each.joint for each in given.chain.links
    ]
    clause.holds(alike, f"`chain` gives {type(chain).__name__}", "a Chain with the same links and joints")
    with clause.running(f"`inputs` of {present!r}"):
        driven = present.inputs(given.recording)
    clause.holds(isinstance(driven, Recording), f"`inputs` gives {type(driven).__name__}", "a Recording")
    for name in ("time", "tau"):
        _array(clause, f"`inputs(...).{name}`", getattr(driven, name), getattr(given.recording, name).shape)
    _array(clause, "`inputs(...).gravity`", np.asarray(driven.gravity), (2,))


def _sensors(clause: Clause, present: Effect, given: Given) -> None:
    """What it makes of measurements."""
    frames, markers, _ = given.positions.shape
    with clause.running(f"`instants` of {present!r}"):
        seen = present.instants(given.stamps, given.positions)
    _array(clause, "`instants`", seen, (frames,), (frames, markers))
    with clause.running(f"`shown` of {present!r}"):
        shown = present.shown(given.positions, given.headings)
    _array(clause, "`shown`", shown, given.positions.shape)
    with clause.running(f"`encoder` of {present!r}"):
        theta = present.encoder(given.theta)
    _array(clause, "`encoder`", theta, given.theta.shape)


def _motions(clause: Clause, present: Effect, given: Given, seed: int) -> None:
    """Force, rates or way, and rest, for states with several leading axes."""
    chain = present.chain(given.chain)
    with clause.running(f"`force`, `rates`, `way` or `states` of {present!r}"):
        force, rates, count = present.force(chain, _PAYLOAD), present.rates(chain), present.states(chain)
        way = present.way(chain)
    clause.holds(isinstance(count, int) and count >= 0, f"{count!r} states", "a number of them")
    told = sum(each is not None for each in (rates, way))
    expected = "one of `rates` and `way` where there are states"
    clause.holds(told == (count > 0), f"{count} states, rates {rates} and way {way}", expected)
    with clause.running(f"`smooth` of {present!r}"):
        smooth = present.smooth()
        alike = same(smooth.chain(given.chain), chain) and smooth.values == present.values
        kept = smooth.states(chain)
    clause.holds(alike, f"`smooth` gives {smooth!r}", "the same parameters and the same chain")
    allowed = {0} if way is not None else {0, count}
    expected = f"{count}, or none" if way is None else "none, where `way` carries them"
    clause.holds(kept in allowed, f"`smooth` gives an effect with {kept} states", expected)
    random = np.random.default_rng(seed)
    for leading in ((), (_FRAMES,), (_COPIES, _FRAMES)):
        q, v = (still(_ANGLES * random.normal(size=(*leading, chain.size))) for _ in range(2))
        time = still(np.abs(random.normal(size=leading)))
        with clause.running(f"`rest` of {present!r}"):
            rest = present.rest(chain, q)
        _array(clause, f"`rest` at angles {q.shape}", rest, (*leading, count))
        with clause.running(f"`settled` of {present!r}"):
            settled = present.settled(chain, q)
        _array(clause, f"`settled` at angles {q.shape}", settled, q.shape)
        z = still(rest + 0.1 * _ANGLES * random.normal(size=rest.shape))
        for name, motion, shape in (("force", force, q.shape), ("rates", rates, z.shape)):
            if motion is not None:
                _motion(clause, f"`{name}` of {present!r}", motion, (time, q, v, z), shape)
        if way is not None:
            to = still(q + _ANGLES * random.normal(size=q.shape))
            _motion(clause, f"`way` of {present!r}", way, (q, z, to), z.shape)
            with clause.running(f"`way` of {present!r}"):
                stays = np.allclose(way(q, rest, q), rest, rtol=0.0, atol=_ROUNDING)
            clause.holds(stays, "`way` changes states at rest where the joints stay", "states that follow the joints")


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
