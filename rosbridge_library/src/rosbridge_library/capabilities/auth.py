# SPDX-License-Identifier: BSD-3-Clause
"""auth (specification 3.3): accepted, and without effect while authentication is off."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rosbridge_library.capability import Capability, Operation

if TYPE_CHECKING:
    from rosbridge_library.protocol import Protocol


class Auth(Capability):
    """Takes a client's credentials when nobody asks for them."""

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        protocol.register_operation("auth", self.auth)

    def auth(self, message: Operation) -> None:
        """Accept any credentials."""
        self.basic_type_check(message, ())
        self.protocol.log("info", "auth: authentication is off; everybody may connect", message.get("id"))
