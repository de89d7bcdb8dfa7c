# SPDX-License-Identifier: BSD-3-Clause
"""What a bridge costs: the same load through any rosbridge or Foxglove server, measured from outside.

A run has four parts, each a process of its own: a publisher that costs little, the server under test, raw-socket
clients, and the runner that reads the server's CPU time and memory from /proc. See README.md for the command.
"""
