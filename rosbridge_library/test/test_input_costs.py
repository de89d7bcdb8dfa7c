# SPDX-License-Identifier: BSD-3-Clause
"""No input costs more than linear time or memory, whatever a client sends to a protocol.

Time is that of this thread's processor, the least of three runs, so that other work on the machine does not count.
Eight times the input may take 24 times as long: quadratic time would be 64 times.
"""

from __future__ import annotations

import asyncio
import base64
import gc
import json
import logging
import time
import tracemalloc
import zlib
from types import SimpleNamespace
from typing import Any, Callable, Dict, List, Sequence, Union

import pytest

from rosbridge_library.capabilities.defragmentation import MAX_INCOMPLETE_MESSAGES
from rosbridge_library.rosbridge_protocol import RosbridgeProtocol

Frame = Union[str, bytes]
SMALL = 20_000
FACTOR = 8
MIB = 1 << 20


class Quiet(RosbridgeProtocol):
    """Counts what goes out."""

    def __init__(self, parameters: Dict[str, Any]) -> None:
        node: Any = SimpleNamespace(loop=asyncio.get_running_loop())
        super().__init__("client", parameters, node=node)
        self.statuses: List[str] = []

    def outgoing(self, message: Frame) -> None:
        self.statuses.append(str(message))


def seconds(frames: Sequence[Frame]) -> float:
    """What a new protocol takes for these."""

    async def main() -> float:
        protocol = Quiet({})
        begin = time.thread_time()
        for frame in frames:
            protocol.incoming(frame)
        took = time.thread_time() - begin
        protocol.finish()
        return took

    return asyncio.run(main())


def fragment(num: int, total: int, data: str = "x", name: str = "f") -> bytes:
    return json.dumps({"op": "fragment", "id": name, "num": num, "total": total, "data": data}).encode()


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")


def png_operation(size: int) -> bytes:
    head = b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", (size).to_bytes(4, "big") + b"\0\0\0\1\x08\x02\0\0\0")
    image = head + png_chunk(b"IDAT", zlib.compress(bytes(3 * size + 1))) + png_chunk(b"IEND", b"")
    return json.dumps({"op": "png", "data": base64.b64encode(image).decode()}).encode()


@pytest.fixture(autouse=True)
def _unlogged(monkeypatch: pytest.MonkeyPatch) -> None:
    """pytest keeps all that is logged, which would be taken for memory of the protocol's."""
    monkeypatch.setattr(logging.getLogger("rosbridge.protocol"), "disabled", True)


INPUTS: Dict[str, Callable[[int], Sequence[Frame]]] = {
    "nested arrays": lambda n: [b"[" * n],
    "nested arrays, closed": lambda n: [b"[" * n + b"]" * n],
    "nested objects": lambda n: [b'{"op":' * n],
    "nesting for the other parser": lambda n: [b"[NaN," * n],
    "bare tokens": lambda n: [b'{"op":"x","a":[' + b"NaN," * n + b"1]}"],
    "nested CBOR arrays": lambda n: [b"\xa1\x62op" + b"\x81" * n],
    "nested CBOR maps": lambda n: [b"\xa1\x62op" + b"\xa1\x61a" * n],
    "endless CBOR arrays": lambda n: [b"\xa1\x62op" + b"\x9f" * n],
    "CBOR string in pieces": lambda n: [b"\xa1\x62op\x7f" + b"\x61a" * n + b"\xff"],
    "CBOR typed array of nothing": lambda n: [b"\xa1\x62op" + b"\xd8\x41" * n],
    "a long opcode": lambda n: [b'{"op":"%b"}' % (b"x" * 20 * n)],
    "a long id": lambda n: [b'{"op":"set_level","level":7,"id":"%b"}' % (b"x" * 20 * n)],
    "a long text that is not UTF-8": lambda n: [b'{"op":"' + b"\xff" * 20 * n],
    "a long number": lambda n: [b'{"op":"x","a":' + b"7" * 20 * n + b"}"],
    "a long number for the other parser": lambda n: [b'{"op":"x","b":NaN,"a":' + b"7" * 20 * n + b"}"],
    "a long fraction for the other parser": lambda n: [b'{"op":"x","b":NaN,"a":0.' + b"7" * 20 * n + b"}"],
    "half surrogate pairs": lambda n: [b'{"op":"x","b":NaN,"a":"' + b"\\ud800" * n + b'"}'],
    "many keys": lambda n: [json.dumps({"op": "x", **{str(i): i for i in range(n)}}).encode()],
    "one key, many times": lambda n: [b'{"a":1,' * 0 + b"{" + b'"a":1,' * n + b'"op":"x"}'],
    "many small messages": lambda n: [b"{}"] * (n // 10),
    "many fragments": lambda n: [fragment(i, n // 10) for i in range(n // 10)],
    "many fragments, the last ones first": lambda n: [fragment(i, n // 10) for i in reversed(range(n // 10))],
    "fragments that never complete": lambda n: [fragment(i, 10**6) for i in range(n // 10)],
    "one fragment, many times": lambda n: [fragment(0, 10**6, "x" * 50)] * (n // 10),
    "fragments of many messages": lambda n: [fragment(0, 2, name=str(i)) for i in range(n // 10)],
    "a large fragment": lambda n: [fragment(0, 2, "x" * 20 * n), fragment(1, 2)],
    "a picture": lambda n: [png_operation(10 * n)],
    "a picture that is none": lambda n: [b'{"op":"png","data":"%b"}' % (b"A" * 20 * n)],
}


@pytest.mark.parametrize("name", INPUTS)
def test_time_is_linear(name: str) -> None:
    small, large = INPUTS[name](SMALL), INPUTS[name](SMALL * FACTOR)
    little = min(seconds(small) for _ in range(3))
    much = min(seconds(large) for _ in range(3))
    floor_s = 0.002  # below which the clock and the first status count more than the input
    assert much < 3 * FACTOR * max(little, floor_s), f"{little:.4f} s, and for {FACTOR} times as much {much:.4f} s"


@pytest.mark.parametrize(
    "name", ["nested arrays", "nested CBOR arrays", "endless CBOR arrays", "many keys", "a long opcode", "a long id"]
)
def test_memory_is_linear_and_given_back(name: str) -> None:
    frames = INPUTS[name](SMALL * FACTOR)
    size = sum(map(len, frames))

    async def main() -> None:
        protocol = Quiet({})
        protocol.incoming(b"{}")
        gc.collect()
        tracemalloc.start()
        try:
            before, _ = tracemalloc.get_traced_memory()
            for frame in frames:
                protocol.incoming(frame)
            protocol.statuses.clear()
            after, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak - before < 40 * size + MIB
        assert after - before < 0.2 * MIB
        protocol.finish()

    asyncio.run(main())


@pytest.mark.parametrize("count", [0xFF, 0xFFFFFFFF, 2**63])
@pytest.mark.parametrize("kind", [b"\x5b", b"\x7b", b"\x9b", b"\xbb"])
def test_a_length_in_cbor_that_nothing_follows_costs_no_memory(kind: bytes, count: int) -> None:
    async def main() -> None:
        protocol = Quiet({})
        protocol.incoming(b"{}")
        tracemalloc.start()
        try:
            protocol.incoming(b"\xa1\x62op" + kind + count.to_bytes(8, "big"))
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak < 4 * MIB
        assert "Not CBOR" in protocol.statuses[-1]
        protocol.finish()

    asyncio.run(main())


def test_fragments_that_never_complete_are_bounded_in_number_and_bytes_and_freed_at_the_end() -> None:
    async def main() -> None:
        protocol = Quiet({"max_incoming_size": 4 * MIB})
        protocol.incoming(b"{}")
        gc.collect()
        tracemalloc.start()
        try:
            before, _ = tracemalloc.get_traced_memory()
            for number in range(400):
                protocol.incoming(fragment(0, 2, "x" * 100_000, name=str(number)))
            for number in range(1000):
                protocol.incoming(fragment(0, 2, "x", name=f"small {number}"))
            held, peak = tracemalloc.get_traced_memory()
            said = protocol.statuses[:]
            protocol.statuses.clear()
            protocol.finish()
            gc.collect()
            left, _ = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert 2 * MIB < held - before < 6 * MIB
        assert peak - before < 8 * MIB
        assert any("incomplete messages of more than" in each for each in said)
        assert any(f"more than {MAX_INCOMPLETE_MESSAGES} messages are incomplete" in each for each in said)
        assert left - before < MIB

    asyncio.run(main())


def test_fragments_that_stop_coming_are_given_up_in_time_and_told() -> None:
    async def main() -> None:
        protocol = Quiet({"fragment_timeout": 0.2})
        begin = time.monotonic()
        protocol.incoming(fragment(0, 3, name="late"))
        await asyncio.sleep(0.1)
        protocol.incoming(fragment(1, 3, name="late"))  # the time counts from the last one
        while not protocol.statuses:
            assert time.monotonic() - begin < 5
            await asyncio.sleep(0.01)
        assert 0.3 <= time.monotonic() - begin < 2
        assert "only 2 of 3 fragments came in time" in protocol.statuses[0]
        protocol.incoming(fragment(2, 3, name="late"))  # begins anew
        assert len(protocol.statuses) == 1
        protocol.finish()

    asyncio.run(main())
