# SPDX-License-Identifier: BSD-3-Clause
"""WebSocket framing: what the server writes, and what it reads, in whatever pieces it comes."""

from __future__ import annotations

import contextlib
import itertools
import struct
import time
from typing import List, Tuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosbridge_library.payload import Payload
from rosbridge_server.framing import (
    BINARY,
    CLOSE,
    CONTINUATION,
    MESSAGE_TOO_BIG,
    PING,
    PONG,
    PROTOCOL_ERROR,
    TEXT,
    FrameError,
    FrameReader,
    Message,
    websocket_frame,
)

MASK = bytes((0x12, 0xF0, 0x00, 0xA5))


def client_frame(
    opcode: int, body: bytes, *, final: bool = True, bits: int = 0, mask: bytes = MASK, form: int = 0
) -> bytes:
    """A masked frame, its length written in the shortest form or in `form` bytes (2 or 8)."""
    first = (0x80 if final else 0) | bits | opcode
    if form == 8 or len(body) > 65535:
        header = struct.pack("!BBQ", first, 0x80 | 127, len(body))
    elif form == 2 or len(body) > 125:
        header = struct.pack("!BBH", first, 0x80 | 126, len(body))
    else:
        header = bytes((first, 0x80 | len(body)))
    return header + mask + bytes(byte ^ key for byte, key in zip(body, itertools.cycle(mask)))


def read(reader: FrameReader, *pieces: bytes) -> List[Tuple[int, bytes]]:
    return [(message.opcode, message.data) for piece in pieces for message in reader.feed(piece)]


@pytest.mark.parametrize("size", [0, 1, 125, 126, 127, 16384, 16385, 65535, 65536, 1 << 20])
@pytest.mark.parametrize("binary", [False, True])
def test_outgoing_frame(size: int, binary: bool) -> None:
    body = bytes(i % 251 for i in range(size))
    frame = b"".join(websocket_frame(Payload([body[: size // 3], memoryview(body)[size // 3 :]], binary)))
    if size < 126:
        header = struct.pack("!BB", 0x82 if binary else 0x81, size)
    elif size < 65536:
        header = struct.pack("!BBH", 0x82 if binary else 0x81, 126, size)
    else:
        header = struct.pack("!BBQ", 0x82 if binary else 0x81, 127, size)
    assert frame == header + body


def test_a_large_part_is_not_copied_and_a_frame_is_shared() -> None:
    body = bytes(1 << 20)
    payload = Payload([b"head", body])
    frame = payload.framed(websocket_frame)
    assert frame[-1] is body
    assert payload.framed(websocket_frame) is frame


messages = st.tuples(st.sampled_from([TEXT, BINARY]), st.binary(max_size=300) | st.just(b"x" * 70000))


@given(st.lists(messages, max_size=6), st.data())
@settings(deadline=None)
def test_messages_come_out_however_they_are_cut(sent: List[Tuple[int, bytes]], data: st.DataObject) -> None:
    """Messages in one frame or several, with pings between, and the stream cut anywhere."""
    stream = b""
    pings = 0
    for opcode, body in sent:
        cuts = sorted(data.draw(st.lists(st.integers(0, len(body)), max_size=3)))
        bounds = [0, *cuts, len(body)]
        for index, (start, end) in enumerate(zip(bounds, bounds[1:])):
            if index and data.draw(st.booleans()):
                stream += client_frame(PING, b"?")
                pings += 1
            first, last = index == 0, index == len(bounds) - 2
            stream += client_frame(opcode if first else CONTINUATION, body[start:end], final=last)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    reader = FrameReader()
    got = read(reader, *(stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)])))
    assert [message for message in got if message[0] != PING] == sent
    assert got.count((PING, b"?")) == pings


@given(st.binary(max_size=200), st.booleans(), st.integers(0, 50))
def test_any_bytes_give_messages_or_a_frame_error(stream: bytes, extensions: bool, limit: int) -> None:
    reader = FrameReader(limit, extensions)
    got: List[Message] = []
    with contextlib.suppress(FrameError):
        for piece in (stream[:7], stream[7:]):
            got += reader.feed(piece)
    assert all(len(message.data) <= max(limit, 125) for message in got)


def test_one_byte_at_a_time() -> None:
    stream = client_frame(TEXT, b"hello") + client_frame(BINARY, b"y" * 300) + client_frame(CLOSE, b"\x03\xe8")
    got = read(FrameReader(), *(stream[i : i + 1] for i in range(len(stream))))
    assert got == [(TEXT, b"hello"), (BINARY, b"y" * 300), (CLOSE, b"\x03\xe8")]


@pytest.mark.parametrize("form", [2, 8])
def test_a_length_in_a_longer_form_than_needed_is_read(form: int) -> None:
    assert read(FrameReader(), client_frame(TEXT, b"", form=form) + client_frame(TEXT, b"a", form=form)) == [
        (TEXT, b""),
        (TEXT, b"a"),
    ]


def test_text_is_not_decoded() -> None:
    assert read(FrameReader(), client_frame(TEXT, b"\xff\xc3")) == [(TEXT, b"\xff\xc3")]


def test_compressed_messages_are_marked_when_compression_was_negotiated() -> None:
    reader = FrameReader(extensions=True)
    stream = (
        client_frame(TEXT, b"a", bits=0x40, final=False)
        + client_frame(CONTINUATION, b"b")
        + client_frame(TEXT, b"c")
        + client_frame(BINARY, b"d", bits=0x40)
    )
    assert list(reader.feed(stream)) == [
        Message(TEXT, b"ab", True),
        Message(TEXT, b"c", False),
        Message(BINARY, b"d", True),
    ]


@pytest.mark.parametrize(
    "stream",
    [
        pytest.param(b"\x81\x05hello", id="not masked"),
        pytest.param(client_frame(TEXT, b"", bits=0x40), id="compressed without extension"),
        pytest.param(client_frame(TEXT, b"", bits=0x20), id="reserved bit 2"),
        pytest.param(client_frame(TEXT, b"", bits=0x10, form=8), id="reserved bit 3, long form"),
        pytest.param(client_frame(3, b""), id="unknown data opcode"),
        pytest.param(client_frame(11, b""), id="unknown control opcode"),
        pytest.param(client_frame(PING, b"", final=False), id="fragmented ping"),
        pytest.param(client_frame(PING, b"x" * 126), id="long ping"),
        pytest.param(client_frame(CONTINUATION, b""), id="continuation of nothing"),
        pytest.param(client_frame(TEXT, b"", final=False) + client_frame(TEXT, b""), id="message inside another"),
        pytest.param(client_frame(PONG, b"", bits=0x40), id="compressed pong"),
    ],
)
def test_broken_framing_is_refused(stream: bytes) -> None:
    with pytest.raises(FrameError) as error:
        read(FrameReader(), stream)
    assert error.value.code == PROTOCOL_ERROR


def test_the_limit_holds_for_a_frame_and_for_their_sum_before_the_data_is_there() -> None:
    assert read(FrameReader(10), client_frame(TEXT, b"x" * 10)) == [(TEXT, b"x" * 10)]
    announced = client_frame(TEXT, b"x" * 200)[:8]
    with pytest.raises(FrameError) as error:
        read(FrameReader(100), announced)
    assert error.value.code == MESSAGE_TOO_BIG
    reader = FrameReader(100)
    assert read(reader, client_frame(TEXT, b"x" * 60, final=False)) == []
    assert read(reader, client_frame(PING, b"x" * 60)) == [(PING, b"x" * 60)]
    with pytest.raises(FrameError) as error:
        read(reader, client_frame(CONTINUATION, b"x" * 41))
    assert error.value.code == MESSAGE_TOO_BIG


def test_an_enormous_length_costs_nothing() -> None:
    with pytest.raises(FrameError) as error:
        read(FrameReader(1 << 28), b"\x82\xff" + b"\xff" * 8 + MASK)
    assert error.value.code == MESSAGE_TOO_BIG


def test_a_piece_costs_the_same_however_much_of_its_message_is_there() -> None:
    """The last 2000 pieces of 32000 cost what the first 2000 do; if each copied what is there, it would be 31 times."""
    reader = FrameReader()
    piece = bytes(1000)
    assert read(reader, struct.pack("!BBQ", 0x82, 0xFF, 32_000_000) + bytes(4)) == []
    times = []
    for _ in range(16):
        begin = time.process_time()
        for _ in range(2000 if len(times) < 15 else 1999):
            assert not list(reader.feed(piece))
        times.append(time.process_time() - begin)
    assert read(reader, piece) == [(BINARY, bytes(32_000_000))]
    assert min(times[12:]) < 5 * max(times[:4]), times
