# SPDX-License-Identifier: GPL-3.0-or-later
"""Threads for the steps of an encode, and the chance to cancel between them.

Work is cut the same way whatever the number of threads and every piece writes its own part of the result, so results do
not depend on the threads. Only the calling thread calls the progress function, which may raise to cancel.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from types import TracebackType
from typing import Any, TypeVar

Tick = Callable[[], None]

# Seconds between two calls of the progress function outside the ends of stages.
INTERVAL = 0.1

Item = TypeVar("Item")
Result = TypeVar("Result")


def no_tick() -> None:
    """For callers that neither show progress nor cancel."""


def processor_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """A pool of threads, or the calling thread alone. threads: 0 means one for each core. Use as a context."""

    def __init__(self, threads: int = 1, tick: Tick = no_tick) -> None:
        self.threads = threads or processor_cores()
        self.tick = tick
        self._pool = ThreadPoolExecutor(self.threads, "encode") if self.threads > 1 else None

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def run(self, work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """The results of `work` on every item, in the items' order. What any of them raises ends it, after those
        under way."""
        items = list(items)
        if self._pool is None or len(items) < 2:
            results = []
            for item in items:
                self.tick()
                results.append(work(item))
            return results
        futures = [self._pool.submit(work, item) for item in items]
        try:
            return [self._result(future) for future in futures]
        except BaseException:
            for future in futures:
                future.cancel()
            wait(futures)
            raise

    def run_in_blocks(self, work: Callable[[int], Result], count: int, block: int) -> list[Result]:
        """The results of `work` on 0, 1, ... count - 1, so many in a row by one thread."""
        parts = self.run(lambda start: [work(n) for n in range(start, min(start + block, count))],
                         range(0, count, block))
        return [result for part in parts for result in part]

    def _result(self, future: Future[Any]) -> Any:
        while not wait([future], INTERVAL).done:
            self.tick()
        return future.result()


SERIAL = Workers()
