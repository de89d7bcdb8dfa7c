# SPDX-License-Identifier: BSD-3-Clause
"""Who is connected, told to ROS: the latched topics ``client_count`` and ``connected_clients``.

Under a connect storm many changes are told as one: a change is published at once when the last publication is
a while ago, and else when that while is over, so that the last state always gets out and the topics cost
little. Publishing serializes and takes rospy's locks, so it runs on a thread of its own; never two at a time,
hence in order.
"""

from __future__ import annotations

import asyncio
import logging
from concurrent.futures import ThreadPoolExecutor
from typing import Callable, Dict, Optional, Tuple

import rospy
from genpy import Time
from rosbridge_msgs.msg import ConnectedClient, ConnectedClients
from std_msgs.msg import Int32

logger = logging.getLogger("rosbridge.clients")

_INTERVAL_S = 0.1


class Clients:
    """The connected clients, by id. `add` and `remove` are called on the loop; ``now()`` is ROS time, (secs,
    nsecs).

    Made after rospy.init_node, and registers its two publishers with the master: blocking, so not on the
    loop.
    """

    def __init__(self, now: Callable[[], Tuple[int, int]]) -> None:
        self._now = now
        self._clients: Dict[str, ConnectedClient] = {}
        self._count = rospy.Publisher("client_count", Int32, queue_size=1, latch=True)
        self._connected = rospy.Publisher("connected_clients", ConnectedClients, queue_size=1, latch=True)
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="rosbridge-clients")
        self._changed = False
        self._publishing: Optional[asyncio.Task[None]] = None
        self._publish(0, ConnectedClients())

    def __len__(self) -> int:
        return len(self._clients)

    def add(self, client_id: str, ip_address: str) -> None:
        """A client has connected."""
        self._clients[client_id] = ConnectedClient(ip_address=ip_address, connection_time=Time(*self._now()))
        self._change()

    def remove(self, client_id: str) -> None:
        """A client is gone."""
        del self._clients[client_id]
        self._change()

    def close(self) -> None:
        """Publishes no more."""
        if self._publishing is not None:
            self._publishing.cancel()
        self._thread.shutdown(wait=False)

    def _change(self) -> None:
        self._changed = True
        if self._publishing is None:
            self._publishing = asyncio.get_event_loop().create_task(self._publish_changes())

    async def _publish_changes(self) -> None:
        loop = asyncio.get_event_loop()
        try:
            while self._changed:
                self._changed = False
                clients = ConnectedClients(clients=list(self._clients.values()))
                await loop.run_in_executor(self._thread, self._publish, len(self._clients), clients)
                await asyncio.sleep(_INTERVAL_S)
        finally:
            self._publishing = None

    def _publish(self, count: int, clients: ConnectedClients) -> None:
        try:
            self._count.publish(Int32(data=count))
            self._connected.publish(clients)
        except (rospy.ROSException, rospy.ROSSerializationException) as error:
            logger.error("Could not publish the connected clients: %s", error)
