# SPDX-License-Identifier: BSD-3-Clause
"""Every answer, from a master's own logic in the test and services that answer what they are told to."""

from __future__ import annotations

import json
from typing import Any, Callable, Dict, List, Mapping, Optional, Sequence

import pytest

from rosapi.api import Api
from rosapi.service_types import Tell
from rosbridge_library.access import Access
from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.ros.master import MasterError, MasterUnreachable

Call = Callable[..., Any]

SERVICE_TYPES: Dict[str, Optional[str]] = {
    "/base/reset": "std_srvs/Trigger",
    "/base/stop": "std_srvs/Empty",
    "/lidar/reset": "std_srvs/Trigger",
    "/hung/reset": None,
}


def _node_uri(node: str) -> str:
    return f"http://{node.strip('/')}:4000/"


@pytest.fixture
def robot(master_call: Call, monkeypatch: pytest.MonkeyPatch) -> Call:
    """A master that knows a small robot; each node has a host of its name."""

    def register(method: str, node: str, *arguments: Any) -> None:
        handler = master_call.handler  # type: ignore[attr-defined]
        code, reason, _ = getattr(handler, method)(node, *arguments, _node_uri(node))
        assert code == 1, reason

    register("registerPublisher", "/lidar", "/scan", "sensor_msgs/LaserScan")
    register("registerPublisher", "/lidar2", "/scan", "sensor_msgs/LaserScan")
    register("registerPublisher", "/camera", "/image", "sensor_msgs/Image")
    register("registerPublisher", "/base", "/exotic", "not_installed_msgs/Thing")
    register("registerSubscriber", "/nav", "/map", "*")
    for part, kind in (("goal", "ActionGoal"), ("cancel", "GoalID")):
        register("registerSubscriber", "/nav", f"/move/{part}", f"move/{kind}")
    for part in ("status", "feedback", "result"):
        register("registerPublisher", "/nav", f"/move/{part}", f"move/{part}")
    for service in SERVICE_TYPES:
        node = "/" + service.split("/")[1]
        register("registerService", node, service, f"rosrpc://{node[1:]}:5000")
    return master_call


def _probe(uris: Mapping[str, str], tell: Tell) -> None:
    for service, uri in uris.items():
        assert uri == f"rosrpc://{service.split('/')[1]}:5000"
        tell(service, SERVICE_TYPES[service])


def _api(call: Call, **globs: str) -> Api:
    def look_up(services: Sequence[str]) -> Mapping[str, str]:
        return {service: call("lookupService", service) for service in services}

    return Api(call, look_up, _probe, lambda: (12, 34), Access.from_parameters(**globs))


@pytest.fixture
def api(robot: Call) -> Api:
    return _api(robot)


MOVE = ["/move/cancel", "/move/feedback", "/move/goal", "/move/result", "/move/status"]


class TestEverythingAllowed:
    def test_topics(self, api: Api) -> None:
        answer = api.topics()
        assert answer["topics"] == ["/exotic", "/image", "/map", *MOVE, "/scan"]
        assert answer["types"][:3] == ["not_installed_msgs/Thing", "sensor_msgs/Image", ""]
        assert answer["types"][-1] == "sensor_msgs/LaserScan"

    def test_topics_for_type(self, api: Api) -> None:
        assert api.topics_for_type("sensor_msgs/LaserScan") == {"topics": ["/scan"]}
        assert api.topics_for_type("sensor_msgs/Imu") == {"topics": []}

    def test_topics_and_raw_types(self, api: Api) -> None:
        answer = api.topics_and_raw_types()
        texts = dict(zip(answer["topics"], answer["typedefs_full_text"]))
        assert answer["topics"] == api.topics()["topics"]
        assert answer["types"] == api.topics()["types"]
        assert "float32 angle_min" in texts["/scan"]
        assert "MSG: std_msgs/Header" in texts["/scan"]
        assert texts["/exotic"] == texts["/map"] == ""

    def test_topic_type(self, api: Api) -> None:
        assert api.topic_type("/scan") == api.topic_type("scan") == {"type": "sensor_msgs/LaserScan"}
        assert api.topic_type("/map") == {"type": ""}

    def test_publishers_and_subscribers(self, api: Api) -> None:
        assert api.publishers("scan") == {"publishers": ["/lidar", "/lidar2"]}
        assert api.subscribers("/move/goal") == {"subscribers": ["/nav"]}
        assert api.subscribers("/scan") == {"subscribers": []}

    def test_action_servers(self, api: Api) -> None:
        assert api.action_servers() == {"action_servers": ["/move"]}

    def test_services(self, api: Api) -> None:
        assert api.services() == {"services": sorted(SERVICE_TYPES)}
        assert api.services_for_type("std_srvs/Trigger") == {"services": ["/base/reset", "/lidar/reset"]}
        assert api.services_for_type("std_srvs/SetBool") == {"services": []}
        assert api.service_type("base/reset") == {"type": "std_srvs/Trigger"}
        assert api.service_node("/base/stop") == {"node": "/base"}
        assert api.service_host("/base/stop") == {"host": "base"}
        assert api.service_providers("base/reset") == {"providers": ["/base"]}

    @pytest.mark.parametrize(("uri", "host"), [("rosrpc://Robot1:40", "Robot1"), ("rosrpc://[::1]:40", "::1")])
    def test_hosts_as_they_are_registered(self, api: Api, robot: Call, uri: str, host: str) -> None:
        robot("registerService", "/base/stop", uri, "http://base:4000/")
        assert api.service_host("/base/stop") == {"host": host}

    def test_providers_of_a_type(self, api: Api) -> None:
        assert api.service_providers("std_srvs/Trigger") == {"providers": ["/base", "/lidar"]}
        assert api.service_providers("std_srvs/SetBool") == {"providers": []}

    def test_nodes(self, api: Api) -> None:
        assert api.nodes() == {"nodes": ["/base", "/camera", "/hung", "/lidar", "/lidar2", "/nav"]}
        assert api.node_details("nav") == {
            "subscribing": ["/map", "/move/cancel", "/move/goal"],
            "publishing": ["/move/feedback", "/move/result", "/move/status"],
            "services": [],
        }
        assert api.node_details("/base")["services"] == ["/base/reset", "/base/stop"]

    @pytest.mark.parametrize("name", ["/unknown", "", "/", "no such name!", "\x00"])
    def test_what_is_unknown_is_empty(self, api: Api, name: str) -> None:
        assert api.topic_type(name) == {"type": ""}
        assert api.topics_for_type(name) == {"topics": []}
        assert api.publishers(name) == {"publishers": []}
        assert api.subscribers(name) == {"subscribers": []}
        assert api.services_for_type(name) == {"services": []}
        assert api.service_type(name) == {"type": ""}
        assert api.service_node(name) == {"node": ""}
        assert api.service_host(name) == {"host": ""}
        assert api.service_providers(name) == {"providers": []}
        assert api.node_details(name) == {"subscribing": [], "publishing": [], "services": []}

    def test_a_hung_service_has_no_type_but_a_node_and_host(self, api: Api) -> None:
        assert api.service_type("/hung/reset") == {"type": ""}
        assert api.service_node("/hung/reset") == {"node": "/hung"}
        assert api.service_host("/hung/reset") == {"host": "hung"}

    def test_details(self, api: Api) -> None:
        assert [each.type for each in api.message_details("std_msgs/String")["typedefs"]] == ["std_msgs/String"]
        assert api.service_request_details("std_srvs/SetBool")["typedefs"][0].fieldnames == ["data"]
        assert api.service_response_details("std_srvs/SetBool")["typedefs"][0].fieldnames == [
            "success",
            "message",
        ]
        for details in (api.message_details, api.service_request_details, api.service_response_details):
            with pytest.raises(RosbridgeError, match="not_installed_msgs"):
                details("not_installed_msgs/Thing")

    def test_parameters(self, api: Api) -> None:
        assert api.set_param("speed", "2") == {}
        assert api.get_param("/speed", "") == {"value": "2"}
        assert api.has_param("/speed") == {"exists": True}
        assert api.search_param("speed") == {"global_name": "/speed"}
        assert api.get_param_names() == {"names": ["/speed"]}
        assert api.delete_param("/speed") == {}
        assert api.get_param("/speed", "x") == {"value": '"x"'}

    def test_time(self, api: Api) -> None:
        assert api.get_time() == {"time": (12, 34)}

    def test_lists_share_one_look_at_the_master(self, api: Api, robot: Call) -> None:
        del robot.log[:]  # type: ignore[attr-defined]
        for _ in range(3):
            api.topics()
            api.services()
            api.nodes()
            api.publishers("/scan")
            api.node_details("/nav")
        assert robot.log == ["getSystemState", "getTopicTypes"]  # type: ignore[attr-defined]


class TestGlobs:
    def test_topics(self, robot: Call) -> None:
        api = _api(robot, topics_glob="[/scan, /move/*]")
        assert api.topics()["topics"] == [*MOVE, "/scan"]
        assert api.topics_and_raw_types()["topics"] == [*MOVE, "/scan"]
        assert api.topics_for_type("sensor_msgs/Image") == {"topics": []}
        assert api.topic_type("/image") == {"type": ""}
        assert api.publishers("/image") == {"publishers": []}
        assert api.subscribers("/map") == {"subscribers": []}
        assert api.node_details("/nav")["subscribing"] == ["/move/cancel", "/move/goal"]
        assert api.node_details("/camera")["publishing"] == []
        assert api.action_servers() == {"action_servers": ["/move"]}
        assert api.services()["services"] == sorted(SERVICE_TYPES)

    def test_an_action_server_needs_all_its_topics_open(self, robot: Call) -> None:
        assert _api(robot, topics_glob="[/move/goal, /move/status]").action_servers() == {"action_servers": []}

    def test_services(self, robot: Call) -> None:
        api = _api(robot, services_glob="['/base/*']")
        assert api.services() == {"services": ["/base/reset", "/base/stop"]}
        assert api.services_for_type("std_srvs/Trigger") == {"services": ["/base/reset"]}
        assert api.service_type("/lidar/reset") == {"type": ""}
        assert api.service_node("/lidar/reset") == {"node": ""}
        assert api.service_host("/lidar/reset") == {"host": ""}
        assert api.service_providers("/lidar/reset") == {"providers": []}
        assert api.service_providers("std_srvs/Trigger") == {"providers": ["/base"]}
        assert api.node_details("/lidar")["services"] == []
        assert "/scan" in api.topics()["topics"]

    def test_closed_services_are_not_even_asked(self, robot: Call) -> None:
        asked: List[str] = []

        def probe(uris: Mapping[str, str], tell: Tell) -> None:
            asked.extend(uris)
            _probe(uris, tell)

        def look_up(services: Sequence[str]) -> Mapping[str, str]:
            return {service: robot("lookupService", service) for service in services}

        access = Access.from_parameters(services_glob="[/base/*]")
        Api(robot, look_up, probe, lambda: None, access).services_for_type("std_srvs/Trigger")
        assert sorted(asked) == ["/base/reset", "/base/stop"]

    def test_parameters(self, robot: Call) -> None:
        robot("setParam", "/secret", 1)
        robot("setParam", "/open", 2)
        api = _api(robot, params_glob="[/open]")
        assert api.get_param_names() == {"names": ["/open"]}
        assert api.get_param("/secret", "") == {"value": "null"}
        assert api.has_param("/secret") == {"exists": False}
        assert api.search_param("secret") == {"global_name": ""}
        for change in (lambda: api.set_param("/secret", "2"), lambda: api.delete_param("/secret")):
            with pytest.raises(RosbridgeError, match="params_glob"):
                change()
        assert robot("getParam", "/secret") == 1

    @pytest.mark.parametrize("text", ["", "[]", "[*]"])
    def test_an_empty_list_allows_everything(self, robot: Call, text: str) -> None:
        api = _api(robot, topics_glob=text, services_glob=text, params_glob=text)
        assert len(api.topics()["topics"]) == 9
        assert api.services()["services"] == sorted(SERVICE_TYPES)
        api.set_param("/x", json.dumps("y"))
        assert api.get_param_names() == {"names": ["/x"]}


class TestMaster:
    def test_while_it_is_away_every_answer_from_it_fails_with_the_reason(self) -> None:
        def call(method: str, *arguments: Any) -> Any:
            raise MasterUnreachable("the ROS master is unreachable: connection refused")

        api = _api(call)
        for answer in (
            api.topics,
            api.services,
            api.nodes,
            lambda: api.topic_type("/scan"),
            lambda: api.service_type("/base/reset"),
            lambda: api.get_param("/a", "1"),
            lambda: api.set_param("/a", "1"),
            lambda: api.has_param("/a"),
            lambda: api.search_param("a"),
            api.get_param_names,
        ):
            with pytest.raises(RosbridgeError, match="connection refused"):
                answer()
        assert api.get_time() == {"time": (12, 34)}
        assert api.message_details("std_msgs/String")["typedefs"]

    def test_a_service_that_is_gone_since_the_snapshot_is_left_out(self, robot: Call) -> None:
        def look_up(services: Sequence[str]) -> Mapping[str, str]:
            return {each: robot("lookupService", each) for each in services if each != "/lidar/reset"}

        api = Api(robot, look_up, _probe, lambda: None, Access())
        assert api.services_for_type("std_srvs/Trigger") == {"services": ["/base/reset"]}

    def test_a_parameter_that_the_master_cannot_give_is_an_error(self, robot: Call) -> None:
        def call(method: str, *arguments: Any) -> Any:
            if method == "getParam":
                raise MasterError("it can't be written as XML-RPC")
            return robot(method, *arguments)

        robot("setParam", "/odd", 1)
        with pytest.raises(RosbridgeError, match="can't be written"):
            _api(call).get_param("/odd", "")
