# SPDX-License-Identifier: BSD-3-Clause
"""A child process in a process group of its own, whose output goes to a file.

The file is what tests wait on and what a failing test shows (see conftest.py). Ending a process ends its
whole group, politely first, so that nothing outlives the test that started it.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import time
from pathlib import Path
from typing import Dict, List, Match, Optional, Sequence, Union

from support.wait import wait_until

started: List[Process] = []
"""Every process of this test session, the latest last."""


class Process:
    """A running command; use it in a `with`, or call `stop()`."""

    def __init__(
        self, command: Sequence[Union[str, Path]], *, name: str, directory: Path, environment: Dict[str, str]
    ) -> None:
        """Starts `command`; its output goes to a new file `name`-….log in `directory`."""
        self.name = name
        self.log_path = _unused(directory, name)
        with self.log_path.open("wb") as log:
            self._child = subprocess.Popen(
                [str(word) for word in command],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )
        started.append(self)

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        return self._child.pid

    @property
    def alive(self) -> bool:
        return self._child.poll() is None

    @property
    def exit_code(self) -> Optional[int]:
        """None while it runs; negative: the signal that ended it."""
        return self._child.poll()

    @property
    def output(self) -> str:
        """All that it has written so far."""
        return self.log_path.read_text(encoding="utf-8", errors="replace")

    def wait_for_line(self, pattern: str, timeout: float = 10.0) -> Match[str]:
        """The first match of `pattern` in the output; AssertionError when the process ends without it."""

        def found() -> Optional[Match[str]]:
            ended = not self.alive  # looked at before the output, which is then complete
            match = re.search(pattern, self.output, re.MULTILINE)
            if match is None and ended:
                raise AssertionError(f"{self.name} ended ({self.exit_code}) without {pattern!r}:\n{self.output}")
            return match

        return wait_until(found, timeout, lambda: f"{pattern!r} in the output of {self.name}:\n{self.output}")

    def wait(self, timeout: float = 10.0) -> int:
        """Its exit code once it has ended by itself; AssertionError after `timeout` seconds."""
        wait_until(lambda: not self.alive, timeout, lambda: f"end of {self.name}:\n{self.output}")
        return self._child.wait()

    def signal(self, number: int) -> None:
        """Sends a signal to the process alone."""
        self._child.send_signal(number)

    def kill(self) -> None:
        """Ends the whole group at once, as a crash or a power cut would."""
        self._signal_group(signal.SIGKILL)
        self._child.wait()

    def stop(self, timeout: float = 5.0) -> float:
        """Ends it with SIGINT, then SIGTERM, then SIGKILL, each after `timeout` seconds; the seconds it
        took."""
        begin = time.monotonic()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            if not self.alive:
                break
            self.signal(number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._child.wait(timeout)
        took = time.monotonic() - begin
        self._signal_group(signal.SIGKILL)  # what it may have left behind
        return took

    def _signal_group(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._child.pid, number)


def _unused(directory: Path, name: str) -> Path:
    """A new, empty file for the output of one more process of that name."""
    directory.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        path = directory / f"{name}-{number}.log"
        try:
            path.touch(exist_ok=False)
        except FileExistsError:
            number += 1
        else:
            return path
