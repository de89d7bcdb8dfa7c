# SPDX-License-Identifier: BSD-3-Clause
"""The real server, as its executable runs it, on a port of its own choice.

Parameters are set on the master with the types given here, like a launch file does; flags go on the command
line.
"""

from __future__ import annotations

import re
from typing import Any, Dict, Iterable, List, Mapping, Optional, Sequence

from support.client import Client
from support.process import Process
from support.ros import RosMaster, executable
from support.wait import wait_until

ROSAPI_SERVICES = 27
"""rosapi's own 25, and the two that each node has for its loggers."""

running: List[Bridge] = []
"""The servers whose logs are looked at when a test ends (see conftest.py)."""

_UNEXPECTED = re.compile(
    r"\[(ERROR|FATAL|CRITICAL)\]|^(ERROR|FATAL|CRITICAL)\b|^Traceback \(most recent call last\)"
    r"|^Exception (ignored|in thread)|never retrieved|was never awaited|^Task was destroyed",
    re.MULTILINE,
)


class Bridge:
    """A running rosbridge_websocket, and rosapi beside it if asked for."""

    def __init__(
        self,
        master: RosMaster,
        parameters: Optional[Mapping[str, Any]] = None,
        arguments: Sequence[str] = (),
        *,
        rosapi: bool = False,
        name: str = "rosbridge_websocket",
        environment: Optional[Dict[str, str]] = None,
    ) -> None:
        """`parameters`: private ones of the server (the globs are rosapi's too); `arguments`: its command
        line; `name`: its node name; `environment`: variables on top of the master's. Returns when clients can
        connect."""
        self.master = master
        self.name = name
        self.port = 0
        self.process: Process
        self.rosapi: Optional[Process] = None
        self._parameters = dict(parameters or {})
        self._arguments = list(arguments)
        self._with_rosapi = rosapi
        self._environment = environment
        self._logs: Dict[Process, int] = {}
        try:
            self._start(self._parameters.get("port", 0))
        except BaseException:
            self.stop()
            raise
        running.append(self)

    def __enter__(self) -> Bridge:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    def connect(self, **options: Any) -> Client:
        """A new client; `options` are those of `Client`."""
        return Client(self.url, **options)

    def stop(self, timeout: float = 5.0) -> float:
        """Ends it as Ctrl-C does; the seconds that the server took."""
        took = 0.0
        for process in reversed(list(self._logs)):
            seconds = process.stop(timeout)
            took = seconds if process is self.process else took
        if self in running:
            running.remove(self)
        return took

    def restart(self) -> None:
        """Ends it and starts it again on the same port."""
        for process in reversed(list(self._logs)):
            process.stop()
        self._start(self.port)

    def unexpected(self, allowed: Iterable[str] = ()) -> List[str]:
        """Error lines and tracebacks in the logs since the last time this was asked, but for those in which
        one of the patterns `allowed` is found (in the line, or in any line of its traceback)."""
        patterns = list(allowed)
        found: List[str] = []
        for process, offset in self._logs.items():
            with process.log_path.open("rb") as log:
                log.seek(offset)
                text = log.read()
            whole = text[: text.rfind(b"\n") + 1] if process.alive else text
            self._logs[process] = offset + len(whole)
            found += [f"{process.name}: {entry}" for entry in errors_in(whole.decode("utf-8", "replace"), patterns)]
        return found

    def _start(self, port: int) -> None:
        if self._actual_port():
            self.master.call("deleteParam", f"/{self.name}/actual_port")  # of the server that ran before
        for parameter, value in {"address": "127.0.0.1", **self._parameters, "port": port}.items():
            self.master.set_param(f"/{self.name}/{parameter}", value)
        self.process = self._launch("rosbridge_server", "rosbridge_websocket", self.name, self._arguments)
        self.port = wait_until(
            lambda: self._ready(self.process) and self._actual_port(),
            20.0,
            lambda: f"a port of {self.name}:\n{self.process.output}",
        )
        if self._with_rosapi:
            self.rosapi = self._start_rosapi()

    def _start_rosapi(self) -> Process:
        for glob in ("topics_glob", "services_glob", "params_glob"):
            if glob in self._parameters:
                self.master.set_param(f"/rosapi/{glob}", self._parameters[glob])
        process = self._launch("rosapi", "rosapi_node", "rosapi", [])
        wait_until(
            lambda: self._ready(process) and len(self.master.services_of("/rosapi")) >= ROSAPI_SERVICES,
            20.0,
            lambda: f"the services of rosapi:\n{process.output}",
        )
        return process

    def _launch(self, package: str, program: str, name: str, arguments: List[str]) -> Process:
        command = [str(executable(package, program)), *arguments, f"__name:={name}"]
        process = self.master.process_in(command, name, self._environment)
        self._logs[process] = 0
        return process

    def _ready(self, process: Process) -> bool:
        if not process.alive:
            raise AssertionError(f"{process.name} ended ({process.exit_code}):\n{process.output}")
        return True

    def _actual_port(self) -> int:
        return int(self.master.get_param(f"/{self.name}/actual_port", 0))


def errors_in(log: str, allowed: Sequence[str] = ()) -> List[str]:
    """The entries of a log that are errors or have tracebacks, but for those in which an allowed pattern is found."""
    return [
        entry
        for entry in _entries(log)
        if _UNEXPECTED.search(entry) and not any(re.search(pattern, entry) for pattern in allowed)
    ]


def _entries(text: str) -> List[str]:
    """The log's entries: a line with the traceback that follows it, if any, as one."""
    entries: List[str] = []
    in_traceback = False
    for line in text.splitlines():
        begins = line.startswith("Traceback (most recent call last)")
        chained = line.startswith(("During handling of the above", "The above exception was")) or not line
        if entries and (in_traceback or begins or chained):
            entries[-1] += "\n" + line
        else:
            entries.append(line)
        in_traceback = begins or (in_traceback and line.startswith((" ", "\t")))
    return entries
