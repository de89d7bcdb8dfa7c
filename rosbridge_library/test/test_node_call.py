# SPDX-License-Identifier: BSD-3-Clause
"""Blocking calls on the thread pool: deadlines, errors, cancellation."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any

import pytest

from rosbridge_library.ros.node import RosTimeout, call_blocking


class AtOnce(Executor):
    """Has every call done when `submit` returns: so a test knows when the loop hears of it."""

    def submit(self, function: Any, *args: Any, **_: Any) -> Future:  # type: ignore[override,type-arg]
        future: Future = Future()  # type: ignore[type-arg]
        future.set_result(function(*args))
        return future


def test_it_returns_and_raises_what_the_function_does() -> None:
    async def run() -> None:
        with ThreadPoolExecutor(1) as threads:
            assert await call_blocking(threads, divmod, (7, 2), 5.0) == (3, 1)
            assert await call_blocking(threads, divmod, (7, 2), None) == (3, 1)
            with pytest.raises(ZeroDivisionError):
                await call_blocking(threads, divmod, (7, 0), 5.0)

    asyncio.run(run())


def test_it_waits_no_longer_than_it_may() -> None:
    release = threading.Event()

    async def run() -> None:
        with ThreadPoolExecutor(1) as threads:
            with pytest.raises(RosTimeout, match=r"no answer to wait within 0\.05 s"):
                await call_blocking(threads, release.wait, (10,), 0.05)
            release.set()

    asyncio.run(run())


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_no_cancellation_is_lost_whenever_it_comes(turns: int) -> None:
    """asyncio.wait_for loses one that comes when the call has just ended, before Python 3.12."""

    async def run() -> bool:
        task = asyncio.ensure_future(call_blocking(AtOnce(), divmod, (7, 2), 5.0))
        for _ in range(turns):
            await asyncio.sleep(0)
        cancelled = task.cancel()
        await asyncio.wait({task})
        return task.cancelled() or not cancelled

    assert asyncio.run(run())
