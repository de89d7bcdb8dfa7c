# SPDX-License-Identifier: BSD-3-Clause
"""What all TCPROS sockets have in common, of topics and of services."""

from __future__ import annotations

import socket

# The intervals are rospy's.
_KEEPALIVE = (("TCP_KEEPIDLE", 60), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 9))


def keep_alive(sock: socket.socket) -> None:
    """Have the kernel notice a peer whose machine is gone while nobody has anything to say."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEPALIVE:
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
