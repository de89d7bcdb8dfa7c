# SPDX-License-Identifier: BSD-3-Clause
"""A ROS master's own logic inside the test, for what needs a master's answers but no network."""

from __future__ import annotations

import xmlrpc.client
from typing import Any, Callable, Iterator, List

import pytest
from rosmaster.master_api import ROSMasterHandler

from rosbridge_library.ros.master import MasterError


@pytest.fixture
def master_call() -> Iterator[Callable[..., Any]]:
    """`call(method, *arguments)` as Master.call has it; values pass through XML-RPC text both ways.

    `call.log` lists the methods called so far; `call.handler` is the master, for calls in the name of other
    nodes.
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
