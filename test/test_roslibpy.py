# SPDX-License-Identifier: BSD-3-Clause
"""The bridge under roslibpy, the Python library, as published on PyPI, in this process on its default transport.

roslibpy logs an error for whatever the bridge sends that it can't take, status messages among it: a test that does not
expect one fails of it. Its Twisted reactor can run only once in a process, so it is started and ended with this module.
"""

from __future__ import annotations

import itertools
import json
import logging
import math
import threading
import time
from typing import Any, Callable, Dict, Iterator, List

import genpy
import pytest
import roslibpy

from support.bridge import Bridge
from support.node import Node, publish, script
from support.robot import SAMPLES, as_json, heard
from support.ros import RosMaster
from support.wait import wait_until

try:
    from roslibpy import actionlib
except ImportError:  # roslibpy 2
    from roslibpy.ros1 import actionlib

ADD = "rosbridge_library/AddTwoInts"
ACTION = "actionlib/TestAction"
COUNT = ("/robot/count", "std_msgs/Int32")

Open = Callable[..., roslibpy.Ros]


@pytest.fixture(scope="module")
def bridge(ros_master: RosMaster) -> Iterator[Bridge]:
    with Bridge(ros_master, {"unregister_timeout": 0.5}, rosapi=True) as server:
        yield server


@pytest.fixture(scope="module")
def event_loop_of_roslibpy(bridge: Bridge) -> Iterator[None]:
    """It runs as long as the first client that started it."""
    first = roslibpy.Ros("127.0.0.1", bridge.port)
    first.run()
    yield
    first.terminate()


@pytest.fixture
def open_ros(bridge: Bridge, robot: Node, event_loop_of_roslibpy: None) -> Iterator[Open]:
    """`open_ros()`: a new connection to the module's bridge, or to another one."""
    clients: List[roslibpy.Ros] = []

    def new(server: Bridge = bridge) -> roslibpy.Ros:
        clients.append(roslibpy.Ros("127.0.0.1", server.port))
        clients[-1].run()
        return clients[-1]

    yield new
    for client in clients:
        client.close()
    wait_until(lambda: not any(client.is_connected for client in clients), 5.0, "closed connections")


@pytest.fixture
def ros(open_ros: Open) -> roslibpy.Ros:
    return open_ros()


@pytest.fixture(autouse=True)
def _nothing_logged(request: pytest.FixtureRequest, caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """With `@pytest.mark.allow_log("roslibpy")` errors of roslibpy may be."""
    yield
    marker = request.node.get_closest_marker("allow_log")
    if marker is None or "roslibpy" not in marker.args:
        records = [record for record in caplog.get_records("call") if record.levelno >= logging.ERROR]
        assert not records, [logging.Formatter().format(record) for record in records]


def collect(topic: roslibpy.Topic, count: int, timeout: float = 10.0) -> List[Any]:
    """The first messages of a topic, which is subscribed to meanwhile."""
    messages: List[Any] = []
    topic.subscribe(messages.append)
    wait_until(
        lambda: len(messages) >= count, timeout, lambda: f"{count} messages of {topic.name}, not {len(messages)}"
    )
    topic.unsubscribe()
    return messages[:count]


def numbers(messages: List[Any]) -> List[int]:
    return [message["data"] for message in messages]


def is_run(values: List[int]) -> bool:
    """Whether the numbers count up by one."""
    return values == list(range(values[0], values[0] + len(values)))


# Connections


def test_a_connection_opens_closes_and_opens_again(ros: roslibpy.Ros):
    events: List[str] = []
    ros.on("closing", lambda: events.append("closing"))
    ros.on("close", lambda _: events.append("close"))
    assert ros.is_connected
    ros.authenticate("mac", "127.0.0.1", "127.0.0.1", "rand", 1, "user", 2)  # sent whenever it connects
    ros.close()
    wait_until(lambda: events == ["closing", "close"], 5.0, lambda: f"close, not only {events}")
    ros.connect()
    wait_until(lambda: ros.is_connected, 5.0, "the connection")
    ready = threading.Event()
    ros.on_ready(ready.set)
    assert ready.wait(5.0)
    assert ros.get_time()["secs"] > 1_600_000_000


def test_a_program_goes_on_after_the_bridge_restarts(open_ros: Open, start_bridge, ros_master: RosMaster, nodes):
    server = start_bridge(name="restarting")
    ros = open_ros(server)
    ros.factory.set_initial_delay(0.1)
    received: List[Any] = []
    roslibpy.Topic(ros, *COUNT).subscribe(received.append)
    talker = roslibpy.Topic(ros, "/roslibpy/talk", "std_msgs/String", latch=True)
    talker.publish(roslibpy.Message({"data": "before"}))
    roslibpy.Service(ros, "/roslibpy/provided", ADD).advertise(add)
    wait_until(lambda: received and ros_master.providers("/roslibpy/provided"), 10.0, "all of it")
    server.restart()
    at_restart = len(received)
    wait_until(lambda: len(received) > at_restart, 10.0, "messages after the restart")
    wait_until(lambda: ros_master.providers("/roslibpy/provided"), 10.0, "the service")
    talker.publish(roslibpy.Message({"data": "after"}))
    source = (
        "from std_msgs.msg import String\n"
        "from rosbridge_library.srv import AddTwoInts\n"
        "rospy.wait_for_service('/roslibpy/provided', 10)\n"
        "ready()\n"
        "say(text=rospy.wait_for_message('/roslibpy/talk', String, 10).data)\n"
        "say(sum=rospy.ServiceProxy('/roslibpy/provided', AddTwoInts)(2, 3).sum)\n"
    )
    caller = nodes(script(ros_master, source))
    assert caller.wait_records("sum") == [5]
    assert caller.records("text") == ["after"]


# Topics


def test_every_kind_of_message_arrives(ros: roslibpy.Ros):
    received: Dict[str, Any] = {}
    for name, message in SAMPLES.items():

        def take(values: Any, name: str = name) -> None:
            received[name] = values

        roslibpy.Topic(ros, f"/robot/sample/{name}", message._type).subscribe(take)
    wait_until(lambda: len(received) == len(SAMPLES), 10.0, lambda: f"all samples, not only {sorted(received)}")
    for name, message in SAMPLES.items():
        assert without_seq(received[name]) == without_seq(as_json(message)), name


def without_seq(value: Any) -> Any:
    """The values without `seq`, in which rospy counts how often it has sent the message to anybody."""
    if isinstance(value, dict):
        return {name: without_seq(item) for name, item in value.items() if name != "seq"}
    return [without_seq(item) for item in value] if isinstance(value, list) else value


def test_a_stream_has_no_gaps(ros: roslibpy.Ros):
    assert is_run(numbers(collect(roslibpy.Topic(ros, *COUNT), 30)))


def test_throttle_rate_keeps_messages_apart(ros: roslibpy.Ros):
    times: List[float] = []
    ros.on("/robot/count", lambda _: times.append(time.monotonic()))
    received = numbers(collect(roslibpy.Topic(ros, *COUNT, throttle_rate=150), 6))
    assert times[5] - times[0] > 0.8 * 5 * 0.150
    assert received[-1] - received[0] >= 30


def test_queue_length_keeps_what_the_throttle_holds_back(ros: roslibpy.Ros, ros_master: RosMaster, nodes):
    options = {"rate": 0, "count": 12, "counter": "data", "subscribers": 1}
    nodes(publish(ros_master, "/roslibpy/burst", "std_msgs/Int32", **options))
    topic = roslibpy.Topic(ros, "/roslibpy/burst", "std_msgs/Int32", throttle_rate=20, queue_length=50)
    assert numbers(collect(topic, 12)) == list(range(12))


def test_unsubscribing_ends_the_subscription_in_ros(ros: roslibpy.Ros, ros_master: RosMaster):
    topic = roslibpy.Topic(ros, *COUNT)
    collect(topic, 3)
    wait_until(lambda: not ros_master.subscribers("/robot/count"), 10.0, "unregistered")
    assert is_run(numbers(collect(topic, 3)))


def test_every_kind_of_message_is_published(ros: roslibpy.Ros, robot: Node):
    for name, message in SAMPLES.items():
        topic = roslibpy.Topic(ros, f"/from_roslibpy/{name}", message._type)
        topic.publish(roslibpy.Message(as_python(message)))
    received = heard(robot, [f"/from_roslibpy/{name}" for name in SAMPLES])
    for name, message in SAMPLES.items():
        assert_same(received[f"/from_roslibpy/{name}"], message, name)


def as_python(value: Any) -> Any:
    """A message as programs write it for roslibpy: NaN and infinities go out as the tokens that Python's json has."""
    if isinstance(value, genpy.Time):
        return roslibpy.Time(value.secs, value.nsecs)
    if isinstance(value, genpy.Message):
        return {name: as_python(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, (list, tuple)):
        return [as_python(item) for item in value]
    return value if isinstance(value, float) else as_json(value)


def assert_same(received: Any, sent: Any, path: str) -> None:
    """That a record of the robot is what was sent, infinities and NaN included."""
    if isinstance(sent, float) and math.isnan(sent):
        assert math.isnan(received), path
    elif isinstance(sent, bytes):
        assert bytes(received) == sent, path
    elif isinstance(sent, (list, tuple)):
        assert len(received) == len(sent), path
        for index, item in enumerate(sent):
            assert_same(received[index], item, f"{path}[{index}]")
    elif hasattr(sent, "__slots__"):
        for name in sent.__slots__:
            assert_same(received[name], getattr(sent, name), f"{path}.{name}")
    else:
        assert received == sent, path


def test_headers_of_roslibpy(ros: roslibpy.Ros, robot: Node):
    stamp = roslibpy.Time.from_sec(1234567890.5)
    topic = roslibpy.Topic(ros, "/from_roslibpy/joints", "sensor_msgs/JointState")
    for frame, time_ in (("stamped", stamp), ("unstamped", None)):
        header = roslibpy.Header(seq=None, stamp=time_, frame_id=frame)
        topic.publish(roslibpy.Message({"header": header, "name": [], "position": [], "velocity": [], "effort": []}))

    def headers() -> Dict[str, Any]:
        records = robot.records("heard")
        found = [record["message"]["header"] for record in records if record["topic"] == "/from_roslibpy/joints"]
        return {header["frame_id"]: header["stamp"] for header in found}

    wait_until(lambda: "unstamped" in headers(), 10.0, "the header without stamp")
    assert headers()["stamped"] == {"secs": 1234567890, "nsecs": 500000000}
    assert headers()["unstamped"]["secs"] > 1_600_000_000


def test_messages_go_from_client_to_client(open_ros: Open):
    sender, reader = open_ros(), open_ros()
    name, kind = "/roslibpy/between", "std_msgs/Int32"
    received: List[Any] = []
    roslibpy.Topic(reader, name, kind).subscribe(received.append)
    reader.get_time()  # the bridge has handled the subscription
    topic = roslibpy.Topic(sender, name, kind)
    topic.advertise()
    for number in range(50):
        topic.publish(roslibpy.Message({"data": number}))
    wait_until(lambda: len(received) == 50, 10.0, lambda: f"50 messages, not {numbers(received)}")
    assert numbers(received) == list(range(50))


def test_a_latched_message_reaches_those_who_come_later(open_ros: Open, ros_master: RosMaster):
    first, late = open_ros(), open_ros()
    name, kind = "/roslibpy/latched", "std_msgs/String"
    topic = roslibpy.Topic(first, name, kind, latch=True)
    topic.publish(roslibpy.Message({"data": "first"}))
    topic.publish(roslibpy.Message({"data": "last"}))
    first.get_time()
    assert collect(roslibpy.Topic(late, name, kind), 1) == [{"data": "last"}]
    assert topic.is_advertised
    topic.unadvertise()
    wait_until(lambda: not ros_master.publishers(name), 10.0, f"end of {name}")


# Services and parameters


def add(request: Any, response: Any) -> bool:
    """The callback of a service; it says that it failed when it adds a negative number, but answers."""
    response["sum"] = request["a"] + request["b"]
    return bool(request["a"] >= 0)


def call(ros: roslibpy.Ros, name: str, **values: Any) -> Any:
    return dict(roslibpy.Service(ros, name, ADD).call(roslibpy.ServiceRequest(values), timeout=10))


asked = itertools.count()


def ask_robot(ros: roslibpy.Ros, topic: str, **request: Any) -> Any:
    """Has the robot, a ROS node, do something; its answer."""
    answer_to = f"/roslibpy/answer{next(asked)}"
    ask = roslibpy.Topic(ros, topic, "std_msgs/String")
    ask.publish(roslibpy.Message({"data": json.dumps({**request, "answer_to": answer_to})}))
    (answer,) = collect(roslibpy.Topic(ros, answer_to, "std_msgs/String"), 1, timeout=20.0)
    ask.unadvertise()
    return json.loads(answer["data"])


def have_called(ros: roslibpy.Ros, service: str, a: int, b: int) -> Any:
    return ask_robot(ros, "/robot/call", service=service, a=a, b=b)


def test_services_answer_blocking_and_not(ros: roslibpy.Ros):
    assert call(ros, "/robot/add", a=2**62, b=-1) == {"sum": 2**62 - 1}
    answers: List[Any] = []
    service = roslibpy.Service(ros, "/robot/add", ADD)
    for number in range(5):
        service.call(roslibpy.ServiceRequest({"a": number, "b": 1}), answers.append, answers.append)
    wait_until(lambda: len(answers) == 5, 10.0, lambda: f"5 answers, not {answers}")
    assert sorted(answer["sum"] for answer in answers) == [1, 2, 3, 4, 5]


@pytest.mark.allow_log("roslibpy")
def test_failed_calls_have_a_reason(ros: roslibpy.Ros):
    for name, values, reason in (
        ("/robot/fail", {"a": 1, "b": 2}, "it failed, as asked"),
        ("/nobody/here", {"a": 1, "b": 2}, "/nobody/here"),
        ("/robot/add", {"a": "one", "b": 2}, "integer"),
    ):
        with pytest.raises(Exception, match=reason) as raised:
            call(ros, name, **values)
        assert type(raised.value).__name__ == "ServiceException"


def test_a_call_that_hangs_delays_nothing(ros: roslibpy.Ros):
    service = roslibpy.Service(ros, "/robot/hang", ADD)
    answers: List[Any] = []
    service.call(roslibpy.ServiceRequest({"a": 1, "b": 2}), answers.append, answers.append)
    assert call(ros, "/robot/add", a=1, b=2) == {"sum": 3}
    assert answers == []


@pytest.mark.allow_log("roslibpy")
def test_a_program_provides_a_service(open_ros: Open, ros_master: RosMaster):
    ros, other = open_ros(), open_ros()
    name = "/roslibpy/sum"
    service = roslibpy.Service(ros, name, ADD)
    service.advertise(add)
    assert have_called(ros, name, 20, 22) == {"sum": 42}
    assert have_called(ros, name, -5, 1) == {"sum": -4}  # values count, although the result is false
    assert call(other, name, a=1, b=2) == {"sum": 3}
    assert other.get_service_type(name) == ADD
    service.unadvertise()
    wait_until(lambda: not ros_master.providers(name), 10.0, f"end of {name}")
    with pytest.raises(Exception, match=name):
        call(other, name, a=1, b=2)
    service.advertise(add)
    assert have_called(ros, name, 1, 1) == {"sum": 2}


def test_a_service_whose_callback_returns_nothing_answers(ros: roslibpy.Ros):
    def answer(request: Any, response: Any) -> None:
        response["sum"] = request["a"]

    roslibpy.Service(ros, "/roslibpy/careless", ADD).advertise(answer)
    assert have_called(ros, "/roslibpy/careless", 7, 0) == {"sum": 7}


def test_parameters(ros: roslibpy.Ros, ros_master: RosMaster):
    name = "/roslibpy_parameter"
    assert ros.get_param(name) is None
    for value in (1, -2.5, True, "tëxt", "", "7", [1, "two", [3.5]], {"speed": {"max": 1.5}}):
        ros.set_param(name, value)
        assert ros.get_param(name) == value
        assert ros_master.get_param(name) == value
    assert f"{name}/speed/max" in ros.get_params()
    ros.delete_param(name)
    assert ros_master.get_param(name, "gone") == "gone"


# rosapi


def test_rosapi(ros: roslibpy.Ros):
    assert ros.get_time().to_sec() == pytest.approx(time.time(), abs=60)
    assert "/robot/count" in ros.get_topics()
    assert ros.get_topic_type("/robot/count") == "std_msgs/Int32"
    assert ros.get_topic_type("/nowhere") == ""
    assert "/robot/sample/scan" in ros.get_topics_for_type("sensor_msgs/LaserScan")
    assert {"/robot/add", "/rosapi/topics"} <= set(ros.get_services())
    assert ros.get_service_type("/robot/add") == ADD
    assert ros.get_services_for_type("rosbridge_library/SendBytes") == ["/robot/send_bytes"]
    assert {"/robot", "/rosapi", "/rosbridge_websocket"} <= set(ros.get_nodes())
    details = ros.get_node_details("/robot")
    assert "/robot/count" in details["publishing"]
    assert "/robot/call" in details["subscribing"]
    assert "/robot/add" in details["services"]
    assert "/rosbridge_websocket/port" in ros.get_params()
    actions: List[Any] = []
    ros.get_action_servers(actions.append)
    wait_until(lambda: actions, 10.0, "action servers")
    assert sorted(actions[0]["action_servers"]) == ["/robot/count_to", "/robot/tasks"]


def test_rosapi_tells_types(ros: roslibpy.Ros):
    scan = ros.get_message_details("sensor_msgs/LaserScan")["typedefs"]
    assert [definition["type"] for definition in scan] == ["sensor_msgs/LaserScan", "std_msgs/Header", "time"]
    ranges = scan[0]["fieldnames"].index("ranges")
    assert (scan[0]["fieldtypes"][ranges], scan[0]["fieldarraylen"][ranges]) == ("float32", 0)
    request = ros.get_service_request_details("rosbridge_library/TestNestedService")["typedefs"]
    assert (request[0]["fieldnames"], request[0]["fieldtypes"]) == (["pose"], ["geometry_msgs/Pose"])
    response = ros.get_service_response_details("rosbridge_library/TestNestedService")["typedefs"]
    assert response[0]["fieldtypes"] == ["std_msgs/Float64"]


# Actions


def send(client: actionlib.ActionClient, goal: int, timeout: float = 0.0) -> Any:
    """A goal on its way; `seen` is the feedback that comes."""
    sent = actionlib.Goal(client, roslibpy.Message({"goal": goal}))
    sent.seen = []
    sent.on("feedback", lambda message: sent.seen.append(message["feedback"]))
    sent.send(timeout=timeout or None)
    return sent


@pytest.fixture
def action_client(ros: roslibpy.Ros) -> Iterator[Callable[[str], actionlib.ActionClient]]:
    clients: List[actionlib.ActionClient] = []

    def new(server: str) -> actionlib.ActionClient:
        clients.append(actionlib.ActionClient(ros, server, ACTION))
        return clients[-1]

    yield new
    for client in clients:
        client.dispose()


def test_goals_are_carried_out(action_client):
    client = action_client("/robot/count_to")
    for goal in (5, 2):
        done = send(client, goal)
        assert done.wait(10) == {"result": goal}
        wait_until(lambda done=done, goal=goal: done.seen and done.seen[-1] == goal, 5.0, "all feedback")
        assert is_run(done.seen)
        wait_until(lambda done=done: done.status["status"] == actionlib.GoalStatus.SUCCEEDED, 5.0, "success")


@pytest.mark.parametrize("everything", [False, True], ids=["one", "all"])
def test_goals_are_cancelled(action_client, everything: bool):
    client = action_client("/robot/count_to")
    goal = send(client, 1000)
    wait_until(lambda: goal.seen, 10.0, "feedback")
    (client if everything else goal).cancel()
    result = goal.wait(10)
    assert result["result"] == goal.seen[-1] < 1000
    wait_until(lambda: goal.status["status"] == actionlib.GoalStatus.PREEMPTED, 5.0, "preempted")


def test_a_goal_that_takes_too_long(action_client):
    goal = send(action_client("/robot/count_to"), 1000, timeout=0.3)
    timed_out = threading.Event()
    goal.on("timeout", timed_out.set)
    assert timed_out.wait(5.0)
    goal.cancel()
    assert goal.wait(10)["result"] < 1000


def test_two_goals_at_once(action_client):
    client = action_client("/robot/tasks")
    cancelled, done = send(client, 1000), send(client, 10)
    wait_until(lambda: cancelled.seen and done.seen, 10.0, "feedback of both")
    cancelled.cancel()
    assert cancelled.wait(10)["result"] == cancelled.seen[-1] < 1000
    assert done.wait(10) == {"result": 10}
    wait_until(lambda: done.seen[-1] == 10, 5.0, "all feedback")
    assert is_run(done.seen)


def test_an_action_client_tells_that_there_is_no_server(action_client, monkeypatch):
    monkeypatch.setattr(actionlib, "DEFAULT_CONNECTION_TIMEOUT", 0.3)
    with pytest.raises(Exception, match="failed to connect"):
        action_client("/nobody")


def test_an_action_server_in_the_program(ros: roslibpy.Ros):
    noted: List[int] = []
    roslibpy.Topic(ros, "/robot/goal_feedback", "std_msgs/Int32").subscribe(
        lambda message: noted.append(message["data"])
    )
    server = actionlib.SimpleActionServer(ros, "/roslibpy/action", ACTION)

    def tell_until(done: Callable[[], bool], number: int, what: str) -> None:
        # ROS has the robot's client see the server before the server sees it: what is told once may be told to nobody.
        def told() -> bool:
            server.send_feedback({"feedback": number * 10})
            return done()

        wait_until(told, 10.0, what)

    def act(goal: Any) -> None:
        number = goal["goal"]
        if number == 5:  # the robot cancels it when it has feedback
            tell_until(server.is_preempt_requested, number, "the request to cancel")
            server.set_preempted()
            return
        # A result that overtook the feedback would make it void.
        tell_until(lambda: number * 10 in noted, number, "feedback noted")
        server.set_succeeded({"result": number * 2})

    server.start(act)
    outcomes = ask_robot(ros, "/robot/send_goals", server="/roslibpy/action", goals=[3, 4, 5])
    first, second, cancelled = outcomes
    for outcome in outcomes:
        outcome["feedback"] = sorted(set(outcome["feedback"]))
    succeeded = {"finished": True, "state": actionlib.GoalStatus.SUCCEEDED}
    assert first == {**succeeded, "result": 6, "feedback": [30]}
    assert second == {**succeeded, "result": 8, "feedback": [40]}
    assert (cancelled["state"], cancelled["feedback"]) == (actionlib.GoalStatus.PREEMPTED, [50])
