# SPDX-License-Identifier: BSD-3-Clause
"""Asking services for their type: one, and hundreds of which many hang."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from typing import Dict, Iterator, List

import pytest

from rosbridge_library.ros.service_probe import (
    ServiceRefused,
    ServiceUnreachable,
    probe_service,
    probe_services,
)
from support import node as nodes
from support.ros import RosMaster

SERVICES = 150


@pytest.fixture(scope="module")
def live(ros_master: RosMaster) -> Iterator[Dict[str, str]]:
    """The uris of the services of two nodes, which have many each."""
    source = (
        "from std_srvs.srv import Trigger\n"
        "name = rospy.get_name()\n"
        f"for number in range({SERVICES}):\n"
        "    rospy.Service(f'{name}/service_{number}', Trigger, lambda request: (True, ''))\n"
        "ready()\nrospy.spin()\n"
    )
    with nodes.script(ros_master, source, name="first"), nodes.script(ros_master, source, name="second"):
        names = [f"/{node}/service_{number}" for node in ("first", "second") for number in range(SERVICES)]
        yield {name: ros_master.call("lookupService", name) for name in names}


@contextlib.contextmanager
def silent_nodes(count: int) -> Iterator[List[str]]:
    """The uris of nodes that let one connect and then say nothing, as a stopped process does."""
    with contextlib.ExitStack() as stack:
        listeners = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        yield [f"rosrpc://127.0.0.1:{listener.getsockname()[1]}" for listener in listeners]


def closed_uri() -> str:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return f"rosrpc://127.0.0.1:{listener.getsockname()[1]}"


def test_header_of_a_service(live: Dict[str, str]) -> None:
    name, uri = next(iter(live.items()))
    header = asyncio.run(probe_service(uri, name, "/test", 5.0))
    assert header["type"] == "std_srvs/Trigger"
    assert header["md5sum"] == "937c9679a518e3a18d831e57125ea522"
    assert header["callerid"] == "/first"


def test_not_provided(live: Dict[str, str]) -> None:
    uri = next(iter(live.values()))
    with pytest.raises(ServiceRefused, match=r"/first.*is not a provider of.*/other"):
        asyncio.run(probe_service(uri, "/other", "/test", 5.0))


def test_nobody_there() -> None:
    uri = closed_uri()
    with pytest.raises(ServiceUnreachable, match=f"/service can't be reached at {uri}: Connection refused"):
        asyncio.run(probe_service(uri, "/service", "/test", 5.0))


def test_no_answer() -> None:
    with silent_nodes(1) as (uri,):
        begin = time.monotonic()
        with pytest.raises(ServiceUnreachable, match=rf"{uri}: no answer within 0\.3 s"):
            asyncio.run(probe_service(uri, "/service", "/test", 0.3))
        assert time.monotonic() - begin < 1.0


def test_a_name_that_can_not_be_sent() -> None:
    with silent_nodes(1) as (uri,), pytest.raises(ServiceUnreachable, match="not valid text"):
        asyncio.run(probe_service(uri, "/\ud800", "/test", 0.3))


def test_none() -> None:
    assert asyncio.run(probe_services({}, "/test", 1.0)) == {}


def test_hundreds_of_which_many_hang(live: Dict[str, str]) -> None:
    """20 nodes of 15 services hang, and more nodes than there may be connections: the others answer in time."""
    with silent_nodes(20) as silent:
        hanging = {f"/silent_{node}/{number}": silent[node] for node in range(20) for number in range(15)}
        gone = {f"/gone/{number}": closed_uri() for number in range(20)}
        refused = {f"/refused/{number}": next(iter(live.values())) for number in range(20)}
        services = {**hanging, **gone, **refused, **live}
        begin = time.monotonic()
        results = asyncio.run(probe_services(services, "/test", 1.5, concurrency=24))
        assert time.monotonic() - begin < 2.0
    assert set(results) == set(services)
    for name in live:
        header = results[name]
        assert isinstance(header, dict), header
        assert header["type"] == "std_srvs/Trigger"
    for name in hanging:
        assert isinstance(results[name], ServiceUnreachable)
        assert f"{name} can't be reached at {services[name]}: no answer" in str(results[name])
    for name in gone:
        assert "Connection refused" in str(results[name])
    assert all(isinstance(results[name], ServiceRefused) for name in refused)


def test_done_as_soon_as_all_answered(live: Dict[str, str]) -> None:
    begin = time.monotonic()
    results = asyncio.run(probe_services(live, "/test", 60.0))
    assert all(isinstance(result, dict) for result in results.values())
    assert time.monotonic() - begin < 10.0


def test_a_dead_node_is_asked_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        uri = f"rosrpc://127.0.0.1:{listener.getsockname()[1]}"
        asyncio.run(probe_services({f"/service_{number}": uri for number in range(50)}, "/test", 0.3))
        listener.setblocking(False)
        listener.accept()[0].close()
        with pytest.raises(BlockingIOError):
            listener.accept()


def test_cancelled_by_its_caller() -> None:
    async def main() -> None:
        with silent_nodes(3) as silent:
            task = asyncio.ensure_future(probe_services({f"/service_{uri}": uri for uri in silent}, "/test", 60.0))
            await asyncio.wait({task}, timeout=0.2)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            assert len(asyncio.all_tasks()) == 1

    asyncio.run(main())
