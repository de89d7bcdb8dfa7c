# SPDX-License-Identifier: BSD-3-Clause
"""The node that the published clients are tried with (programs/robot.py), and what its samples are in JSON."""

from __future__ import annotations

import base64
import io
import math
from typing import Any, Dict, List

import genpy

from support.node import Node, script
from support.programs.samples import samples
from support.ros import RosMaster
from support.wait import wait_until

SAMPLES: Dict[str, Any] = samples()


def start(master: RosMaster) -> Node:
    """The robot, once it is registered whole."""
    return script(master, "from programs import robot\nrobot.run()", name="robot")


def heard(robot: Node, topics: List[str], timeout: float = 10.0) -> Dict[str, Any]:
    """What came on these topics last, once something has come on each: {topic: message}, bytes as lists of ints."""

    def found() -> Dict[str, Any]:
        records = {record["topic"]: record["message"] for record in robot.records("heard")}
        return {topic: records[topic] for topic in topics if topic in records}

    wait_until(lambda: len(found()) == len(topics), timeout, lambda: f"{topics}, but only {sorted(found())}")
    return found()


def as_json(value: Any) -> Any:
    """A message, or part of one, as the specification and the interfaces have it in JSON."""
    if isinstance(value, genpy.TVal):
        return {"secs": value.secs, "nsecs": value.nsecs}
    if isinstance(value, genpy.Message):
        return {name: as_json(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, (list, tuple)):
        return [as_json(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def wire(message: Any) -> bytes:
    """The message as it is on a ROS connection."""
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()
