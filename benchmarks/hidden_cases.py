"""Suites of experiments with something hidden in them, for `hidden_effects.py`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tests.hidden import two_links
from tests.hidden.rigs import PLAIN, Conditions
from tests.hidden.settings import Rig
from tests.hidden.severities import EFFECTS, Planted, draw, effects_of, of_size, twins

MULTIPLES = (1.0, 2.0, 5.0, 20.0)  # of the smallest detectable size
NOTHING = "nothing"  # the name of what is hidden in clean recordings


@dataclass(frozen=True)
class Case:
    """One experiment to diagnose.

    Attributes:
        suite: its suite.
        rig: its kind.
        effects: ids of what is hidden.
        seed: draws the rig, its recordings, their noise, and the effects' sizes.
        multiple: of the smallest detectable size; 0: everyday sizes.
    """

    suite: str
    rig: Rig
    effects: tuple[str, ...]
    seed: int
    multiple: float = 0.0

    @property
    def key(self) -> str:
        """What a finished case is known by."""
        size = f"x{self.multiple:g}" if self.multiple else "everyday"
        return "/".join([self.suite, self.rig, "+".join(self.effects) or NOTHING, size, str(self.seed)])

    @property
    def conditions(self) -> Conditions:
        """How its recordings are made."""
        random = np.random.default_rng([self.seed, 4])
        match self.suite:
            case "coloured":
                return Conditions(noise_correlation=float(random.uniform(0.5, 0.9)))
            case "outliers":
                return Conditions(outliers=0.005, dropped_frames=0.1)
            case "reference":
                return Conditions(reference=True)
        return PLAIN

    @property
    def candidates(self) -> list[str] | None:
        """Effects that the diagnosis may consider; None: all."""
        if self.suite != "missing":
            return None
        hidden = frozenset().union(*(twins(self.rig, effect) for effect in self.effects))
        return [effect for effect in EFFECTS if effect not in hidden]

    def planted(self, smallest: Mapping[str, Mapping[str, float]]) -> list[Planted]:
        """What is hidden; `smallest` holds detectable sizes of parameters, by effect, as a clean diagnosis said."""
        if self.suite in ("arms", "elbow"):  # from hardly visible to plain
            factor = float(0.3 * 10.0 ** np.random.default_rng([self.seed, 7]).uniform())
            if self.suite == "elbow":
                return [two_links.drawn(effect, self.seed, factor) for effect in self.effects]
            return [draw(effect, self.seed, self.rig, factor) for effect in self.effects]
        if not self.multiple:
            return [draw(effect, self.seed, self.rig) for effect in self.effects]
        return [of_size(effect, self.seed, smallest.get(effect, {}), self.multiple) for effect in self.effects]


SUITES: Mapping[str, str] = {
    "everyday": "one everyday effect on the hub-driven rig",
    "severities": "one effect, in multiples of the smallest size that is said to be detectable",
    "clean": "nothing hidden, either rig",
    "coloured": "everyday effects and clean recordings, the camera's noise correlated from frame to frame",
    "outliers": "everyday effects and clean recordings, 0.5 % wrong sightings, a tenth of the frames lost",
    "pairs": "two everyday effects at once",
    "missing": "one everyday effect that is not among the candidates, nor is anything that looks like it",
    "clamped": "one everyday effect on a clamped link, free decays only",
    "arms": "one effect of any size, or none, on an arm of any size with other sensors and drives, all drawn anew",
    "elbow": "one effect of any size, or none, on an arm of two links with an elbow motor, drawn anew, by MuJoCo",
    "reference": "one everyday effect, and recordings known to be without it",
}


def cases_of(suite: str, seeds: Sequence[int]) -> list[Case]:
    """All cases of a suite, seed by seed."""
    return [case for seed in seeds for case in _of_seed(suite, seed)]


def _of_seed(suite: str, seed: int) -> Iterator[Case]:
    single = [(effect,) for effect in EFFECTS]
    match suite:
        case "everyday" | "missing":
            yield from (Case(suite, "hub", effects, seed) for effects in single)
        case "coloured" | "outliers" | "reference":
            yield from (Case(suite, "hub", effects, seed) for effects in [(), *single])
        case "severities":
            yield from (Case(suite, "hub", effects, seed, size) for effects in single for size in MULTIPLES)
        case "clean":
            yield from (Case(suite, rig, (), seed) for rig in ("hub", "clamped"))
        case "clamped":
            yield from (Case(suite, "clamped", (effect,), seed) for effect in effects_of("clamped"))
        case "arms":
            kinds: tuple[Rig, ...] = ("arm", "clamped_arm")
            every = [(kind, (effect,)) for kind in kinds for effect in effects_of(kind)] + [
                (kind, ()) for kind in kinds
            ]
            yield from (Case(suite, kind, effects, 100 * seed + k) for k, (kind, effects) in enumerate(every))
        case "elbow":
            every_one = [(), *((effect,) for effect in two_links.EFFECTS)]
            yield from (Case(suite, "two_links", effects, 100 * seed + k) for k, effects in enumerate(every_one))
        case "pairs":
            yield from (Case(suite, "hub", pair, seed) for pair in pairs_of(seed))
        case _:
            raise ValueError(f"no suite {suite!r}; there are {', '.join(SUITES)}")


def pairs_of(seed: int) -> list[tuple[str, str]]:
    """Effects by twos, each effect once at most, none with a twin of its own."""
    order = np.random.default_rng([seed, 5]).permutation(np.array(EFFECTS)).tolist()
    pairs = []
    while len(order) > 1:
        first = order.pop()
        partner = next((each for each in reversed(order) if each not in twins("hub", first)), None)
        if partner is not None:
            order.remove(partner)
            pairs.append((str(first), str(partner)))
    return pairs


def reference_case(case: Case) -> Case:
    """The clean case whose diagnosis says what would have been detectable."""
    return Case("clean", case.rig, (), case.seed)
