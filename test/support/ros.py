# SPDX-License-Identifier: BSD-3-Clause
"""A private ROS master, and the environment that makes processes find it and the built packages.

Each test module has a master of its own on a free port, so that suites neither disturb each other nor
anything else on the machine. It can be killed and started again on its port, empty, for tests of just that.
"""

from __future__ import annotations

import functools
import http.client
import os
import random
import shutil
import socket
import subprocess
import sys
import xmlrpc.client
from pathlib import Path
from typing import Any, Dict, List, Optional

from support.process import Process
from support.wait import wait_until

ROOT = Path(__file__).resolve().parents[2]
CALLER_ID = "/rosbridge_test"


@functools.lru_cache(maxsize=None)
def _workspace_environment() -> Dict[str, str]:
    """The environment of this process with the built packages in it: as it is when they are already there,
    else with this checkout's devel space sourced."""
    if any(_executables("rosbridge_server", os.environ.get("CMAKE_PREFIX_PATH", ""))):
        return dict(os.environ)
    setup = ROOT / "build" / "devel" / "setup.bash"
    if not setup.exists():
        raise RuntimeError(f"no {setup}: build first (scripts/test does)")
    sourced = subprocess.run(
        ["bash", "-c", 'source "$1" && env -0', "bash", str(setup)], stdout=subprocess.PIPE, check=True
    )
    variables = sourced.stdout.decode("utf-8", "surrogateescape").split("\0")
    return dict(variable.split("=", 1) for variable in variables if variable)


def _executables(package: str, prefix_path: str) -> List[Path]:
    directories = [Path(prefix) / "lib" / package for prefix in prefix_path.split(os.pathsep) if prefix]
    return [path for directory in directories if directory.is_dir() for path in sorted(directory.iterdir())]


def executable(package: str, name: str) -> Path:
    """The executable of a package, as rosrun finds it: in the devel or install space, or the distribution's."""
    for path in _executables(package, _workspace_environment()["CMAKE_PREFIX_PATH"] + os.pathsep + "/usr"):
        if path.name == name:
            return path
    raise RuntimeError(f"no executable {name} of {package} in the workspace: build first (scripts/test does)")


def free_port() -> int:
    """A port that nobody listens on and that the kernel gives to nobody else: it is below the ephemeral
    range, so that it stays free while a test has its server down."""
    for port in random.sample(range(20000, 32000), 100):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise RuntimeError("no free port")


class _DeadlineTransport(xmlrpc.client.Transport):
    """A connection per call that gives up after some seconds."""

    def __init__(self, timeout: float) -> None:
        super().__init__()
        self._timeout = timeout

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = http.client.HTTPConnection(str(host), timeout=self._timeout)
        self._connection = host, connection  # which close() closes
        return connection


class RosMaster:
    """A rosmaster process on a port of 127.0.0.1; started by the constructor."""

    def __init__(self, directory: Path) -> None:
        """`directory` takes its log, and the ROS logs of all that runs in its environment."""
        self.directory = directory
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.process = self._start()

    def __enter__(self) -> RosMaster:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def environment(self) -> Dict[str, str]:
        """The environment for processes that use this master and the built packages."""
        environment = dict(_workspace_environment())
        for name in ("ROS_HOSTNAME", "ROS_NAMESPACE", "ROSCONSOLE_CONFIG_FILE", "ROS_PYTHON_LOG_CONFIG_FILE"):
            environment.pop(name, None)
        environment.update(
            ROS_MASTER_URI=self.uri,
            ROS_IP="127.0.0.1",
            ROS_HOME=str(self.directory / "ros"),
            ROS_LOG_DIR=str(self.directory / "ros" / "log"),
            PYTHONUNBUFFERED="1",
        )
        return environment

    def call(self, method: str, *arguments: Any) -> Any:
        """The value of one call of the master API; RuntimeError when the master refuses, OSError when it is
        down."""
        with xmlrpc.client.ServerProxy(self.uri, transport=_DeadlineTransport(5.0)) as proxy:
            code, reason, value = getattr(proxy, method)(CALLER_ID, *arguments)  # type: ignore[misc]
        if code != 1:
            raise RuntimeError(f"{method}{arguments}: {reason}")
        return value

    def get_param(self, name: str, default: Any = None) -> Any:
        return self.call("getParam", name) if self.call("hasParam", name) else default

    def set_param(self, name: str, value: Any) -> None:
        self.call("setParam", name, value)

    def publishers(self, topic: str) -> List[str]:
        """The nodes that publish `topic`, as the master knows them."""
        return self._registered(0, topic)

    def subscribers(self, topic: str) -> List[str]:
        return self._registered(1, topic)

    def providers(self, service: str) -> List[str]:
        return self._registered(2, service)

    def services_of(self, node: str) -> List[str]:
        """The services that a node provides."""
        return [service for service, nodes in self.call("getSystemState")[2] if node in nodes]

    def _registered(self, kind: int, name: str) -> List[str]:
        return [node for entry, nodes in self.call("getSystemState")[kind] if entry == name for node in nodes]

    def process_in(self, command: List[str], name: str, environment: Optional[Dict[str, str]] = None) -> Process:
        """A process in this master's environment, with `environment` on top; its log is in `directory`."""
        return Process(
            command,
            name=name,
            directory=self.directory,
            environment={**self.environment, **(environment or {})},
        )

    def kill(self) -> None:
        """Ends the master at once; nobody is told."""
        self.process.kill()

    def restart(self) -> None:
        """A new, empty master on the same port; kills the one that runs."""
        self.process.kill()
        self.process = self._start()

    def stop(self) -> None:
        self.process.stop()

    def _start(self) -> Process:
        rosmaster = shutil.which("rosmaster", path=self.environment.get("PATH"))
        if rosmaster is None:
            raise RuntimeError("no rosmaster on the PATH: install python3-rosmaster (scripts/test does)")
        process = self.process_in([rosmaster, "--core", "-p", str(self.port)], "rosmaster")

        def answers() -> bool:
            if not process.alive:
                raise RuntimeError(f"rosmaster ended ({process.exit_code}):\n{process.output}")
            try:
                return bool(self.call("getPid") == process.pid)
            except OSError:
                return False

        wait_until(answers, 20.0, lambda: f"an answer of the master at {self.uri}:\n{process.output}")
        return process


def python() -> str:
    """The interpreter for nodes of the tests: the one that runs them."""
    return sys.executable
