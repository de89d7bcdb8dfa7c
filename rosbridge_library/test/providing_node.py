# SPDX-License-Identifier: BSD-3-Clause
"""A ROS node whose services are provided as web clients provide them; for test_services_providers.

It does what it is told by lines of JSON on a Unix socket, named by its first argument, and writes each request
that reaches a provider as a line of JSON on its output.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Callable, Dict, Optional

import rospy

from rosbridge_library.codec import MessageType, get_service_type
from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.ros.master import Master
from rosbridge_library.ros.node import call_blocking
from rosbridge_library.ros.providers import Provider, ServiceProviders

Command = Dict[str, Any]


def say(**record: Any) -> None:
    print(json.dumps(record), flush=True)


class ProvidingNode:
    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(8)
        self._providers = ServiceProviders(self._call_blocking, Master(rospy.get_name()), rospy.get_name())
        self._clients: Dict[str, Provider] = {}
        self._advertising: Dict[str, asyncio.Task[Provider]] = {}
        self._cancelled = 0

    async def _call_blocking(self, function: Callable[..., Any], *args: Any, timeout: Optional[float] = 5.0) -> Any:
        return await call_blocking(self._threads, function, args, timeout)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        command = json.loads(await reader.readline())
        try:
            answer = await getattr(self, command.pop("do"))(**command)
        except (RosbridgeError, asyncio.CancelledError) as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        writer.write(json.dumps(answer).encode() + b"\n")
        await writer.drain()
        writer.close()

    async def advertise(
        self, client: str, service: str, kind: str, timeout: Optional[float] = None, **behaviour: Any
    ) -> Command:
        """`behaviour`: a response in `values`, after `delay` seconds; or `error`, `bug`, `hang`."""

        async def handle(request_type: MessageType, wire: bytes) -> bytes:
            say(client=client, request=request_type.to_values(wire) if len(wire) < 1000 else len(wire))
            try:
                if "error" in behaviour:
                    raise RosbridgeError(behaviour["error"])
                if "bug" in behaviour:
                    raise KeyError(behaviour["bug"])
                await asyncio.sleep(1e6 if "hang" in behaviour else behaviour.get("delay", 0))
            except asyncio.CancelledError:
                self._cancelled += 1
                raise
            return get_service_type(kind).response.from_values(behaviour["values"], lambda: (0, 0))[0]

        task = asyncio.ensure_future(self._providers.advertise(service, kind, handle, timeout))
        self._advertising[client] = task
        self._clients[client] = await task
        return {"warning": self._clients[client].warning}

    async def cancel(self, client: str) -> Command:
        """Cancel an advertise if it is under way."""
        return {"cancelled": client in self._advertising and self._advertising[client].cancel()}

    async def unadvertise(self, client: str) -> Command:
        begin = time.monotonic()
        unregistered = self._clients[client].unadvertise(f"{client} is gone")
        blocked = time.monotonic() - begin
        await unregistered
        return {"blocked": blocked}

    async def state(self) -> Command:
        return {
            "active": sorted(client for client, provider in self._clients.items() if provider.active),
            "cancelled": self._cancelled,
            "threads": threading.active_count(),
            "tasks": len(asyncio.all_tasks()),
            "files": len(os.listdir("/proc/self/fd")),
            "cpu_s": time.process_time(),
        }

    async def close(self) -> Command:
        begin = time.monotonic()
        await self._providers.close()
        return {"took": time.monotonic() - begin}


async def main() -> None:
    node = ProvidingNode()
    async with await asyncio.start_unix_server(node.serve, sys.argv[1]):
        say(ready=True)
        await asyncio.Event().wait()


if __name__ == "__main__":
    rospy.init_node("providing", disable_signals=True)
    asyncio.run(main())
