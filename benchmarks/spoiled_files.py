"""What the commands make of spoiled experiments, by the thousand.

Cases are drawn as in `tests/test_spoiled.py`. Each in which a command breaks the law of `tests/spoiled.py` is told, and
kept with its files and its command where a folder is given.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the commands do for themselves

import argparse
import shlex
import sys
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic

from hypothesis import HealthCheck, Phase, given, seed, settings

sys.path.append(str(Path(__file__).resolve().parents[1]))

from tests.spoiled import Case, Outcome, cases, run

PORTION = 50  # cases that Hypothesis draws at once: of more, it makes many alike


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000, help="number of different cases (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the first portion (default: %(default)s)")
    parser.add_argument("-o", "--out", type=Path, help="folder for the cases in which a command breaks the law")
    arguments = parser.parse_args()
    seen: set[str] = set()
    endings: Counter[str] = Counter()
    faults: Counter[str] = Counter()
    slowest, began, portion = (0.0, ""), monotonic(), arguments.seed

    @settings(
        max_examples=PORTION, database=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck),
        deadline=None, derandomize=False,
    )  # fmt: skip
    @given(cases())
    def draw(case: Case) -> None:
        nonlocal slowest
        if repr(case) in seen or len(seen) == arguments.cases:
            return
        seen.add(repr(case))
        with TemporaryDirectory() as parent:
            outcome = run(case, Path(parent))
        endings[f"{case.command[0]}: status {outcome.status}"] += 1
        faults.update(outcome.faults)
        slowest = max(slowest, (outcome.seconds, shlex.join(case.command)))
        if outcome.faults:
            print(f"portion {portion}: {case.command[0]}: {', '.join(outcome.faults)}: {outcome.stderr!a}", flush=True)
            if arguments.out is not None:
                keep(case, outcome, arguments.out / f"{sum(faults.values()):04}")

    while len(seen) < arguments.cases:
        seed(portion)(draw)()
        portion += 1
        if portion % 10 == 0:
            print(f"{len(seen)} cases, {sum(faults.values())} faults, {monotonic() - began:.0f} s", file=sys.stderr)
    for ending, count in sorted(endings.items()):
        print(f"{count:6}  {ending}")
    print(f"{len(seen)} cases in {monotonic() - began:.0f} s, the slowest in {slowest[0]:.1f} s ({slowest[1]})")
    print(f"faults: {dict(faults) or 'none'}")
    return bool(faults)


def keep(case: Case, outcome: Outcome, folder: Path) -> None:
    """Write a case, its command, and what came of it."""
    folder.mkdir(parents=True)
    case.write(folder)
    told = [
        f"vjm {shlex.join(case.command)}",
        f"status {outcome.status}",
        *outcome.faults,
        outcome.stderr,
        outcome.stdout,
    ]
    (folder / "outcome.txt").write_text("\n".join(told), encoding="utf-8", errors="backslashreplace")


if __name__ == "__main__":
    raise SystemExit(main())
