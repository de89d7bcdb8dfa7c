# SPDX-License-Identifier: BSD-3-Clause
"""Inputs that are nearly right, made from a seed: operations, websocket bytes, TCPROS bytes.

Each begins as something that a client or a node may well send, is changed in its structure (fields left out, values of
other types, numbers at the edges, deep nesting), is encoded, and may have its bytes changed too. So it gets past the
first check, where noise would not.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from random import Random
from typing import Any, Callable, Dict, List, Sequence, Tuple

import cbor2

TOPICS = ["/fuzz/a", "/fuzz/b", "fuzz/c", "/fuzz/image", "~private", "/", "", "/fuzz//x", "/fuzz/ü", "/rosout"]
SERVICES = ["/fuzz/service", "/fuzz/own", "/fuzz/other", "service", ""]
TYPES = [
    "std_msgs/Int32",
    "std_msgs/String",
    "std_msgs/Header",
    "sensor_msgs/Image",
    "geometry_msgs/TwistStamped",
    "tf2_msgs/TFMessage",
    "std_msgs/Float64MultiArray",
    "std_msgs/NoSuchType",
    "no_such_package/Type",
    "std_msgs/msg/Int32",
    "../etc/passwd",
    "a/b/c/d",
    "std_srvs/Empty",
    "rosbridge_library/AddTwoInts",
    "",
    "*",
]
ENCODINGS = ["none", "png", "cbor", "cbor-raw"]
VALUES: List[Any] = [
    None, True, False, 0, -1, 1, 255, 256, -129, 2**31, 2**32, 2**53, 2**63 - 1, 2**63, 2**64, -(2**63) - 1, 10**30,
    0.0, -0.0, 0.5, 1e-320, 1e308, math.inf, -math.inf, math.nan,
    "", "a", "\x00", "ü世🤖", "\ud800", "x" * 300, "x" * 70000, "none", "png", "cbor", "cbor-raw", "QUJD", "=", "1",
    [], [[]], {}, {"": None}, {"data": 1}, [0] * 1000, ["a"] * 50, [None], [{}], {"secs": 1, "nsecs": -1},
    {"data": [[1]]},
]  # fmt: skip
MESSAGES: List[Any] = [
    {"data": 1},
    {"data": "text"},
    {"seq": 1, "stamp": {"secs": 1, "nsecs": 2}, "frame_id": "map"},
    {"height": 1, "width": 3, "encoding": "mono8", "step": 3, "data": "AAEC"},
    {"twist": {"linear": {"x": 1.5}, "angular": {"z": None}}},
    {"transforms": [{"header": {"frame_id": "a"}, "child_frame_id": "b", "transform": {"rotation": {"w": 1}}}] * 3},
    {"layout": {"dim": [{"label": "x", "size": 2, "stride": 2}], "data_offset": 0}, "data": [1.5, None]},
    [1, 2],
    {"a": 1, "b": 2},
]


def operation(random: Random) -> Dict[str, Any]:
    """One that is right, or could be."""
    choose = random.choice
    identifier = {"id": choose(["x", "y", 1, 2.5])} if random.random() < 0.7 else {}
    topic, service, kind, message = choose(TOPICS), choose(SERVICES), choose(TYPES), choose(MESSAGES)
    fragment = {"op": "fragment", "data": '{"op":"publish"', "num": random.randrange(3), "total": choose([1, 2, 3])}
    subscribe = {
        "throttle_rate": choose([0, 1, 50]),
        "queue_length": choose([0, 1, 9]),
        "compression": choose(ENCODINGS),
    }
    made: Dict[str, Any] = choose(
        [
            {"op": "advertise", "topic": topic, "type": kind, "latch": choose([True, False]), "queue_size": 5},
            {"op": "unadvertise", "topic": topic},
            {"op": "publish", "topic": topic, "msg": message},
            {"op": "publish", "topic": topic, "msg": message, "type": kind, "latch": True},
            {"op": "subscribe", "topic": topic, "type": kind, **subscribe},
            {"op": "subscribe", "topic": topic, "fragment_size": choose([1, 10, 10**6])},
            {"op": "unsubscribe", "topic": topic},
            {"op": "call_service", "service": service, "args": message, "timeout": 0.02},
            {"op": "advertise_service", "service": service, "type": kind},
            {"op": "unadvertise_service", "service": service},
            {"op": "service_response", "service": service, "values": message, "result": choose([True, False])},
            {**fragment, "id": choose(["f", "g", 7])},
            {"op": "png", "data": base64.b64encode(b"\x89PNG\r\n\x1a\n" + random.randbytes(30)).decode()},
            {"op": "set_level", "level": choose(["error", "warning", "info"])},
            {"op": "status", "level": "info", "msg": "text"},
            {"op": "auth", "mac": "", "client": "", "dest": "", "rand": "", "t": 0, "level": "", "end": 0},
        ]
    )
    return {**made, **identifier}


def restructured(random: Random, value: Any) -> Any:
    """A value with one place in it changed."""
    if isinstance(value, dict) and value and random.random() < 0.85:
        key = random.choice(list(value))
        how = random.random()
        if how < 0.6:
            return {**value, key: restructured(random, value[key])}
        if how < 0.75:
            return {name: each for name, each in value.items() if name != key}
        return {**value, random.choice([*value, "extra", "", "msg", "values", "id"]): random.choice(VALUES)}
    if isinstance(value, list) and value and random.random() < 0.7:
        index = random.randrange(len(value))
        return [*value[:index], restructured(random, value[index]), *value[index + 1 :]]
    if random.random() < 0.05:
        for _ in range(random.choice([5, 300, 3000])):
            value = [value]
        return value
    return random.choice(VALUES)


def damaged(random: Random, data: bytes) -> bytes:
    """Bytes with a few places changed, left out, doubled or cut."""
    changed = bytearray(data)
    for _ in range(random.choice([1, 1, 2, 5])):
        at = random.randrange(len(changed) + 1)
        length = random.choice([1, 1, 2, 4, 16])
        random.choice(_DAMAGES)(random, changed, at, length)
    return bytes(changed)


_DAMAGES: Sequence[Callable[[Random, bytearray, int, int], object]] = (
    lambda random, data, at, length: data.__setitem__(slice(at, at + length), random.randbytes(length)),
    lambda random, data, at, length: data.__setitem__(slice(at, at + length), b""),
    lambda random, data, at, length: data.__setitem__(slice(at, at), data[at : at + length]),
    lambda random, data, at, length: data.__setitem__(slice(at, at), b"\xff" * length),
    lambda random, data, at, length: data.__setitem__(slice(at, at + 4), struct.pack("<I", random.choice(_LENGTHS))),
    lambda random, data, at, length: data.__setitem__(slice(at, None), b""),
)
_LENGTHS = (0, 1, 3, 255, 65536, 2**24, 2**30, 2**31 - 1, 2**31, 2**32 - 1)


def _json(value: Any) -> bytes:
    try:
        return json.dumps(value).encode("utf-8", "surrogatepass")
    except (RecursionError, ValueError):
        return b"[" * 3000


def _cbor(value: Any) -> bytes:
    try:
        return cbor2.dumps(value)
    except (cbor2.CBOREncodeError, RecursionError, ValueError):
        return b"\x81" * 3000 + b"\x00"


def frame(random: Random) -> Tuple[bytes, bool]:
    """What a client sends, and whether it is a binary message."""
    value: Any = operation(random)
    for _ in range(random.choice([0, 1, 1, 2, 4])):
        value = restructured(random, value)
    binary = random.random() < 0.3
    data = _cbor(value) if binary else _json(value)
    if random.random() < 0.3:
        data = damaged(random, data)
    return data, binary


_HANDSHAKE = (
    b"GET /path HTTP/1.1\r\nHost: robot\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Extensions: permessage-deflate\r\nSec-WebSocket-Protocol: a, b\r\nOrigin: null\r\n\r\n"
)


def websocket_frame(random: Random) -> bytes:
    """One frame of a client: its header may be anything, its length may not be that of its body."""
    body, binary = frame(random)
    body = body[: random.choice([10, 125, 126, 65535, 65536, 10**6])]
    opcode = random.choice([1, 2, 2 if binary else 1, 0, 8, 9, 10, 3, 15])
    first = opcode | random.choice([0x80, 0x80, 0x80, 0, 0xC0, 0xF0])
    masked = random.choice([0x80, 0x80, 0x80, 0x80, 0])
    length = len(body) if random.random() < 0.8 else random.choice([0, 125, 126, 2**16, 2**31, 2**63 - 1, 2**63])
    if length < 126:
        head = struct.pack("!BB", first, masked | length)
    elif length < 65536:
        head = struct.pack("!BBH", first, masked | 126, length)
    else:
        head = struct.pack("!BBQ", first, masked | 127, length)
    return head + (bytes(4) if masked else b"") + body


def websocket_bytes(random: Random) -> bytes:
    """A handshake and some frames."""
    handshake = _HANDSHAKE if random.random() < 0.6 else damaged(random, _HANDSHAKE)
    stream = handshake + b"".join(websocket_frame(random) for _ in range(random.randrange(5)))
    return damaged(random, stream) if random.random() < 0.3 else stream


def connection_header(random: Random, **fields: str) -> bytes:
    """A TCPROS connection header that has most of these fields."""
    kept = {key: value for key, value in fields.items() if random.random() < 0.95}
    if kept and random.random() < 0.3:
        kept[random.choice(list(kept))] = random.choice(["", "*", "1", "x" * 5000, "a=b", "\x00", "ü"])
    lines = [f"{key}={value}".encode() for key, value in kept.items()]
    body = b"".join(struct.pack("<I", len(line)) + line for line in lines)
    header = struct.pack("<I", len(body)) + body
    return damaged(random, header) if random.random() < 0.4 else header


def wire_frames(random: Random, body: bytes) -> bytes:
    """Some messages as TCPROS carries them."""
    stream = b"".join(
        struct.pack("<I", len(each)) + each
        for each in (damaged(random, body) if random.random() < 0.5 else body for _ in range(random.randrange(6)))
    )
    return damaged(random, stream) if stream and random.random() < 0.3 else stream
