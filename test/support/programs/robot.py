# SPDX-License-Identifier: BSD-3-Clause
"""A node that has all that the published clients are tried with, so that their tests share one process.

/robot/count            std_msgs/Int32, a hundred times a second, counting up
/robot/sample/NAME      latched: the messages of `samples`
/from_CLIENT/NAME       what comes there, with the types of `samples`, becomes a record `heard`
/robot/add fail hang nested send_bytes    services
/robot/count_to         a SimpleActionServer: counts to the goal, 20 ms a step; a negative goal is aborted
/robot/tasks            an ActionServer that does the same, for several goals at once
/robot/call             has the robot call a service: {"service", "a", "b", "answer_to"}
/robot/send_goals       has it send goals one after the other: {"server", "goals", "answer_to"}; goal 5 is cancelled
                        when it has feedback; /robot/goal_feedback is the feedback last noted, latched

What comes of a call or of the goals is published as JSON, latched, on the topic that `answer_to` names.
"""

from __future__ import annotations

import functools
import json
import threading
import time
from typing import Any, Callable, Dict

import actionlib
import rospy
from actionlib.msg import TestAction, TestFeedback, TestGoal, TestResult
from rosbridge_library.srv import (
    AddTwoInts,
    AddTwoIntsResponse,
    SendBytes,
    SendBytesResponse,
    TestNestedService,
    TestNestedServiceResponse,
)
from std_msgs.msg import Float64, Int32, String

from programs.program import plain, ready, say
from programs.samples import samples

CLIENTS = ("roslib1", "roslib2", "roslibpy", "foxglove")
STEP_S = 0.02
COUNT_INTERVAL_S = 0.01


def publish_samples() -> None:
    for name, message in samples().items():
        publisher = rospy.Publisher(f"/robot/sample/{name}", type(message), latch=True, queue_size=1)
        publisher.publish(message)


def listen() -> None:
    def hear(message: Any, topic: str) -> None:
        say(heard={"topic": topic, "message": plain(message)})

    for client in CLIENTS:
        for name, message in samples().items():
            topic = f"/from_{client}/{name}"
            rospy.Subscriber(topic, type(message), hear, callback_args=topic)


def serve() -> None:
    def fail(_: Any) -> None:
        raise rospy.ServiceException("it failed, as asked")

    def hang(_: Any) -> None:
        rospy.rostime.wallsleep(1e9)

    rospy.Service("/robot/add", AddTwoInts, lambda request: AddTwoIntsResponse(request.a + request.b))
    rospy.Service("/robot/fail", AddTwoInts, fail)
    rospy.Service("/robot/hang", AddTwoInts, hang)
    rospy.Service(
        "/robot/nested",
        TestNestedService,
        lambda request: TestNestedServiceResponse(Float64(request.pose.position.x)),
    )
    rospy.Service("/robot/send_bytes", SendBytes, lambda request: SendBytesResponse("x" * request.count))


def in_thread(work: Callable[..., None]) -> Callable[..., None]:
    """`work`, which then doesn't hold up whoever calls it."""

    @functools.wraps(work)
    def start(*arguments: Any) -> None:
        threading.Thread(target=work, args=arguments, daemon=True).start()

    return start


def serve_simple_action() -> None:
    def count(goal: TestGoal) -> None:
        if goal.goal < 0:
            server.set_aborted(TestResult(goal.goal), "no such number")
            return
        for number in range(1, goal.goal + 1):
            if server.is_preempt_requested():
                server.set_preempted(TestResult(number - 1))
                return
            server.publish_feedback(TestFeedback(number))
            time.sleep(STEP_S)
        server.set_succeeded(TestResult(goal.goal))

    server = actionlib.SimpleActionServer("/robot/count_to", TestAction, count, auto_start=False)
    server.start()


def serve_action() -> None:
    cancelled = set()

    @in_thread
    def count(handle: Any) -> None:
        handle.set_accepted()
        for number in range(1, handle.get_goal().goal + 1):
            if handle.get_goal_id().id in cancelled:
                handle.set_canceled(TestResult(number - 1))
                return
            handle.publish_feedback(TestFeedback(number))
            time.sleep(STEP_S)
        handle.set_succeeded(TestResult(handle.get_goal().goal))

    server = actionlib.ActionServer(
        "/robot/tasks", TestAction, count, lambda handle: cancelled.add(handle.get_goal_id().id), auto_start=False
    )
    server.start()


def answer(topic: str, outcome: Any) -> None:
    """Latched, so that it gets to who asked however long the subscription takes."""
    rospy.Publisher(topic, String, latch=True, queue_size=1).publish(json.dumps(outcome))


def call_for_clients() -> None:
    @in_thread
    def call(message: String) -> None:
        wanted = json.loads(message.data)
        try:
            rospy.wait_for_service(wanted["service"], 5.0)
            outcome = {"sum": rospy.ServiceProxy(wanted["service"], AddTwoInts)(wanted["a"], wanted["b"]).sum}
        except (rospy.ROSException, rospy.ServiceException) as error:
            outcome = {"error": str(error)}
        answer(wanted["answer_to"], outcome)

    rospy.Subscriber("/robot/call", String, call)


def send_goals_for_clients() -> None:
    noted = rospy.Publisher("/robot/goal_feedback", Int32, latch=True, queue_size=1)

    @in_thread
    def send(message: String) -> None:
        wanted = json.loads(message.data)
        client = actionlib.SimpleActionClient(wanted["server"], TestAction)
        if client.wait_for_server(rospy.Duration(10.0)):
            answer(wanted["answer_to"], [carry_out(client, goal) for goal in wanted["goals"]])
        else:
            answer(wanted["answer_to"], {"error": "no server"})

    def carry_out(client: actionlib.SimpleActionClient, goal: int) -> Dict[str, Any]:
        feedback = []

        def note(message: TestFeedback) -> None:
            feedback.append(message.feedback)
            noted.publish(message.feedback)
            if goal == 5:
                client.cancel_goal()

        client.send_goal(TestGoal(goal), feedback_cb=note)
        finished = client.wait_for_result(rospy.Duration(10.0))
        result = client.get_result()
        return {
            "finished": finished,
            "state": client.get_state(),
            "result": None if result is None else result.result,
            "feedback": feedback,
        }

    rospy.Subscriber("/robot/send_goals", String, send)


def run() -> None:
    """All of it, in a node that has been initialised; returns when that is shut down."""
    publish_samples()
    listen()
    serve()
    serve_simple_action()
    serve_action()
    call_for_clients()
    send_goals_for_clients()
    count = rospy.Publisher("/robot/count", Int32, queue_size=100)
    ready()
    number = 0
    while not rospy.is_shutdown():
        count.publish(number)
        number += 1
        time.sleep(COUNT_INTERVAL_S)
