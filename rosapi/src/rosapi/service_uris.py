# SPDX-License-Identifier: BSD-3-Clause
"""The uris of many services, asked of the master in one request.

The master tells uris one service at a time, and a request for each takes a second on a robot with 300
services; it also carries out several calls in one request (`system.multicall`).
"""

from __future__ import annotations

import http.client
import xmlrpc.client
from typing import Any, Dict, Sequence, Tuple, Union
from xml.parsers.expat import ExpatError

from rosbridge_library.ros.master import Master, MasterUnreachable

_SUCCESS = 1


class _Transport(xmlrpc.client.Transport):
    """HTTP whose every wait ends after `timeout_s`."""

    def __init__(self, timeout_s: float) -> None:
        super().__init__()
        self._timeout_s = timeout_s

    def make_connection(self, host: Union[Tuple[str, Dict[str, str]], str]) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = self._timeout_s
        return connection


def look_up_services(master: Master, services: Sequence[str]) -> Dict[str, str]:
    """The uris of those `services` that the master knows, by name. Raises MasterUnreachable."""
    if not services:
        return {}
    calls = [{"methodName": "lookupService", "params": [master.caller_id, service]} for service in services]
    try:
        with xmlrpc.client.ServerProxy(master.uri, _Transport(master.timeout)) as proxy:
            answers: Any = proxy.system.multicall(calls)
    except (OSError, http.client.HTTPException, xmlrpc.client.Error, ExpatError) as error:
        raise MasterUnreachable(f"the ROS master at {master.uri} doesn't tell where services are: {error}") from error
    return {service: answer[0][2] for service, answer in zip(services, answers) if _succeeded(answer)}


def _succeeded(answer: Any) -> bool:
    """A call's answer is a list of one triple (code, message, value), or a dictionary telling of a fault."""
    return isinstance(answer, list) and answer[0][0] == _SUCCESS
