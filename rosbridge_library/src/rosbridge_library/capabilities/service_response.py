# SPDX-License-Identifier: BSD-3-Clause
"""service_response from a client (specification 3.4.9): its answer to a call of its service."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rosbridge_library.capabilities.provision import provisions
from rosbridge_library.capability import Capability, Operation, on_loop

if TYPE_CHECKING:
    from rosbridge_library.protocol import Protocol


class ServiceResponse(Capability):
    """Takes a client's answers."""

    service_response_msg_fields = (
        (False, "service", str),
        (True, "id", (str, int)),
    )  # values and result are looked at where the caller that waits is told what is wrong with them

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        protocol.register_operation("service_response", self.service_response)

    @on_loop
    def service_response(self, message: Operation) -> None:
        """Give an answer to the ROS caller that waits for it."""
        self.basic_type_check(message, self.service_response_msg_fields)
        provisions(self.protocol).answer(message)
