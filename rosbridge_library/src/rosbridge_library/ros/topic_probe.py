# SPDX-License-Identifier: BSD-3-Clause
"""What exactly is the type of a topic? A publisher tells its definition in its connection header.

The master knows the type's name alone. For a type that is not installed here, a probe connects to a publisher like a
subscriber of any type does, reads its header, and leaves. It blocks, so it belongs on the thread pool.
"""

from __future__ import annotations

import http.client
import socket
import time
from typing import Any, List, Sequence, Tuple

from rosbridge_library.codec import MessageType, message_type_from_definition
from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.ros.master import Master, NodeApi, NodeError, NodeUnreachable, connect_until
from rosbridge_library.ros.network_errors import describe
from rosbridge_library.ros.tcpros_header import (
    LENGTH_BYTES,
    HeaderError,
    decode_header,
    decode_length,
    encode_header,
)


class ProbeFailed(RosbridgeError):
    """No publisher of a topic could be asked for its type."""


def probe_topic(master: Master, topic: str, publishers: Sequence[str], timeout_s: float) -> MessageType:
    """The type that one of the nodes `publishers` says `topic` has, asked one after the other.

    Raises ProbeFailed, with the last one's reason, and DefinitionError.
    """
    deadline = time.monotonic() + timeout_s
    reason = "nobody publishes it"
    for publisher in publishers:
        try:
            return _probe(master, topic, publisher, deadline)
        except (NodeUnreachable, NodeError, HeaderError) as error:
            reason = str(error)
        except (OSError, http.client.HTTPException, ValueError, LookupError) as error:
            reason = f"{publisher}: {describe(error)}"
    raise ProbeFailed(f"the type of {topic} can't be learnt: {reason}")


def _probe(master: Master, topic: str, publisher: str, deadline: float) -> MessageType:
    uri = master.call("lookupNode", publisher, timeout=_left_s(deadline))
    node = NodeApi(master.caller_id, uri, timeout=_left_s(deadline))
    parameters: List[Any] = node.call("requestTopic", topic, [["TCPROS"]])
    _, host, port = parameters
    fields = {"topic": topic, "type": "*", "md5sum": "*", "message_definition": "", "callerid": master.caller_id}
    header = _exchange((host, port), encode_header(fields), deadline)
    if "error" in header:
        raise HeaderError(f"{publisher} refuses: {header['error']}")
    return message_type_from_definition(header["type"], header.get("message_definition", ""), header.get("md5sum"))


def _left_s(deadline: float) -> float:
    return max(0.01, deadline - time.monotonic())


def _exchange(address: Tuple[str, int], request: bytes, deadline: float) -> Any:
    with connect_until(*address, deadline) as sock:
        sock.sendall(request)
        length = decode_length(_read(sock, LENGTH_BYTES))
        return decode_header(_read(sock, length))


def _read(sock: socket.socket, size: int) -> bytes:
    data = bytearray(size)
    at = 0
    while at < size:
        count = sock.recv_into(memoryview(data)[at:])
        if count == 0:
            raise HeaderError("the publisher closed the connection before its header")
        at += count
    return bytes(data)
