"""Worker processes among which a diagnosis shares its work."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Self, TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Workers:
    """A number of processes.

    Attributes:
        count: of processes.
        executor: sends them jobs; None: this process does all.
    """

    count: int = 1
    executor: Executor | None = None

    @classmethod
    @contextmanager
    def start(cls, count: int) -> Iterator[Self]:
        """Run processes as long as they are needed."""
        if count == 1:
            yield cls()
            return
        with ProcessPoolExecutor(count, mp_context=get_context("forkserver")) as executor:
            yield cls(count, executor)

    def map(self, work: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Result]:
        """Return the results of a function for each job, in the jobs' order."""
        if self.executor is None or len(jobs) < 2:
            return [work(job) for job in jobs]
        return [*self.executor.map(work, jobs)]


ALONE = Workers()
