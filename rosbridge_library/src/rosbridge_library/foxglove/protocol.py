# SPDX-License-Identifier: BSD-3-Clause
"""One client that speaks the Foxglove protocol.

It handles operations as any `rosbridge_library.protocol.Protocol` does: in the order they came, each by the capability
that registered it, and what goes wrong is told. What is told is a status: an error or a warning that is an answer to
something the client did comes without an id; one that says how things are has an id, and is taken back when they
change.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Dict, Iterable, Mapping, Optional, Sequence, Union

from rosbridge_library.capability import OperationId
from rosbridge_library.foxglove import messages
from rosbridge_library.payload import Outbox
from rosbridge_library.protocol import Protocol

if TYPE_CHECKING:
    from rosbridge_library.foxglove.server import FoxgloveServer

_LEVELS = {"warning": messages.WARNING, "error": messages.ERROR}


class FoxgloveProtocol(Protocol):
    """A client of `server`; made by it."""

    outliving: ClassVar[Sequence[str]] = ("advertise", "unadvertise", messages.MESSAGE_DATA)

    def __init__(
        self,
        client_id: Union[str, int],
        parameters: Optional[Mapping[str, Any]] = None,
        *,
        server: FoxgloveServer,
        outbox: Optional[Outbox] = None,
    ) -> None:
        super().__init__(client_id, parameters, node=server.node, outbox=outbox)
        self.server = server
        self.operations.clear()  # those of rosbridge
        self._shown: Dict[str, str] = {}
        self.send(server.info())
        for capability_class in server.capability_classes:
            self.add_capability(capability_class)

    def _decode(self, message: Union[str, bytes]) -> Any:
        return messages.decode(message.encode("utf-8", "surrogatepass") if isinstance(message, str) else message)

    def _report(self, error: Exception, operation: Any) -> None:
        if isinstance(error, messages.IncompleteCall):
            self.send(messages.service_call_failure(error.service_id, error.call_id, str(error)))
        else:
            super()._report(error, operation)

    # This protocol knows one encoding, and no fragments.

    def encoding(self, compression: str) -> str:
        return "none"

    def fragment_size(self, asked: Optional[int]) -> Optional[int]:
        return None

    # Statuses

    def send_status(self, level: str, message: str, lid: OperationId) -> None:
        if level in _LEVELS:
            self.send(messages.status(_LEVELS[level], message))

    def dropped(self, messages: Mapping[str, int]) -> None:
        """Nothing: channels tell of each topic by a status that is withdrawn when no more are dropped."""

    def show(self, status_id: str, message: str) -> None:
        """Show a warning until it is withdrawn, in place of the one with this id."""
        if self._shown.get(status_id) != message:
            self._shown[status_id] = message
            self.send(messages.status(messages.WARNING, message, status_id))

    def withdraw(self, status_ids: Iterable[str]) -> None:
        """Take back those of these statuses that are shown."""
        shown = [status_id for status_id in status_ids if self._shown.pop(status_id, None) is not None]
        if shown:
            self.send(messages.remove_status(shown))

    def finish(self) -> None:
        if not self.finished:
            self.server.left(self)
        super().finish()
