# SPDX-License-Identifier: BSD-3-Clause
"""Sensors that publish with stamps, and viewers that tell how much of it they see and how late it is.

with sensors(master, image_bytes=250_000), Viewer(master, bridge.port, [subscription("/state")]) as viewer:
    view = viewer.watch(3.0)
    view.rate("/state"), view.percentile("/state", 99)
"""

from __future__ import annotations

import itertools
import json
import signal
import time
from typing import Any, Dict, List, Optional, Sequence

from support.node import _PROGRAMS, Node, _program
from support.process import Process
from support.ros import RosMaster, python
from support.wait import wait_until

_numbers = itertools.count(1)
REPORT_INTERVAL_S = 0.2
TYPES = {"/image": "sensor_msgs/Image", "/state": "geometry_msgs/TwistStamped", "/map": "nav_msgs/OccupancyGrid"}


def sensors(
    master: RosMaster,
    *,
    image_bytes: int = 0,
    image_rate: float = 30.0,
    state_rate: float = 50.0,
    map_bytes: int = 0,
) -> Node:
    """A node that publishes /image and /state, and the latched /map; 0 bytes leave a topic out."""
    options = {"image_bytes": image_bytes, "image_rate": image_rate, "state_rate": state_rate, "map_bytes": map_bytes}
    return _program(master, "sensors.py", options, f"sensors{next(_numbers)}", ())


def subscription(topic: str, compression: str = "none", **wishes: Any) -> Dict[str, Any]:
    return {"topic": topic, "type": TYPES[topic], "compression": compression, **wishes}


class View:
    """What viewers saw during some time."""

    def __init__(self, seconds: float, connections: int, seen: Sequence[Dict[str, Any]]) -> None:
        self.seconds = seconds
        self.connections = connections
        self.warnings: List[str] = [text for each in seen for text in each["warnings"]]
        self._seen = seen

    def delays(self, topic: str) -> List[float]:
        return sorted(delay for each in self._seen for delay in each["delays"].get(topic, ()))

    def rate(self, topic: str) -> float:
        """Messages a second, of one connection on the average."""
        return len(self.delays(topic)) / self.seconds / self.connections

    def percentile(self, topic: str, percent: float) -> float:
        """The delay, in seconds, that so many of a hundred messages have at most."""
        delays = self.delays(topic)
        assert delays, f"nothing came on {topic}"
        return delays[min(len(delays) - 1, int(len(delays) * percent / 100))]


class Viewer:
    """Clients in a process of their own, which can be stopped."""

    def __init__(
        self,
        master: RosMaster,
        port: int,
        subscriptions: Sequence[Dict[str, Any]],
        connections: int = 1,
        receive_buffer: int = 0,
    ) -> None:
        """Returns when all have sent their subscriptions. `receive_buffer`: of the sockets, in bytes; 0: the usual."""
        self.connections = connections
        wanted = {
            "port": port,
            "subscriptions": list(subscriptions),
            "connections": connections,
            "receive_buffer": receive_buffer,
        }
        command = [python(), str(_PROGRAMS / "viewer.py"), json.dumps(wanted)]
        paths = [str(_PROGRAMS.parent), master.environment.get("PYTHONPATH", "")]
        environment = {"PYTHONPATH": ":".join(path for path in paths if path)}
        self.process: Process = master.process_in(command, f"viewer{next(_numbers)}", environment)
        self._node = Node(self.process)
        self._node.wait_records("ready", timeout=20.0)

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()

    def stop(self) -> None:
        """Stops the process, as a laptop that falls asleep: its connections stay."""
        self.process.signal(signal.SIGSTOP)

    def resume(self) -> None:
        self.process.signal(signal.SIGCONT)

    def watch(self, seconds: float) -> View:
        """What comes during the next so many seconds."""
        begin = time.time()
        time.sleep(seconds)
        return self.view(begin, begin + seconds)

    def view(self, begin: float, end: Optional[float] = None) -> View:
        """What came between two times (of time.time()); waits until all of it is told."""
        end = time.time() if end is None else end

        def told() -> bool:
            records = self._node.records("seen")
            return bool(records) and float(records[-1]["at"]) >= end

        wait_until(told, 10.0, lambda: f"a report of {self.process.name}:\n{self.process.output[-2000:]}")
        records = self._node.records("seen")
        inside = [index for index, each in enumerate(records) if begin < each["at"] <= end]
        assert inside, f"no report between {begin} and {end}"
        first, last = inside[0], inside[-1]
        since = records[first - 1]["at"] if first else records[0]["at"] - REPORT_INTERVAL_S
        return View(records[last]["at"] - since, self.connections, records[first : last + 1])

    def sees(self, *topics: str, timeout: float = 20.0) -> None:
        """Waits until messages of all these topics have come."""

        def all_seen() -> bool:
            return set(topics) <= {topic for each in self._node.records("seen") for topic in each["delays"]}

        wait_until(all_seen, timeout, lambda: f"{topics} in {self.process.output[-2000:]}")

    @property
    def closed(self) -> List[int]:
        """The connections that the server has closed."""
        return [int(each) for each in self._node.records("closed")]
