"""Records of diagnosed cases as Markdown."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import mean

from hidden_figures import (
    OTHERS,
    Record,
    alarmed,
    all_found,
    all_right,
    classes,
    confusion,
    covered,
    flagged,
    gained,
    middle,
    rate,
    right_first,
    share,
    truths,
    usable,
    wrong_name,
)

Row = tuple[str, str]


def report(records: Sequence[Record]) -> str:
    """All suites that have records, one after another."""
    suites = dict.fromkeys(record["suite"] for record in records)
    sections = [_section(suite, [record for record in records if record["suite"] == suite]) for suite in suites]
    return "\n\n".join([_runs(records), _times(records), *sections]) + "\n"


def _runs(records: Sequence[Record]) -> str:
    """What was diagnosed when, on which commit, and what came out of it."""
    runs: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        runs.setdefault((record.get("made", ""), record["suite"]), []).append(record)
    rows = [
        (made, suite, _seeds(run), str(len(run)), _right(suite, usable(run)), middle(r["seconds"] for r in usable(run)))
        for (made, suite), run in runs.items()
    ]
    return _table(("made", "suite", "seeds", "cases", "right", "s"), rows)


def _seeds(records: Sequence[Record]) -> str:
    """Seeds, those in a row as a range."""
    seeds = sorted({int(record["seed"]) for record in records})
    starts = [seed for seed in seeds if seed - 1 not in seeds]
    ends = [seed for seed in seeds if seed + 1 not in seeds]
    return ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in zip(starts, ends, strict=True))


def _right(suite: str, records: Sequence[Record]) -> str:
    """How many were told rightly: what was hidden and nothing else; where it is not in the list, that it is unknown."""
    right = [
        not alarmed(record) if not record["truth"] else flagged(record) if suite == "missing" else all_right(record)
        for record in records
    ]
    return f"{sum(right)}/{len(right)}"


def _section(suite: str, records: Sequence[Record]) -> str:
    done = usable(records)
    parts = [f"## {suite}", _table(("figure", "value"), _figures(suite, done) + _failures(records))]
    if suite == "severities":
        parts.append(_by_size(done))
    parts.append(_by_effect([record for record in done if len(record["truth"]) == 1]))
    parts.append(_matrix([record for record in done if len(record["truth"]) < 2]))
    return "\n\n".join(part for part in parts if part)


def _figures(suite: str, records: Sequence[Record]) -> list[Row]:
    """The figures that mean something for these records."""
    clean = [record for record in records if not record["truth"]]
    hidden = [record for record in records if record["truth"]]
    rows: list[Row] = []
    for rig in dict.fromkeys(record["rig"] for record in clean):
        rows.append((f"false alarms, {rig} rig", rate([r for r in clean if r["rig"] == rig], alarmed)))
    if not hidden:
        return rows
    if suite == "missing":
        rows += [("unknown or flagged", rate(hidden, flagged)), ("one wrong name alone", rate(hidden, wrong_name))]
        return rows
    inside = [hit for record in hidden for hit in covered(record)]
    named = [set_ for record in hidden for set_ in classes(record)[:1]]
    rows += [
        ("right class named first", rate(hidden, right_first)),
        ("every hidden effect found", rate(hidden, all_found)),
        ("every hidden effect found, and nothing else", rate(hidden, all_right)),
        ("one wrong name alone", rate(hidden, wrong_name)),
        ("true value within 1.96 standard errors", share(sum(inside), len(inside))),
        ("share of the avoidable error avoided, median", middle(gained(record) for record in hidden)),
        ("effects in the class named first, mean", f"{mean(map(len, named)):.2f}" if named else "-"),
    ]
    return rows


def _failures(records: Sequence[Record]) -> list[Row]:
    broken = [record for record in records if "error" in record]
    return [("broken off by an error", f"{len(broken)}: {broken[0]['error']}")] if broken else []


def _by_size(records: Sequence[Record]) -> str:
    """One row for each multiple of the smallest detectable size."""
    rows = []
    for size in sorted({record["multiple"] for record in records}):
        chosen = [record for record in records if record["multiple"] == size]
        rows.append((f"{size:g}", rate(chosen, right_first), rate(chosen, alarmed)))
    return _table(("times the smallest", "right class named first", "anything noticed"), rows)


def _by_effect(records: Sequence[Record]) -> str:
    """One row for each hidden effect."""
    rows = []
    for effect in dict.fromkeys(truths(record)[0] for record in records):
        chosen = [record for record in records if truths(record) == [effect]]
        inside = [hit for record in chosen for hit in covered(record)]
        counts: list[Callable[[Record], bool]] = [right_first, all_right, flagged]
        rows.append(
            (
                effect,
                str(len(chosen)),
                *(str(sum(map(count, chosen))) for count in counts),
                f"{sum(inside)}/{len(inside)}",
                middle(gained(record) for record in chosen),
                middle((record["seconds"] for record in chosen), ".1f"),
            )
        )
    heads = ("hidden", "cases", "right first", "only right", "flagged", "covered", "avoided", "s")
    return _table(heads, rows) if rows else ""


def _matrix(records: Sequence[Record]) -> str:
    """Truth by name; names that never occur are left out."""
    counts = confusion(records)
    hidden = list(dict.fromkeys(truth for truth, _ in counts))
    names = {name for _, name in counts}
    order = [each for each in hidden if each in names] + sorted(names - set(hidden) - set(OTHERS))
    order += [each for each in OTHERS if each in names]
    rows = [(truth, *(str(counts[truth, name] or "") for name in order)) for truth in hidden]
    return _table(("hidden \\ named", *order), rows) if rows else ""


def _times(records: Sequence[Record]) -> str:
    seconds = [record["seconds"] for record in usable(records)]
    slowest = f"{max(seconds):.1f} s" if seconds else "-"
    rows = [
        ("cases", f"{len(records)}"),
        ("time of a diagnosis, median", f"{middle(seconds, '.1f')} s"),
        ("longest", slowest),
    ]
    return _table(("figure", "value"), rows)


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
