#!/usr/bin/env python3
# SPDX-License-Identifier: BSD-3-Clause
"""The test node of rosbridge_websocket.test: a client of the launched bridge, with this node on ROS's side."""

from __future__ import annotations

import sys
import threading
import unittest
from pathlib import Path

import rospy
import rostest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "test"))

from rosbridge_library.srv import AddTwoInts, AddTwoIntsResponse
from std_msgs.msg import Int32, String

from support.client import Client
from support.wait import wait_until


class LaunchedBridge(unittest.TestCase):
    def setUp(self) -> None:
        port = wait_until(lambda: rospy.get_param("/rosbridge_websocket/actual_port", 0), 20.0, "a port")
        self.client = Client(f"ws://127.0.0.1:{port}")
        self.addCleanup(self.client.close)

    def test_args_are_private_parameters_of_their_own_types(self) -> None:
        parameters = rospy.get_param("/rosbridge_websocket")
        expected = {
            "port": 0,
            "address": "127.0.0.1",
            "ssl": False,
            "retry_startup_delay": 5,
            "fragment_timeout": 600,
            "delay_between_messages": 0,
            "max_message_size": "None",
            "unregister_timeout": 3.5,
            "websocket_external_port": "None",
            "use_compression": False,
            "authenticate": False,
            "websocket_ping_interval": 20,
            "websocket_ping_timeout": 30,
            "websocket_null_origin": True,
            "topics_glob": "[*]",
            "services_glob": "[*]",
            "params_glob": "[/open/*]",
            "bson_only_mode": False,
            "binary_encoder": "default",
        }
        self.assertEqual({name: parameters[name] for name in expected}, expected)
        self.assertNotIn("certfile", parameters)
        self.assertEqual(rospy.get_param("/rosapi/params_glob"), "[/open/*]")

    def test_messages_go_both_ways(self) -> None:
        heard = threading.Event()
        rospy.Subscriber("/from_web", String, lambda message: message.data == "hello" and heard.set())
        publisher = rospy.Publisher("/from_ros", Int32, latch=True, queue_size=1)
        publisher.publish(7)
        self.client.subscribe("/from_ros", "std_msgs/Int32")
        self.assertEqual(self.client.next_message("/from_ros"), {"data": 7})
        self.client.advertise("/from_web", "std_msgs/String")
        self.client.publish("/from_web", {"data": "hello"})
        self.assertTrue(heard.wait(10))

    def test_services_go_both_ways(self) -> None:
        rospy.Service("/add", AddTwoInts, lambda request: AddTwoIntsResponse(request.a + request.b))
        response = self.client.call_service("/add", {"a": 2, "b": 3})
        self.assertEqual((response["result"], response["values"]), (True, {"sum": 5}))

        self.client.advertise_service("/web_add", "rosbridge_library/AddTwoInts")
        rospy.wait_for_service("/web_add", 10)
        answers = []
        caller = threading.Thread(target=lambda: answers.append(rospy.ServiceProxy("/web_add", AddTwoInts)(4, 5).sum))
        caller.start()
        self.client.serve("/web_add", lambda args: (True, {"sum": args["a"] + args["b"]}))
        caller.join(10)
        self.assertEqual(answers, [9])

    def test_rosapi_answers_within_its_globs(self) -> None:
        def call(service: str, **args: str) -> object:
            return self.client.call_service(f"/rosapi/{service}", args)["values"]

        wait_until(lambda: rospy.get_param("/rosapi", None) is not None, 20.0, "rosapi")
        rospy.wait_for_service("/rosapi/get_param", 20)
        rospy.set_param("/open/door", 1)
        rospy.set_param("/shut/door", 2)
        self.assertEqual(call("get_param", name="/open/door"), {"value": "1"})
        self.assertNotEqual(call("get_param", name="/shut/door"), {"value": "2"})


if __name__ == "__main__":
    rospy.init_node("launched_bridge")
    rostest.rosrun("rosbridge_server", "launched_bridge", LaunchedBridge)
