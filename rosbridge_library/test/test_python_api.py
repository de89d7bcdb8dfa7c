# SPDX-License-Identifier: BSD-3-Clause
"""The Python API as programs written for rosbridge_library use it: rospy.init_node, protocols whose `outgoing` is
overridden, capabilities made by hand, from any thread, without an event loop of their own.

Each script is a node of its own on a private master, and ends by saying what it found.
"""

from __future__ import annotations

from typing import Any, Dict

import pytest

from support.node import script
from support.ros import RosMaster
from support.wait import wait_until

BEGINNING = """
import json, threading, time
import rosbridge_library.protocol
from rosbridge_library.protocol import Protocol, InvalidArgumentException, MissingArgumentException
from rosbridge_library.capability import Capability
from rosbridge_library.rosbridge_protocol import RosbridgeProtocol
from rosbridge_library.msg import Num
from rosbridge_library.srv import AddTwoInts, AddTwoIntsResponse
from std_msgs.msg import String, Int32

class Recording(RosbridgeProtocol):
    def __init__(self, *arguments, **options):
        self.messages = []
        super().__init__(*arguments, **options)
    def outgoing(self, message, compression="none"):
        self.messages.append(json.loads(message) if isinstance(message, str) else message)
    def wait(self, **fields):
        end = time.monotonic() + 10
        while time.monotonic() < end:
            for message in list(self.messages):
                if all(message.get(name) == value for name, value in fields.items()):
                    return message
            time.sleep(0.01)
        raise AssertionError("no %s in %s" % (fields, self.messages))

def until(condition):
    end = time.monotonic() + 10
    while not condition():
        if time.monotonic() > end:
            raise AssertionError("not in time")
        time.sleep(0.01)

ready()
"""


def found(master: RosMaster, nodes: Any, name: str, source: str, **options: Any) -> Any:
    node = nodes(script(master, BEGINNING + source + "\nsay(done=found)\n", name=name, **options))
    return node.wait_records("done", timeout=20.0)[0]


def left_behind(master: RosMaster, name: str, *prefixes: str) -> Any:
    state = master.call("getSystemState")
    return [entry[0] for kind in state for entry in kind if f"/{name}" in entry[1] and entry[0].startswith(prefixes)]


def test_a_protocol_with_json_in_and_out(ros_master: RosMaster, nodes: Any) -> None:
    source = """
protocol = Recording("client")
received = []
rospy.Subscriber("/api/out", String, lambda message: received.append(message.data))
protocol.incoming(json.dumps({"op": "set_level", "level": "info"}))
protocol.incoming(json.dumps({"op": "subscribe", "id": "s", "topic": "/api/in", "type": "std_msgs/String"}))
protocol.wait(op="status", id="s")
publisher = rospy.Publisher("/api/in", String, queue_size=10)
until(lambda: publisher.get_num_connections())
publisher.publish(String("hello"))
message = protocol.wait(op="publish")
protocol.incoming(json.dumps({"op": "advertise", "topic": "/api/out", "type": "std_msgs/String"}))
protocol.incoming(json.dumps({"op": "publish", "topic": "/api/out", "msg": {"data": "out"}}))
until(lambda: received)
rospy.Service("/api/add", AddTwoInts, lambda request: AddTwoIntsResponse(request.a + request.b))
rospy.wait_for_service("/api/add", 10)
protocol.incoming(json.dumps({"op": "call_service", "service": "/api/add", "args": [1, 2], "id": "c"}))
response = protocol.wait(op="service_response", id="c")
protocol.incoming(json.dumps({"op": "advertise_service", "id": "a", "service": "/api/mine",
                              "type": "rosbridge_library/AddTwoInts"}))
protocol.wait(op="status", id="a")
answers = []
def call():
    answers.append(rospy.ServiceProxy("/api/mine", AddTwoInts)(3, 4).sum)
thread = threading.Thread(target=call)
thread.start()
request = protocol.wait(op="call_service")
protocol.incoming(json.dumps({"op": "service_response", "id": request["id"], "values": {"sum": 7}, "result": True}))
thread.join(10)
protocol.incoming("nonsense")
error = protocol.wait(op="status", level="error")
protocol.finish()
protocol.finish()
protocol.incoming(json.dumps({"op": "subscribe", "topic": "/api/late", "type": "std_msgs/String"}))
found = {"message": message, "received": received, "response": response["values"], "answers": answers}
publisher.unregister()
"""
    assert found(ros_master, nodes, "whole", source) == {
        "message": {"op": "publish", "topic": "/api/in", "msg": {"data": "hello"}},
        "received": ["out"],
        "response": {"sum": 3},
        "answers": [7],
    }
    wait_until(
        lambda: left_behind(ros_master, "whole", "/api/in", "/api/mine", "/api/late") == [], 5.0, "an empty master"
    )


def test_capabilities_made_by_hand(ros_master: RosMaster, nodes: Any) -> None:
    source = """
from rosbridge_library.capabilities.advertise import Advertise
from rosbridge_library.capabilities.publish import Publish
from rosbridge_library.capabilities.subscribe import Subscribe
from rosbridge_library.capabilities.call_service import CallService
from rosbridge_library.capabilities.advertise_service import AdvertiseService
from rosbridge_library.capabilities.unadvertise_service import UnadvertiseService
from rosbridge_library.capabilities.service_response import ServiceResponse
from rosbridge_library.capabilities.fragmentation import Fragmentation
from rosbridge_library.capabilities.defragmentation import Defragment

class Plain(Protocol):
    sent = []
    def send(self, message, cid=None, compression="none"):
        self.sent.append(message)

protocol = Protocol("by hand")
advertise, publish, subscribe = Advertise(protocol), Publish(protocol), Subscribe(protocol)
received = []
rospy.Subscriber("/hand/topic", Num, lambda message: received.append(message.num))
advertise.advertise({"op": "advertise", "topic": "/hand/topic", "type": "rosbridge_library/Num"})
publish.publish({"op": "publish", "topic": "/hand/topic", "msg": {"num": 5}})
until(lambda: received)
errors = []
for handler, message in (
    (advertise.advertise, {"op": "advertise"}),
    (advertise.advertise, {"op": "advertise", "topic": 3, "type": "std_msgs/String"}),
    (advertise.unadvertise, {"op": "unadvertise"}),
    (publish.publish, {"op": "publish"}),
    (publish.publish, {"op": "publish", "topic": 5, "msg": {}}),
    (publish.publish, {"op": "publish", "topic": "/hand/topic", "msg": {"num": "x"}}),
    (subscribe.subscribe, {"op": "subscribe"}),
    (subscribe.unsubscribe, {"op": "unsubscribe"}),
    (AdvertiseService(protocol).advertise_service, {"op": "advertise_service"}),
    (UnadvertiseService(protocol).unadvertise_service, {"op": "unadvertise_service"}),
    (ServiceResponse(protocol).service_response, {"op": "service_response"}),
    (Defragment(protocol).defragment, {"op": "fragment"}),
):
    try:
        handler(message)
        errors.append(None)
    except Exception as error:
        errors.append(type(error).__name__)

plain = Plain("plain")
CallService(plain).call_service({"op": "call_service", "service": "/rosout/get_loggers"})
rospy.Service("/hand/add", AddTwoInts, lambda request: AddTwoIntsResponse(request.a + request.b))
parts = Fragmentation(protocol).fragment({"op": "x", "data": "y" * 100}, 30, "mid")
advertise.finish()
publish.finish()
subscribe.finish()
protocol.finish()
found = {"received": received, "errors": errors, "parts": len(parts)}
"""
    assert found(ros_master, nodes, "hand", source) == {
        "received": [5],
        "errors": [
            "MissingArgumentException",
            "InvalidArgumentException",
            "MissingArgumentException",
            "MissingArgumentException",
            "InvalidArgumentException",
            "FieldTypeMismatchException",
            "MissingArgumentException",
            "MissingArgumentException",
            "MissingArgumentException",
            "MissingArgumentException",
            "MissingArgumentException",
            "MissingArgumentException",
        ],
        "parts": 4,
    }


def test_a_package_that_extends_the_protocol(ros_master: RosMaster, nodes: Any) -> None:
    source = """
class Shout(Capability):
    def __init__(self, protocol):
        Capability.__init__(self, protocol)
        self.finished = False
        protocol.register_operation("shout", self.shout)
    def shout(self, message):
        self.basic_type_check(message, [(True, "text", str)])
        self.protocol.send({"op": "shouted", "text": message["text"].upper()}, message.get("id"))
        self.protocol.log("warning", "too loud", message.get("id"))
    def finish(self):
        self.finished = True

RosbridgeProtocol.rosbridge_capabilities.append(Shout)
protocol = Recording("extended", parameters={"fragment_timeout": 5, "max_message_size": None, "unknown": 1})
protocol.incoming(json.dumps({"op": "set_level", "level": "warning"}))
protocol.incoming(json.dumps({"op": "shout", "text": "hey", "id": "i"}))
protocol.incoming(json.dumps({"op": "shout", "id": "j"}))
try:
    Shout(protocol).basic_type_check({"text": 5}, [(True, "text", str)])
except InvalidArgumentException as error:
    complaint = str(error)
protocol.finish()
found = {"messages": protocol.messages, "finished": [c.finished for c in protocol.capabilities if isinstance(c, Shout)],
         "complaint": "text" in complaint}
"""
    result: Dict[str, Any] = found(ros_master, nodes, "extended", source)
    shouted, warning, error = result["messages"]
    assert shouted == {"op": "shouted", "text": "HEY", "id": "i"}
    assert warning == {"op": "status", "level": "warning", "msg": "too loud", "id": "i"}
    assert (error["level"], error["id"]) == ("error", "j")
    assert result["finished"] == [True]
    assert result["complaint"]


def test_many_threads_with_a_protocol_each(ros_master: RosMaster, nodes: Any) -> None:
    source = """
counts = {}
def client(number):
    protocol = Recording(number)
    topic = "/threads/topic_%d" % number
    protocol.incoming(json.dumps({"op": "set_level", "level": "info"}))
    protocol.incoming(json.dumps({"op": "subscribe", "id": "s", "topic": topic, "type": "std_msgs/Int32"}))
    protocol.wait(op="status", id="s")
    protocol.incoming(json.dumps({"op": "advertise", "topic": topic, "type": "std_msgs/Int32"}))
    for value in range(20):
        protocol.incoming(json.dumps({"op": "publish", "topic": topic, "msg": {"data": value}}))
    until(lambda: sum(message["op"] == "publish" for message in protocol.messages) == 20)
    counts[number] = [message["msg"]["data"] for message in protocol.messages if message["op"] == "publish"]
    protocol.finish()
threads = [threading.Thread(target=client, args=(number,)) for number in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join(20)
found = [counts.get(number) == list(range(20)) for number in range(8)]
"""
    assert found(ros_master, nodes, "threads", source) == [True] * 8


def test_outgoing_may_come_back_in(ros_master: RosMaster, nodes: Any) -> None:
    """A program may answer from within `outgoing`, which runs on the library's thread."""
    source = """
class Answering(Recording):
    def outgoing(self, message, compression="none"):
        super().outgoing(message)
        if json.loads(message)["op"] == "call_service":
            request = json.loads(message)
            values = {"sum": request["args"]["a"] * 10}
            self.incoming(json.dumps({"op": "service_response", "id": request["id"], "values": values, "result": True}))
protocol = Answering("answering")
protocol.incoming(json.dumps({"op": "set_level", "level": "info"}))
protocol.incoming(json.dumps({"op": "advertise_service", "id": "a", "service": "/back/service",
                              "type": "rosbridge_library/AddTwoInts"}))
protocol.wait(op="status", id="a")
found = rospy.ServiceProxy("/back/service", AddTwoInts)(4, 0).sum
protocol.finish()
"""
    assert found(ros_master, nodes, "answering", source) == 40


def test_a_subscriber_of_the_program_that_blocks_delays_no_protocol(ros_master: RosMaster, nodes: Any) -> None:
    source = """
protocol = Recording("first")
protocol.incoming(json.dumps({"op": "set_level", "level": "error"}))
entered, left = threading.Event(), threading.Event()
def block(message):
    entered.set()
    left.wait(10)
rospy.Subscriber("/blocking/topic", String, block)
publisher = rospy.Publisher("/blocking/topic", String, queue_size=1)
until(lambda: publisher.get_num_connections())
publisher.publish(String("x"))
entered.wait(10)
outcome = []
def talk():
    protocol.incoming(json.dumps({"op": "nonsense"}))
    outcome.append(len(protocol.messages))
thread = threading.Thread(target=talk, daemon=True)
thread.start()
thread.join(3)
found = list(outcome)
left.set()
"""
    assert found(ros_master, nodes, "blocking", source) == [1]


def test_program_and_protocol_share_a_topic(ros_master: RosMaster, nodes: Any) -> None:
    """Whoever of them was first."""
    source = """
protocol = Recording("sharing")
protocol.incoming(json.dumps({"op": "set_level", "level": "info"}))
heard = {"/share/a": [], "/share/b": []}
publishers = {topic: rospy.Publisher(topic, Int32, queue_size=100) for topic in heard}
def subscribe(topic):
    protocol.incoming(json.dumps({"op": "subscribe", "id": topic, "topic": topic, "type": "std_msgs/Int32"}))
    protocol.wait(op="status", id=topic)
subscribe("/share/a")
listeners = [rospy.Subscriber(topic, Int32, lambda message, topic=topic: heard[topic].append(message.data))
             for topic in heard]
until(lambda: publishers["/share/b"].get_num_connections())
subscribe("/share/b")
for topic, publisher in publishers.items():
    for number in range(50):
        publisher.publish(number)
def received(topic):
    return [m["msg"]["data"] for m in list(protocol.messages) if m["op"] == "publish" and m["topic"] == topic]
until(lambda: all(len(heard[topic]) == len(received(topic)) == 50 for topic in heard))
protocol.incoming(json.dumps({"op": "unsubscribe", "topic": "/share/a"}))
protocol.incoming(json.dumps({"op": "unsubscribe", "topic": "/share/b"}))
for publisher in publishers.values():
    publisher.publish(50)
until(lambda: all(len(each) == 51 for each in heard.values()))
found = [each == list(range(51)) for each in heard.values()] + [received(topic) == list(range(50)) for topic in heard]
protocol.finish()
"""
    assert found(ros_master, nodes, "sharing", source) == [True] * 4


@pytest.mark.parametrize("module", ["protocol", "capability", "internal.exceptions"])
def test_where_the_exceptions_are(module: str) -> None:
    import importlib

    found_in = importlib.import_module(f"rosbridge_library.{module}")
    assert issubclass(found_in.MissingArgumentException, Exception)
    assert issubclass(found_in.InvalidArgumentException, Exception)
