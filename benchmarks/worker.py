# SPDX-License-Identifier: BSD-3-Clause
"""A child process that runs one part of a measurement, and talks with the runner over a pipe.

The child's function gets the pipe first. It sends a reply for each command it receives; what it raises is raised in
the runner. A child whose runner is gone reads the end of the pipe and ends as well.
"""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Callable, Optional, Type

Pipe = Connection
_REPLY_TIMEOUT_S = 60.0


class WorkerFailed(Exception):
    """The child's function raised; the text is its traceback."""


class Worker:
    """A running child; use it in a `with`."""

    def __init__(self, function: Callable[..., None], *arguments: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._child = context.Process(target=_run, args=(function, theirs, arguments), daemon=True)
        self._child.start()
        theirs.close()

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        self._pipe.close()
        self._child.join(5.0)
        if self._child.is_alive():
            self._child.kill()
            self._child.join()

    @property
    def pid(self) -> int:
        return self._child.pid or 0

    def tell(self, command: Any) -> None:
        """Sends a command."""
        try:
            self._pipe.send(command)
        except BrokenPipeError:
            self.reply()  # says why it ended
            raise

    def reply(self) -> Any:
        """The next reply; WorkerFailed when the child failed, ended or is silent for a minute."""
        if not self._pipe.poll(_REPLY_TIMEOUT_S):
            raise WorkerFailed(f"no reply within {_REPLY_TIMEOUT_S:g} s")
        try:
            ok, value = self._pipe.recv()
        except EOFError:
            raise WorkerFailed("it ended without a reply") from None
        if not ok:
            raise WorkerFailed(value)
        return value

    def ask(self, command: Any) -> Any:
        """Sends a command and returns the reply to it."""
        self.tell(command)
        return self.reply()


def answer(pipe: Pipe, value: Any = None) -> None:
    """Sends a reply, from the child."""
    pipe.send((True, value))


def _run(function: Callable[..., None], pipe: Pipe, arguments: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the runner ends its children
    try:
        function(pipe, *arguments)
    except EOFError:
        pass  # the runner closed the pipe: the end
    except Exception:  # noqa: BLE001 - whatever it is, the runner shall raise it
        try:
            pipe.send((False, traceback.format_exc()))
        except BrokenPipeError:
            traceback.print_exc()
