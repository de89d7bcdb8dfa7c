# SPDX-License-Identifier: BSD-3-Clause
"""Calls to the ROS master, and to the XML-RPC API that every ROS node has.

rospy's own client shares one connection per peer behind a lock and waits for ever when the peer
hangs, so that one stopped process stalls everything that asks it. Here each call has a connection
of its own and a deadline that covers all of it, whatever socket.setdefaulttimeout says (rospy sets
it). The calls block: on the event loop they belong on the thread pool.
"""

from __future__ import annotations

import http.client
import socket
import time
import urllib.parse
import xmlrpc.client
from typing import Any, Optional, Tuple, Type, cast
from xml.parsers.expat import ExpatError

import rosgraph

from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.ros.network_errors import describe
from rosbridge_library.xml_text import is_xml_text

# The state of a graph of ten thousand topics is about 2 MB; what is far longer is no answer.
MAX_ANSWER_BYTES = 64 * 1024 * 1024
READ_BYTES = 1 << 16


class NodeUnreachable(RosbridgeError):
    """The call did not reach the node, or its answer did not come in time."""


class NodeError(RosbridgeError):
    """The node answered that the call failed; the message is its reason."""


class MasterUnreachable(NodeUnreachable):
    """The call did not reach the ROS master, or its answer did not come in time."""


class MasterError(NodeError):
    """The ROS master answered that the call failed; the message is its reason."""


class UnsupportedValue(RosbridgeError):
    """An argument has no XML-RPC form: None, an integer beyond 32 bits, control characters, half a surrogate pair."""


class NodeApi:
    """The XML-RPC API of one ROS node. Thread-safe: calls share nothing."""

    unreachable: Type[NodeUnreachable] = NodeUnreachable
    error: Type[NodeError] = NodeError
    description = "the node at"

    def __init__(self, caller_id: str, uri: str, timeout: float = 5.0) -> None:
        """Prepare calls to `uri` (http://host:port/) as the node `caller_id`; `timeout` in seconds, for
        each.
        """
        self.caller_id = caller_id
        self.uri = uri
        self.timeout = timeout

    def call(self, method: str, *args: Any, timeout: Optional[float] = None) -> Any:
        """Call `method` with the caller id and `args`, and return the value of the answer.

        Base64 and dateTime values come as bytes and datetime. `timeout` in seconds overrides that of
        the constructor; finding the address of a host by name is the one step it can't cut short.

        Raises NodeUnreachable or NodeError (of Master: MasterUnreachable, MasterError), and
        UnsupportedValue for arguments that XML-RPC can't carry.
        """
        return self.value(method, self.answer(method, *args, timeout=timeout))

    def answer(self, method: str, *args: Any, timeout: Optional[float] = None) -> bytes:
        """The bytes of the answer to a `call`, for `value`: a caller may know already what they say.

        Raises what `call` raises, but NodeError.
        """
        body = _encode_call(method, (self.caller_id, *args))
        seconds = self.timeout if timeout is None else timeout
        try:
            status, answer = _post(self.uri, body, time.monotonic() + seconds)
        except socket.timeout as error:
            raise self._unreachable(f"no answer to {method} within {seconds:g} s") from error
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise self._unreachable(describe(error)) from error
        if status != http.client.OK:
            raise self._unreachable(f"it answered {method} with HTTP status {status}")
        return answer

    def value(self, method: str, answer: bytes) -> Any:
        """The value in the bytes that `answer` returned for that method. Raises NodeUnreachable or NodeError."""
        try:
            parameters, _ = xmlrpc.client.loads(answer, use_builtin_types=True)
            code, message, value = cast(Tuple[Any, ...], parameters[0])
        except xmlrpc.client.Fault as fault:
            raise self.error(f"{method} failed at {self.description} {self.uri}: {fault.faultString}") from fault
        except (xmlrpc.client.Error, ExpatError, ValueError, TypeError, LookupError) as error:
            raise self._unreachable(f"its answer to {method} is none of the ROS API") from error
        if code != 1:
            raise self.error(str(message))
        return value

    def _unreachable(self, reason: str) -> NodeUnreachable:
        return self.unreachable(f"{self.description} {self.uri} is unreachable: {reason}")


class Master(NodeApi):
    """The ROS master at `uri`, by default the one that ROS_MASTER_URI or `__master:=` names."""

    unreachable = MasterUnreachable
    error = MasterError
    description = "the ROS master at"

    def __init__(self, caller_id: str, uri: Optional[str] = None, timeout: float = 5.0) -> None:
        super().__init__(caller_id, rosgraph.get_master_uri() if uri is None else uri, timeout)


class _DeadlineSocket(socket.socket):
    """A socket whose operations all end at one time, however the peer spreads out its bytes."""

    deadline: float

    def _arm(self) -> None:
        left = self.deadline - time.monotonic()
        if left <= 0:
            raise socket.timeout("timed out")
        self.settimeout(left)

    def connect(self, address: Any) -> None:
        self._arm()
        super().connect(address)

    def sendall(self, data: Any, flags: int = 0) -> None:
        self._arm()
        super().sendall(data, flags)

    def recv_into(self, buffer: Any, nbytes: int = 0, flags: int = 0) -> int:
        self._arm()
        return super().recv_into(buffer, nbytes, flags)


def connect_until(host: str, port: int, deadline: float) -> socket.socket:
    """A connected socket whose operations all end at `deadline` (on time.monotonic). Raises OSError."""
    failure: Optional[OSError] = None
    for family, kind, protocol, _, address in socket.getaddrinfo(host, port, 0, socket.SOCK_STREAM):
        sock = _DeadlineSocket(family, kind, protocol)
        sock.deadline = deadline
        try:
            sock.connect(address)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            sock.close()
            failure = error
        else:
            return sock
    raise failure or OSError(f"the host {host} has no address")


def _post(uri: str, body: bytes, deadline: float) -> Tuple[int, bytes]:
    """POST `body` and return the HTTP status and the body of the answer."""
    parts = urllib.parse.urlsplit(uri)
    if parts.scheme != "http" or not parts.hostname:
        raise ValueError("its address is not of the form http://host:port/")
    connection = http.client.HTTPConnection(parts.hostname, parts.port)
    connection.sock = connect_until(connection.host, connection.port, deadline)
    try:
        headers = {"Content-Type": "text/xml", "Connection": "close"}
        connection.request("POST", parts.path or "/", body, headers)
        response = connection.getresponse()
        answer = bytearray()
        while True:
            piece = response.read(READ_BYTES)  # piece by piece: Python 3.8 first clears as much memory as may be read
            if not piece:
                return response.status, bytes(answer)
            answer += piece
            if len(answer) > MAX_ANSWER_BYTES:
                raise ValueError(f"its answer is longer than {MAX_ANSWER_BYTES} bytes")
    finally:
        connection.close()


def _encode_call(method: str, args: Tuple[Any, ...]) -> bytes:
    try:
        text = xmlrpc.client.dumps(args, method)
        if not is_xml_text(text):
            raise UnsupportedValue(f"the arguments of {method} have control characters, which XML-RPC can't carry")
        return text.encode("utf-8")
    except (TypeError, OverflowError, UnicodeError, RecursionError) as error:
        raise UnsupportedValue(f"the arguments of {method} can't be sent over XML-RPC: {error}") from error
