# SPDX-License-Identifier: BSD-3-Clause
"""The least that makes a process a ROS node: a slave API of its own, calls to the master, connection headers.

rospy would bring threads and conversions into what must cost little. All parts of a benchmark run on one machine, so
the node is known by the loopback address.
"""

from __future__ import annotations

import os
import socket
import struct
import threading
import xmlrpc.client
from socketserver import ThreadingMixIn
from typing import Any, Dict, List, Tuple
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from rosgraph.network import decode_ros_handshake_header, encode_ros_handshake_header

HOST = "127.0.0.1"
_HANDSHAKE_TIMEOUT_S = 10.0
_LENGTH = struct.Struct("<I")
MAX_HEADER_BYTES = 1 << 20
Reply = Tuple[int, str, Any]
"""Code (1: it worked), reason, value."""


class _Server(ThreadingMixIn, SimpleXMLRPCServer):
    daemon_threads = True


class _AnyPath(SimpleXMLRPCRequestHandler):
    rpc_paths = ()


class RosNode:
    """A node with a slave API and a listening TCP socket, whose connections are the caller's to accept."""

    def __init__(self, name: str, master_uri: str) -> None:
        self.name = name
        self.master_uri = master_uri
        self.listener = socket.create_server((HOST, 0))
        self.port = int(self.listener.getsockname()[1])
        self._server = _Server((HOST, 0), _AnyPath, logRequests=False)
        self._server.register_instance(_SlaveApi(self))
        self.uri = f"http://{HOST}:{self._server.server_address[1]}/"
        self.topics: List[List[str]] = []
        """Name and type of what it publishes."""
        threading.Thread(target=self._server.serve_forever, name="slave api", daemon=True).start()

    def master(self, method: str, *arguments: Any) -> Any:
        """A call of the master; RuntimeError when it refuses, OSError when it is down."""
        code, reason, value = getattr(xmlrpc.client.ServerProxy(self.master_uri), method)(self.name, *arguments)
        if code != 1:
            raise RuntimeError(f"{method}{arguments}: {reason}")
        return value

    def register_publisher(self, topic: str, type_name: str) -> None:
        self.topics.append([topic, type_name])
        self.master("registerPublisher", topic, type_name, self.uri)

    def unregister_publisher(self, topic: str) -> None:
        self.master("unregisterPublisher", topic, self.uri)

    def register_service(self, service: str) -> None:
        self.master("registerService", service, self._service_uri, self.uri)

    def unregister_service(self, service: str) -> None:
        self.master("unregisterService", service, self._service_uri)

    @property
    def _service_uri(self) -> str:
        return f"rosrpc://{HOST}:{self.port}"


class _SlaveApi:
    """What other nodes may call; the names are those of the calls, as their arguments are."""

    def __init__(self, node: RosNode) -> None:
        self._node = node

    def getPid(self, _caller: str) -> Reply:  # noqa: N802
        return 1, "", os.getpid()

    def getMasterUri(self, _caller: str) -> Reply:  # noqa: N802
        return 1, "", self._node.master_uri

    def getBusInfo(self, _caller: str) -> Reply:  # noqa: N802
        return 1, "", []

    def getBusStats(self, _caller: str) -> Reply:  # noqa: N802
        return 1, "", [[], [], []]

    def getSubscriptions(self, _caller: str) -> Reply:  # noqa: N802
        return 1, "", []

    def getPublications(self, _caller: str) -> Reply:  # noqa: N802
        return 1, "", self._node.topics

    def requestTopic(self, _caller: str, topic: str, _protocols: Any) -> Reply:  # noqa: N802
        if all(topic != name for name, _ in self._node.topics):
            return 0, f"not published: {topic}", 0
        return 1, "", ["TCPROS", HOST, self._node.port]

    def publisherUpdate(self, _caller: str, _topic: str, _publishers: Any) -> Reply:  # noqa: N802
        return 1, "", 0

    def paramUpdate(self, _caller: str, _key: str, _value: Any) -> Reply:  # noqa: N802
        return 1, "", 0


def send_header(connection: socket.socket, fields: Dict[str, str]) -> None:
    """Sends a TCPROS connection header."""
    connection.sendall(encode_ros_handshake_header(fields))


def receive_header(connection: socket.socket) -> Dict[str, str]:
    """Reads a TCPROS connection header, waiting for it; ValueError when that is not what comes."""
    connection.settimeout(_HANDSHAKE_TIMEOUT_S)
    (length,) = _LENGTH.unpack(receive_exactly(connection, _LENGTH.size))
    if length > MAX_HEADER_BYTES:
        raise ValueError(f"a connection header of {length} bytes")
    fields: Dict[str, str] = decode_ros_handshake_header(_LENGTH.pack(length) + receive_exactly(connection, length))
    return fields


def receive_exactly(connection: socket.socket, size: int) -> bytes:
    """So many bytes; ConnectionResetError when the connection ends before."""
    data = bytearray()
    while len(data) < size:
        piece = connection.recv(size - len(data))
        if not piece:
            raise ConnectionResetError("the connection ended")
        data += piece
    return bytes(data)
