# SPDX-License-Identifier: BSD-3-Clause
"""The servers under test: this one, the baseline, any that a command starts, or one that runs already."""

from __future__ import annotations

import contextlib
import os
import shlex
import socket
import sys
import time
from pathlib import Path
from typing import Dict, FrozenSet, Iterator, NamedTuple, Optional, Tuple

from benchmarks.measure import with_descendants
from support.process import Process
from support.ros import executable, free_port

_START_TIMEOUT_S = 30.0
ALL_ENCODINGS = frozenset(("json", "png", "cbor", "cbor-raw", "foxglove"))


class Candidate(NamedTuple):
    """A server to measure: by the command that starts it, or by the URL where it runs."""

    name: str
    command: Tuple[str, ...] = ()
    """Its words; `{port}` in them is replaced."""
    url: str = ""
    pid: Optional[int] = None
    """Of a server that runs already; None: its CPU time and memory are unknown."""
    encodings: FrozenSet[str] = ALL_ENCODINGS
    """Those that it may know; whether it speaks the protocol is found out."""


class Running(NamedTuple):
    """A server that listens."""

    url: str
    pid: Optional[int]
    startup_s: Optional[float]
    """From its start until it accepted a connection; None when it was not started here."""
    log_path: Optional[Path] = None

    @property
    def pids(self) -> Tuple[int, ...]:
        """Its processes; none when they are unknown."""
        return () if self.pid is None else tuple(with_descendants(self.pid))

    @property
    def log_tail(self) -> str:
        """The last lines that it has written, for a failure."""
        if self.log_path is None:
            return ""
        lines = self.log_path.read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join(["", "The server's log ends:", *lines[-20:]]) if lines else ""


def candidate(text: str) -> Candidate:
    """The server that `--server` names: ours, baseline, or NAME=COMMAND. Raises ValueError."""
    if text == "ours":
        program = str(executable("rosbridge_server", "rosbridge_websocket"))
        arguments = ("--port", "{port}", "--address", "127.0.0.1", "__name:=rosbridge_benchmark_{port}")
        return Candidate("ours", (program, *arguments))
    if text == "baseline":
        command = (sys.executable, "-m", "benchmarks.baseline", "--port", "{port}")
        return Candidate("baseline", command, encodings=frozenset(("json", "cbor", "cbor-raw")))
    name, separator, command_line = text.partition("=")
    if not separator or "{port}" not in command_line:
        raise ValueError(f"{text!r} is not ours, baseline or NAME=COMMAND with {{port}} in it")
    return Candidate(name, tuple(shlex.split(command_line)))


@contextlib.contextmanager
def running(server: Candidate, environment: Dict[str, str], directory: Path) -> Iterator[Running]:
    """The server, listening; one that is started here ends with the block, and logs to `directory`."""
    if server.url:
        yield Running(server.url, server.pid, None)
        return
    port = free_port()
    command = [word.replace("{port}", str(port)) for word in server.command]
    begin = time.monotonic()
    with Process(command, name=server.name, directory=directory, environment=environment) as process:
        _wait_until_listening(process, port)
        yield Running(f"ws://127.0.0.1:{port}", process.pid, time.monotonic() - begin, process.log_path)


def started_environment(environment: Dict[str, str]) -> Dict[str, str]:
    """The environment for servers and nodes that finds this package."""
    root = Path(__file__).resolve().parents[1]
    paths = [str(root), str(root / "test"), environment.get("PYTHONPATH", "")]
    return {**environment, "PYTHONPATH": os.pathsep.join(path for path in paths if path)}


def _wait_until_listening(process: Process, port: int) -> None:
    deadline = time.monotonic() + _START_TIMEOUT_S
    while True:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        if not process.alive:
            raise RuntimeError(f"{process.name} ended ({process.exit_code}):\n{process.output}")
        if time.monotonic() > deadline:
            raise TimeoutError(f"{process.name} doesn't listen after {_START_TIMEOUT_S:g} s:\n{process.output}")
        time.sleep(0.005)
