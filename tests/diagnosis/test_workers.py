"""Processes of a diagnosis: interrupts are not for them, each has one thread, and none outlives its parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from vjm.diagnosis.workers import _deferred_interrupts

_SCRIPT = """
import signal, time
from threadpoolctl import threadpool_info
from vjm.diagnosis.workers import Workers

def work(seconds):
    time.sleep(seconds)
    threads = [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()), max(threads)

if __name__ == "__main__":
    with Workers.start(2) as workers:
        print(workers.map(work, [0.0, 0.0]), flush=True)
        {rest}
"""


def test_an_interrupt_waits_for_processes_to_start() -> None:
    told = []
    before = signal.signal(signal.SIGINT, lambda *_: told.append("later"))
    try:
        with _deferred_interrupts():
            signal.raise_signal(signal.SIGINT)
            told.append("started")
        assert told == ["started", "later"]
        signal.raise_signal(signal.SIGINT)
        assert told == ["started", "later", "later"]  # the handler is given back
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.fixture
def script(tmp_path: Path) -> Path:
    return tmp_path / "script.py"


def test_interrupts_are_blocked_and_linear_algebra_has_one_thread(script: Path) -> None:
    script.write_text(_SCRIPT.format(rest="pass"), encoding="utf-8")
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "[(True, 1), (True, 1)]\n", "")


def test_they_end_with_a_parent_that_is_killed(script: Path) -> None:
    script.write_text(_SCRIPT.format(rest="workers.map(work, [90.0, 90.0])"), encoding="utf-8")
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        process.kill()
        rest, _ = process.communicate(timeout=60)  # to the pipe's end, where nobody holds it any more
    assert (first, rest) == (b"[(True, 1), (True, 1)]\n", b"")
