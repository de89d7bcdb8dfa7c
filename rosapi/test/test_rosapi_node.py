# SPDX-License-Identifier: BSD-3-Clause
"""The real rosapi_node on a private master: every service through rospy, big and broken graphs, restarts."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import sys
import xmlrpc.client
from pathlib import Path
from typing import Any, Callable, Iterator, List

import pytest

from rosapi.node import SERVICES
from support.process import Process
from support.ros import RosMaster, executable
from support.wait import wait_until

PROGRAMS = Path(__file__).resolve().parent / "programs"

StartCaller = Callable[[RosMaster], Any]


def start_rosapi(master: RosMaster, *arguments: str) -> Process:
    return master.process_in([str(executable("rosapi", "rosapi_node")), *arguments], "rosapi")


def is_up(master: RosMaster) -> bool:
    services = {service for service, _ in master.call("getSystemState")[2]}
    return {f"/rosapi/{name}" for name in SERVICES} <= services


@contextlib.contextmanager
def rosapi(master: RosMaster, *arguments: str) -> Iterator[Process]:
    """A node whose services are registered."""
    with start_rosapi(master, *arguments) as process:
        wait_until(lambda: is_up(master), 20.0, lambda: process.output)
        yield process


@pytest.fixture(scope="module")
def node(ros_master: RosMaster) -> Iterator[Process]:
    with rosapi(ros_master) as process:
        yield process


@pytest.fixture(scope="module")
def live(ros_master: RosMaster) -> Iterator[Process]:
    command = [sys.executable, str(PROGRAMS / "provider.py"), "3"]
    with ros_master.process_in(command, "live") as process:
        process.wait_for_line("all services are up", 20.0)
        yield process


@pytest.fixture
def caller(ros_master: RosMaster, node: Process, live: Process, start_caller: StartCaller) -> Any:
    return start_caller(ros_master)


def register(master: RosMaster, method: str, node_name: str, *arguments: Any) -> None:
    """Registers in the name of another node, which nobody runs."""
    proxy = xmlrpc.client.ServerProxy(master.uri)
    code, reason, _ = getattr(proxy, method)(node_name, *arguments)  # type: ignore[misc]
    assert code == 1, reason


class TestEveryService:
    """The module's master has rosapi, the caller and programs/provider.py."""

    def test_topics(self, caller: Any) -> None:
        answer = caller.call("topics")
        types = dict(zip(answer["topics"], answer["types"]))
        assert answer["topics"] == sorted(answer["topics"])
        assert types["/rosout"] == "rosgraph_msgs/Log"
        assert types["/live/any"] == ""

    def test_topics_for_type(self, caller: Any) -> None:
        assert caller.call("topics_for_type", "rosgraph_msgs/Log") == {"topics": ["/rosout"]}

    def test_topics_and_raw_types(self, caller: Any) -> None:
        answer = caller.call("topics_and_raw_types")
        texts = dict(zip(answer["topics"], answer["typedefs_full_text"]))
        assert "byte FATAL=16" in texts["/rosout"]
        assert texts["/live/any"] == ""

    def test_topic_type(self, caller: Any) -> None:
        assert caller.call("topic_type", "rosout") == {"type": "rosgraph_msgs/Log"}
        assert caller.call("topic_type", "/none") == {"type": ""}

    def test_publishers(self, caller: Any) -> None:
        assert {"/live", "/rosapi"} <= set(caller.call("publishers", "/rosout")["publishers"])

    def test_subscribers(self, caller: Any) -> None:
        assert caller.call("subscribers", "/live/any") == {"subscribers": ["/live"]}

    def test_action_servers(self, caller: Any, ros_master: RosMaster) -> None:
        for part in ("goal", "cancel", "status", "feedback", "result"):
            uri = "http://127.0.0.1:1/"
            register(ros_master, "registerPublisher", "/actor", f"/dishes/{part}", f"dishes/{part}", uri)
        wait_until(lambda: caller.call("action_servers") == {"action_servers": ["/dishes"]}, 5.0)

    def test_services(self, caller: Any) -> None:
        services = caller.call("services")["services"]
        assert services == sorted(services)
        assert {f"/rosapi/{name}" for name in SERVICES} <= set(services)
        assert "/live/empty" in services

    def test_services_for_type(self, caller: Any) -> None:
        expected = {"services": ["/live/trigger_0", "/live/trigger_1", "/live/trigger_2"]}
        assert caller.call("services_for_type", "std_srvs/Trigger") == expected
        assert caller.call("services_for_type", "rosapi/Topics") == {"services": ["/rosapi/topics"]}

    def test_service_type(self, caller: Any) -> None:
        assert caller.call("service_type", "/live/empty") == {"type": "std_srvs/Empty"}
        for name, service_type in SERVICES.items():
            assert caller.call("service_type", f"/rosapi/{name}") == {"type": service_type._type}
        assert caller.call("service_type", "/none") == {"type": ""}

    def test_service_node(self, caller: Any) -> None:
        assert caller.call("service_node", "/live/empty") == {"node": "/live"}
        assert caller.call("service_node", "/none") == {"node": ""}

    def test_service_host(self, caller: Any) -> None:
        assert caller.call("service_host", "/live/empty") == {"host": "127.0.0.1"}
        assert caller.call("service_host", "/none") == {"host": ""}

    def test_service_providers(self, caller: Any) -> None:
        assert caller.call("service_providers", "live/empty") == {"providers": ["/live"]}
        assert caller.call("service_providers", "std_srvs/Trigger") == {"providers": ["/live"]}
        assert caller.call("service_providers", "/none") == {"providers": []}

    def test_nodes(self, caller: Any) -> None:
        assert {"/live", "/rosapi", "/caller"} <= set(caller.call("nodes")["nodes"])

    def test_node_details(self, caller: Any) -> None:
        details = caller.call("node_details", "live")
        assert details["subscribing"] == ["/live/any"]
        assert details["publishing"] == ["/rosout"]
        assert "/live/trigger_1" in details["services"]
        assert caller.call("node_details", "/none") == {"subscribing": [], "publishing": [], "services": []}

    def test_message_details(self, caller: Any) -> None:
        (point_stamped, header, time, point) = caller.call("message_details", "geometry_msgs/PointStamped")["typedefs"]
        assert point_stamped["type"] == "geometry_msgs/PointStamped"
        assert point_stamped["fieldtypes"] == ["std_msgs/Header", "geometry_msgs/Point"]
        assert (header["type"], time["type"]) == ("std_msgs/Header", "time")
        assert point == {
            "type": "geometry_msgs/Point",
            "fieldnames": ["x", "y", "z"],
            "fieldtypes": ["float64", "float64", "float64"],
            "fieldarraylen": [-1, -1, -1],
            "examples": ["0.0", "0.0", "0.0"],
            "constnames": [],
            "constvalues": [],
        }
        assert "not_installed_msgs" in caller.error("message_details", "not_installed_msgs/Thing")

    def test_service_request_details(self, caller: Any) -> None:
        (typedef,) = caller.call("service_request_details", "rosapi/SetParam")["typedefs"]
        assert (typedef["type"], typedef["fieldnames"]) == ("rosapi/SetParamRequest", ["name", "value"])
        assert "NoSuchService" in caller.error("service_request_details", "std_srvs/NoSuchService")

    def test_service_response_details(self, caller: Any) -> None:
        typedefs = caller.call("service_response_details", "rosapi/MessageDetails")["typedefs"]
        assert [each["type"] for each in typedefs] == ["rosapi/MessageDetailsResponse", "rosapi/TypeDef"]
        assert "package/Type" in caller.error("service_response_details", "")

    def test_parameters(self, caller: Any, ros_master: RosMaster) -> None:
        value = {"text": "ü<&>", "numbers": [1, -2.5, True], "nested": {"empty": {}, "list": []}}
        assert caller.call("set_param", "robot/config", json.dumps(value)) == {}
        assert ros_master.get_param("/robot/config") == value
        assert json.loads(caller.call("get_param", "/robot/config", "")["value"]) == value
        assert caller.call("has_param", "/robot") == {"exists": True}
        assert caller.call("search_param", "robot") == {"global_name": "/robot"}
        assert "/robot/config/text" in caller.call("get_param_names")["names"]
        assert caller.call("delete_param", "robot/config") == {}
        assert caller.call("delete_param", "robot/config") == {}
        assert caller.call("has_param", "robot/config") == {"exists": False}
        assert caller.call("get_param", "/robot/config", "") == {"value": "null"}
        assert caller.call("get_param", "/robot/config", "plain") == {"value": '"plain"'}

    def test_values_that_others_have_set(self, caller: Any, ros_master: RosMaster) -> None:
        ros_master.set_param("/odd", {"data": xmlrpc.client.Binary(b"\x00"), "nan": float("nan")})
        ros_master.set_param("/when", xmlrpc.client.DateTime("20200229T12:30:05"))
        assert json.loads(caller.call("get_param", "/odd", "")["value"]) == {"data": "AA==", "nan": None}
        assert caller.call("get_param", "/when", "") == {"value": '"2020-02-29T12:30:05"'}

    @pytest.mark.parametrize("value", ["null", "3000000000", "plain text", '"\\u0000"', 100 * "[" + 100 * "]"])
    def test_values_that_cannot_be_set(self, caller: Any, value: str) -> None:
        assert "service cannot process request" in caller.error("set_param", "/impossible", value)
        assert caller.call("has_param", "/impossible") == {"exists": False}

    def test_get_time(self, caller: Any) -> None:
        assert caller.call("get_time")["time"]["secs"] > 1_500_000_000


class HungNodes:
    """Sockets that accept connections and never answer, as the ports of a stopped process do."""

    def __init__(self, count: int) -> None:
        self._sockets = [socket.create_server(("127.0.0.1", 0), backlog=64) for _ in range(count)]

    @property
    def ports(self) -> List[int]:
        return [each.getsockname()[1] for each in self._sockets]

    def close(self) -> None:
        for each in self._sockets:
            each.close()


@pytest.fixture
def hung_nodes() -> Iterator[HungNodes]:
    nodes = HungNodes(20)
    yield nodes
    nodes.close()


class TestBigGraph:
    """1500 topics, 300 services, of which 100 are at 20 nodes that hang."""

    TOPICS = 1500
    HUNG_SERVICES = 100
    LIVE_SERVICES = 200

    @pytest.fixture
    def robot(self, tmp_path: Path, hung_nodes: HungNodes) -> Iterator[RosMaster]:
        with RosMaster(tmp_path) as master:
            calls = []
            for index in range(self.TOPICS):
                number = index % len(hung_nodes.ports)
                node, api = f"/hung_{number}", f"http://127.0.0.1:{hung_nodes.ports[number]}/"
                topic = [f"/topic_{index:04}", "sensor_msgs/Image", api]
                calls.append({"methodName": "registerPublisher", "params": [node, *topic]})
            for index in range(self.HUNG_SERVICES):
                number = index % len(hung_nodes.ports)
                address = f"127.0.0.1:{hung_nodes.ports[number]}"
                service = [f"/hung_{number}/service_{index}", f"rosrpc://{address}", f"http://{address}/"]
                calls.append({"methodName": "registerService", "params": [f"/hung_{number}", *service]})
            answers: Any = xmlrpc.client.ServerProxy(master.uri).system.multicall(calls)
            assert all(answer[0][0] == 1 for answer in answers)
            command = [sys.executable, str(PROGRAMS / "provider.py"), str(self.LIVE_SERVICES - 1)]
            with master.process_in(command, "live") as live, rosapi(master):
                live.wait_for_line("all services are up", 30.0)
                yield master

    def test_answers_come_in_time(self, robot: RosMaster, start_caller: StartCaller) -> None:
        caller = start_caller(robot)
        calls = {name: caller.ask(name) for name in ("topics", "services", "nodes")}
        answers = {name: caller.answer(call_id) for name, call_id in calls.items()}
        for name, answer in answers.items():
            assert answer.took < 1.0, name
        topics, services, nodes = (answers[name].response[name] for name in ("topics", "services", "nodes"))
        assert len([topic for topic in topics if topic.startswith("/topic_")]) == self.TOPICS
        assert len([service for service in services if "/hung_" in service]) == self.HUNG_SERVICES
        assert len(services) >= 300
        assert len([node for node in nodes if node.startswith("/hung_")]) == 20

        burst = [caller.answer(call_id) for call_id in [caller.ask("topics") for _ in range(50)]]
        assert max(answer.took for answer in burst) < 1.0  # none of the connections was dropped and tried again

        slow = caller.ask("services_for_type", "std_srvs/Trigger")
        live = [caller.ask("service_type", f"/live/{name}") for name in ("empty", "trigger_5")]
        again = [caller.ask("services_for_type", "std_srvs/Trigger") for _ in range(10)]
        for call_id, kind in zip(live, ("std_srvs/Empty", "std_srvs/Trigger")):
            answer = caller.answer(call_id)
            assert answer.response == {"type": kind}
            assert answer.took < 1.0  # nobody waits for the dead nodes of others
        expected = sorted(f"/live/trigger_{index}" for index in range(self.LIVE_SERVICES - 1))
        for call_id in (slow, *again):
            answer = caller.answer(call_id)
            assert answer.took < 3.0
            assert answer.response == {"services": expected}

        known = caller.answer(caller.ask("services_for_type", "std_srvs/Empty"))
        assert known.response == {"services": ["/live/empty"]}
        assert known.took < 1.0  # neither the live nor the dead are asked again
        for _ in range(2):
            hung = caller.answer(caller.ask("service_type", "/hung_3/service_3"))
            assert hung.response == {"type": ""}
            assert hung.took < 3.0


def test_dead_services(caller: Any, ros_master: RosMaster) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        closed = f"rosrpc://127.0.0.1:{server.getsockname()[1]}"
    for name, uri in (
        ("refused", closed),
        ("lost", "rosrpc://no-such-host.invalid:1"),
        ("odd", "rosrpc://x:y"),
    ):
        register(ros_master, "registerService", "/gone", f"/gone/{name}", uri, "http://127.0.0.1:1/")
        answer = caller.answer(caller.ask("service_type", f"/gone/{name}"))
        assert answer.response == {"type": ""}
        assert answer.took < 3.0
    assert caller.call("service_host", "/gone/lost") == {"host": "no-such-host.invalid"}
    assert caller.call("services_for_type", "std_srvs/Empty") == {"services": ["/live/empty"]}


def test_a_service_that_its_node_does_not_know(caller: Any, ros_master: RosMaster) -> None:
    uri = ros_master.call("lookupService", "/live/empty")
    register(ros_master, "registerService", "/moved", "/moved", uri, "http://127.0.0.1:1/")
    assert caller.call("service_type", "/moved") == {"type": ""}


class TestMaster:
    def test_services_come_back_after_the_master_restarts_empty(
        self, tmp_path: Path, start_caller: StartCaller
    ) -> None:
        with RosMaster(tmp_path) as master, rosapi(master) as process:
            caller = start_caller(master)
            assert "/rosout" in caller.call("topics", persistent=True)["topics"]

            master.kill()
            away = wait_until(
                lambda: caller.answer(caller.ask("topics", persistent=True)).error,
                10.0,
                "an error while it is away",
            )
            assert "unreachable" in away

            master.restart()
            assert not is_up(master)
            wait_until(lambda: is_up(master), 10.0, lambda: process.output)
            assert "/rosapi" in caller.call("nodes")["nodes"]
            assert "/rosout" in caller.call("topics")["topics"]

    def test_a_hung_master_is_an_error_not_a_wait(self, tmp_path: Path, start_caller: StartCaller) -> None:
        with RosMaster(tmp_path) as master, rosapi(master):
            caller = start_caller(master)
            caller.call("get_param_names", persistent=True)
            master.process.signal(signal.SIGSTOP)
            answer = caller.answer(caller.ask("get_param_names", persistent=True), 20.0)
            assert "getParamNames" in answer.error
            assert answer.took < 10.0
            master.process.signal(signal.SIGCONT)
            assert caller.call("get_param_names", persistent=True)["names"] is not None


class TestComingAndGoing:
    def test_it_waits_for_a_master_and_says_so(self, tmp_path: Path) -> None:
        master = RosMaster(tmp_path)
        master.kill()
        with start_rosapi(master) as process:
            process.wait_for_line(f"{master.uri}.*waiting", 10.0)
            assert process.output.count("waiting") == 1
            master.restart()
            wait_until(lambda: is_up(master), 15.0, lambda: process.output)
        master.stop()

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_a_signal_ends_it(self, tmp_path: Path, number: int) -> None:
        with RosMaster(tmp_path) as master, rosapi(master) as process:
            process.signal(number)
            assert process.wait(2.5) == 0
            assert not any("/rosapi" in nodes for role in master.call("getSystemState") for _, nodes in role)
            assert "Traceback" not in process.output

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_a_signal_ends_it_before_there_is_a_master(self, tmp_path: Path, number: int) -> None:
        master = RosMaster(tmp_path)
        master.kill()
        with start_rosapi(master) as process:
            process.wait_for_line("waiting", 10.0)
            process.signal(number)
            assert process.wait(2.5) == 0
            assert "Traceback" not in process.output

    @pytest.mark.parametrize("registered", [0, 1, 4, 15, 24])
    def test_a_signal_ends_it_while_it_starts(self, tmp_path: Path, registered: int) -> None:
        """When about that many services are registered."""
        with RosMaster(tmp_path) as master, start_rosapi(master) as process:
            wait_until(lambda: master.publishers("/rosout"), 15.0, lambda: process.output)
            wait_until(lambda: len(master.call("getSystemState")[2]) >= registered, 15.0)
            process.signal(signal.SIGTERM)
            assert process.wait(4.0) == 0
            assert "Traceback" not in process.output
            assert master.call("getSystemState") == [[], [], []]

    def test_a_signal_ends_it_while_the_master_hangs(self, tmp_path: Path) -> None:
        with RosMaster(tmp_path) as master, rosapi(master) as process:
            master.process.signal(signal.SIGSTOP)
            process.signal(signal.SIGTERM)
            assert process.wait(4.0) == 0
            master.process.signal(signal.SIGCONT)

    def test_a_second_one_takes_over(self, tmp_path: Path, start_caller: StartCaller) -> None:
        with RosMaster(tmp_path) as master, rosapi(master) as first, start_rosapi(master) as second:
            assert first.wait(10.0) == 0
            wait_until(lambda: is_up(master), 10.0, lambda: second.output)
            assert "/rosapi" in start_caller(master).call("nodes")["nodes"]


class TestParameters:
    def test_globs(self, tmp_path: Path, start_caller: StartCaller) -> None:
        with RosMaster(tmp_path) as master:
            for kind, globs in (
                ("topics", "[/clo*]"),
                ("services", "[/caller/*]"),
                ("params", "['/open/*']"),
            ):
                master.set_param(f"/rosapi/{kind}_glob", globs)
            with rosapi(master):
                caller = start_caller(master)
                assert caller.call("topics")["topics"] in (["/clock"], [])
                wait_until(lambda: caller.call("topics")["topics"] == ["/clock"], 5.0)
                services = caller.call("services")["services"]
                assert set(services) == {
                    "/caller/get_loggers",
                    "/caller/set_logger_level",
                    "/rosapi/get_loggers",
                    "/rosapi/set_logger_level",
                    *(f"/rosapi/{name}" for name in SERVICES),
                }
                assert "params_glob" in caller.error("set_param", "/closed", "1")
                assert "params_glob" in caller.error("delete_param", "/rosapi/params_glob")
                assert caller.call("has_param", "/rosapi/params_glob") == {"exists": False}
                caller.call("set_param", "/open/a", "1")
                assert caller.call("get_param_names") == {"names": ["/open/a"]}

    def test_a_list_on_the_command_line(self, tmp_path: Path, start_caller: StartCaller) -> None:
        with RosMaster(tmp_path) as master, rosapi(master, "_params_glob:=['/open/*', '/too']"):
            caller = start_caller(master)
            caller.call("set_param", "/too", "1")
            caller.call("set_param", "/open/a", "1")
            assert "params_glob" in caller.error("set_param", "/closed", "1")

    def test_simulated_time(self, tmp_path: Path, start_caller: StartCaller) -> None:
        with RosMaster(tmp_path) as master:
            master.set_param("/use_sim_time", True)
            with rosapi(master):
                caller = start_caller(master)

                def simulated() -> bool:
                    caller.publish_clock(123, 456)
                    return caller.call("get_time") == {"time": {"secs": 123, "nsecs": 456}}

                wait_until(simulated, 10.0)

    def test_in_a_namespace(self, tmp_path: Path) -> None:
        with RosMaster(tmp_path) as master, start_rosapi(master, "__ns:=/robot1") as process:
            wait_until(lambda: master.providers("/robot1/rosapi/topics"), 15.0, lambda: process.output)


def test_an_argument_that_is_no_yaml_is_told(tmp_path: Path) -> None:
    with RosMaster(tmp_path) as master, start_rosapi(master, "_topics_glob:=[*]") as process:
        assert process.wait(10.0) == 1
        assert "can't start" in process.output
        assert "Traceback" not in process.output
