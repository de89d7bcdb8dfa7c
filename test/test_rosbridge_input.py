# SPDX-License-Identifier: BSD-3-Clause
"""What a client may send, and what it should not: fragments, PNG and CBOR coming in, levels, and bad input.

Whatever comes gets an error status, in linear time, and the connection goes on.
"""

from __future__ import annotations

import base64
import io
import itertools
import json
import time
import zlib
from typing import Any, Dict, List

import cbor2
import numpy
import png
import pytest

from support.bridge import Bridge
from support.client import Client

_numbers = itertools.count(1)
INT32, STRING = "std_msgs/Int32", "std_msgs/String"


def fresh(name: str = "input") -> str:
    return f"/{name}_{next(_numbers)}"


@pytest.fixture
def client(bridge: Bridge, connect) -> Client:
    return connect(bridge)


@pytest.fixture
def loop(client: Client) -> str:
    """A topic that the client publishes and receives."""
    topic = fresh()
    client.set_level("info")
    number = client.subscribe(topic, STRING)
    client.advertise(topic, STRING)
    client.wait_for(op="status", level="info", id=number)
    client.set_level("error")
    client.sync()
    client.statuses()
    return topic


def publication(topic: str, text: str = "hello") -> Dict[str, Any]:
    return {"op": "publish", "id": "wrapped", "topic": topic, "msg": {"data": text}}


def fragments(text: str, size: int, fragment_id: Any = "f") -> List[Dict[str, Any]]:
    parts = [text[at : at + size] for at in range(0, len(text), size)]
    return [
        {"op": "fragment", "id": fragment_id, "data": part, "num": number, "total": len(parts)}
        for number, part in enumerate(parts)
    ]


def image(text: bytes, **options: Any) -> str:
    """Base64 of a PNG image, one pixel high, whose pixels are the text."""
    options = {"greyscale": False, "bitdepth": 8, **options}
    planes = (1 if options["greyscale"] else 3) + bool(options.get("alpha"))
    padded = text + b"\n" * (-len(text) % planes)
    stream = io.BytesIO()
    png.Writer(len(padded) // planes, 1, **options).write(stream, [padded])
    return base64.b64encode(stream.getvalue()).decode()


def still_works(client: Client, topic: str) -> None:
    client.publish(topic, {"data": "still there"})
    client.wait_for(op="publish", topic=topic, msg={"data": "still there"})


# Fragments


@pytest.mark.parametrize("fragment_id", ["text", 7, 0, ""])
def test_fragments_in_order(client: Client, loop: str, fragment_id: Any):
    for part in fragments(json.dumps(publication(loop, "ä😀" * 30), ensure_ascii=False), 7, fragment_id):
        client.send(part)
    assert client.next_message(loop) == {"data": "ä😀" * 30}


def test_fragments_in_any_order_with_duplicates_and_mixed(client: Client, loop: str):
    one = fragments(json.dumps(publication(loop, "one")), 10, "one")
    two = fragments(json.dumps(publication(loop, "two")), 10, "two")
    for part in [*one[::2], *two[:0:-1], *one[:0:-1], *two[3:], *one[2:], two[0], one[0]]:
        client.send(part)
    assert {client.next_message(loop)["data"] for _ in range(2)} == {"one", "two"}


def test_a_single_fragment_is_a_message(client: Client, loop: str):
    client.send({"op": "fragment", "id": 1, "num": 0, "total": 1, "data": json.dumps(publication(loop))})
    assert client.next_message(loop) == {"data": "hello"}


def test_an_id_can_be_used_again(client: Client, loop: str):
    for number in range(3):
        for part in fragments(json.dumps(publication(loop, str(number))), 20, "again"):
            client.send(part)
        assert client.next_message(loop) == {"data": str(number)}


def test_an_operation_in_fragments_is_answered_with_its_own_id(client: Client):
    for part in fragments('{"op": "nonsense", "id": "inner"}', 5, "outer"):
        client.send(part)
    client.wait_for(op="status", level="error", id="inner")


@pytest.mark.parametrize(
    "change",
    [
        {"num": -1},
        {"num": 3},
        {"num": "0"},
        {"num": 0.5},
        {"num": True},
        {"num": None},
        {"total": 0},
        {"total": -1},
        {"total": "3"},
        {"total": 10**9},
        {"total": None},
        {"data": 5},
        {"data": None},
        {"data": ["x"]},
        {"data": {}},
        {"id": None},
        {"id": ["x"]},
        {"id": {}},
        {"id": True},
    ],
)
def test_a_bad_fragment_is_an_error(client: Client, loop: str, change: Dict[str, Any]):
    client.send({"op": "fragment", "id": "bad", "num": 0, "total": 3, "data": "x", **change})
    status = client.wait_for(op="status", level="error")
    assert status.get("id") == ("bad" if "id" not in change else None)
    still_works(client, loop)


def test_fragments_that_disagree_are_an_error(client: Client, loop: str):
    client.send({"op": "fragment", "id": "bad", "num": 0, "total": 3, "data": "x"})
    client.send({"op": "fragment", "id": "bad", "num": 1, "total": 2, "data": "x"})
    client.wait_for(op="status", level="error", id="bad")
    still_works(client, loop)


def test_fragments_of_nonsense_are_an_error(client: Client, loop: str):
    for part in fragments("this is not JSON at all", 5, "nonsense"):
        client.send(part)
    client.wait_for(op="status", level="error", id="nonsense")
    for part in fragments("[1, 2, 3]", 5, "list"):
        client.send(part)
    client.wait_for(op="status", level="error")
    still_works(client, loop)


def test_many_incomplete_messages_are_refused_in_the_end(client: Client, loop: str):
    for number in range(1000):
        client.send({"op": "fragment", "id": number, "num": 0, "total": 2, "data": "x" * 100})
    client.wait_for(op="status", level="error", id=999)
    still_works(client, loop)


def test_a_hundred_thousand_fragments(client: Client, loop: str):
    begin = time.monotonic()
    text = json.dumps(publication(loop, "x" * 100_000))
    for part in fragments(text, 5):
        client.send(part)
    assert client.next_message(loop, timeout=20) == {"data": "x" * 100_000}
    assert time.monotonic() - begin < 15


# PNG


def test_png_comes_in(client: Client, loop: str):
    text = json.dumps(publication(loop, "in a picture"))
    client.send({"op": "png", "data": image(text.encode())})
    assert client.next_message(loop) == {"data": "in a picture"}


@pytest.mark.parametrize("options", [{"alpha": True}, {"greyscale": True}, {"greyscale": True, "alpha": True}])
def test_png_of_any_channels(client: Client, loop: str, options: Dict[str, Any]):
    client.send({"op": "png", "data": image(json.dumps(publication(loop)).encode(), **options)})
    assert client.next_message(loop) == {"data": "hello"}


def test_png_in_fragments_of_its_own(client: Client, loop: str):
    for part in reversed(fragments(image(json.dumps(publication(loop)).encode()), 20, "picture")):
        client.send({**part, "op": "png"})
    assert client.next_message(loop) == {"data": "hello"}


def test_fragments_of_a_png_operation(client: Client, loop: str):
    text = json.dumps({"op": "png", "data": image(json.dumps(publication(loop)).encode())})
    for part in fragments(text, 20):
        client.send(part)
    assert client.next_message(loop) == {"data": "hello"}


def test_png_of_one_part_with_num_and_total_but_no_id(client: Client, loop: str):
    client.send({"op": "png", "num": 0, "total": 1, "data": image(json.dumps(publication(loop)).encode())})
    assert client.next_message(loop) == {"data": "hello"}


def corrupt_images() -> List[str]:
    good = base64.b64decode(image(b'{"op": "nonsense"}' * 20))
    found = [
        "",
        "not base64!",
        "ä",
        base64.b64encode(b"").decode(),
        base64.b64encode(b"GIF89a").decode(),
        base64.b64encode(good[:8]).decode(),
        base64.b64encode(good[: len(good) // 2]).decode(),
    ]
    for at in range(8, len(good), 3):
        found.append(base64.b64encode(good[:at] + bytes([good[at] ^ 0x55]) + good[at + 1 :]).decode())
    return found


def chunk(kind: bytes, data: bytes) -> bytes:
    return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")


def crafted_image(width: int, height: int, body: bytes, *, depth: int = 8, colour: int = 2, interlace: int = 0) -> str:
    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([depth, colour, 0, 0, interlace])
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
    return base64.b64encode(b"\x89PNG\r\n\x1a\n" + chunks).decode()


def test_corrupt_images_are_errors(client: Client, loop: str):
    for number, data in enumerate(corrupt_images()):
        client.send({"op": "png", "id": number, "data": data})
        client.wait_for(lambda message: message.get("level") == "error", op="status")
    still_works(client, loop)


@pytest.mark.parametrize(
    "data",
    [
        crafted_image(0, 1, zlib.compress(b"\0")),
        crafted_image(1, 0, zlib.compress(b"")),
        crafted_image(5, 5, zlib.compress(b"")),
        crafted_image(5, 5, b"no deflate stream"),
        crafted_image(5, 5, zlib.compress(b"\0" * 10)),
        crafted_image(1, 1, zlib.compress(b"\0" * 4), depth=3),
        crafted_image(1, 1, zlib.compress(b"\0" * 4), colour=9),
        crafted_image(1, 1, zlib.compress(b"\x09" * 4)),
        crafted_image(1, 1, zlib.compress(b"\0" * 4), colour=3),
        crafted_image(1, 1, zlib.compress(b"\0" * 4), interlace=1),
        crafted_image(2**31 - 1, 2**31 - 1, zlib.compress(b"\0" * 4)),
        crafted_image(2**31 - 1, 1, zlib.compress(b"\0" * 4), interlace=1),
    ],
)
def test_crafted_images_are_errors(client: Client, loop: str, data: str):
    begin = time.monotonic()
    client.send({"op": "png", "data": data})
    client.wait_for(op="status", level="error")
    assert time.monotonic() - begin < 2.0
    still_works(client, loop)


def test_an_image_that_unpacks_to_much_more_than_it_says_is_refused_before_it_does(client: Client, loop: str):
    body = zlib.compress(bytes(1 << 28), 1)
    for width, height, interlace in ((1, 1, 0), (1, 1, 1), (20000, 20000, 0), (100, 100, 0)):
        begin = time.monotonic()
        client.send({"op": "png", "data": crafted_image(width, height, body, interlace=interlace)})
        client.wait_for(op="status", level="error")
        assert time.monotonic() - begin < 0.5
    still_works(client, loop)


def test_pictures_in_pictures_in_pictures_are_refused(client: Client, loop: str):
    text = json.dumps(publication(loop))
    for _ in range(300):
        text = json.dumps({"op": "png", "data": image(text.encode(), compression=9)})
    begin = time.monotonic()
    client.send_frame(text)
    client.wait_for(op="status", level="error")
    assert time.monotonic() - begin < 2.0
    client.sync()
    assert client.statuses() == []
    still_works(client, loop)


# CBOR


def test_any_operation_may_come_as_cbor(client: Client):
    topic = fresh()
    client.set_level("info")
    for operation in (
        {"op": "subscribe", "topic": topic, "type": "std_msgs/Float32MultiArray"},
        {"op": "advertise", "topic": topic, "type": "std_msgs/Float32MultiArray"},
    ):
        client.send({**operation, "id": operation["op"]}, cbor=True)
        client.wait_for(op="status", level="info", id=operation["op"])
    values = numpy.array([1.5, 2.5], "<f4")
    tagged = cbor2.CBORTag(85, values.tobytes())
    layout = {"dim": [], "data_offset": 0}
    client.send({"op": "publish", "topic": topic, "msg": {"layout": layout, "data": tagged}}, cbor=True)
    assert client.next_message(topic)["data"] == [1.5, 2.5]
    client.send({"op": "unsubscribe", "topic": topic, "id": "subscribe"}, cbor=True)
    client.wait_for(op="status", level="info", id="subscribe")
    client.send({"op": "call_service", "service": "/no/such", "id": "call"}, cbor=True)
    assert client.wait_for(op="service_response", id="call")["result"] is False
    client.send({"op": "set_level", "level": "none"}, cbor=True)


def test_bytes_in_cbor_fill_byte_arrays(client: Client):
    topic = fresh()
    client.set_level("info")
    number = client.subscribe(topic, "rosbridge_library/TestUInt8", compression="cbor")
    client.advertise(topic, "rosbridge_library/TestUInt8")
    client.wait_for(op="status", level="info", id=number)
    client.send({"op": "publish", "topic": topic, "msg": {"data": b"\x00\xff"}}, cbor=True)
    client.publish(topic, {"data": base64.b64encode(b"\x01\x02").decode()})
    client.publish(topic, {"data": [3, 4]})
    assert [each["data"] for each in client.messages(topic, 3)] == [b"\x00\xff", b"\x01\x02", b"\x03\x04"]


@pytest.mark.parametrize(
    "identifier",
    [
        b"bytes",
        10**30,
        -(10**30),
        cbor2.undefined,
        cbor2.CBORSimpleValue(99),
        cbor2.CBORTag(85, b"\0" * 8),
        {"a": 1},
        [1],
        True,
    ],
)
def test_an_id_that_cannot_come_back_is_an_error(client: Client, loop: str, identifier: Any):
    fields = {"topic": loop, "service": "/x", "level": "info", "msg": {"data": "x"}}
    for op in ("subscribe", "call_service", "set_level", "auth", "nonsense", "publish"):
        client.send({"op": op, "id": identifier, **fields}, cbor=True)
        status = client.wait_for(op="status", level="error")
        assert "id" not in status
        assert "id" in status["msg"] or op == "nonsense"
    assert client.wait_for(op="service_response", result=False)["service"] == "/x"
    still_works(client, loop)


@pytest.mark.parametrize(
    "frame",
    [
        b"\xa1",
        b"\xbf",
        b"\xa1\x62op",
        b"\xa1\x62op\x7b\xff\xff\xff\xff\xff\xff\xff\xff",
        b"\xa1\x62op\x9b\x00\x00\xff\xff\xff\xff\xff\xff",
        b"\xba\xff\xff\xff\xff",
        b"\xa1\x81" * 200_000,
        b"\xa1\x62op" * 200_000,
        b"\xa1\x61a\xff",
        b"\xa1\x62op\x62\xff\xfe",
        cbor2.dumps({"op": "subscribe", "topic": "/x"}) + b"rest",
        cbor2.dumps({"op": b"subscribe"}),
        cbor2.dumps({"op": cbor2.undefined}),
        cbor2.dumps({1: 2, (3, 4): 5}),
        cbor2.dumps({"op": "publish", "topic": "/x", "msg": cbor2.CBORTag(28, [cbor2.CBORTag(29, 0)])}),
        cbor2.dumps(["op"]),
        cbor2.dumps("op"),
        b"\xd9\xd9\xf7",
        b"",
        b"\x00",
        b"\xff" * 1000,
    ],
)
def test_binary_frames_of_nonsense_are_errors(client: Client, loop: str, frame: bytes):
    client.send_frame(frame)
    client.wait_for(op="status", level="error")
    still_works(client, loop)


def test_json_in_a_binary_frame_is_json(client: Client, loop: str):
    client.send_frame(json.dumps(publication(loop)).encode())
    assert client.next_message(loop) == {"data": "hello"}


# Bad JSON


@pytest.mark.parametrize(
    "frame",
    [
        "",
        " ",
        "{",
        "}",
        "nonsense",
        '{"op": "subscribe"',
        '{"op": "subscribe",}',
        "{'op': 'subscribe'}",
        "null",
        "true",
        "5",
        '"op"',
        "[]",
        '[{"op": "subscribe"}]',
        "{}",
        '{"op": null}',
        '{"op": 5}',
        '{"op": ["subscribe"]}',
        '{"op": {}}',
        '{"op": ""}',
        '{"op": "nonsense"}',
        '{"op": "__init__"}',
        '{"OP": "subscribe"}',
        '{"receiver": "/topic", "msg": []}',
        '{"op": "\\ud800"}',
        '{"op": "\\ud800", "x": NaN}',
        '{"op": "x", "id": "\\udc00", "x": NaN}',
        '{"op": "x", "id": 99999999999999999999, "x": NaN}',
        '{"op": "x", "id": ' + "9" * 5000 + ', "x": NaN}',
        '{"op": "call_service", "service": "\\ud800", "x": NaN}',
        "\x00",
        "\ufeff{}",
        "{" * 1_000_000,
        "[" * 1_000_000,
        "[" * 1_000_000 + "NaN",
        '{"op":' * 500_000,
        '{"op":' + "[" * 500_000 + "]" * 500_000 + "}",
        '{"op":"publish","topic":"/x","msg":' + '{"a":' * 300 + "1" + "}" * 300 + "}",
        '{"a":NaN,"op":' + "[" * 900 + "]" * 900 + "}",
        '"' + "\\" * 1_000_000,
    ],
    ids=lambda frame: repr(frame[:30]),
)
def test_text_frames_of_nonsense_are_errors(client: Client, loop: str, frame: str):
    begin = time.monotonic()
    client.send_frame(frame)
    client.wait_for(op="status", level="error")
    assert time.monotonic() - begin < 2.0
    still_works(client, loop)


def test_half_a_character_is_an_error(client: Client, loop: str):
    from websockets.frames import Frame, Opcode

    for text in (b'{"op":"x\xc3"}', b"\xc3", b"\xed\xa0\x80", b"\xf0\x9f\x98", b"\xff\xfe", b"\x80", b"\xa1\x81"):
        protocol = client.connection.protocol
        with client.connection.protocol_mutex:
            data = Frame(Opcode.TEXT, text).serialize(mask=True, extensions=protocol.extensions)
            client.connection.socket.sendall(data)
        client.wait_for(op="status", level="error")
    still_works(client, loop)


def test_fifty_megabytes_are_taken(client: Client, loop: str):
    begin = time.monotonic()
    text = "x" * 50_000_000
    client.publish(loop, {"data": text})
    assert client.next_message(loop, timeout=30) == {"data": text}
    client.send_frame("x" * 50_000_000)
    status = client.wait_for(op="status", level="error", timeout=10)
    assert len(status["msg"]) < 1000
    assert time.monotonic() - begin < 20
    still_works(client, loop)


@pytest.mark.parametrize("field", ["op", "topic", "type", "service", "compression", "level", "msg"])
def test_an_error_about_ten_megabytes_is_short(client: Client, loop: str, field: str):
    huge = "x" * 10_000_000
    operation = {
        "op": {"service": "call_service", "level": "set_level", "type": "advertise", "msg": "publish"}.get(
            field, "subscribe"
        ),
        "topic": loop,
        "type": INT32,
        field: huge,
    }
    client.send(operation)
    status = client.wait_for(op="status", level="error")
    assert len(status["msg"]) < 2000
    still_works(client, loop)


def test_every_field_of_every_operation_with_every_wrong_type(client: Client, loop: str):
    """Each gets an answer, and none an internal error."""
    operations = [
        {"op": "advertise", "topic": loop, "type": STRING, "latch": False, "queue_size": 1},
        {"op": "unadvertise", "topic": loop},
        {"op": "publish", "topic": loop, "msg": {"data": "x"}},
        {"op": "subscribe", "topic": loop, "type": STRING, "throttle_rate": 0, "queue_length": 0, "fragment_size": 9},
        {"op": "unsubscribe", "topic": loop},
        {"op": "call_service", "service": "/x", "args": [], "type": "a/b", "timeout": 1.0, "fragment_size": 5},
        {"op": "advertise_service", "service": "/x", "type": "std_srvs/Empty"},
        {"op": "unadvertise_service", "service": "/x"},
        {"op": "service_response", "service": "/x", "values": {}, "result": True, "id": "y"},
        {"op": "set_level", "level": "info"},
        {"op": "fragment", "id": "x", "data": "x", "num": 0, "total": 2},
        {"op": "png", "data": "x", "num": 0, "total": 2},
    ]
    wrong = [5.5, "text", -7, True, ["list"], {"object": 1}, "", 2**63, 1e308]
    mandatory = ("topic", "type", "service", "level", "data", "num", "total")
    sent = 0
    for operation in operations:
        for field in operation:
            for value in wrong:
                if field == "op" or type(value) is type(operation[field]):
                    continue
                sent += 1
                client.send({"id": f"wrong-{sent}", **operation, field: value})
        for field in set(operation) & set(mandatory):
            client.send({name: value for name, value in operation.items() if name != field})
    client.set_level("error")
    client.sync()
    assert sent > 150
    statuses = [message["msg"] for message in client.take(op="status")]
    assert [text for text in statuses if "internal" in text] == []
    other = fresh()
    client.subscribe(other, STRING)
    client.advertise(other, STRING)
    client.publish(other, {"data": "still there"})
    assert client.next_message(other) == {"data": "still there"}


# Levels


def test_the_default_level_is_error(client: Client):
    topic = fresh()
    client.advertise(topic, "geometry_msgs/Point")  # info
    client.publish(topic, {"x": 1})  # warning
    client.send({"op": "unadvertise", "topic": "/never"})  # warning
    number = client.publish(topic, {"x": "text"})  # error
    status = client.wait_for(op="status")
    assert (status["level"], status["id"]) == ("error", number)
    client.sync()
    assert client.statuses() == []


@pytest.mark.parametrize(
    ("level", "expected"),
    [
        ("none", []),
        ("error", ["error"]),
        ("warning", ["warning", "error"]),
        ("info", ["info", "warning", "info", "error"]),
    ],
)
@pytest.mark.parametrize("op", ["set_level", "set_status_level"])
def test_levels(client: Client, level: str, expected: List[str], op: str):
    topic = fresh()
    client.send({"op": op, "level": level})
    client.advertise(topic, "geometry_msgs/Point")
    client.publish(topic, {"x": 1})
    client.advertise(topic, "geometry_msgs/Point")
    client.publish(topic, {"x": "text"})
    client.send({"op": "set_level", "level": "error"})
    client.sync()
    statuses = [message["level"] for message in client.take(op="status") if "level is now" not in message["msg"]]
    assert statuses == expected


@pytest.mark.parametrize("level", ["debug", "ERROR", "", None, 5, ["info"], {}])
def test_a_bad_level_changes_nothing(client: Client, level: Any):
    client.send({"op": "set_level", "level": level, "id": "bad"})
    client.wait_for(op="status", level="error", id="bad")
    client.send({"op": "unadvertise", "topic": "/never"})
    client.sync()
    assert client.statuses() == []


def test_a_status_message_has_level_msg_and_the_id_if_there_was_one(client: Client):
    client.send({"op": "nonsense"})
    status = client.wait_for(op="status")
    assert set(status) == {"op", "level", "msg"}
    for identifier in ("text", 7, 0, "", 1.5, -3):
        client.send({"op": "nonsense", "id": identifier})
        status = client.wait_for(op="status")
        assert status["id"] == identifier
        assert set(status) == {"op", "level", "msg", "id"}
        assert "nonsense" in status["msg"]


def test_status_from_a_client_is_taken(client: Client):
    for message in (
        {"level": "info", "msg": "hello"},
        {"level": ["x"], "msg": 5},
        {},
        {"level": "error", "msg": "x" * 10**6},
    ):
        client.send({"op": "status", **message})
    client.sync()
    assert client.statuses() == []


def test_auth_is_accepted_while_authentication_is_off(client: Client, loop: str):
    client.send({"op": "auth", "mac": "x", "client": "x", "dest": "x", "rand": "x", "t": 1, "level": "admin", "end": 2})
    client.send({"op": "auth"})
    client.sync()
    assert client.statuses() == []
    still_works(client, loop)


def test_operations_are_handled_in_the_order_they_came(client: Client):
    """Though some wait for the master and some don't."""
    client.set_level("info")
    client.sync()
    client.statuses()
    ids = []
    for _ in range(50):
        topic = fresh("order")
        ids.append(client.advertise(topic, STRING))
        client.send({"op": "nonsense", "id": topic})
        ids.append(topic)
    client.sync()
    assert [status["id"] for status in client.statuses()] == ids


def test_thousands_of_operations_behind_a_slow_one(client: Client, loop: str):
    topic = fresh("behind")
    client.subscribe(topic, INT32)
    client.advertise(topic, INT32, queue_size=5000)
    for number in range(3000):
        client.publish(topic, {"data": number})
    assert [each["data"] for each in client.messages(topic, 3000)] == list(range(3000))
