# SPDX-License-Identifier: BSD-3-Clause
"""A small synchronous rosbridge v2 client.

It holds what it receives until somebody waits for it, so that a test can say what must come without saying in
which order everything comes. It is strict where clients are: a text frame must be JSON without NaN, a binary
one CBOR.
"""

from __future__ import annotations

import base64
import contextlib
import io
import itertools
import json
import time
from types import TracebackType
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple, Type, Union

import cbor2
import png
from websockets.sync.client import connect

Message = Dict[str, Any]

_numbers = itertools.count(1)


class Client:
    """One connection. Messages wait in `inbox`, decoded; `frames` keeps every frame as it came (str or
    bytes)."""

    def __init__(self, url: str, *, timeout: float = 10.0, **options: Any) -> None:
        """`timeout`: the default of every wait, in seconds; `options`: of websockets' connect (subprotocols,
        origin, additional_headers …)."""
        settings: Dict[str, Any] = {
            "max_size": None,
            "compression": None,
            "ping_interval": None,
            "proxy": None,
        }
        settings.update(options)
        self.timeout = timeout
        self.inbox: List[Message] = []
        self.frames: List[Union[str, bytes]] = []
        self._closing = contextlib.ExitStack()
        self.connection = self._closing.enter_context(connect(url, **settings))

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        trace: Optional[TracebackType],
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection as browsers do; harmless when it is closed already."""
        self._closing.close()

    def drop(self) -> None:
        """Loses the connection without a closing handshake, as a client does that crashes."""
        self.connection.close_socket()

    def send(self, operation: Message, *, cbor: bool = False) -> None:
        """Sends an operation as JSON, or as CBOR in a binary frame."""
        self.connection.send(cbor2.dumps(operation) if cbor else json.dumps(operation))

    def send_frame(self, frame: Union[str, bytes]) -> None:
        """Sends any text or binary frame."""
        self.connection.send(frame)

    def receive(self, timeout: Optional[float] = None) -> Message:
        """The next message from the connection, whatever waits in the inbox. TimeoutError when none comes;
        websockets' ConnectionClosed when the server closed the connection."""
        frame = self.connection.recv(self.timeout if timeout is None else timeout)
        self.frames.append(frame)
        return decode(frame)

    def wait_for(
        self,
        condition: Optional[Callable[[Message], bool]] = None,
        timeout: Optional[float] = None,
        **fields: Any,
    ) -> Message:
        """The first message, waiting or still to come, that fulfils `condition` and has the values of
        `fields`; it is taken out of the inbox. AssertionError, with what came instead, after `timeout`
        seconds."""

        def matches(message: Message) -> bool:
            return all(name in message and message[name] == value for name, value in fields.items()) and (
                condition is None or condition(message)
            )

        for index, message in enumerate(self.inbox):
            if matches(message):
                return self.inbox.pop(index)
        deadline = time.monotonic() + (self.timeout if timeout is None else timeout)
        while True:
            try:
                message = self.receive(max(0.0, deadline - time.monotonic()))
            except TimeoutError:
                came = [_short(message) for message in self.inbox]
                raise AssertionError(f"no message with {fields or condition} came, but {came}") from None
            if matches(message):
                return message
            self.inbox.append(message)

    def take(self, **fields: Any) -> List[Message]:
        """Every message in the inbox with these values, taken out of it; waits for nothing."""
        chosen = [m for m in self.inbox if all(m.get(name) == value for name, value in fields.items())]
        self.inbox = [m for m in self.inbox if not any(m is taken for taken in chosen)]
        return chosen

    def collect(self, seconds: float) -> List[Message]:
        """All that is in the inbox and comes within so many seconds: for rates, and for what must not
        come."""
        deadline = time.monotonic() + seconds
        while True:
            try:
                self.inbox.append(self.receive(max(0.0, deadline - time.monotonic())))
            except TimeoutError:
                messages, self.inbox = self.inbox, []
                return messages

    def sync(self) -> None:
        """Returns when the server has handled all that was sent before, and its answers are in the inbox:
        sends an operation that is always answered (an unknown one, with an error status) and waits for that.
        For clients whose level is not none; the server logs no error for it."""
        number = f"sync:{next(_numbers)}"
        self.send({"op": number, "id": number})
        self.wait_for(op="status", id=number)

    def set_level(self, level: str) -> None:
        self.send({"op": "set_level", "level": level})

    def statuses(self, level: Optional[str] = None) -> List[Message]:
        """The status messages in the inbox, taken out of it."""
        return self.take(op="status", **({} if level is None else {"level": level}))

    def subscribe(self, topic: str, kind: Optional[str] = None, **options: Any) -> str:
        """Subscribes, and returns the id; waits for nothing. `options`: further fields of the operation."""
        return self._operation("subscribe", topic=topic, **_with_type(kind), **options)

    def advertise(self, topic: str, kind: str, **options: Any) -> str:
        return self._operation("advertise", topic=topic, type=kind, **options)

    def publish(self, topic: str, message: Message, **options: Any) -> str:
        return self._operation("publish", topic=topic, msg=message, **options)

    def advertise_service(self, service: str, kind: str, **options: Any) -> str:
        return self._operation("advertise_service", service=service, type=kind, **options)

    def request(self, service: str, args: Any = None, **options: Any) -> str:
        """Sends a call_service, and returns its id; the response is for `wait_for(op="service_response",
        id=…)`."""
        return self._operation("call_service", service=service, args={} if args is None else args, **options)

    def call_service(self, service: str, args: Any = None, wait: Optional[float] = None, **options: Any) -> Message:
        """Calls a service and returns the whole service_response, which must come within `wait` seconds."""
        number = self.request(service, args, **options)
        return self.wait_for(timeout=wait, op="service_response", id=number)

    def next_message(self, topic: str, timeout: Optional[float] = None) -> Any:
        """The `msg` of the next publish on `topic`."""
        return self.wait_for(timeout=timeout, op="publish", topic=topic)["msg"]

    def messages(self, topic: str, count: int, timeout: Optional[float] = None) -> List[Any]:
        """The `msg` of the next so many of `topic`, all within `timeout` seconds."""
        deadline = time.monotonic() + (self.timeout if timeout is None else timeout)
        return [self.next_message(topic, max(0.0, deadline - time.monotonic())) for _ in range(count)]

    def serve(self, service: str, handler: Callable[[Any], Tuple[bool, Any]], timeout: Optional[float] = None) -> Any:
        """Answers the next call of a service that this client advertised with `handler(args)`, which returns
        (result, values); the args."""
        call = self.wait_for(timeout=timeout, op="call_service", service=service)
        result, values = handler(call.get("args", {}))
        response = {"op": "service_response", "service": service, "values": values, "result": result}
        self.send({**response, **({"id": call["id"]} if "id" in call else {})})
        return call.get("args", {})

    def _operation(self, op: str, **fields: Any) -> str:
        operation: Message = {"op": op, "id": f"{op}:{next(_numbers)}", **fields}
        self.send(operation)
        return str(operation["id"])


def decode(frame: Union[str, bytes]) -> Message:
    """The message in a frame: JSON in text (a png operation unpacked), CBOR in binary."""
    if isinstance(frame, bytes):
        message = cbor2.loads(frame)
    else:
        message = json.loads(frame, parse_constant=_no_constant)
        if message.get("op") == "png":
            message = json.loads(unpack_png(message["data"]), parse_constant=_no_constant)
    assert isinstance(message, dict), f"not an object: {message!r:.200}"
    return message


def unpack_png(data: str) -> bytes:
    """The bytes in the pixels of a base64 PNG, without the newlines that pad them."""
    _, _, rows, _ = png.Reader(file=io.BytesIO(base64.b64decode(data))).read()
    return b"".join(bytes(row) for row in rows).rstrip(b"\n")


def defragment(fragments: Sequence[Message]) -> Message:
    """The message whose fragment operations these are, in any order."""
    ordered = sorted(fragments, key=lambda fragment: int(fragment["num"]))
    assert [fragment["num"] for fragment in ordered] == list(range(ordered[0]["total"])), "fragments are missing"
    return decode("".join(fragment["data"] for fragment in ordered))


def _with_type(kind: Optional[str]) -> Dict[str, str]:
    return {} if kind is None else {"type": kind}


def _no_constant(token: str) -> Any:
    raise AssertionError(f"{token} is not JSON")


def _short(message: Message) -> str:
    text = repr(message)
    return text if len(text) < 300 else text[:300] + "…"
