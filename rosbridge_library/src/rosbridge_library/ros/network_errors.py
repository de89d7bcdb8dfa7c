# SPDX-License-Identifier: BSD-3-Clause
"""Why a connection failed, in words for people: without the numbers and tuples of Python's socket errors."""

from __future__ import annotations

import os
import socket


def describe(error: Exception) -> str:
    """The reason that `error` gives, such as "Connection refused"."""
    if isinstance(error, socket.gaierror):  # its errno is none of the operating system's
        return error.strerror or str(error)
    if isinstance(error, OSError) and error.errno is not None:
        return os.strerror(error.errno)
    return str(error) or type(error).__name__
