# SPDX-License-Identifier: BSD-3-Clause
"""ROS names as web clients write them.

Clients are not ROS nodes and have no namespace, so a name without a leading slash is global: ``chatter`` is
``/chatter``. The name that a client wrote is still what it reads in every reply.
"""

from __future__ import annotations

import re

from rosbridge_library.internal.exceptions import InvalidArgumentException

# ROS's rule (wiki.ros.org/Names) for a global name, as the master's tools check it.
_GLOBAL_NAME = re.compile(r"(?:/[A-Za-z0-9_]+)+\Z")


MAX_NAME_LENGTH = 1000
"""In characters. ROS has no limit, but a name goes to the master and into every list of names."""


def global_name(name: str) -> str:
    """`name` as a global name: one leading slash, no double slashes, none at the end."""
    return "/" + "/".join(part for part in name.split("/") if part)


def checked_global_name(name: str, what: str) -> str:
    """`global_name(name)`, or InvalidArgumentException saying why `name` can't name a `what` (topic, service)."""
    if len(name) > MAX_NAME_LENGTH:
        raise InvalidArgumentException(f"'{name[:200]}…' is too long a name for a {what}: {len(name)} characters")
    resolved = global_name(name)
    if not _GLOBAL_NAME.match(resolved):
        raise InvalidArgumentException(f"'{name[:200]}' is not a legal name for a {what}")
    return resolved
