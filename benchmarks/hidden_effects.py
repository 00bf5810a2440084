"""How well `vjm.diagnose` finds what is hidden in recordings of a continuous beam.

    python benchmarks/hidden_effects.py everyday clean --seeds 10 --jobs 2 -o results.jsonl

Each finished case is one line of the results file; cases that are there are not run again, so that a benchmark can be
stopped and taken up. The tables of all that the file holds go to standard output and, beside it, to a Markdown file.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one process, one core: --jobs says how many

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [path for path in (str(ROOT), str(Path(__file__).parent)) if path not in sys.path]

from hidden_cases import NOTHING, SUITES, Case, cases_of, reference_case  # noqa: E402
from hidden_figures import smallest_detectable  # noqa: E402
from hidden_tables import report  # noqa: E402

from tests.hidden.rigs import Truth, write_hidden  # noqa: E402
from tests.hidden.two_links import write_two_links  # noqa: E402

Result = dict[str, Any]
# The experiment file and the candidates (None: all), to the dictionary that `vjm diagnose` writes.
Diagnose = Callable[[Path, list[str] | None], Result]
Smallest = Mapping[str, Mapping[str, float]]


def diagnose(file: Path, effects: list[str] | None, budget: float = float("inf")) -> Result:
    """The package's own diagnosis, within a budget of processor time, s."""
    import vjm
    from vjm.report.result_json import result_object

    found: Result = result_object(vjm.diagnose(vjm.load_experiment(file), effects=effects, seed=0, budget=budget))
    return found


def run(case: Case, smallest: Smallest, how: Diagnose, keep: Path | None = None) -> Result:
    """Write a case's recordings, diagnose them, and put what came out beside the truth."""
    record: Result = {"key": case.key, "suite": case.suite, "rig": case.rig, "seed": case.seed}
    record |= {"multiple": case.multiple, "truth": [{"effect": each, "parameters": {}} for each in case.effects]}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) if keep is None else keep / case.key.replace("/", "-")
        try:
            if case.rig == "two_links":
                truth = write_two_links(folder, case.planted(smallest), case.seed)
            else:
                truth = write_hidden(folder, case.rig, case.planted(smallest), case.seed, case.conditions)
            record |= _true(truth)
            start = time.process_time()
            result = how(folder / "experiment.toml", case.candidates)
            record |= {"seconds": time.process_time() - start, "result": result}
        except Exception as error:
            record["error"] = f"{type(error).__name__}: {error}"
    return record


def _true(truth: Truth) -> Result:
    """What a record says of the truth."""
    effects = [{"effect": each.effect, "parameters": dict(each.parameters)} for each in truth.effects]
    return {
        "truth": effects,
        "noise_rms": truth.noise_rms,
        "right_rms": truth.right_rms,
        "setting": asdict(truth.setting),
    }


def read(file: Path) -> list[Result]:
    """Records of finished cases, the last one of each, with when and where it was made; a cut line is left out."""
    records: dict[str, Result] = {}
    made = ""
    for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else []:
        try:
            found = json.loads(line)
        except ValueError:
            continue
        if "key" in found:
            records[found["key"]] = found | {"made": made}
        else:
            made = f"{found['date']}, {found['commit']}, {found['machine']}"
    return list(records.values())


def append(file: Path, line: Mapping[str, Any]) -> None:
    """One more line, written whole."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a+b") as stream:
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(0, size - 1))
        cut = stream.read(1) not in (b"", b"\n")
        stream.write((("\n" if cut else "") + json.dumps(line) + "\n").encode())


def header(arguments: argparse.Namespace) -> Result:
    """When, on which commit, and with what the cases that follow were run."""
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() or "no commit"
    machine = f"Python {platform.python_version()}, {os.cpu_count()} cores"
    options = {"suites": arguments.suites, "seeds": arguments.seeds, "jobs": arguments.jobs}
    options |= {"budget": arguments.budget} if arguments.budget < float("inf") else {}
    return {"date": date.today().isoformat(), "commit": commit, "machine": machine} | options


def chosen(arguments: argparse.Namespace) -> list[Case]:
    """The cases asked for, those first whose diagnosis others need."""
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    cases = [case for suite in arguments.suites for case in cases_of(suite, seeds)]
    if arguments.only:
        cases = [case for case in cases if not arguments.only.isdisjoint(case.effects or (NOTHING,))]
    needed = [reference_case(case) for case in cases if case.multiple]
    return list(dict.fromkeys([*needed, *cases]))


def finish(cases: Sequence[Case], arguments: argparse.Namespace, how: Diagnose) -> None:
    """Run what is not in the results file yet, first what the rest depends on."""
    for wave in (
        [case for case in cases if not case.multiple],
        [case for case in cases if case.multiple],
    ):
        records = {record["key"]: record for record in read(arguments.out)}
        pending = [case for case in wave if "result" not in records.get(case.key, {})]
        tasks = [(case, _smallest(case, records), how, arguments.keep) for case in pending]
        for count, record in enumerate(_results(tasks, arguments.jobs), 1):
            append(arguments.out, record)
            said = record.get("error") or f"{record['result']['verdict']}, {record['seconds']:.1f} s"
            print(f"{count}/{len(tasks)} {record['key']}: {said}", file=sys.stderr, flush=True)


def _smallest(case: Case, records: Mapping[str, Result]) -> Smallest:
    """Detectable sizes, from the clean diagnosis that a case in multiples of them rests on."""
    clean = records.get(reference_case(case).key, {})
    return smallest_detectable(clean) if case.multiple and "result" in clean else {}


def _results(tasks: Sequence[tuple[Case, Smallest, Diagnose, Path | None]], jobs: int) -> Iterator[Result]:
    """Records in the order in which they are finished."""
    if jobs == 1:
        yield from (run(*task) for task in tasks)
        return
    with ProcessPoolExecutor(jobs) as pool:
        futures = [pool.submit(run, *task) for task in tasks]
        for future in as_completed(futures):
            yield future.result()


def parse(words: Iterable[str] | None) -> argparse.Namespace:
    """The command line."""
    suites = "\n".join(f"  {name:11} {text}" for name, text in SUITES.items())
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=f"suites:\n{suites}", formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("suites", nargs="+", choices=SUITES, metavar="SUITE", help="one or more of those below")
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds (default 3)")
    parser.add_argument("--first-seed", type=int, default=1, help="the first of them (default 1)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument("--only", type=lambda text: set(text.split(",")), help=f"hidden effects, or {NOTHING}: a,b,c")
    parser.add_argument("--budget", type=float, default=float("inf"), help="of a diagnosis, s (default: none)")
    parser.add_argument("--keep", type=Path, help="keep the experiments' folders here")
    parser.add_argument("--tables-only", action="store_true", help="run nothing")
    parser.add_argument("-o", "--out", type=Path, default=Path("hidden_effects.jsonl"), help="results file")
    return parser.parse_args(None if words is None else list(words))


def main(words: Iterable[str] | None = None, how: Diagnose | None = None) -> None:
    """Run, then print and write the tables."""
    arguments = parse(words)
    cases = chosen(arguments)
    if not arguments.tables_only:
        append(arguments.out, header(arguments))
        finish(cases, arguments, how or partial(diagnose, budget=arguments.budget))
    wanted = {case.key for case in cases if case.suite in arguments.suites}
    text = report([record for record in read(arguments.out) if record["key"] in wanted])
    print(text)
    arguments.out.with_suffix(".md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
