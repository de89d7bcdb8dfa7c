# SPDX-License-Identifier: BSD-3-Clause
"""A value that is fetched when somebody asks for it, and then good for a short while.

Service handlers run in a thread each. A web page asks for topics, nodes and services in one breath, and many
pages ask at once: they all share one fetch. This is a door between threads, so it has a lock; it is never
held while fetching.
"""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future
from typing import Callable, Generic, Optional, TypeVar

T = TypeVar("T")


class Recent(Generic[T]):
    """The value of `fetch()`, whose fetch began at most `max_age_s` ago, or is under way."""

    def __init__(self, fetch: Callable[[], T], max_age_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._fetch = fetch
        self._max_age_s = max_age_s
        self._clock = clock
        self._lock = threading.Lock()
        self._latest: Optional[Future[T]] = None
        self._began = 0.0

    def get(self) -> T:
        """The value. Raises what `fetch` raises; a failure is told to all who waited for it and not kept."""
        with self._lock:
            latest = self._latest
            if latest is not None and self._is_good(latest):
                mine = None
            else:
                latest = mine = self._latest = Future()
                self._began = self._clock()
        if mine is not None:
            try:
                mine.set_result(self._fetch())
            except BaseException as error:  # whatever it is, those who wait must hear of it
                mine.set_exception(error)
                raise
        return latest.result()

    def _is_good(self, latest: Future[T]) -> bool:
        if not latest.done():
            return True
        return latest.exception() is None and self._clock() - self._began < self._max_age_s
