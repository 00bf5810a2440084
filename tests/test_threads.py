"""Linear algebra runs on one thread, and as before afterwards; of other processes, see diagnosis/test_workers.py."""

from __future__ import annotations

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
