"""The search where something may stick and slip: with simulations held near the angles that encoders measured."""

from __future__ import annotations

from vjm.diagnosis.holding import can_be_held, held, held_at_nominal, released
from vjm.diagnosis.refit import ADRIFT, Explanation, Names
from vjm.diagnosis.search import FEW, Found, Search
from vjm.effects.effect import is_abrupt


def whole_search(search: Search, begun: Found) -> tuple[Search, Found]:
    """Look for all that is missing, open loop as far as that is a guide.

    A joint that sticks a moment too early is off for good, so that fits open loop are lost among accidents. What may
    stick and slip is looked for with simulations held; what does not is fitted open loop, which shows more.

    Args:
        search: open loop.
        begun: what it has found so far.

    Returns:
        The search that found the explanation, and where it ended.
    """
    if not can_be_held(search.start):
        return search, search.run(begun)
    found, asked = begun, set[Names]()
    while True:
        found = search.run(found, lambda each: each.best.names not in asked and _may_stick(search, each))
        if found.best.names in asked or not _may_stick(search, found):
            return search, found
        asked.add(found.best.names)
        search.tell("holding the arm near the angles that were measured")
        held_search = _held(search, found)
        if held_search is None:
            continue
        other, beside = held_search
        if _is_needed(other, beside) or _is_adrift(search, found):
            beside = other.run(beside)
            if is_abrupt(beside.best.effects):
                return other, beside
            found = _released(search, found, beside.best, other.trials.runner_up(beside.best))
            asked.add(found.best.names)


def _may_stick(search: Search, found: Found) -> bool:
    """Whether what sticks and slips is among the most needed, or may be hidden where nothing follows the recordings."""
    return bool(search.needed(found.best, found.last)) and (_is_adrift(search, found) or _is_needed(search, found))


def _is_adrift(search: Search, found: Found) -> bool:
    """Whether the search begins where nothing follows the recordings."""
    return found.best is search.start and found.best.point.misfit > ADRIFT


def _is_needed(search: Search, found: Found) -> bool:
    """Whether what sticks and slips is among the most needed."""
    return any(found.last.seen.effects[k].abrupt for k in search.needed(found.best, found.last)[:FEW])


def _held(search: Search, found: Found) -> tuple[Search, Found] | None:
    """The search with simulations held, and what it would have found so far; None where that cannot be simulated."""
    start = held(search.start)
    best = start if found.best is search.start else held(found.best)
    if start is None or best is None:
        return None
    if best is start and start.point.misfit > ADRIFT:
        # Parameters that follow nothing, even held, lead away from what is missing.
        best = start = held_at_nominal(search.start) or start
    other = search.again(start)
    first = other.judged(start)
    if best is start:
        return other, Found.nothing(start, first)
    other.trials.tried[best.names] = best
    return other, Found(best, first, other.judged(best), found.p_values)


def _released(search: Search, found: Found, best: Explanation, runner_up: Explanation | None) -> Found:
    """What was found with simulations held, fitted open loop; what was before where that cannot be simulated."""
    free = None if best.names == found.best.names else released(best, search.start)
    if free is None:
        return found
    search.trials.tried[free.names] = free
    free = search.trials.sharpen(search.trials.polish(free))
    return Found(free, found.first, search.judged(free), found.p_values, runner_up)
