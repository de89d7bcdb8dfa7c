# SPDX-License-Identifier: BSD-3-Clause
"""Websocket clients that call a service, each its next call as soon as the last one is answered."""

from __future__ import annotations

import itertools
import json
import selectors
import struct
import time
from typing import Iterator

from benchmarks.clients import connect, foxglove_entry
from benchmarks.tally import Tally, Window
from benchmarks.websocket import BINARY, TEXT, Connection
from benchmarks.worker import Pipe, answer

_CALL_REQUEST, _CALL_RESPONSE = 2, 3
_SET_BOOL_TRUE = b"\x01"
_FOXGLOVE_HEAD = struct.Struct("<BIII")


class _Caller:
    """One client with one call under way."""

    def __init__(self, url: str, encoding: str, service: str) -> None:
        self.connection: Connection = connect(url, encoding)
        self._numbers: Iterator[int] = itertools.count(1)
        self._number = 0
        self._begin_ns = 0
        self._service = service
        self._foxglove_id = 0
        if encoding == "foxglove":
            self._foxglove_id = foxglove_entry(self.connection, "advertiseServices", "services", "name", service)

    def call(self) -> None:
        """Sends the next call."""
        self._number = next(self._numbers)
        self._begin_ns = time.time_ns()
        if self._foxglove_id:
            encoding = b"ros1"
            head = _FOXGLOVE_HEAD.pack(_CALL_REQUEST, self._foxglove_id, self._number, len(encoding))
            self.connection.send(head + encoding + _SET_BOOL_TRUE, BINARY)
            return
        text = '{"op":"call_service","id":"%d","service":"%s","args":{"data":true}}' % (self._number, self._service)
        self.connection.send(text.encode())

    def answered(self, tally: Tally) -> bool:
        """Reads a message; whether it is the response, which is then counted. RuntimeError when the call failed."""
        opcode, payload = self.connection.receive()
        if not self._is_response(opcode, payload):
            return False
        tally.add(self._begin_ns, len(payload), time.time_ns())
        return True

    def _is_response(self, opcode: int, payload: bytes) -> bool:
        if opcode == BINARY:
            return payload[0] == _CALL_RESPONSE and _FOXGLOVE_HEAD.unpack_from(payload)[2] == self._number
        if opcode != TEXT:
            return False
        message = json.loads(payload)
        if message.get("op") == "serviceCallFailure" or message.get("result") is False:
            raise RuntimeError(f"the call failed: {message}")
        return bool(message.get("op") == "service_response" and message.get("id") == str(self._number))


def run(pipe: Pipe, url: str, encoding: str, service: str, clients: int) -> None:
    """A worker. Commands: "start", whose reply says that every client had an answer; a Window to count in; "finish",
    whose reply is the tally; latencies are from call to response."""
    tally = Tally()
    pipe.recv()
    callers = [_Caller(url, encoding, service) for _ in range(clients)]
    for caller in callers:
        caller.call()
        while not caller.answered(tally):
            pass
    answer(pipe)
    with selectors.DefaultSelector() as selector:
        selector.register(pipe, selectors.EVENT_READ)
        for caller in callers:
            selector.register(caller.connection.socket, selectors.EVENT_READ, caller)
            caller.call()
        while True:
            for key, _ in selector.select():
                if key.data is None:
                    command = pipe.recv()
                    if not isinstance(command, Window):
                        answer(pipe, tally.summary())
                        return
                    tally.window = command
                else:
                    _answer_and_call(key.data, tally)


def _answer_and_call(caller: _Caller, tally: Tally) -> None:
    """Takes what waits for the caller; the connection may hold more than one message, then its socket is silent."""
    while True:
        if caller.answered(tally):
            caller.call()
        if not caller.connection.rest:
            return
