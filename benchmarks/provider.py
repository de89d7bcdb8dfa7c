# SPDX-License-Identifier: BSD-3-Clause
"""A raw ROS service of type std_srvs/SetBool that answers every request alike."""

from __future__ import annotations

import io
import selectors
import socket
import struct

from std_srvs.srv import SetBool, SetBoolResponse

from benchmarks.rosnode import RosNode, receive_exactly, receive_header, send_header
from benchmarks.worker import Pipe, answer

_LENGTH = struct.Struct("<I")
_OK = b"\x01"


def run(pipe: Pipe, service: str, master_uri: str) -> None:
    """A worker. Replies when the service is registered, and serves until the pipe ends."""
    node = RosNode("/benchmark_provider", master_uri)
    body = io.BytesIO()
    SetBoolResponse(success=True, message="done").serialize(body)
    response = _OK + _LENGTH.pack(body.tell()) + body.getvalue()
    node.register_service(service)
    answer(pipe)
    try:
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            selector.register(node.listener, selectors.EVENT_READ)
            while True:
                for key, _ in selector.select():
                    if key.fileobj is pipe:
                        pipe.recv()
                    elif key.fileobj is node.listener:
                        _accept(node, service, selector)
                    else:
                        _serve(key.fileobj, response, selector)  # type: ignore[arg-type]
    finally:
        node.unregister_service(service)


def _accept(node: RosNode, service: str, selector: selectors.BaseSelector) -> None:
    connection, _ = node.listener.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    header = receive_header(connection)
    if header.get("service", service) != service:
        send_header(connection, {"error": f"only {service} is here"})
        connection.close()
        return
    kind = SetBool
    fields = {"callerid": node.name, "type": kind._type, "md5sum": kind._md5sum}
    fields.update(request_type=kind._request_class._type, response_type=kind._response_class._type)
    send_header(connection, fields)
    selector.register(connection, selectors.EVENT_READ)  # a probe just closes it


def _serve(connection: socket.socket, response: bytes, selector: selectors.BaseSelector) -> None:
    """Answers one request; calls that aren't persistent close the connection then."""
    try:
        (length,) = _LENGTH.unpack(receive_exactly(connection, _LENGTH.size))
        receive_exactly(connection, length)
        connection.sendall(response)
    except (ConnectionResetError, BrokenPipeError):
        selector.unregister(connection)
        connection.close()
