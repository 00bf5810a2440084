"""What many diagnoses of known truth amount to: counts, rates and tables, from records of finished cases.

A record is a dictionary of plain values: `key`, `suite`, `rig`, `truth` (effects with parameters), `result` (as
`vjm diagnose` writes it), `noise_rms` and `right_rms` (m, by file), `seconds`; or `error` in place of a result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import hypot, isfinite, pi, sqrt
from statistics import mean, median
from typing import Any

from hidden_cases import NOTHING

Record = Mapping[str, Any]

OTHERS = ("none", "unknown", "set", "insufficient")
_WORTH_GAINING = 0.02  # of the noise: where less is missing there is nothing to gain
_FLAG = 0.01  # p-value of what remains, below which a diagnosis says itself that something is missing


def truths(record: Record) -> list[str]:
    """Ids of what is hidden."""
    return [each["effect"] for each in record["truth"]]


def classes(record: Record) -> list[set[str]]:
    """The class of each cause that was named: its effect and what cannot be told from it."""
    return [{cause["effect"], *cause["indistinguishable_from"]} for cause in record["result"]["causes"]]


def right_first(record: Record) -> bool:
    """Whether the class named first holds one of the hidden effects."""
    named = classes(record)
    return bool(named) and not named[0].isdisjoint(truths(record))


def all_right(record: Record) -> bool:
    """Whether every hidden effect is in a class of its own, and no class is left over."""
    named, hidden = classes(record), truths(record)
    return len(named) == len(hidden) and _matched(hidden, named)


def all_found(record: Record) -> bool:
    """Whether every hidden effect is in a class of its own, whatever else was named."""
    return _matched(truths(record), classes(record))


def _matched(hidden: Sequence[str], named: Sequence[set[str]]) -> bool:
    """Whether each of a few effects can have a class to itself."""
    if not hidden:
        return True
    first, *others = hidden
    choices = [k for k, each in enumerate(named) if first in each]
    return any(_matched(others, [each for j, each in enumerate(named) if j != k]) for k in choices)


def alarmed(record: Record) -> bool:
    """Whether anything was said to be missing."""
    return record["result"]["verdict"] in ("named", "set", "unknown")


def flagged(record: Record) -> bool:
    """Whether the diagnosis says itself that it cannot explain everything."""
    remaining = (record["result"].get("remaining") or {}).get("p_value")
    doubtful = remaining is not None and remaining < _FLAG
    return record["result"]["verdict"] in ("unknown", "insufficient") or doubtful


def wrong_name(record: Record) -> bool:
    """Whether one cause alone was named with confidence, and it is not there."""
    return record["result"]["verdict"] == "named" and not flagged(record) and not right_first(record)


def column(record: Record) -> str:
    """Where a record stands in the confusion matrix."""
    verdict: str = record["result"]["verdict"]
    return record["result"]["causes"][0]["effect"] if verdict == "named" else verdict


def covered(record: Record) -> list[bool]:
    """Whether value +- 1.96 std holds the truth, for every parameter of the hidden effects that were named."""
    causes = {cause["effect"]: cause["parameters"] for cause in record["result"]["causes"]}
    found = []
    for planted in record["truth"]:
        for name, estimate in causes.get(planted["effect"], {}).items():
            std = estimate["std"]
            if name in planted["parameters"] and std is not None and isfinite(std) and std > 0.0:
                found.append(abs(_miss(name, estimate["value"] - planted["parameters"][name])) <= 1.96 * std)
    return found


def _miss(name: str, difference: float) -> float:
    """An error; of an angle on a circle, or of a line's direction, the short way round."""
    turn = {"phase": 2.0 * pi, "direction": pi}.get(name)
    return difference if turn is None else (difference + turn / 2.0) % turn - turn / 2.0


def gained(record: Record) -> float | None:
    """Share of what is avoidable that the diagnosis avoids, over hold-outs: (E0 - E1) / (E0 - E*), E* the noise.

    None where the model without the cause is within a fiftieth of the noise.
    """
    held = [each for each in record["result"]["recordings"] if each["role"] == "holdout"]
    if not held or any(each[f"marker_rms_{when}_m"] is None for each in held for when in ("before", "after")):
        return None
    before, after = (sqrt(mean(each[f"marker_rms_{when}_m"] ** 2 for each in held)) for when in ("before", "after"))
    every, right = (sqrt(mean(record[kind][each["file"]] ** 2 for each in held)) for kind in ("noise_rms", "right_rms"))
    floor = every if after >= 0.95 * every else right  # replays may leave wrong sightings out
    avoidable = before - floor
    return (before - after) / avoidable if avoidable > _WORTH_GAINING * floor else None


def smallest_detectable(record: Record) -> dict[str, dict[str, float]]:
    """By effect and parameter, as a diagnosis said; of several candidates of one effect, the first."""
    found: dict[str, dict[str, float]] = {}
    for each in record["result"]["candidates"]:
        sizes = {name: float(size) for name, size in (each["smallest_detectable"] or {}).items() if size is not None}
        if sizes:
            found.setdefault(each["effect"], sizes)
    return found


def usable(records: Iterable[Record]) -> list[Record]:
    """Those that came to a result."""
    return [record for record in records if "result" in record]


def share(count: int, total: int) -> str:
    """Two numbers and what they make, with a 95 % interval (Wilson)."""
    if not total:
        return "-"
    z, rate = 1.96, count / total
    centre = (rate + z**2 / (2 * total)) / (1 + z**2 / total)
    spread = z / (1 + z**2 / total) * hypot(sqrt(rate * (1 - rate) / total), z / (2 * total))
    low, high = 100 * max(0.0, centre - spread), 100 * min(1.0, centre + spread)
    return f"{count}/{total} = {100 * rate:.1f} % ({low:.1f} to {high:.1f})"


def rate(records: Sequence[Record], question: Callable[[Record], bool]) -> str:
    """Share of records for which the answer is yes."""
    return share(sum(map(question, records)), len(records))


def middle(values: Iterable[float | None], form: str = ".2f") -> str:
    """Median of what is known."""
    known = [value for value in values if value is not None]
    return format(median(known), form) if known else "-"


def confusion(records: Sequence[Record]) -> Counter[tuple[str, str]]:
    """How often each truth, one effect or none, got each name."""
    return Counter((next(iter(truths(record)), NOTHING), column(record)) for record in records)
