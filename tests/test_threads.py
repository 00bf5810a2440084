"""Linear algebra runs on one thread, in this process and in others, and as before afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from threadpoolctl import threadpool_info, threadpool_limits

import vjm

DEMO = Path(vjm.__file__).parent / "demo" / "experiment.toml"


def _threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_results_are_computed_on_one_thread() -> None:
    demo, seen = vjm.load_experiment(DEMO), list[set[int]]()
    identify = vjm.identify  # imported here, and its libraries with it, before their threads are set
    with threadpool_limits(2, user_api="blas"):
        identify(demo, "torque", baselines=False, progress=lambda *_: seen.append(_threads()))
        assert seen
        assert all(threads == {1} for threads in seen)
        assert _threads() == {2}


def test_so_do_worker_processes(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        """
from threadpoolctl import threadpool_info
from vjm.diagnosis.workers import Workers

def threads(_):
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

if __name__ == "__main__":
    with Workers.start(2) as workers:
        print(workers.map(threads, [0, 1]))
""",
        encoding="utf-8",
    )
    environment = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, script],
        env=environment | {"OPENBLAS_NUM_THREADS": "2"},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout == "[{1}, {1}]\n"
