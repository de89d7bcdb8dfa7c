# SPDX-License-Identifier: BSD-3-Clause
"""Routes the bridge's Python logging to where a ROS node's log goes: the console, the log file and
``/rosout``.

rospy puts its handlers on the logger "rosout" alone, and they block (publishing to /rosout may ask the master
for a parameter; a console may be a full pipe). So records go through a queue to a thread that runs them, and
the loop never waits for a log line. The queue is bounded; what does not fit is counted, and the count told
when there is room again.
"""

from __future__ import annotations

import contextlib
import io
import logging
import logging.handlers
import queue
import sys
from typing import Callable, List

_ROUTED = ("rosbridge", "tornado", "asyncio")
_MAX_WAITING = 10000


class _DroppingQueueHandler(logging.handlers.QueueHandler):
    lost = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        try:
            if self.lost:
                text = f"{self.lost} log lines before this one were lost: the log can't be written fast enough"
                self.queue.put_nowait(logging.LogRecord(record.name, logging.WARNING, __file__, 0, text, (), None))
                self.lost = 0
            self.queue.put_nowait(record)
        except queue.Full:
            self.lost += 1


def route_to_ros() -> Callable[[], None]:
    """Sends what the bridge, Tornado and asyncio log to rospy's handlers, on a thread. Call after
    rospy.init_node.

    Returns the function that writes what is left and stops the thread.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(line_buffering=True)  # a line is seen when it is logged, also through a pipe
    ros = logging.getLogger("rosout")
    handlers: List[logging.Handler] = [*ros.handlers, *logging.getLogger().handlers]
    waiting: queue.Queue[logging.LogRecord] = queue.Queue(_MAX_WAITING)
    listener = logging.handlers.QueueListener(waiting, *handlers, respect_handler_level=True)
    entrance = _DroppingQueueHandler(waiting)
    for name in _ROUTED:
        logger = logging.getLogger(name)
        logger.handlers[:] = [entrance]
        logger.propagate = False
        logger.setLevel(logging.INFO)
    listener.start()

    def stop() -> None:
        with contextlib.suppress(queue.Full):  # the log is stuck: what it does not take is lost
            listener.stop()

    return stop
