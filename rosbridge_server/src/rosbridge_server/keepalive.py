# SPDX-License-Identifier: BSD-3-Clause
"""Finds out that a client is gone when its connection does not say so (a cable pulled, a laptop asleep).

A ping goes out every interval. When nothing at all has been received for the timeout after a ping, the client
is given up. Any received byte counts, not only pongs: a client that uploads a large message over a slow link
can't send a pong until that message is through. Tornado's own pings count pongs alone, and cut the timeout
down to the interval. The timeout begins when the ping has gone out: behind a large message on a slow link that takes
its time, and whether such a client takes anything is for the outbox to watch.
"""

from __future__ import annotations

import asyncio
from typing import Callable, Optional


class KeepAlive:
    """Calls ``ping(sent)`` every ``interval`` seconds, and ``lost()`` once after ``timeout`` seconds of silence
    after one; ``sent()`` is to be called when that ping has gone out, and there is no other ping before.

    0 switches the pings, or the timeout, off. `heard` is to be called for everything that is received, and
    `pause` when nothing is read for a while: what is not listened to can't be silent.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        interval: float,
        timeout: float,
        ping: Callable[[Callable[[], None]], None],
        lost: Callable[[], None],
    ) -> None:
        self._loop = loop
        self._interval = interval
        self._timeout = timeout
        self._ping = ping
        self._lost = lost
        self._paused = False
        self._pinging = False  # a ping waits to be sent
        self._deadline: Optional[asyncio.TimerHandle] = None
        self._next: Optional[asyncio.TimerHandle] = None
        if interval > 0:
            self._next = loop.call_later(interval, self._tick)

    def heard(self) -> None:
        """Something was received: the client lives."""
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def pause(self) -> None:
        """Nothing is read from now on."""
        self.heard()
        self._paused = True

    def resume(self) -> None:
        """What comes is read again."""
        self._paused = False

    def stop(self) -> None:
        """No more pings, and `lost` is not called any more."""
        self.heard()
        if self._next is not None:
            self._next.cancel()
            self._next = None

    def _tick(self) -> None:
        self._next = self._loop.call_later(self._interval, self._tick)
        if not self._pinging:
            self._pinging = True
            self._ping(self._sent)

    def _sent(self) -> None:
        self._pinging = False
        stopped = self._next is None
        if self._timeout > 0 and self._deadline is None and not self._paused and not stopped:
            self._deadline = self._loop.call_later(self._timeout, self._give_up)

    def _give_up(self) -> None:
        self.stop()
        self._lost()
