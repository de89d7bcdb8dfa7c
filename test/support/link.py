# SPDX-License-Identifier: BSD-3-Clause
"""A network between clients and a server that is as bad as a test wants it: slow, or cut without a word.

It is a proxy with small buffers of its own, so that what the server sends waits at the server, as it does before a
slow radio. Cut, it takes nothing and closes nothing: what a client sees that walks out of reach, or its server.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time
from typing import Optional, Set

_CHUNK_BYTES = 8192
_BUFFER_BYTES = 16384


class Link:
    """Forwards connections made to `port` to a port of this machine; runs in a thread until `close`."""

    def __init__(self, target_port: int, rate: Optional[float] = None) -> None:
        """`rate`: bytes a second from the server to each client; None: as fast as they come; 0: cut."""
        self._rate = rate
        self._target_port = target_port
        self._listener = socket.socket()
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        self._listener.bind(("127.0.0.1", 0))
        self._listener.listen(64)
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._tasks: Set[asyncio.Future[None]] = set()
        self._forwarding = asyncio.Event()
        self._set_forwarding()
        self._serving = self._loop.create_task(self._serve())
        self._thread = threading.Thread(target=self._run, name="link", daemon=True)
        self._thread.start()

    def __enter__(self) -> Link:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def rate(self) -> Optional[float]:
        """May be set at any time."""
        return self._rate

    @rate.setter
    def rate(self, rate: Optional[float]) -> None:
        self._rate = rate
        self._loop.call_soon_threadsafe(self._set_forwarding)

    def _set_forwarding(self) -> None:
        if self._rate == 0:
            self._forwarding.clear()
        else:
            self._forwarding.set()

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    def close(self) -> None:
        """Closes every connection, abruptly."""
        self._loop.call_soon_threadsafe(self._serving.cancel)
        self._thread.join(5.0)
        assert not self._thread.is_alive()

    def _run(self) -> None:
        with contextlib.suppress(asyncio.CancelledError):
            self._loop.run_until_complete(self._serving)
        self._loop.close()

    async def _serve(self) -> None:
        try:
            while True:
                client, _ = await self._loop.sock_accept(self._listener)
                task = self._loop.create_task(self._forward_both(client))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
        finally:
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            self._listener.close()

    async def _forward_both(self, client: socket.socket) -> None:
        with client, socket.socket() as server:
            server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            server.setblocking(False)
            await self._loop.sock_connect(server, ("127.0.0.1", self._target_port))
            ways = {
                self._loop.create_task(self._forward(server, client, paced=True)),
                self._loop.create_task(self._forward(client, server, paced=False)),
            }
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)

    async def _forward(self, source: socket.socket, target: socket.socket, paced: bool) -> None:
        """Returns when either end has gone."""
        due = time.monotonic()
        with contextlib.suppress(ConnectionError):
            while True:
                await self._forwarding.wait()
                data = await self._loop.sock_recv(source, _CHUNK_BYTES)
                if not data:
                    return
                await self._forwarding.wait()
                await self._loop.sock_sendall(target, data)
                rate = self.rate
                if paced and rate:
                    due = max(due, time.monotonic() - 0.02) + len(data) / rate  # makes up for what a timer is late
                    await asyncio.sleep(max(0.0, due - time.monotonic()))
