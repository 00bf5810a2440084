"""Processes among which a diagnosis shares its work; they end with it, with Ctrl-C, or with their parent.

Interrupts are for the process that started them, which ends them in turn.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import active_children, forkserver, get_context, parent_process, resource_tracker
from multiprocessing.process import BaseProcess
from threading import Thread
from typing import Self, TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Workers:
    """Processes among which a diagnosis shares its work: `count` of an executor, or this one alone."""

    count: int = 1
    executor: Executor | None = None

    @classmethod
    @contextmanager
    def start(cls, count: int) -> Iterator[Self]:
        """Run processes as long as they are needed; whatever ends the work early ends them as well."""
        if count == 1:
            yield cls()
            return
        # Interrupts are for this process alone: the server inherits the mask, and its processes from it. The resource
        # tracker would lift the mask if the server had to start it.
        resource_tracker.ensure_running()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        others, context = {*active_children()}, get_context("forkserver")
        executor = ProcessPoolExecutor(count, mp_context=context, initializer=_end_with_parent)
        try:
            with _interrupted_later():
                for _ in range(count):
                    executor.submit(int)  # starts a process
            yield cls(count, executor)
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            for process in {*active_children()} - others:
                process.terminate()
            raise
        executor.shutdown()

    def map(self, work: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Result]:
        """Return the results of a function for each job, in the jobs' order."""
        mapped = map if self.executor is None or len(jobs) < 2 else self.executor.map
        return [*mapped(work, jobs)]


@contextmanager
def _interrupted_later() -> Iterator[None]:
    """Tell Ctrl-C at the block's end: a process that is interrupted while it starts another does not know of that."""
    pressed: list[int] = []
    try:
        before = signal.signal(signal.SIGINT, lambda number, _: pressed.append(number))
    except ValueError:  # not the main thread, which alone is told
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    for number in pressed[:1]:
        signal.raise_signal(number)


def _end_with_parent() -> None:
    """Make this process end when the one that started it does, however that ends."""

    def watch(parent: BaseProcess) -> None:
        parent.join()
        os._exit(1)

    if (parent := parent_process()) is not None:
        Thread(target=watch, args=(parent,), daemon=True).start()


ALONE = Workers()
