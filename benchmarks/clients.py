# SPDX-License-Identifier: BSD-3-Clause
"""Websocket clients that subscribe to the load and count it: any number of them on one selector loop.

They speak rosbridge v2 (json, png, cbor, cbor-raw) or Foxglove (foxglove: advertise, subscribe, message data).
"""

from __future__ import annotations

import json
import selectors
import time
from typing import Any, List, Sequence

from benchmarks.messages import LOADS
from benchmarks.stamps import finder
from benchmarks.tally import Tally, Window
from benchmarks.websocket import TEXT, Connection, MessageCounter
from benchmarks.worker import Pipe, answer

COMPRESSION = {"json": "none", "png": "png", "cbor": "cbor", "cbor-raw": "cbor-raw"}
_FIRST_MESSAGE_TIMEOUT_S = 30.0
_DRAINED_S, _DRAIN_TIMEOUT_S = 0.3, 5.0


def connect(url: str, encoding: str) -> Connection:
    """A connection that speaks the protocol of `encoding`."""
    return Connection(url, foxglove=encoding == "foxglove")


def subscribe(connection: Connection, encoding: str, topic: str, type_name: str) -> None:
    """Subscribes; the messages come later."""
    if encoding == "foxglove":
        channel = foxglove_entry(connection, "advertise", "channels", "topic", topic)
        send_json(connection, {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel}]})
        return
    operation = {"op": "subscribe", "topic": topic, "type": type_name, "compression": COMPRESSION[encoding]}
    send_json(connection, operation)


def send_json(connection: Connection, operation: Any) -> None:
    connection.send(json.dumps(operation).encode())


def foxglove_entry(connection: Connection, op: str, entries: str, field: str, name: str) -> int:
    """The id of what a Foxglove server advertises under a name, waiting for it."""
    while True:
        opcode, payload = connection.receive()
        if opcode != TEXT:
            continue
        message = json.loads(payload)
        if message.get("op") == op:
            for entry in message[entries]:
                if entry[field] == name:
                    return int(entry["id"])


def run(pipe: Pipe, url: str, load_name: str, encoding: str, topic: str, clients: int) -> None:
    """A worker. Commands: "start", whose reply says that every client has had a message; a Window to count in;
    "finish", whose reply is the tally once nothing more comes."""
    tally = Tally()
    find = finder(load_name, encoding)
    pipe.recv()
    counters: List[MessageCounter] = []
    with selectors.DefaultSelector() as selector:
        selector.register(pipe, selectors.EVENT_READ, None)
        for _ in range(clients):
            connection = connect(url, encoding)
            subscribe(connection, encoding, topic, LOADS[load_name].type)
            counters.append(MessageCounter(connection, find, tally))
            selector.register(connection.socket, selectors.EVENT_READ, counters[-1])
        _wait_for_first(selector, counters)
        answer(pipe)
        while True:
            command = _read(selector, None, pipe)
            if not isinstance(command, Window):
                break
            tally.window = command
        _drain(selector, tally)
    answer(pipe, tally.summary())


def run_idle(pipe: Pipe, url: str, encoding: str, clients: int) -> None:
    """A worker with clients that do nothing but answer pings. Replies when all are connected; ends with the pipe."""
    tally = Tally()
    with selectors.DefaultSelector() as selector:
        selector.register(pipe, selectors.EVENT_READ, None)
        for _ in range(clients):
            counter = MessageCounter(connect(url, encoding), lambda *_: None, tally)
            selector.register(counter.socket, selectors.EVENT_READ, counter)
        answer(pipe)
        _read(selector, None, pipe)


def _read(selector: selectors.BaseSelector, timeout_s: Any, pipe: Any = None) -> Any:
    """Reads the clients' sockets for `timeout_s`, or until the runner sends a command, which is returned."""
    end = None if timeout_s is None else time.monotonic() + timeout_s
    while True:
        left = None if end is None else max(0.0, end - time.monotonic())
        for key, _ in selector.select(left):
            if key.data is not None:
                key.data.read()
            elif pipe is not None:
                return pipe.recv()
        if end is not None and time.monotonic() >= end:
            return None


def _wait_for_first(selector: selectors.BaseSelector, counters: Sequence[MessageCounter]) -> None:
    deadline = time.monotonic() + _FIRST_MESSAGE_TIMEOUT_S
    while not all(counter.count for counter in counters):
        if time.monotonic() > deadline:
            silent = sum(not counter.count for counter in counters)
            raise TimeoutError(f"{silent} of {len(counters)} clients got no message in {_FIRST_MESSAGE_TIMEOUT_S:g} s")
        _read(selector, 0.02)


def _drain(selector: selectors.BaseSelector, tally: Tally) -> None:
    """Reads on until nothing has come for a while: what was sent in the window may come late."""
    deadline = time.monotonic() + _DRAIN_TIMEOUT_S
    tally.last_ns = time.time_ns()
    while time.monotonic() < deadline and time.time_ns() - tally.last_ns < _DRAINED_S * 1e9:
        _read(selector, 0.05)
