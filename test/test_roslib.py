# SPDX-License-Identifier: BSD-3-Clause
"""The bridge under roslib, the JavaScript library, as published on npm: the 1.x and the 2.x line, in Node.

Each test runs one scenario of clients/*.mjs with both lines and looks at what the program, ROS and the master saw. An
error status that the test did not expect fails it.
"""

from __future__ import annotations

import base64
import json
import math
import shutil
import signal
from pathlib import Path
from typing import Any, Dict, Iterator, List

import pytest
from tf2_msgs.msg import TFMessage

from support.bridge import Bridge
from support.node import Node, publish, script
from support.robot import SAMPLES, as_json, heard, wire
from support.ros import RosMaster
from support.wait import wait_until

CLIENTS = Path(__file__).resolve().parent / "clients"
ADD = "rosbridge_library/AddTwoInts"
ACTIVE, PREEMPTED, SUCCEEDED, ABORTED = 1, 2, 3, 4
TOPICS = {f"/robot/sample/{name}": message._type for name, message in SAMPLES.items()}


class Roslib:
    """One line of roslib: runs scenarios with it."""

    def __init__(self, line: int, bridge: Bridge) -> None:
        self.line = line
        self.name = f"roslib{line}"
        self.bridge = bridge
        self.may_get_errors = False
        self._programs: List[Node] = []

    def start(self, scenario: str, **options: Any) -> Node:
        """A running program; `scenario` is "file.function"."""
        file, _, function = scenario.partition(".")
        node = shutil.which("node")
        assert node is not None, "no node on the PATH (scripts/test installs it)"
        command = [node, str(CLIENTS / "run.mjs"), str(self.line), self.bridge.url]
        command += [str(CLIENTS / f"{file}.mjs"), function, json.dumps(options)]
        program = Node(self.bridge.master.process_in(command, f"{self.name}-{function}"))
        self._programs.append(program)
        return program

    def run(self, scenario: str, **options: Any) -> Any:
        """The result of a scenario."""
        return result(self.start(scenario, **options))

    def stop(self) -> None:
        for program in self._programs:
            program.stop()
        statuses = [status for program in self._programs for status in program.records("status")]
        errors = [status["msg"] for status in statuses if status["level"] == "error"]
        assert self.may_get_errors or not errors, errors


def result(program: Node) -> Any:
    """What its scenario returned; the program has ended well."""
    (done,) = program.wait_records("done", timeout=20.0)
    assert program.process.wait() == 0
    return done


@pytest.fixture(scope="module")
def bridge(ros_master: RosMaster) -> Iterator[Bridge]:
    with Bridge(ros_master, {"unregister_timeout": 0.5}, rosapi=True) as server:
        yield server


@pytest.fixture(params=[1, 2], ids=["1.x", "2.x"])
def roslib(request: pytest.FixtureRequest, bridge: Bridge, robot: Node) -> Iterator[Roslib]:
    library = Roslib(request.param, bridge)
    yield library
    library.stop()


def tell(program: Node) -> None:
    """Lets a program go on that waits for it."""
    program.process.signal(signal.SIGUSR2)


def is_run(numbers: List[int]) -> bool:
    """Whether the numbers count up by one."""
    return numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def without_seq(value: Any) -> Any:
    """The JSON values without `seq`, in which rospy counts how often it has sent the message to anybody."""
    if isinstance(value, dict):
        return {name: without_seq(item) for name, item in value.items() if name != "seq"}
    return [without_seq(item) for item in value] if isinstance(value, list) else value


def wire_without_seq(data: bytes, like: Any) -> bytes:
    """The bytes of a message, with the `seq` of another of its type put in, for the same reason."""
    if like._has_header:
        return wire(like)[:4] + data[4:]
    if isinstance(like, TFMessage):
        message = TFMessage().deserialize(data)
        for transform, other in zip(message.transforms, like.transforms):
            transform.header.seq = other.header.seq
        return wire(message)
    return data


# Connections


def test_connections_open_and_close_with_their_events(roslib: Roslib):
    outcome = roslib.run("connection.openAndClose")
    assert outcome["events"] == [True, "close", False, "connection", True]
    assert outcome["before"] == outcome["after"] == {"exists": False}


def test_a_program_goes_on_after_the_bridge_restarts(roslib: Roslib, ros_master: RosMaster, start_bridge, nodes):
    roslib.bridge = start_bridge(name="restarting")
    says, provides = f"/{roslib.name}/talk", f"/{roslib.name}/provided"
    program = roslib.start("connection.reconnect", hears="/robot/count", says=says, provides=provides)
    program.wait_records("connected")
    wait_until(lambda: ros_master.providers(provides), 10.0, provides)
    roslib.bridge.restart()
    (back,) = program.wait_records("back")
    assert back["received"] > back["atLoss"] > 0
    caller = (
        "from std_msgs.msg import String\n"
        "from rosbridge_library.srv import AddTwoInts\n"
        f"rospy.wait_for_service({provides!r}, 10)\n"
        "ready()\n"
        f"say(text=rospy.wait_for_message({says!r}, String, 10).data)\n"
        f"say(sum=rospy.ServiceProxy({provides!r}, AddTwoInts)(2, 3).sum)\n"
    )
    listener = nodes(script(ros_master, caller))
    assert listener.wait_records("sum") == [5]
    assert listener.records("text") == ["after"]
    tell(program)
    result(program)


def test_compressed_connections_and_fragments(roslib: Roslib, ros_master: RosMaster, start_bridge, nodes):
    settings: Dict[str, Any] = {"use_compression": True}
    if roslib.line == 2:
        settings["max_message_size"] = 1000  # 1.x can't put fragments together
    roslib.bridge = start_bridge(settings, name="compressing")
    text = {"data": "päckchen " * 5000}
    nodes(publish(ros_master, "/large", "std_msgs/String", text, count=1, latch=True))
    assert roslib.run("connection.large", topic="/large") == {"received": 45000, "answered": 100000}


# Topics


@pytest.mark.parametrize("compression", ["none", "png"])
def test_every_kind_of_message_arrives(roslib: Roslib, compression: str):
    received = roslib.run("topics.receive", topics=TOPICS, compression=compression)
    expected = {f"/robot/sample/{name}": as_json(message) for name, message in SAMPLES.items()}
    assert without_seq(received) == without_seq(expected)


def typed(name: str, values: Any) -> Dict[str, Any]:
    """A JavaScript typed array, as run.mjs writes it."""
    return {"$": name, "values": list(values)}


def test_cbor_gives_typed_arrays_and_keeps_nan(roslib: Roslib):
    received = without_seq(roslib.run("topics.receive", topics=TOPICS, compression="cbor"))

    def sample(name: str) -> Any:
        return received[f"/robot/sample/{name}"]

    assert sample("text") == as_json(SAMPLES["text"])
    assert sample("int64") == as_json(SAMPLES["int64"])
    assert sample("duration") == as_json(SAMPLES["duration"])
    assert sample("transforms") == without_seq(as_json(SAMPLES["transforms"]))
    assert sample("scan")["ranges"] == typed("Float32Array", [0.5, {"$": "NaN"}, {"$": "Infinity"}, 2.0**-20])
    assert sample("scan")["intensities"] == typed("Float32Array", [])
    assert sample("scan")["header"] == without_seq(as_json(SAMPLES["scan"].header))
    assert sample("joints")["position"] == typed("Float64Array", [0.1, {"$": "NaN"}])
    assert sample("joints")["name"] == ["left", "right"]
    assert sample("odometry")["pose"]["covariance"] == typed("Float64Array", [index / 4 for index in range(36)])
    assert sample("odometry")["pose"]["pose"] == as_json(SAMPLES["odometry"].pose.pose)
    assert sample("odometry")["twist"]["twist"]["linear"] == {"x": {"$": "-Infinity"}, "y": 0, "z": 0}
    assert sample("uint16s")["data"] == typed("Uint16Array", [0, 1, 65535])
    for name in ("image", "cloud"):
        assert base64.b64decode(sample(name)["data"]["base64"]) == SAMPLES[name].data
    int64s = list(SAMPLES["int64s"].data)
    if roslib.line == 1:  # which makes plain numbers of them
        assert sample("int64s")["data"] == int64s
    else:
        big = [{"$": "BigInt", "value": str(number)} for number in int64s]
        assert sample("int64s")["data"] == typed("BigInt64Array", big)


def test_cbor_raw_gives_the_bytes_of_ros(roslib: Roslib):
    received = roslib.run("topics.receive", topics=TOPICS, compression="cbor-raw")
    assert set(received) == set(TOPICS)
    for name, message in SAMPLES.items():
        raw = received[f"/robot/sample/{name}"]
        assert wire_without_seq(base64.b64decode(raw["bytes"]["base64"]), message) == wire(message), name
        assert raw["secs"] > 1_600_000_000
        assert 0 <= raw["nsecs"] < 1_000_000_000


def test_a_stream_has_no_gaps(roslib: Roslib):
    topic = {"name": "/robot/count", "messageType": "std_msgs/Int32"}
    outcome = roslib.run("topics.listen", topic=topic, count=30)
    assert is_run([message["data"] for message in outcome["messages"]])


def test_throttle_rate_keeps_messages_apart_and_sends_the_newest(roslib: Roslib):
    topic = {"name": "/robot/count", "messageType": "std_msgs/Int32", "throttle_rate": 150}
    outcome = roslib.run("topics.listen", topic=topic, count=6)
    numbers = [message["data"] for message in outcome["messages"]]
    # Five intervals of 150 ms, at 10 ms a message: about 75 messages; none is the queue of an old one.
    assert outcome["times"][-1] - outcome["times"][0] > 0.8 * 5 * 150
    assert numbers[-1] - numbers[0] >= 30
    assert all(after - before >= 3 for before, after in zip(numbers, numbers[1:]))


def test_queue_length_keeps_what_the_throttle_holds_back(roslib: Roslib, ros_master: RosMaster, nodes):
    name = f"/{roslib.name}/burst"
    options = {"rate": 0, "count": 12, "counter": "data", "subscribers": 1}
    nodes(publish(ros_master, name, "std_msgs/Int32", **options))
    topic = {"name": name, "messageType": "std_msgs/Int32", "throttle_rate": 30, "queue_length": 50}
    outcome = roslib.run("topics.listen", topic=topic, count=12)
    assert [message["data"] for message in outcome["messages"]] == list(range(12))
    assert outcome["times"][-1] - outcome["times"][0] > 0.8 * 11 * 30


def test_without_a_queue_the_last_message_still_comes(roslib: Roslib, ros_master: RosMaster, nodes):
    name = f"/{roslib.name}/state"
    options = {"rate": 0, "count": 12, "counter": "data", "subscribers": 1}
    nodes(publish(ros_master, name, "std_msgs/Int32", **options))
    topic = {"name": name, "messageType": "std_msgs/Int32", "throttle_rate": 200}
    outcome = roslib.run("topics.listen", topic=topic, count=2)
    assert [message["data"] for message in outcome["messages"]] == [0, 11]


def test_callbacks_come_off_one_by_one(roslib: Roslib):
    outcome = roslib.run("topics.twoCallbacks")
    assert is_run(outcome["first"])
    assert len(outcome["first"]) == 10
    assert is_run(outcome["second"])
    assert outcome["second"][-1] in outcome["first"][:5]


def test_unsubscribing_ends_the_subscription_in_ros(roslib: Roslib, ros_master: RosMaster):
    wait_until(lambda: not ros_master.subscribers("/robot/count"), 15.0, "end of earlier subscriptions")
    program = roslib.start("topics.again")
    program.wait_records("unsubscribed")
    wait_until(lambda: not ros_master.subscribers("/robot/count"), 15.0, "unregistered")
    tell(program)
    outcome = result(program)
    assert outcome["after"] > outcome["before"]


def test_several_topics_on_one_name_share_a_stream(roslib: Roslib):
    outcome = roslib.run("topics.severalTopics")
    for name in ("quick", "other", "after"):
        assert is_run(outcome[name]), name
    # Once another Topic wants every message, the throttled one hears them too: there is one stream.
    assert outcome["gotSlow"] >= 5
    assert outcome["slow"][-4:] == outcome["quick"][-4:]
    assert set(outcome["after"]) <= set(outcome["other"])


def test_every_kind_of_message_is_published(roslib: Roslib, robot: Node):
    messages = [
        {"topic": f"/from_{roslib.name}/{name}", "type": message._type, "message": as_json(message)}
        for name, message in SAMPLES.items()
    ]
    roslib.run("topics.publish", messages=messages)
    received = heard(robot, [message["topic"] for message in messages])
    for name, message in SAMPLES.items():
        assert_same(received[f"/from_{roslib.name}/{name}"], message, name)


def assert_same(received: Any, sent: Any, path: str) -> None:
    """That a record of the robot is what was sent; JSON has made NaN of infinities."""
    if isinstance(sent, bytes):
        assert bytes(received) == sent, path
    elif isinstance(sent, float) and not math.isfinite(sent):
        assert math.isnan(received), path
    elif isinstance(sent, (list, tuple)):
        assert len(received) == len(sent), path
        for index, item in enumerate(sent):
            assert_same(received[index], item, f"{path}[{index}]")
    elif hasattr(sent, "__slots__"):
        assert set(received) == set(sent.__slots__), path
        for name in sent.__slots__:
            assert_same(received[name], getattr(sent, name), f"{path}.{name}")
    else:
        assert received == sent, path


def test_bytes_may_be_a_list_and_a_header_may_be_left_out(roslib: Roslib, robot: Node):
    topic = f"/from_{roslib.name}/image"
    image = {"height": 1, "width": 2, "step": 2, "encoding": "list", "is_bigendian": 0, "data": [7, 255]}
    roslib.run("topics.publish", messages=[{"topic": topic, "type": "sensor_msgs/Image", "message": image}])
    received = wait_until(lambda: _image(robot, topic, "list"), 10.0, "the image")
    assert received["data"] == [7, 255]
    assert received["header"]["stamp"]["secs"] > 1_600_000_000  # the present, not 0


def test_publishing_without_advertising(roslib: Roslib, robot: Node):
    topic = f"/from_{roslib.name}/image"
    message = {"encoding": "bare", "height": 1, "width": 1, "step": 1, "is_bigendian": 0, "data": "/w=="}
    roslib.run("topics.publishBare", topic=topic, message=message)
    assert wait_until(lambda: _image(robot, topic, "bare"), 10.0, "the image")["data"] == [255]


def _image(robot: Node, topic: str, encoding: str) -> Any:
    messages = [record["message"] for record in robot.records("heard") if record["topic"] == topic]
    return next((message for message in messages if message["encoding"] == encoding), None)


def test_a_latched_message_reaches_those_who_come_later(roslib: Roslib, ros_master: RosMaster, nodes):
    name = f"/{roslib.name}/latched"
    program = roslib.start("topics.latch", name=name)
    assert program.wait_records("published") == ["last"]
    listen = (
        "from std_msgs.msg import String\n"
        "ready()\n"
        f"message = rospy.wait_for_message({name!r}, String, 10)\n"
        "say(text=message.data, latching=message._connection_header['latching'])\n"
    )
    listener = nodes(script(ros_master, listen))
    assert listener.wait_records("text") == ["last"]
    assert listener.records("latching") == ["1"]
    tell(program)
    program.wait_records("unadvertised")
    wait_until(lambda: not ros_master.publishers(name), 15.0, f"end of {name}")
    tell(program)
    result(program)


def test_messages_go_from_client_to_client(roslib: Roslib):
    received = roslib.run("topics.betweenClients", name=f"/{roslib.name}/between", count=50)
    assert received == [list(range(50)), list(range(50))]


def test_mistakes_are_told(roslib: Roslib):
    roslib.may_get_errors = True
    outcome = roslib.run("topics.mistakes", topic=f"/{roslib.name}/pose")
    assert [status["level"] for status in outcome["errors"]] == ["error"] * 3
    wrong_field, conflict, no_type = (status["msg"] for status in outcome["errors"])
    assert "position.x" in wrong_field
    assert "geometry_msgs/Pose" in conflict
    assert "no_such_package" in no_type
    assert [status["id"].split(":")[0] for status in outcome["errors"]] == ["publish", "advertise", "advertise"]
    (warning,) = outcome["warnings"]
    assert warning["level"] == "warning"
    assert "position.y" in warning["msg"]


# Services


def test_services_answer(roslib: Roslib):
    pose = {"position": {"x": 1.5, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    calls = [
        ["/robot/add", ADD, {"a": 2**53 - 2, "b": 1}],
        ["robot/add", ADD, {"a": -3, "b": 1}],
        ["/robot/nested", "rosbridge_library/TestNestedService", {"pose": pose}],
        ["/robot/send_bytes", "rosbridge_library/SendBytes", {"count": 300000}],
    ]
    large, small, nested, many = roslib.run("services.call", calls=calls)
    assert large == {"sum": 2**53 - 1}
    assert small == {"sum": -2}
    assert nested == {"data": {"data": 1.5}}
    assert many == {"data": "x" * 300000}


@pytest.mark.allow_log("/robot/fail", "/nobody/here")
def test_failed_calls_have_a_reason(roslib: Roslib):
    roslib.may_get_errors = True
    calls = [
        ["/robot/fail", ADD, {"a": 1, "b": 2}],
        ["/nobody/here", ADD, {"a": 1, "b": 2}],
        ["/robot/add", ADD, {"a": "one", "b": 2}],
        ["/robot/add", ADD, {"c": 2}],
    ]
    failing, unknown, mistyped, misnamed = roslib.run("services.call", calls=calls)
    assert "it failed, as asked" in failing["failed"]
    assert "/nobody/here" in unknown["failed"]
    assert "integer" in mistyped["failed"]
    assert "'a'" in mistyped["failed"]
    assert "field c" in misnamed["failed"]


def test_a_call_is_given_up_after_its_timeout(roslib: Roslib, start_bridge):
    roslib.may_get_errors = True
    timeout: Dict[str, Any] = {}
    if roslib.line == 1:  # its calls have no timeout of their own
        roslib.bridge = start_bridge({"default_call_service_timeout": 0.7}, name="impatient")
    else:
        timeout = {"timeout": 0.7}
    outcome = roslib.run("services.giveUp", **timeout)
    assert outcome["sum"] == {"sum": 3}
    assert outcome["order"] == ["add", "hanging"]
    assert "0.7" in outcome["hanging"]["failed"]
    assert 650 < outcome["took"] < 5000


def test_a_program_provides_a_service(roslib: Roslib, ros_master: RosMaster):
    roslib.may_get_errors = True  # 1.x answers "failed" with values that lack nothing; the last call fails
    name = f"/{roslib.name}/sum"
    outcome = roslib.run("services.provide", name=name)
    assert outcome["fromRobot"] == {"sum": 42}
    assert outcome["many"] == [{"sum": 11}, {"sum": 12}, {"sum": 13}]
    assert outcome["typeName"] == ADD
    assert name in outcome["gone"]["failed"]
    assert {"a": 20, "b": 22} in outcome["requests"]
    assert len(outcome["requests"]) == 5
    if roslib.line == 1:  # sends values with result false: the values count
        assert outcome["failing"] == {"sum": -1}
    else:
        assert "error" in outcome["failing"]
    assert not ros_master.providers(name)


def test_a_service_that_returns_anything_answers(roslib: Roslib):
    outcome = roslib.run("services.provideCarelessly", name=f"/{roslib.name}/careless")
    if roslib.line == 1:
        assert outcome == [{"sum": 1}, {"sum": 2}, {"sum": 3}, {"sum": 4}]
    else:  # makes a failure of undefined and null, without values
        assert ["error" in answer for answer in outcome] == [True, True, False, False]
        assert outcome[2:] == [{"sum": 3}, {"sum": 4}]


@pytest.mark.parametrize("roslib", [2], indirect=True, ids=["2.x"])
def test_a_service_answers_later_or_fails_with_its_reason(roslib: Roslib):
    three, two, one = roslib.run("services.provideLater", name=f"/{roslib.name}/later")
    assert "three is not to be added" in three["error"]
    assert (two, one) == ({"sum": 12}, {"sum": 11})


def test_a_service_is_taken_over(roslib: Roslib):
    answers = roslib.run("services.provideAgain", name=f"/{roslib.name}/again")
    assert answers == [{"sum": 0}, {"sum": 1}, {"sum": 2}]


def test_a_call_fails_at_once_when_the_provider_leaves(roslib: Roslib, ros_master: RosMaster):
    roslib.may_get_errors = True
    name = f"/{roslib.name}/leaving"
    outcome = roslib.run("services.provideAndLeave", name=name)
    assert "disconnected" in outcome["answer"]["failed"]
    assert outcome["took"] < 3000
    wait_until(lambda: not ros_master.providers(name), 10.0, f"end of {name}")


def test_parameters(roslib: Roslib, ros_master: RosMaster):
    name = f"/{roslib.name}/parameter"
    values = [1, -2.5, True, "tëxt", "", "7", [1, "two", [3.5]], {"speed": {"max": 1.5}}]
    outcome = roslib.run("services.params", name=name, values=values)
    *during, after = outcome["got"]
    assert during == [None, *values]
    assert after is None
    assert f"{name}/speed/max" in outcome["names"]
    assert ros_master.get_param(name, "gone") == "gone"


# rosapi


def test_rosapi_lists_what_there_is(roslib: Roslib):
    questions = [
        ["getTopics"],
        ["getTopicType", "/robot/count"],
        ["getTopicType", "/nowhere"],
        ["getTopicsForType", "sensor_msgs/LaserScan"],
        ["getServices"],
        ["getServiceType", "/robot/add"],
        ["getServicesForType", "rosbridge_library/SendBytes"],
        ["getNodes"],
        ["getParams"],
        ["getActionServers"],
        ["getNodeDetails", "/robot"],
    ]
    topics, type_name, nothing, scans, services, service_type, senders, nodes, params, actions, details = roslib.run(
        "rosapi.ask", questions=questions
    )
    types = dict(zip(topics["topics"], topics["types"]))
    assert types["/robot/count"] == type_name == "std_msgs/Int32"
    assert {name: types[name] for name in TOPICS} == TOPICS
    assert nothing == ""
    assert "/robot/sample/scan" in scans
    assert "/robot/sample/image" not in scans
    assert {"/robot/add", "/robot/hang", "/rosapi/topics"} <= set(services)
    assert service_type == ADD
    assert senders == ["/robot/send_bytes"]
    assert {"/robot", "/rosapi", "/rosbridge_websocket"} <= set(nodes)
    assert "/rosbridge_websocket/port" in params
    assert sorted(actions) == ["/robot/count_to", "/robot/tasks"]
    if isinstance(details, dict):
        details = [details["subscribing"], details["publishing"], details["services"]]
    subscribing, publishing, provided = details
    assert "/robot/call" in subscribing
    assert "/robot/count" in publishing
    assert "/robot/add" in provided


def test_rosapi_tells_types_whole(roslib: Roslib):
    scan, string, transforms = roslib.run(
        "rosapi.decode", types=["sensor_msgs/LaserScan", "std_msgs/String", "tf2_msgs/TFMessage"]
    )
    assert string == {"data": "string"}
    assert scan["ranges"] == ["float32"]
    assert scan["angle_min"] == "float32"
    assert scan["header"]["seq"] == "uint32"
    assert scan["header"]["frame_id"] == "string"
    (transform,) = transforms["transforms"]
    assert transform["transform"]["rotation"] == dict.fromkeys("xyzw", "float64")


def test_rosapi_tells_services_and_raw_types(roslib: Roslib):
    roslib.may_get_errors = True
    questions = [
        ["getServiceRequestDetails", "rosbridge_library/TestNestedService"],
        ["getServiceResponseDetails", "rosbridge_library/TestNestedService"],
        ["getTopicsAndRawTypes"],
        ["getMessageDetails", "no_such_package/Type"],
    ]
    request, response, raw, unknown = roslib.run("rosapi.ask", questions=questions)
    assert request["typedefs"][0]["fieldnames"] == ["pose"]
    assert [definition["type"] for definition in request["typedefs"][1:]] == [
        "geometry_msgs/Pose",
        "geometry_msgs/Point",
        "geometry_msgs/Quaternion",
    ]
    assert response["typedefs"][0]["fieldtypes"] == ["std_msgs/Float64"]
    definition = raw["typedefs_full_text"][raw["topics"].index("/robot/sample/scan")]
    assert definition == type(SAMPLES["scan"])._full_text.rstrip("\n") or "MSG: std_msgs/Header" in definition
    assert "no_such_package" in unknown["failed"]


# Actions


def test_goals_are_carried_out(roslib: Roslib):
    done, aborted, again = roslib.run("actions.carryOut", server="/robot/count_to", goals=[5, -1, 2])
    assert done["result"] == 5
    assert done["feedback"] == [1, 2, 3, 4, 5]
    assert done["status"] == SUCCEEDED
    assert (aborted["result"], aborted["status"], aborted["feedback"]) == (-1, ABORTED, [])
    assert (again["result"], again["feedback"]) == (2, [1, 2])


@pytest.mark.parametrize("everything", [False, True], ids=["one", "all"])
def test_goals_are_cancelled(roslib: Roslib, everything: bool):
    outcome = roslib.run("actions.cancel", server="/robot/count_to", all=everything)
    assert outcome["status"] == PREEMPTED
    assert outcome["result"] == outcome["feedback"][-1] < 1000


def test_a_goal_that_takes_too_long(roslib: Roslib):
    outcome = roslib.run("actions.goalTimeout", server="/robot/count_to")
    assert outcome["before"] >= 1
    assert outcome["outcome"]["status"] == PREEMPTED


def test_an_action_client_tells_that_there_is_no_server(roslib: Roslib):
    assert roslib.run("actions.serverTimeout", server="/robot/count_to", nobody="/nobody") == []


def test_two_goals_at_once(roslib: Roslib):
    cancelled, done = roslib.run("actions.twoAtOnce", server="/robot/tasks")
    assert cancelled["status"] == PREEMPTED
    assert cancelled["result"] == cancelled["feedback"][-1] < 1000
    assert done["status"] == SUCCEEDED
    assert is_run(done["feedback"])
    assert done["feedback"][-1] == 10
    assert done["result"] == 10


def test_another_program_watches_an_action(roslib: Roslib):
    seen = roslib.run("actions.watch", server="/robot/count_to")
    assert seen == {"goals": [3], "feedback": [1, 2, 3], "results": [3]}


def test_an_action_server_in_the_program(roslib: Roslib):
    succeeded, aborted, cancelled = roslib.run("actions.serve", server=f"/{roslib.name}/action")
    assert (succeeded["finished"], succeeded["state"], succeeded["result"]) == (True, SUCCEEDED, 6)
    assert aborted["state"] == ABORTED
    assert (cancelled["finished"], cancelled["state"]) == (True, PREEMPTED)
    assert [set(outcome["feedback"]) for outcome in (succeeded, aborted, cancelled)] == [{30}, {40}, {50}]
