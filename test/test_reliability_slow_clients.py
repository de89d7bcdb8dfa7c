# SPDX-License-Identifier: BSD-3-Clause
"""A slow client harms only itself: clients that stop, crawl or vanish among others, and links that can't carry it all.

The sensors publish with stamps, and the clients tell how late each message was. With scripts/reliability the same
tests take longer and hold stricter figures.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from typing import Callable, Dict, Iterator, List

import pytest

from support.bridge import Bridge
from support.effort import LONG, effort, figure
from support.link import Link
from support.node import Node
from support.peer import Peer
from support.programs.websocket import connect, text_frame
from support.ros import RosMaster
from support.usage import Peak, usage
from support.viewer import Viewer, sensors, subscription
from support.wait import wait_until

IMAGE, STATE, MAP = subscription("/image", "cbor-raw"), subscription("/state"), subscription("/map", "cbor-raw")
HEALTHY = 7
PINGS: Dict[str, float] = {"websocket_ping_interval": 1.0, "websocket_ping_timeout": 2.0}

pytestmark = pytest.mark.alone

Nodes = Callable[[Node], Node]
Start = Callable[..., Bridge]


def deaf_client(port: int, *subscriptions: Dict[str, str]) -> socket.socket:
    """A client that subscribes and then reads nothing by itself; its kernel takes little."""
    connection = connect(port, receive_buffer=4096)
    for wanted in subscriptions:
        connection.sendall(text_frame({"op": "subscribe", **wanted}))
    return connection


@contextlib.contextmanager
def crawling(connection: socket.socket) -> Iterator[None]:
    """Reads one byte a second."""
    end = threading.Event()

    def read() -> None:
        while not end.wait(1.0):
            with contextlib.suppress(OSError):
                connection.recv(1)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


@pytest.fixture
def counted(ros_master: RosMaster) -> Iterator[Callable[[], int]]:
    """How many clients the bridge says it has."""
    peer = Peer(ros_master)

    def count() -> int:
        if "/client_count" not in subscribed:
            peer.subscribe("/client_count", "std_msgs/Int32")
            subscribed.append("/client_count")
        return int(peer.received("/client_count", 1)[-1]["data"])

    subscribed: List[str] = []
    yield count
    peer.node.stop()


def test_stopped_crawling_and_vanished_clients_harm_nobody(
    start_bridge: Start, ros_master: RosMaster, nodes: Nodes, counted: Callable[[], int]
) -> None:
    """Ten clients, of which one is stopped, one reads a byte a second and one is cut off; and one that never took the
    latched map."""
    seconds = effort(3.0, 20.0)
    nodes(sensors(ros_master, image_bytes=effort(100_000, 230_400), map_bytes=4_000_000))
    bridge = start_bridge({**PINGS, "stall_timeout": 3.0})
    everything = [IMAGE, STATE, MAP]
    with contextlib.ExitStack() as stack:
        link = stack.enter_context(Link(bridge.port))
        healthy = stack.enter_context(Viewer(ros_master, bridge.port, everything, HEALTHY))
        sleeping = stack.enter_context(Viewer(ros_master, bridge.port, everything))
        vanishing = stack.enter_context(Viewer(ros_master, link.port, everything))
        slow = stack.enter_context(deaf_client(bridge.port, *everything))
        for viewer in (healthy, sleeping, vanishing):
            viewer.sees("/image", "/state", "/map")
        before = healthy.watch(seconds)
        memory = usage(bridge.process.pid).rss_mib
        with Peak(bridge.process.pid) as peak, crawling(slow):
            sleeping.stop()
            link.rate = 0
            never = stack.enter_context(deaf_client(bridge.port, MAP))
            began = time.monotonic()
            after = healthy.watch(seconds)
            wait_until(lambda: counted() == HEALTHY, 10.0, lambda: f"{HEALTHY} clients, but {counted()}")
            gone_after = time.monotonic() - began
        assert never.fileno() > 0
        assert healthy.closed == []
    for view in (before, after):
        figure(
            "healthy clients" + (" beside broken ones" if view is after else ""),
            images_per_s=view.rate("/image"),
            states_per_s=view.rate("/state"),
            state_median_ms=1000 * view.percentile("/state", 50),
            state_p99_ms=1000 * view.percentile("/state", 99),
        )
    figure("server", rss_mib_before=memory, rss_mib_peak=peak.rss_mib, broken_clients_gone_after_s=gone_after)
    assert after.rate("/state") > 0.95 * before.rate("/state") > 45
    assert after.rate("/image") > 0.95 * before.rate("/image") > 27
    assert len(after.delays("/map")) == 0, "the latched map came again"
    floor_s = effort(0.05, 0.01)  # what a machine with other work adds by itself
    assert after.percentile("/state", 99) < max(2 * before.percentile("/state", 99), floor_s)
    assert peak.rss_mib < memory + 40
    assert gone_after < seconds + 10


@pytest.mark.parametrize(
    ("image_bytes", "wishes", "median_s"),
    [
        (250_000, {"compression": "cbor-raw"}, 0.2),
        (900_000, {"compression": "cbor-raw"}, 0.6),
        (900_000, {"compression": "none", "fragment_size": 50_000}, 0.1),
    ],
)
def test_a_state_topic_keeps_its_rate_beside_images_on_a_link_of_1_mb_a_second(
    start_bridge: Start,
    ros_master: RosMaster,
    nodes: Nodes,
    image_bytes: int,
    wishes: Dict[str, object],
    median_s: float,
) -> None:
    seconds = effort(3.0, 30.0)
    nodes(sensors(ros_master, image_bytes=image_bytes))
    bridge = start_bridge()
    image = subscription("/image", **wishes)  # type: ignore[arg-type]
    wire_bytes = image_bytes * (4 / 3 if wishes["compression"] == "none" else 1)
    with Link(bridge.port, rate=1e6) as link, Viewer(ros_master, link.port, [image, STATE]) as viewer:
        viewer.sees("/image", "/state")
        time.sleep(2.0)  # the burst that is allowed to wait has gone out
        slow = viewer.watch(seconds)
        link.rate = None
        recovered = time.time()
        healed = viewer.view(recovered + 1.0, recovered + 2.0)
    figure(
        f"1 MB/s, images of {image_bytes} bytes, {wishes}",
        states_per_s=slow.rate("/state"),
        state_median_ms=1000 * slow.percentile("/state", 50),
        state_p99_ms=1000 * slow.percentile("/state", 99),
        images_per_s=slow.rate("/image"),
        image_age_max_s=slow.percentile("/image", 100),
        image_age_max_ms_when_healed=1000 * healed.percentile("/image", 100),
    )
    assert slow.rate("/state") > effort(40, 45)  # in bursts, of which few make up a short time
    assert slow.percentile("/state", 50) < median_s
    assert slow.rate("/image") * wire_bytes > 0.75e6, "the rest of the link is the images'"
    assert slow.percentile("/image", 100) < 3 * wire_bytes / 1e6 + 0.3, "an old image instead of the newest"
    assert any("/image" in warning for warning in slow.warnings), "nobody told that images are dropped"
    assert not any("/state" in warning for warning in slow.warnings)
    assert len(slow.warnings) <= seconds + 1, "told more often than once a second"
    assert healed.rate("/image") > 20
    assert healed.percentile("/image", 90) < 0.3
    assert healed.percentile("/state", 90) < 0.1


def test_the_long_form_is_not_run_by_accident() -> None:
    assert effort("short", "long") == ("long" if LONG else "short")
