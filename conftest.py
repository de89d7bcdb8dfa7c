# SPDX-License-Identifier: BSD-3-Clause
"""Fixtures of all suites: a ROS master per test module, a bridge on it, clients that are closed at the end.

A test fails when a server logged an error or a traceback that the test did not expect; a test that provokes
one says so with `@pytest.mark.allow_log("pattern", …)`. The output of every process is shown with a failure.
"""

from __future__ import annotations

import importlib
import resource
import sys
from pathlib import Path
from typing import Any, Callable, Iterator, List

import pytest

ROOT = Path(__file__).resolve().parent
SHOWN_BYTES = 6000
MAX_DATA_BYTES = 4 << 30


def _make_importable() -> None:
    """`support`, and the built packages unless the devel space was sourced already.

    The packages are imported here because pytest would else take the directories of the same names, which it
    passes on its way to the tests in them, for the packages."""
    sys.path.insert(0, str(ROOT / "test"))
    if not any((Path(entry) / "rosbridge_msgs" / "__init__.py").exists() for entry in sys.path):
        sys.path[1:1] = [str(path) for path in (ROOT / "build" / "devel" / "lib").glob("python3*/dist-packages")]
    for package in ("rosapi", "rosbridge_library", "rosbridge_server"):
        importlib.import_module(package)


_make_importable()

from support import bridge as bridges  # noqa: E402
from support import process as processes  # noqa: E402
from support import robot as robots  # noqa: E402
from support.bridge import Bridge  # noqa: E402
from support.client import Client  # noqa: E402
from support.foxglove import Foxglove  # noqa: E402
from support.node import Node  # noqa: E402
from support.peer import Peer  # noqa: E402
from support.ros import RosMaster  # noqa: E402


def pytest_configure(config: pytest.Config) -> None:
    # What runs away, here or in a process that a test starts, fails that test, and takes no machine down.
    resource.setrlimit(resource.RLIMIT_DATA, (MAX_DATA_BYTES, resource.getrlimit(resource.RLIMIT_DATA)[1]))
    config.addinivalue_line("markers", "alone: measures delays, which other tests at the same time would add to")
    config.addinivalue_line(
        "markers", "allow_log(*patterns): regular expressions of errors that the server may log in this test"
    )


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    outcome: Any = yield
    report = outcome.get_result()
    if report.failed:
        for process in processes.started:
            shown = process.output[-SHOWN_BYTES:]
            if shown:
                report.sections.append((f"output of {process.name} ({process.log_path})", shown))


@pytest.fixture(scope="module")
def ros_master(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosMaster]:
    """A master for this module; it is empty when the module begins."""
    with RosMaster(tmp_path_factory.mktemp("ros")) as master:
        yield master


@pytest.fixture(scope="module")
def bridge(ros_master: RosMaster, request: pytest.FixtureRequest) -> Iterator[Bridge]:
    """A server with the default parameters, without rosapi, for this module."""
    with Bridge(ros_master) as server:
        yield server
        server.stop()
        _fail_on(server.unexpected(_allowed(request.node)))


@pytest.fixture
def start_bridge(ros_master: RosMaster, request: pytest.FixtureRequest) -> Iterator[Callable[..., Bridge]]:
    """Starts servers for one test, with the arguments of `Bridge` after its first; a second one at a time
    needs a `name`."""
    servers: List[Bridge] = []

    def start(*arguments: Any, **options: Any) -> Bridge:
        servers.append(Bridge(ros_master, *arguments, **options))
        return servers[-1]

    yield start
    for server in servers:
        server.stop()
    _fail_on([line for server in servers for line in server.unexpected(_allowed(request.node))])


@pytest.fixture
def connect() -> Iterator[Callable[..., Client]]:
    """`connect(bridge, …)`: a new client of that server, closed when the test ends; options are those of
    `Client`."""
    clients: List[Client] = []

    def new(server: Bridge, **options: Any) -> Client:
        clients.append(server.connect(**options))
        return clients[-1]

    yield new
    for client in clients:
        client.close()


@pytest.fixture
def connect_foxglove() -> Iterator[Callable[..., Foxglove]]:
    """`connect_foxglove(bridge, …)`: a new Foxglove client of that server, closed when the test ends."""
    clients: List[Foxglove] = []

    def new(server: Bridge, **options: Any) -> Foxglove:
        clients.append(Foxglove(server.url, **options))
        return clients[-1]

    yield new
    for client in clients:
        client.close()


@pytest.fixture
def foxglove(bridge: Bridge, connect_foxglove: Callable[..., Foxglove]) -> Foxglove:
    """A Foxglove client of the module's server."""
    return connect_foxglove(bridge)


@pytest.fixture(scope="module")
def peer(ros_master: RosMaster) -> Iterator[Peer]:
    """A node that the tests of this module command."""
    node = Peer(ros_master)
    yield node
    node.node.stop()


@pytest.fixture(scope="module")
def robot(ros_master: RosMaster) -> Iterator[Node]:
    """The node that the published clients are tried with."""
    with robots.start(ros_master) as node:
        yield node


@pytest.fixture
def nodes() -> Iterator[Callable[[Node], Node]]:
    """`nodes(publish(…))`: the node, stopped when the test ends."""
    started: List[Node] = []

    def keep(node: Node) -> Node:
        started.append(node)
        return node

    yield keep
    for node in reversed(started):
        node.interrupt()  # all first: rospy takes its time to shut down
    for node in reversed(started):
        node.stop()


@pytest.fixture(autouse=True, scope="module")
def _own_processes() -> None:
    """A failure shows the processes of its own module alone."""
    del processes.started[:]


@pytest.fixture(autouse=True)
def _no_unexpected_errors(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    allowed = _allowed(request.node)
    _fail_on([line for server in bridges.running for line in server.unexpected(allowed)])


def _allowed(node: pytest.Item) -> List[str]:
    return [str(pattern) for marker in node.iter_markers("allow_log") for pattern in marker.args]


def _fail_on(lines: List[str]) -> None:
    if lines:
        pytest.fail("unexpected in the log of a server:\n" + "\n".join(lines), pytrace=False)
