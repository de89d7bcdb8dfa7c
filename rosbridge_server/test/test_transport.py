# SPDX-License-Identifier: BSD-3-Clause
"""Writing an outbox's batches to a real socket."""

from __future__ import annotations

import asyncio
import socket
from typing import List

import pytest
from tornado.iostream import IOStream

from rosbridge_library.payload import Buffer, Payload
from rosbridge_server.transport import StreamTransport


@pytest.mark.parametrize("size", [1, 1000, 70_000])
@pytest.mark.parametrize("count", [1, 1024, 1025, 3000])
def test_any_number_of_buffers_arrives_in_order(count: int, size: int) -> None:
    buffers: List[Buffer] = [memoryview(bytes([number % 251]) * size) for number in range(count)]
    expected = b"".join(buffers)

    async def main() -> bytes:
        listener = socket.create_server(("127.0.0.1", 0))
        theirs = socket.create_connection(listener.getsockname())
        ours, _ = listener.accept()
        listener.close()
        theirs.setblocking(False)
        stream = IOStream(ours)
        transport = StreamTransport(
            stream, lambda payload: payload.parts, lambda: None, lambda reason: pytest.fail(reason)
        )
        transport.write(list(Payload(buffers, binary=True).parts))
        received = bytearray()
        while len(received) < len(expected):
            chunk = await asyncio.wait_for(asyncio.get_running_loop().sock_recv(theirs, 1 << 20), 10.0)
            assert chunk, "the connection was closed"
            received += chunk
        stream.close()
        theirs.close()
        return bytes(received)

    assert asyncio.run(main()) == expected
