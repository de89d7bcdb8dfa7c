# SPDX-License-Identifier: BSD-3-Clause
"""What the tests of rosapi share: a master's own logic without its network, and a caller of rosapi's services."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import xmlrpc.client
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, NamedTuple, Optional

import pytest
from rosmaster.master_api import ROSMasterHandler

from rosapi.node import SERVICES
from rosbridge_library.ros.master import MasterError
from support.ros import RosMaster

PROGRAMS = Path(__file__).resolve().parent / "programs"


@pytest.fixture
def master_call() -> Iterator[Callable[..., Any]]:
    """`call(method, *arguments)` as Master.call has it; values pass through XML-RPC text both ways.

    `call.log` lists the methods called so far; `call.handler` is the master, for calls in the name of other nodes.
    """
    handler = ROSMasterHandler()
    handler._ready("http://master:11311/")
    log: List[str] = []

    def call(method: str, *arguments: Any) -> Any:
        log.append(method)
        body = xmlrpc.client.dumps(("/rosapi", *arguments), method)
        given, _ = xmlrpc.client.loads(body, use_builtin_types=True)
        answer = xmlrpc.client.dumps((getattr(handler, method)(*given),), methodresponse=True)
        ((code, reason, value),), _ = xmlrpc.client.loads(answer, use_builtin_types=True)
        if code != 1:
            raise MasterError(reason)
        return value

    call.log, call.handler = log, handler  # type: ignore[attr-defined]
    yield call
    handler._shutdown("the test is over")


class Answer(NamedTuple):
    """What came of one call: the response, or the reason of its failure; and the seconds it took."""

    response: Optional[Dict[str, Any]]
    error: Optional[str]
    took: float


class Caller:
    """A node of its own (programs/caller.py) that calls rosapi's services through rospy."""

    def __init__(self, master: RosMaster) -> None:
        self._child = subprocess.Popen(
            [sys.executable, str(PROGRAMS / "caller.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=master.environment,
            universal_newlines=True,
        )
        self._answers: Dict[int, Answer] = {}
        self._arrived = threading.Condition()
        self._asked = 0
        threading.Thread(target=self._read, daemon=True).start()

    def ask(self, name: str, *fields: Any, persistent: bool = False) -> int:
        """Begin a call of /rosapi/`name`; returns its id."""
        self._asked += 1
        self._write(
            id=self._asked,
            service=f"/rosapi/{name}",
            type=SERVICES[name]._type,
            fields=fields,
            persistent=persistent,
        )
        return self._asked

    def answer(self, call_id: int, timeout: float = 15.0) -> Answer:
        """The end of a call; AssertionError after `timeout` seconds."""
        with self._arrived:
            assert self._arrived.wait_for(lambda: call_id in self._answers, timeout), f"no answer in {timeout} s"
            return self._answers.pop(call_id)

    def call(self, name: str, *fields: Any, persistent: bool = False) -> Dict[str, Any]:
        """The response; AssertionError when the service fails."""
        answer = self.answer(self.ask(name, *fields, persistent=persistent))
        assert answer.response is not None, answer.error
        return answer.response

    def error(self, name: str, *fields: Any, persistent: bool = False) -> str:
        """The reason for which the call fails; AssertionError when it doesn't."""
        answer = self.answer(self.ask(name, *fields, persistent=persistent))
        assert answer.error is not None, answer.response
        return answer.error

    def publish_clock(self, secs: int, nsecs: int) -> None:
        self._write(clock=[secs, nsecs])

    def stop(self) -> None:
        self._child.kill()
        self._child.wait()

    def _write(self, **fields: Any) -> None:
        assert self._child.stdin is not None
        self._child.stdin.write(json.dumps(fields) + "\n")
        self._child.stdin.flush()

    def _read(self) -> None:
        assert self._child.stdout is not None
        for line in self._child.stdout:
            answer = json.loads(line)
            with self._arrived:
                self._answers[answer.pop("id")] = Answer(answer.get("response"), answer.get("error"), answer["took"])
                self._arrived.notify_all()


@pytest.fixture
def start_caller() -> Iterator[Callable[[RosMaster], Caller]]:
    """Starts callers for one test."""
    callers: List[Caller] = []

    def start(master: RosMaster) -> Caller:
        callers.append(Caller(master))
        return callers[-1]

    yield start
    for caller in callers:
        caller.stop()
