# SPDX-License-Identifier: BSD-3-Clause
"""Makes rospy's TCPROS server fit for peers that misbehave.

Everybody who subscribes to this node's topics or calls its services connects to one socket, and rospy's
accept thread reads the connection header of each before it takes the next. So one peer that connects and
then says nothing, such as a host that dropped off the network, locks all others out; and in a burst the
kernel drops what is beyond rospy's queue of five, and tries again after 1, 3, 7, 15 seconds.
"""

from __future__ import annotations

import socket
import threading
from typing import Callable, Tuple

from rospy.impl import tcpros_base

ACCEPT_QUEUE = 128
HANDSHAKE_TIMEOUT_S = 10.0

Handler = Callable[[socket.socket, Tuple[str, int]], None]

_relieving = threading.Lock()


def relieve_accept_thread() -> None:
    """Exchange headers in a thread per connection from now on, and let more connections wait.

    Call it after rospy.init_node, from any thread; calling it again does nothing.
    """
    tcpros_base.start_tcpros_server()
    server = tcpros_base._tcpros_server.tcp_ros_server
    with _relieving:
        if not isinstance(server.inbound_handler, _HandshakeThreads):
            server.inbound_handler = _HandshakeThreads(server.inbound_handler)
            server.server_sock.listen(ACCEPT_QUEUE)


class _HandshakeThreads:
    """Does `handler`, which exchanges headers and passes the connection on, in a thread of its own."""

    def __init__(self, handler: Handler) -> None:
        self._handler = handler

    def __call__(self, sock: socket.socket, address: Tuple[str, int]) -> None:
        sock.settimeout(HANDSHAKE_TIMEOUT_S)  # whoever gets the connection then sets what it needs
        threading.Thread(target=self._handler, args=(sock, address), name="handshake", daemon=True).start()
