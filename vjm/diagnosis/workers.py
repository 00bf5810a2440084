"""Processes among which a diagnosis shares its work."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TypeVar

Job = TypeVar("Job")
Done = TypeVar("Done")


@dataclass(frozen=True)
class Workers:
    """What does the work.

    Attributes:
        count: of processes.
        executor: sends them work; None: all is done here.
    """

    count: int = 1
    executor: Executor | None = None

    def map(self, work: Callable[[Job], Done], jobs: Sequence[Job]) -> list[Done]:
        """The work on each job, in the jobs' order, whoever does it."""
        if self.executor is None or len(jobs) < 2:
            return [work(job) for job in jobs]
        return [*self.executor.map(work, jobs)]


ALONE = Workers()


@contextmanager
def workers(count: int) -> Iterator[Workers]:
    """So many processes, as long as they are needed."""
    if count == 1:
        yield ALONE
        return
    with ProcessPoolExecutor(count, mp_context=get_context("forkserver")) as executor:
        yield Workers(count, executor)
