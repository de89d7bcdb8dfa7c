# SPDX-License-Identifier: BSD-3-Clause
"""Work that follows a value: it runs once at a time, with the newest value, and skips those it was too slow for."""

from __future__ import annotations

import asyncio
import logging
from typing import Awaitable, Callable, Generic, Optional, TypeVar

from rosbridge_library.internal.exceptions import RosbridgeError

logger = logging.getLogger("rosbridge.foxglove")

T = TypeVar("T")


class Latest(Generic[T]):
    """Runs `work(value)` for the newest value that `take` was given."""

    def __init__(self, work: Callable[[T], Awaitable[None]]) -> None:
        self._work = work
        self._next: Optional[T] = None
        self._task: Optional[asyncio.Task[None]] = None

    def take(self, value: T) -> None:
        """Work with `value` when what is under way is done."""
        self._next = value
        if self._task is None:
            self._task = asyncio.get_running_loop().create_task(self._run())

    def cancel(self) -> None:
        """End what is under way."""
        self._next = None
        if self._task is not None:
            self._task.cancel()
            self._task = None

    async def _run(self) -> None:
        while self._next is not None:
            value, self._next = self._next, None
            try:
                await self._work(value)
            except RosbridgeError as error:
                logger.warning("%s; it is tried again", error)
            except Exception:  # a bug; what comes later must be worked on all the same
                logger.exception("following the ROS graph failed")
        self._task = None
