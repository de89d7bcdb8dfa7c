# SPDX-License-Identifier: BSD-3-Clause
"""unadvertise_service (specification 3.4.8)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rosbridge_library.capabilities.provision import provisions
from rosbridge_library.capability import Capability, Operation, on_loop

if TYPE_CHECKING:
    from rosbridge_library.protocol import Protocol


class UnadvertiseService(Capability):
    """Takes a client's services back."""

    unadvertise_service_msg_fields = ((True, "service", str),)

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        protocol.register_operation("unadvertise_service", self.unadvertise_service)

    @on_loop
    def unadvertise_service(self, message: Operation) -> None:
        """Stop providing a service; calls that wait for the client fail at once."""
        self.basic_type_check(message, self.unadvertise_service_msg_fields)
        service, lid = message["service"], message.get("id")
        if provisions(self.protocol).unadvertise(service):
            self.protocol.log("info", f"unadvertise_service: {service} is no longer provided", lid)
        else:
            self.protocol.log("warning", f"unadvertise_service: {service} is not provided by this client", lid)
