"""Timing by turns: whatever else the computer does disturbs all contenders alike."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]


def in_turns(tasks: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, np.ndarray]:
    """Seconds that each task took in each round, after one round that does not count."""
    seconds: dict[str, list[float]] = {name: [] for name in tasks}
    for turn in range(repeats + 1):
        for name, task in tasks.items():
            start = time.perf_counter()
            task()
            if turn:
                seconds[name].append(time.perf_counter() - start)
    return {name: np.array(values) for name, values in seconds.items()}


def header(title: str) -> None:
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() or "no commit"
    print(f"{title}\n  {commit}, Python {platform.python_version()}, {os.cpu_count()} cores,", end=" ")
    print(f"load {os.getloadavg()[0]:.1f} (another's load makes seconds worthless; ratios suffer less)")


def line(what: str, value: float, unit: str = "", limit: float | None = None) -> None:
    """One figure, beside its limit where it has one."""
    text = "" if limit is None else f"   limit {limit:g}: {'kept' if value <= limit else 'MISSED'}"
    print(f"  {what:58} {value:8.3g} {unit:2}{text}")
