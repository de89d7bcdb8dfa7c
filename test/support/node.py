# SPDX-License-Identifier: BSD-3-Clause
"""ROS nodes for tests, each a process of its own.

The ones that suites need again and again are in programs/: a publisher, an echo and a service. What they do
is an option; what they have to say is a JSON line on their output. `script` runs any other rospy code.
"""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence

from support.process import Process
from support.ros import RosMaster, python
from support.wait import wait_until

_PROGRAMS = Path(__file__).resolve().parent / "programs"


class Node:
    """A rospy node in a process. `records()` are the JSON lines that it wrote."""

    def __init__(self, process: Process) -> None:
        self.process = process

    def __enter__(self) -> Node:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        self.process.stop()

    def interrupt(self) -> None:
        """Tells it to end, as Ctrl-C does, and does not wait."""
        if self.process.alive:
            self.process.signal(signal.SIGINT)

    def kill(self) -> None:
        """Ends it as a crash does: nothing is unregistered."""
        self.process.kill()

    def records(self, kind: Optional[str] = None) -> List[Any]:
        """The values of the lines `{kind: value}` written so far, or all such lines."""
        lines = [line for line in self.process.output.splitlines(True) if line.startswith("{") and line.endswith("\n")]
        found = [json.loads(line) for line in lines]
        return found if kind is None else [record[kind] for record in found if kind in record]

    def wait_records(self, kind: str, count: int = 1, timeout: float = 10.0) -> List[Any]:
        """`records(kind)` once there are `count` of them."""

        def enough() -> Optional[List[Any]]:
            found = self.records(kind)
            if len(found) < count and not self.process.alive:
                raise AssertionError(f"{self.process.name} ended:\n{self.process.output}")
            return found if len(found) >= count else None

        return wait_until(
            enough,
            timeout,
            lambda: f"{count} of {kind} from {self.process.name}, but {len(self.records(kind))}",
        )


def publish(
    master: RosMaster,
    topic: str,
    kind: str,
    message: Optional[Dict[str, Any]] = None,
    *,
    rate: float = 10.0,
    count: int = 0,
    counter: str = "",
    latch: bool = False,
    subscribers: int = 0,
    name: str = "publisher",
    arguments: Sequence[str] = (),
) -> Node:
    """A node that publishes `message` (as genpy fills messages from dicts) `rate` times a second (0: as fast
    as it can), `count` times (0: until it is stopped), then stays.

    `counter` names the field that counts up from 0 (a string field gets it as text). It starts when
    `subscribers` nodes have subscribed, and returns when its publisher is registered. `arguments`: ROS ones
    (`_private:=`, `__ns:=`)."""
    options = {
        "topic": topic,
        "kind": kind,
        "message": message or {},
        "rate": rate,
        "count": count,
        "counter": counter,
        "latch": latch,
        "subscribers": subscribers,
    }
    return _program(master, "publisher.py", options, name, arguments)


def echo(master: RosMaster, topic: str, kind: str, *, name: str = "echo", arguments: Sequence[str] = ()) -> Node:
    """A node that subscribes; each message becomes a record `message` (uint8[] as lists of ints)."""
    return _program(master, "echo.py", {"topic": topic, "kind": kind}, name, arguments)


def serve(
    master: RosMaster,
    service: str,
    kind: str = "rosbridge_library/AddTwoInts",
    response: Optional[Dict[str, Any]] = None,
    *,
    delay: float = 0.0,
    behaviour: str = "answer",
    name: str = "provider",
    arguments: Sequence[str] = (),
) -> Node:
    """A node that provides a service; each request becomes a record `request`.

    It answers after `delay` seconds with `response` (without one: the sum of a and b). `behaviour`: answer;
    fail (the handler raises); hang (never answers); die (the process ends on the request); deaf (the service
    is registered at an address that accepts connections and never says anything)."""
    options = {"service": service, "kind": kind, "response": response, "delay": delay, "behaviour": behaviour}
    return _program(master, "service.py", options, name, arguments)


def script(master: RosMaster, source: str, *, name: str = "script", arguments: Sequence[str] = ()) -> Node:
    """A node that runs Python source with rospy imported and initialised; ready once it prints `{"ready":
    true}`, for which `ready()` is there, as is `say(**record)`."""
    path = master.directory / f"{name}.py"
    beginning = f"from programs.program import *\nimport rospy\nrospy.init_node({name!r})\n"
    path.write_text(f"{beginning}{source}\nstay()\n")
    return _started(master, [str(path), *arguments], name)


def _program(master: RosMaster, program: str, options: Dict[str, Any], name: str, arguments: Sequence[str]) -> Node:
    command = [str(_PROGRAMS / program), json.dumps(options), f"__name:={name}", *arguments]
    return _started(master, command, name)


def _started(master: RosMaster, command: Sequence[str], name: str) -> Node:
    paths = [str(_PROGRAMS.parent), master.environment.get("PYTHONPATH", "")]
    environment = {"PYTHONPATH": ":".join(path for path in paths if path)}
    node = Node(master.process_in([python(), *command], name, environment))
    try:
        node.wait_records("ready", timeout=20.0)
    except BaseException:
        node.stop()
        raise
    return node
