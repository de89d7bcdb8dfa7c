# SPDX-License-Identifier: BSD-3-Clause
"""What the programs share: options in, records out, messages to and from plain values."""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Any, Dict

import genpy
import rospy

_writing = threading.Lock()


def options() -> Dict[str, Any]:
    """The options, a JSON object that is the first argument."""
    return dict(json.loads(sys.argv[1]))


def say(**record: Any) -> None:
    """One JSON line on the output, whole even among threads."""
    with _writing:
        sys.stdout.write(json.dumps(record) + "\n")
        sys.stdout.flush()


def ready() -> None:
    """Tells that all is registered."""
    say(ready=True)


def stay() -> None:
    """Returns when the node is shut down: rospy.spin(), but quicker to notice."""
    while not rospy.is_shutdown():
        time.sleep(0.02)


def fill(message: Any, values: Dict[str, Any]) -> Any:
    """The message with values from JSON in it; lists of numbers and texts fill uint8[] too."""
    genpy.message.fill_message_args(message, [values])
    for name, kind in zip(message.__slots__, message._slot_types):
        if kind.startswith(("uint8[", "char[")):
            value = getattr(message, name)
            setattr(message, name, value.encode() if isinstance(value, str) else bytes(value))
    return message


def plain(value: Any) -> Any:
    """A message, or part of one, as JSON can hold it."""
    if isinstance(value, (rospy.Time, rospy.Duration, genpy.TVal)):
        return {"secs": value.secs, "nsecs": value.nsecs}
    if isinstance(value, genpy.Message):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, (list, tuple, bytes)):
        return [plain(item) for item in value]
    return value
