# SPDX-License-Identifier: BSD-3-Clause
"""advertise_service (specification 3.4.7): a client offers to answer calls of a ROS service."""

from __future__ import annotations

from typing import TYPE_CHECKING, Awaitable, Optional

from rosbridge_library.capabilities.provision import provisions
from rosbridge_library.capability import Capability, Operation, on_loop

if TYPE_CHECKING:
    from rosbridge_library.protocol import Protocol


class AdvertiseService(Capability):
    """Advertises a client's services."""

    advertise_service_msg_fields = ((True, "service", str), (True, "type", str))

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        protocol.register_operation("advertise_service", self.advertise_service)

    @on_loop
    def advertise_service(self, message: Operation) -> Optional[Awaitable[None]]:
        """Advertise a service; calls of it come to the client as call_service operations."""
        self.basic_type_check(message, self.advertise_service_msg_fields)
        return self._advertise(message)

    async def _advertise(self, message: Operation) -> None:
        service, lid = message["service"], message.get("id")
        provider = await provisions(self.protocol).advertise(service, message["type"], lid)
        if provider.warning:
            self.protocol.log("warning", f"advertise_service: {provider.warning}", lid)
        self.protocol.log("info", f"advertise_service: {service} is provided as {provider.type.name}", lid)

    def finish(self) -> None:
        provisions(self.protocol).close()
