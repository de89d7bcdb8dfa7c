# SPDX-License-Identifier: BSD-3-Clause
"""What type is a service of? The master does not know: each provider has to be asked, by a probe.

A probe is a connection header with probe=1; the provider answers with its own header and ends the
connection. Asking hundreds of services at once needs two precautions. A node that hangs must not use
up the connections, so a node is asked about one service first, and about the others when it answered.
And rospy nodes accept connections one by one from a queue of five, beyond which the kernel drops a
connection for a second, so no node is sent more than a few probes at a time.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Deque, Dict, List, Mapping, Union

from rosbridge_library.ros.service_connection import (
    ServiceRefused,
    ServiceUnreachable,
    open_connection,
)
from rosbridge_library.ros.tcpros_header import HeaderError

__all__ = ["ProbeResult", "ServiceRefused", "ServiceUnreachable", "probe_service", "probe_services"]

PROBES_PER_NODE = 4

ProbeResult = Union[Dict[str, str], ServiceUnreachable]


async def probe_service(uri: str, service: str, caller_id: str, timeout: float) -> Dict[str, str]:
    """Return the connection header (type, md5sum, callerid …) of the provider of `service` at `uri`.

    `timeout` is in seconds. Raises ServiceUnreachable, or its ServiceRefused when the node answers that it
    does not provide that service.
    """
    try:
        return await asyncio.wait_for(_probe(uri, service, caller_id), timeout)
    except asyncio.TimeoutError:
        raise ServiceUnreachable(service, uri, f"no answer within {timeout:g} s") from None


async def probe_services(
    services: Mapping[str, str], caller_id: str, timeout: float, concurrency: int = 128
) -> Dict[str, ProbeResult]:
    """Probe many services, given as name → uri, all within `timeout` seconds.

    Returns for each the header, or why there is none. At most `concurrency` connections are open at a time,
    one for each node that hangs.
    """
    nodes: Dict[str, List[str]] = {}
    for service, uri in services.items():
        nodes.setdefault(uri, []).append(service)
    results: Dict[str, ProbeResult] = {}
    slots = asyncio.Semaphore(concurrency)
    tasks = [asyncio.ensure_future(_probe_node(uri, names, caller_id, slots, results)) for uri, names in nodes.items()]
    try:
        if tasks:
            done, _ = await asyncio.wait(tasks, timeout=timeout)
            for task in done:
                task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    for service, uri in services.items():
        if service not in results:
            results[service] = ServiceUnreachable(service, uri, f"no answer within {timeout:g} s")
    return results


async def _probe(uri: str, service: str, caller_id: str) -> Dict[str, str]:
    fields = {"probe": "1", "md5sum": "*", "callerid": caller_id}
    try:
        connection, header = await open_connection(service, uri, fields)
    except HeaderError as error:
        raise ServiceUnreachable(service, uri, str(error)) from error
    connection.close()
    return header


async def _probe_node(
    uri: str, services: List[str], caller_id: str, slots: asyncio.Semaphore, results: Dict[str, ProbeResult]
) -> None:
    waiting: Deque[str] = deque(services)

    async def probe_next() -> ProbeResult:
        service = waiting.popleft()
        async with slots:
            try:
                results[service] = await _probe(uri, service, caller_id)
            except ServiceUnreachable as error:
                results[service] = error
        return results[service]

    async def probe_rest() -> None:
        while waiting:
            await probe_next()

    first = await probe_next()
    if isinstance(first, ServiceUnreachable) and not isinstance(first, ServiceRefused):
        for service in waiting:
            results[service] = ServiceUnreachable(service, uri, first.reason)
    else:
        await asyncio.gather(*(probe_rest() for _ in range(min(PROBES_PER_NODE, len(waiting)))))
