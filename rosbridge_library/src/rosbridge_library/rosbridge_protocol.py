# SPDX-License-Identifier: BSD-3-Clause
"""rosbridge v2: the protocol with all its operations."""

from __future__ import annotations

from typing import Any, ClassVar, List, Mapping, Optional, Union

from rosbridge_library.capabilities.advertise import Advertise
from rosbridge_library.capabilities.advertise_service import AdvertiseService
from rosbridge_library.capabilities.auth import Auth
from rosbridge_library.capabilities.call_service import CallService
from rosbridge_library.capabilities.defragmentation import Defragment
from rosbridge_library.capabilities.fragmentation import Fragmentation
from rosbridge_library.capabilities.publish import Publish
from rosbridge_library.capabilities.service_response import ServiceResponse
from rosbridge_library.capabilities.subscribe import Subscribe
from rosbridge_library.capabilities.unadvertise_service import UnadvertiseService
from rosbridge_library.payload import Outbox
from rosbridge_library.protocol import CapabilityClass, Protocol
from rosbridge_library.ros.node import Node


class RosbridgeProtocol(Protocol):
    """A client that speaks rosbridge v2. Programs add operations by extending `rosbridge_capabilities`."""

    rosbridge_capabilities: ClassVar[List[CapabilityClass]] = [
        CallService,
        Advertise,
        Publish,
        Subscribe,
        Defragment,
        Fragmentation,
        AdvertiseService,
        ServiceResponse,
        UnadvertiseService,
        Auth,
    ]

    def __init__(
        self,
        client_id: Union[str, int],
        parameters: Optional[Mapping[str, Any]] = None,
        *,
        node: Optional[Node] = None,
        outbox: Optional[Outbox] = None,
    ) -> None:
        super().__init__(client_id, parameters, node=node, outbox=outbox)
        for capability_class in self.rosbridge_capabilities:
            self.add_capability(capability_class)
