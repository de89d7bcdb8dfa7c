# SPDX-License-Identifier: BSD-3-Clause
"""One client's conversation: operations in, payloads out.

A `Protocol` decodes what the client sends, hands each operation to the capability that registered it, and maps what
goes wrong to what the client is told, all in `_report`. Operations are handled in the order they came: while a handler
waits, later ones queue up, and `incoming` returns something to wait for, so that the connection can stop reading.

Payloads go to the client's outbox. A protocol made without one gives each payload to `outgoing`, which programs that
embed the library override.
"""

from __future__ import annotations

import asyncio
import functools
import logging
from collections import deque
from typing import (
    TYPE_CHECKING,
    Any,
    Awaitable,
    Callable,
    ClassVar,
    Deque,
    Dict,
    List,
    Mapping,
    Optional,
    Sequence,
    Set,
    Type,
    Union,
)

from rosbridge_library.capability import Capability, Operation, OperationId, checked_id
from rosbridge_library.codec import decode_cbor, decode_json
from rosbridge_library.encodings import BSON_IF_BINARY, encode_operation, in_fragments
from rosbridge_library.internal.exceptions import (
    DecodeError,
    InvalidArgumentException,
    MissingArgumentException,
    RosbridgeError,
)
from rosbridge_library.parameters import Parameters
from rosbridge_library.payload import Outbox, Payload, Source

if TYPE_CHECKING:
    from rosbridge_library.ros.node import Node

__all__ = ["InvalidArgumentException", "MissingArgumentException", "Protocol"]

logger = logging.getLogger("rosbridge.protocol")

STATUS_LEVELS = {"none": 0, "error": 1, "warning": 2, "info": 3}
_LOGGING_LEVELS = {"error": logging.WARNING, "warning": logging.DEBUG, "info": logging.DEBUG}

MAX_WAITING_OPERATIONS = 64
"""How many operations may wait behind one that isn't finished before the connection should stop reading."""

MAX_STATUS_LENGTH = 1000
"""In characters."""

FINISH_TIMEOUT_S = 2.0
"""How long what a client sent before it left may take to be published."""

Handler = Callable[[Operation], Optional[Awaitable[None]]]


class Protocol:
    """One client. `client_id` is for logs; `parameters` are those of `rosbridge_library.parameters`.

    `node` is the shared ROS side; a protocol made without one uses that of `ros.node.background_node`, whose loop runs
    in a thread, and its methods may then be called from any thread.
    """

    # What a client that is gone wanted all the same: a script publishes, and closes its connection.
    outliving: ClassVar[Sequence[str]] = ("advertise", "publish", "unadvertise", "fragment", "png")

    def __init__(
        self,
        client_id: Union[str, int],
        parameters: Optional[Mapping[str, Any]] = None,
        *,
        node: Optional[Node] = None,
        outbox: Optional[Outbox] = None,
    ) -> None:
        self.client_id = client_id
        self.parameters = Parameters.from_mapping(parameters or {})
        self.outbox: Outbox = outbox if outbox is not None else _CallOutgoing(self)
        self.status_level = "error"
        self.operations: Dict[str, Handler] = {
            "set_level": self._set_level,
            "set_status_level": self._set_level,
            "status": self._status,
        }
        self.capabilities: List[Capability] = []
        self.shared: Dict[str, object] = {}  # what capabilities of this client have in common, by name
        self.finished = False
        """The client is gone: nothing more comes from it or goes to it."""
        self.ended = False
        """And what it began is taken back: nothing may begin any more."""
        self._node = node
        self._waiting: Deque[Union[str, bytes]] = deque()
        self._working: Optional[asyncio.Future[None]] = None  # what later operations wait for
        self._working_on = ""  # its opcode
        self._tasks: Set[asyncio.Future[None]] = set()
        self._ending: Optional[asyncio.TimerHandle] = None

    @property
    def node(self) -> Node:
        """The shared ROS side."""
        if self._node is None:
            from rosbridge_library.ros.node import background_node

            self._node = background_node()
        return self._node

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        """The loop that owns this protocol."""
        return self.node.loop

    # Extending

    def register_operation(self, opcode: str, handler: Handler) -> None:
        """Have `handler` take the operations named `opcode`. It runs on the loop and must not block."""
        self.operations[opcode] = handler

    def unregister_operation(self, opcode: str) -> None:
        """Refuse the operations named `opcode` from now on."""
        self.operations.pop(opcode, None)

    def add_capability(self, capability_class: Callable[[Any], Capability]) -> None:
        """Make a capability for this client."""
        self.capabilities.append(capability_class(self))

    # In

    def incoming(self, message: Union[str, bytes]) -> Optional[Awaitable[None]]:
        """Take one message: JSON text (str, or its bytes, maybe not valid UTF-8), CBOR or, in BSON mode, BSON.

        Never raises for what a client may send. Returns None, or what to wait for before giving it more.
        """
        if asyncio._get_running_loop() is not self.loop:
            asyncio.run_coroutine_threadsafe(self._incoming_finished(message), self.loop).result()
            return None
        if self.finished:
            return None
        if self._working is not None:
            self._waiting.append(message)
            return _ended(self._working) if len(self._waiting) >= MAX_WAITING_OPERATIONS else None
        self._working = self._take(message)
        return None

    async def _incoming_finished(self, message: Union[str, bytes]) -> None:
        self.incoming(message)
        while self._working is not None:
            await _ended(self._working)

    def _take(self, message: Union[str, bytes]) -> Optional[asyncio.Future[None]]:
        try:
            operation = self._decode(message)
        except DecodeError as error:
            self._report(error, {})
            return None
        return self.handle(operation)

    def _decode(self, message: Union[str, bytes]) -> Any:
        if isinstance(message, (bytes, bytearray, memoryview)):
            if self.parameters.bson_only_mode:
                return _decode_bson(bytes(message))
            # A CBOR map begins with 0xa0 to 0xbf (RFC 8949, appendix B), which no UTF-8 text does.
            if message and 0xA0 <= message[0] <= 0xBF:
                return decode_cbor(bytes(message))
        return decode_json(message)

    def handle(self, operation: Any) -> Optional[asyncio.Future[None]]:
        """Begin one decoded operation. Returns what to wait for when it isn't finished yet. Never raises."""
        try:
            handler = self._handler(operation)
            if self.finished and operation["op"] not in self.outliving:
                return None
            pending = handler(operation)
        except Exception as error:  # noqa: BLE001  # reported, whatever it is
            self._report(error, operation)
            return None
        if pending is None:
            return None
        self._working_on = operation["op"]
        return self.spawn(pending, operation)

    def _handler(self, operation: Any) -> Handler:
        if not isinstance(operation, dict):
            raise InvalidArgumentException(f"a message must be an object, not {type(operation).__name__}")
        opcode = operation.get("op")
        if opcode is None:
            if "receiver" in operation:
                raise InvalidArgumentException("this is a message of rosbridge v1; this connection speaks v2 ('op')")
            raise MissingArgumentException("the field 'op' is missing")
        if not isinstance(opcode, str):
            raise InvalidArgumentException(f"the field 'op' must be str, not {type(opcode).__name__}")
        handler = self.operations.get(opcode)
        if handler is None:
            known = ", ".join(sorted(self.operations))
            raise InvalidArgumentException(f"unknown operation '{opcode[:100]}'; there are {known}")
        return handler

    def spawn(self, work: Awaitable[None], operation: Operation) -> asyncio.Future[None]:
        """Go on with `operation`; what goes wrong is reported, and the work is cancelled when the client goes."""
        task = asyncio.ensure_future(work, loop=self.loop)
        if task not in self._tasks:
            self._tasks.add(task)
            task.add_done_callback(functools.partial(self._worked, operation))
        return task

    def _worked(self, operation: Operation, task: asyncio.Future[None]) -> None:
        self._tasks.discard(task)
        error = None if task.cancelled() else task.exception()
        if isinstance(error, Exception):
            self._report(error, operation)
        if task is self._working:
            self._working = None
            while self._waiting and self._working is None:
                self._working = self._take(self._waiting.popleft())
            if self.finished and self._working is None:
                self._end()

    def _report(self, error: Exception, operation: Any) -> None:
        """Tell the client what went wrong. The one place that maps errors to what a client reads."""
        opcode, lid = (operation.get("op"), _id_of(operation)) if isinstance(operation, dict) else (None, None)
        what = f"{opcode[:100]}: " if isinstance(opcode, str) else ""
        if isinstance(error, RosbridgeError):
            self.log("error", what + str(error), lid)
        else:
            logger.error("[client %s] %sfailed", self.client_id, what, exc_info=error)
            self.log("error", f"{what}internal error ({type(error).__name__})", lid)

    # Out

    def send(
        self,
        message: Operation,
        cid: Union[str, int, None] = None,
        compression: str = "none",
        fragment_size: Optional[int] = None,
    ) -> None:
        """Send one operation to the client, on the control lane: in order, never dropped.

        `cid` becomes the operation's `id` where it has none. `compression` is none, png or cbor.
        """
        if cid is not None and "id" not in message:
            message = {**message, "id": cid}
        self.send_payload(encode_operation(message, self.encoding(compression)), fragment_size)

    def send_payload(self, payload: Payload, fragment_size: Optional[int] = None) -> None:
        """Send an encoded operation on the control lane, in fragments if it is longer than `fragment_size`."""
        if not self.finished:
            for part in in_fragments(payload, self.fragment_size(fragment_size)):
                self.outbox.send(part)

    def encoding(self, compression: str) -> str:
        """The encoding for a client that asked for `compression`."""
        if self.parameters.bson_only_mode:
            return "bson"
        if compression == "none" and self.parameters.binary_encoder == "bson":
            return BSON_IF_BINARY
        return compression

    def fragment_size(self, asked: Optional[int]) -> Optional[int]:
        """The length above which messages go out in fragments; the server's max_message_size is a limit too."""
        limit = self.parameters.max_message_size
        return limit if asked is None else asked if limit is None else min(asked, limit)

    def outgoing(self, message: Union[str, bytes]) -> None:
        """Take one encoded message for the client: str is JSON text. For subclasses to override."""

    # Status messages, section 3.2 of the specification

    def log(self, level: str, message: str, lid: OperationId = None) -> None:
        """Log `message`, and send it to the client when it asked for `level`; `lid` is the id of what caused it."""
        if len(message) > MAX_STATUS_LENGTH:
            message = message[:MAX_STATUS_LENGTH] + "…"  # it quotes what the client sent, which may be megabytes
        about = f" [id: {str(lid)[:100]}]" if lid is not None else ""
        logger.log(_LOGGING_LEVELS[level], "[client %s]%s %s", self.client_id, about, message)
        self.send_status(level, message, lid)

    def send_status(self, level: str, message: str, lid: OperationId) -> None:
        """Tell the client, if it asked for `level`."""
        if STATUS_LEVELS[level] <= STATUS_LEVELS[self.status_level]:
            status = {"op": "status", "level": level, "msg": message}
            self.send(status if lid is None else {**status, "id": lid})

    def dropped(self, messages: Mapping[str, int]) -> None:
        """Tell the client that so many messages of these topics were dropped, since it is slow."""
        topics = ", ".join(f"{count} of {topic}" for topic, count in sorted(messages.items()))
        self.log("warning", f"the connection is too slow for all that is subscribed to; dropped messages: {topics}")

    def _set_level(self, message: Operation) -> None:
        level, lid = message.get("level"), checked_id(message)
        if not isinstance(level, str) or level not in STATUS_LEVELS:
            raise InvalidArgumentException(f"the field 'level' must be one of {', '.join(STATUS_LEVELS)}")
        self.status_level = level
        self.log("info", f"status level is now {level}", lid)

    def _status(self, message: Operation) -> None:
        """A status that the client sends is its log line."""
        level = message.get("level")
        if not isinstance(level, str) or level not in _LOGGING_LEVELS:
            level = "info"
        logger.log(_LOGGING_LEVELS[level], "[client %s] says: %s", self.client_id, str(message.get("msg", ""))[:1000])

    # The end

    def finish(self) -> None:
        """The client is gone: end everything that it began. Doing so again does nothing.

        What it sent to be published before it left is published first, for FINISH_TIMEOUT_S at most.
        """
        if asyncio._get_running_loop() is not self.loop:
            asyncio.run_coroutine_threadsafe(self._finish(), self.loop).result()
        elif not self.finished:
            self._finish_now()

    async def _finish(self) -> None:
        if not self.finished:
            self._finish_now()
        while self._working is not None:
            await _ended(self._working)

    def _finish_now(self) -> None:
        self.finished = True
        outlives = self._working is not None and self._working_on in self.outliving
        for task in self._tasks:
            if not outlives or task is not self._working:
                task.cancel()
        if outlives or (self._working is not None and self._waiting):
            self._ending = self.loop.call_later(FINISH_TIMEOUT_S, self._end)
        else:
            self._end()

    def _end(self) -> None:
        if self.ended:
            return
        self.ended = True
        if self._ending is not None:
            self._ending.cancel()
        self._waiting.clear()
        for task in self._tasks:
            task.cancel()
        for capability in self.capabilities:
            try:
                capability.finish()
            except Exception:  # the others must be finished all the same
                logger.exception("[client %s] finishing %s failed", self.client_id, type(capability).__name__)


async def _ended(task: asyncio.Future[None]) -> None:
    """Wait for `task`, however it ends."""
    await asyncio.wait({task})


class _CallOutgoing:
    """The outbox of a protocol that has none: everything goes to `outgoing` at once."""

    def __init__(self, protocol: Protocol) -> None:
        self.dropped: Dict[str, int] = {}
        self.waiting_bytes = 0
        self._protocol = protocol

    def send(self, payload: Payload) -> None:
        self._protocol.outgoing(payload.data if payload.binary else payload.data.decode("utf-8"))

    def offer(self, source: Source, message: object, size: int) -> None:
        for payload in source.encode(message):
            self.send(payload)

    def forget(self, source: Source) -> None:
        """Nothing waits here."""


def _id_of(operation: Operation) -> OperationId:
    """The id to answer with: none where what the client gave can't be one."""
    try:
        return checked_id(operation)
    except InvalidArgumentException:
        return None


def _decode_bson(data: bytes) -> Any:
    import bson  # optional: only BSON mode needs it

    try:
        return bson.decode(data)
    except bson.errors.BSONError as error:
        raise DecodeError(f"not a BSON document: {error}") from error


CapabilityClass = Type[Capability]
