"""Worker processes of a diagnosis; they end with it, with Ctrl-C, or with their parent process.

Only the parent receives interrupts, and ends its workers in turn.
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

from vjm.threads import use_one_thread

Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Workers:
    """Worker processes that share the work of a diagnosis: `count` of an executor, or none but this process."""

    count: int = 1
    executor: Executor | None = None

    @classmethod
    @contextmanager
    def start(cls, count: int) -> Iterator[Self]:
        """Start worker processes for the duration of a `with` block; an error or interrupt in it ends them at once."""
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
        existing, context = {*active_children()}, get_context("forkserver")
        executor = ProcessPoolExecutor(count, mp_context=context, initializer=_initialise)
        try:
            with _deferred_interrupts():
                for _ in range(count):
                    executor.submit(int)  # starts a process
            yield cls(count, executor)
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            for process in {*active_children()} - existing:
                process.terminate()
            raise
        executor.shutdown()

    def map(self, work: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Result]:
        """Return the results of a function for each job, in the jobs' order."""
        mapped = map if self.executor is None or len(jobs) < 2 else self.executor.map
        return [*mapped(work, jobs)]


@contextmanager
def _deferred_interrupts() -> Iterator[None]:
    """Defer Ctrl-C to the end of the block: interrupted while it is started, a process would not be ended again."""
    received: list[int] = []
    try:
        before = signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    except ValueError:  # not the main thread, which alone receives signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    for number in received[:1]:
        signal.raise_signal(number)


def _initialise() -> None:
    """Run linear algebra on one thread in this process, and end it when the one that started it ends, however."""
    use_one_thread()

    def watch(parent: BaseProcess) -> None:
        parent.join()
        os._exit(1)

    if (parent := parent_process()) is not None:
        Thread(target=watch, args=(parent,), daemon=True).start()


SERIAL = Workers()
