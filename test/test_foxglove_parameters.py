# SPDX-License-Identifier: BSD-3-Clause
"""The bridge under Foxglove clients: parameters."""

from __future__ import annotations

import base64
import datetime
import math
import urllib.request
import xmlrpc.client
from typing import Any, Callable, Dict

import pytest

from support.bridge import Bridge
from support.foxglove import Foxglove
from support.peer import Peer
from support.ros import RosMaster

NESTED = {"list": [1, "two", 3.5, [True]], "map": {"deep": {"deeper": "x"}}, "empty": []}


@pytest.mark.parametrize(
    ("value", "entry"),
    [
        (5, {"value": 5}),
        (True, {"value": True}),
        ("text", {"value": "text"}),
        ("", {"value": ""}),
        (2.5, {"value": 2.5, "type": "float64"}),
        (3.0, {"value": 3.0, "type": "float64"}),
        ([1, 2], {"value": [1, 2]}),
        ([1.0, 2.5], {"value": [1.0, 2.5], "type": "float64_array"}),
        ([1, 2.5], {"value": [1, 2.5]}),
        ([], {"value": []}),
        (["a", "b"], {"value": ["a", "b"]}),
        (NESTED, {"value": NESTED}),
        (xmlrpc.client.Binary(b"ABC"), {"value": "QUJD", "type": "byte_array"}),
        ([xmlrpc.client.Binary(b"ABC")], {"value": ["QUJD"]}),
        (datetime.datetime(2020, 1, 2, 3, 4, 5), {"value": "2020-01-02T03:04:05"}),
        (math.nan, {"value": None}),
        ([1.5, math.inf], {"value": [1.5, None]}),
    ],
)
def test_every_kind_of_value_can_be_read(
    foxglove: Foxglove, ros_master: RosMaster, value: Any, entry: Dict[str, Any]
) -> None:
    ros_master.set_param("/read/it", value)
    assert foxglove.get_parameters("/read/it") == {"/read/it": {"name": "/read/it", **entry}}
    if isinstance(value, dict):
        assert foxglove.get_parameters("/read/it/map/deep/deeper")["/read/it/map/deep/deeper"]["value"] == "x"
    ros_master.call("deleteParam", "/read")


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ({"value": 5}, 5),
        ({"value": -(2**31)}, -(2**31)),
        ({"value": False}, False),
        ({"value": "text"}, "text"),
        ({"value": 2.5}, 2.5),
        ({"value": 3, "type": "float64"}, 3.0),
        ({"value": 2**40, "type": "float64"}, float(2**40)),
        ({"value": [1.1, 2, 3.3], "type": "float64_array"}, [1.1, 2.0, 3.3]),
        ({"value": [], "type": "float64_array"}, []),
        ({"value": [1, 2]}, [1, 2]),
        ({"value": ["a"]}, ["a"]),
        ({"value": NESTED}, NESTED),
    ],
)
def test_every_kind_of_value_can_be_set(
    foxglove: Foxglove, ros_master: RosMaster, entry: Dict[str, Any], value: Any
) -> None:
    answer = foxglove.set_parameters({"name": "/set/it", **entry})
    assert answer["/set/it"]["value"] == entry["value"]
    found = ros_master.get_param("/set/it")
    assert found == value
    assert type(found) is type(value)
    ros_master.call("deleteParam", "/set")


def test_bytes_there_and_back(foxglove: Foxglove, ros_master: RosMaster) -> None:
    data = bytes(range(256))
    entry = {"name": "/set/bytes", "value": base64.b64encode(data).decode(), "type": "byte_array"}
    assert foxglove.set_parameters(entry) == {"/set/bytes": entry}
    assert ros_master.get_param("/set/bytes").data == data


def test_all_parameters_are_those_that_are_set(foxglove: Foxglove, ros_master: RosMaster) -> None:
    ros_master.set_param("/all/a", {"b": 1, "c": {"d": [2]}})
    found = foxglove.get_parameters()
    assert set(found) == set(ros_master.call("getParamNames"))
    assert found["/all/a/c/d"] == {"name": "/all/a/c/d", "value": [2]}


def test_what_is_not_set_has_no_value(foxglove: Foxglove, ros_master: RosMaster) -> None:
    assert foxglove.get_parameters("/not/set", "/rosbridge_websocket/port") == {
        "/not/set": {"name": "/not/set"},
        "/rosbridge_websocket/port": {"name": "/rosbridge_websocket/port", "value": 0},
    }
    ros_master.set_param("/unset/it", 1)
    assert foxglove.set_parameters({"name": "/unset/it"}) == {"/unset/it": {"name": "/unset/it"}}
    assert ros_master.get_param("/unset/it") is None
    assert foxglove.set_parameters({"name": "/unset/it", "value": None}) == {"/unset/it": {"name": "/unset/it"}}
    assert not foxglove.statuses


def test_without_an_id_setting_has_no_answer(foxglove: Foxglove, ros_master: RosMaster) -> None:
    foxglove.send("setParameters", parameters=[{"name": "/set/silently", "value": 1}])
    assert foxglove.get_parameters("/set/silently")["/set/silently"]["value"] == 1
    foxglove.send("getParameters", parameterNames=["/set/silently"])
    foxglove.wait(lambda: len(foxglove.values) == 2, "an answer")
    assert "id" not in foxglove.values[1]


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ({"value": 5}, "'name' is missing"),
        ({"name": 5, "value": 5}, "'name' must be a string"),
        ({"name": "", "value": 5}, "not a legal name"),
        ({"name": "/", "value": {}}, "not a legal name"),
        ({"name": "/not legal", "value": 5}, "not a legal name"),
        ({"name": "/bad", "value": 2**31}, "integers of 32 bits only"),
        ({"name": "/bad", "value": [1, None]}, "can't hold null"),
        ({"name": "/bad", "value": {"a": None}}, "can't hold null"),
        ({"name": "/bad", "value": {"a/b": 1}}, "keys"),
        ({"name": "/bad", "value": {"": 1}}, "keys"),
        ({"name": "/bad", "value": "\0"}, "control characters"),
        ({"name": "/bad", "value": 1, "type": "int32"}, "'type' must be one of"),
        ({"name": "/bad", "value": 1, "type": ["float64"]}, "'type' must be one of"),
        ({"name": "/bad", "value": "1", "type": "float64"}, "a float64 must be a number"),
        ({"name": "/bad", "value": True, "type": "float64"}, "a float64 must be a number"),
        ({"name": "/bad", "value": 1.5, "type": "float64_array"}, "must be a list"),
        ({"name": "/bad", "value": [1, "a"], "type": "float64_array"}, "a float64 must be a number"),
        ({"name": "/bad", "value": "no base 64", "type": "byte_array"}, "must be base64"),
        ({"name": "/bad", "value": 5, "type": "byte_array"}, "must be base64"),
    ],
)
def test_what_cannot_be_set_is_told_and_hinders_nothing_else(
    foxglove: Foxglove, ros_master: RosMaster, entry: Dict[str, Any], told: str
) -> None:
    answer = foxglove.set_parameters(entry, {"name": "/set/good", "value": "good"})
    assert answer["/set/good"]["value"] == "good"
    assert "value" not in answer.get("/bad", {})
    assert len(foxglove.statuses) == 1
    assert foxglove.statuses[0]["level"] == 2
    assert told in foxglove.statuses[0]["message"]
    assert ros_master.get_param("/bad") is None


def test_a_value_that_is_nested_without_end_is_refused(foxglove: Foxglove) -> None:
    value: Any = 1
    for _ in range(100):
        value = [value]
    foxglove.set_parameters({"name": "/bad", "value": value})
    assert "nested deeper than 64" in foxglove.statuses[0]["message"]


def test_a_value_that_the_master_cannot_write_spoils_no_other(foxglove: Foxglove, ros_master: RosMaster) -> None:
    """The master takes integers of 64 bits, and then fails to write them."""
    body = xmlrpc.client.dumps(("/test", "/odd/large", 1), "setParam").replace("<int>1</int>", "<i8>5000000000</i8>")
    urllib.request.urlopen(ros_master.uri, body.encode(), 5).read()
    try:
        ros_master.set_param("/odd/sound", 7)
        found = foxglove.get_parameters()
        assert found["/odd/sound"]["value"] == 7
        assert "/odd/large" not in found
        assert foxglove.get_parameters("/odd/large", "/odd/sound")["/odd/sound"]["value"] == 7
    finally:
        ros_master.call("deleteParam", "/odd")


def test_changes_are_told_to_those_who_subscribed(foxglove: Foxglove, bridge: Bridge, ros_master: RosMaster) -> None:
    ros_master.set_param("/watched/a", 1)
    other = Foxglove(bridge.url)
    try:
        for client in (foxglove, other):
            client.send("subscribeParameterUpdates", parameterNames=["/watched/a", "/watched/later"])
            client.send("subscribeParameterUpdates", parameterNames=["/watched/a"])
            client.get_parameters("/rosdistro")  # all before it is handled by now
            del client.values[:]
        ros_master.set_param("/watched/a", 2.0)  # by a node
        foxglove.set_parameters({"name": "/watched/later", "value": "set by a client"})
        ros_master.set_param("/watched/other", 1)
        ros_master.call("deleteParam", "/watched/a")
        expected = [
            {"name": "/watched/a", "value": 2.0, "type": "float64"},
            {"name": "/watched/later", "value": "set by a client"},
            {"name": "/watched/a"},
        ]
        for client in (foxglove, other):
            client.wait(lambda client=client: len(told(client)) == 3, "three changes")
            assert told(client) == expected
        foxglove.send("unsubscribeParameterUpdates", parameterNames=["/watched/later"])
        foxglove.get_parameters("/rosdistro")
        ros_master.set_param("/watched/later", 5)
        ros_master.set_param("/watched/a", 6)
        other.wait(lambda: len(told(other)) == 5, "two more")
        foxglove.wait(lambda: told(foxglove)[3:] == [{"name": "/watched/a", "value": 6}], "one more")
        foxglove.send("unsubscribeParameterUpdates", parameterNames=[])
        foxglove.get_parameters("/rosdistro")
        ros_master.set_param("/watched/a", 7)
        other.wait(lambda: len(told(other)) == 6, "one more")
        assert len(told(foxglove)) == 4
    finally:
        other.close()


def told(client: Foxglove) -> Any:
    """The changes that a client was told of: what is no answer."""
    return [entry for message in list(client.values) if "id" not in message for entry in message["parameters"]]


def test_subscribing_to_all_is_to_all_that_there_are(foxglove: Foxglove, ros_master: RosMaster) -> None:
    ros_master.set_param("/some", {"a": 1, "b": {"c": 2}})
    foxglove.send("subscribeParameterUpdates", parameterNames=[])
    foxglove.get_parameters("/rosdistro")
    assert told(foxglove) == []
    ros_master.set_param("/some/b/c", 3)
    ros_master.set_param("/some/new", 3)
    ros_master.set_param("/some", {"a": 4})
    foxglove.wait(lambda: len(told(foxglove)) == 3, "three changes")
    assert told(foxglove)[0] == {"name": "/some/b/c", "value": 3}
    assert sorted(told(foxglove)[1:], key=str) == [{"name": "/some/a", "value": 4}, {"name": "/some/b/c"}]


@pytest.mark.parametrize(
    ("op", "fields", "message"),
    [
        ("getParameters", {}, "'parameterNames' is missing"),
        ("getParameters", {"parameterNames": [1]}, "'parameterNames' must be a list of strings"),
        ("getParameters", {"parameterNames": [], "id": 5}, "'id' must be a string"),
        ("setParameters", {}, "'parameters' is missing"),
        ("setParameters", {"parameters": ["/a"]}, "'parameters' must be a list of objects"),
        ("subscribeParameterUpdates", {}, "'parameterNames' is missing"),
        ("subscribeParameterUpdates", {"parameterNames": ["not legal"]}, "not a legal name"),
        ("unsubscribeParameterUpdates", {"parameterNames": "all"}, "'parameterNames' must be a list of strings"),
    ],
)
def test_mistakes_are_told(foxglove: Foxglove, op: str, fields: Dict[str, Any], message: str) -> None:
    foxglove.send(op, **fields)
    foxglove.wait_status(message)


def test_closed_parameters_look_as_if_they_were_not_set(
    start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove], ros_master: RosMaster, peer: Peer
) -> None:
    ros_master.set_param("/limits", {"open": 1, "secret": 2, "deep": {"secret": 3, "opened": 4}, "shut": {"secret": 5}})
    server = start_bridge(
        {"params_glob": "[/limits/*]", "param_whitelist": ["/limits/(.*/)?open.*"]}, name="with_param_whitelist"
    )
    client = connect_foxglove(server)
    assert set(client.get_parameters()) == {"/limits/open", "/limits/deep/opened"}
    assert client.get_parameters("/limits", "/limits/secret", "/limits/shut") == {
        "/limits": {"name": "/limits", "value": {"open": 1, "deep": {"opened": 4}}},
        "/limits/secret": {"name": "/limits/secret"},
        "/limits/shut": {"name": "/limits/shut"},
    }
    for entry in (
        {"name": "/limits/secret", "value": 9},
        {"name": "/limits/secret"},
        {"name": "/limits/deep"},
        {"name": "/limits/deep", "value": {"opened": 9}},
        {"name": "/limits/new", "value": {"opened": 9, "secret": 9}},
        {"name": "/elsewhere", "value": 9},
    ):
        client.set_parameters(entry)
        client.wait(lambda: client.statuses, "an error")
        assert "does not let clients change the parameter" in client.statuses.pop()["message"]
    assert client.set_parameters({"name": "/limits/open", "value": 8})["/limits/open"]["value"] == 8
    client.send("subscribeParameterUpdates", parameterNames=["/limits/secret", "/limits/open"])
    client.wait_status("does not let clients use /limits/secret")
    ros_master.set_param("/limits/secret", 7)
    ros_master.set_param("/limits/open", 7)
    client.wait(lambda: told(client), "a change")
    assert told(client) == [{"name": "/limits/open", "value": 7}]
    assert ros_master.get_param("/limits/deep") == {"secret": 3, "opened": 4}


@pytest.mark.allow_log("the ROS master at")
def test_subscriptions_survive_a_master_that_restarts(
    ros_master: RosMaster, start_bridge: Callable[..., Bridge], connect_foxglove: Callable[..., Foxglove]
) -> None:
    client = connect_foxglove(start_bridge(name="with_restart"))
    client.send("subscribeParameterUpdates", parameterNames=["/again"])
    client.get_parameters("/rosdistro")
    ros_master.restart()
    numbers = iter(range(1000))

    def heard() -> bool:
        ros_master.set_param("/again", next(numbers))
        return bool(told(client))

    client.wait(heard, "a change", 15)
