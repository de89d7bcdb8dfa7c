# SPDX-License-Identifier: BSD-3-Clause
"""What the Foxglove clients of one process have in common.

The channels, the services and the connection graph follow the ROS graph, which is watched while there are clients.
Each client is a `FoxgloveProtocol` with a capability per concern; those that the option `capabilities` leaves out are
not offered, and their operations not known.
"""

from __future__ import annotations

import logging
import os
import uuid
from typing import Any, Callable, Dict, List, Mapping, Optional, Set, Union

from rosbridge_library.capability import Capability
from rosbridge_library.foxglove import messages
from rosbridge_library.foxglove.assets import Assets, FetchAsset
from rosbridge_library.foxglove.channels import Channels
from rosbridge_library.foxglove.clock import Clock
from rosbridge_library.foxglove.connection_graph import ConnectionGraph, ConnectionGraphUpdates
from rosbridge_library.foxglove.options import CAPABILITIES, Options
from rosbridge_library.foxglove.parameters import ParameterAccess, ParameterServer, ParameterUpdates
from rosbridge_library.foxglove.protocol import FoxgloveProtocol
from rosbridge_library.foxglove.publishing import Publishing
from rosbridge_library.foxglove.services import ServiceCalls, Services
from rosbridge_library.foxglove.topics import Topics
from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.payload import Outbox
from rosbridge_library.ros.graph import Graph
from rosbridge_library.ros.master import MasterError
from rosbridge_library.ros.node import Node

logger = logging.getLogger("rosbridge.foxglove")

NAME = "rosbridge_suite"
DEFAULT_DISTRIBUTION = "noetic"

CapabilityClass = Callable[[Any], Capability]

OFFERED: Mapping[str, CapabilityClass] = dict(
    zip(CAPABILITIES, (Publishing, ParameterAccess, ParameterUpdates, ServiceCalls, ConnectionGraphUpdates, FetchAsset))
)


class FoxgloveServer:
    """Makes protocols, and holds what they share. Belongs to the node's loop; `start` it before the first client."""

    def __init__(self, node: Node, options: Optional[Options] = None) -> None:
        self.node = node
        self.options = options or Options()
        self.topics = Topics(node, self.options)
        self.services = Services(node, self.options)
        self.connection_graph = ConnectionGraph(self.topics.may_see, self.services.may_see)
        self.parameters = ParameterServer(node, self.options)
        self.assets = Assets(self.options)
        self.ticks: List[Callable[[], None]] = []
        """What is called whenever the graph was looked at."""
        offered = [name for name in CAPABILITIES if name in self.options.capabilities]
        self._capabilities = [*offered, "time"] if node.is_simulated() else offered
        self.capability_classes: List[CapabilityClass] = [Channels, *(OFFERED[name] for name in offered)]
        if node.is_simulated():
            self.capability_classes.append(Clock)
        self._metadata: Dict[str, str] = {}
        self._session_id: Optional[str] = None
        self._generation = 0
        self._clients: Set[FoxgloveProtocol] = set()
        node.graph_watch.interval_s = self.options.max_update_ms / 1000

    async def start(self) -> None:
        """Ask the master what clients are told first."""
        self._generation = self.node.master_generation
        distribution = os.environ.get("ROS_DISTRO") or await self._param("/rosdistro") or DEFAULT_DISTRIBUTION
        self._metadata = {"ROS_DISTRO": str(distribution).strip()}
        # roslaunch gives every start of a ROS system an id; a master that was started by itself has none.
        self._session_id = str(await self._param("/run_id") or uuid.uuid4())

    async def _param(self, name: str) -> Any:
        try:
            return await self.node.call(self.node.master.call, "getParam", name)
        except MasterError:
            return None

    def info(self) -> Dict[str, Any]:
        """The message that a client gets first."""
        return messages.server_info(NAME, self._capabilities, self._metadata, self._session_id)

    def protocol(
        self, client_id: Union[str, int], parameters: Mapping[str, Any], outbox: Optional[Outbox] = None
    ) -> FoxgloveProtocol:
        """A new client."""
        client = FoxgloveProtocol(client_id, parameters, server=self, outbox=outbox)
        self._clients.add(client)
        if len(self._clients) == 1:
            self.node.graph_watch.add(self._follow)
        return client

    def left(self, client: FoxgloveProtocol) -> None:
        """A client is gone. Without any, nothing is watched."""
        if client not in self._clients:
            return
        self._clients.remove(client)
        if not self._clients:
            self.node.graph_watch.remove(self._follow)
            for follower in (self.topics, self.services, self.connection_graph):
                follower.forget()

    def _follow(self, graph: Optional[Graph]) -> None:
        for follower in (self.topics, self.services, self.connection_graph):
            follower.follow(graph)
        for tick in list(self.ticks):
            tick()
        if graph is not None and (self._generation != self.node.master_generation or self.node.param_watch.unsettled):
            self.node.loop.create_task(self._renew())

    async def _renew(self) -> None:
        """The master was started anew, or could not be told something."""
        try:
            if self._generation != self.node.master_generation:
                await self.start()
            await self.node.param_watch.settle()
        except RosbridgeError as error:
            logger.debug("%s; it is tried again", error)
