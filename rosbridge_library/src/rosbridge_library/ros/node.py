# SPDX-License-Identifier: BSD-3-Clause
"""The bridge's ROS side, shared by all clients of every protocol.

A `Node` belongs to one event loop, which owns all its state. Blocking ROS calls leave the loop through `Node.call`.
Make it after rospy.init_node and `start` it: from then on topic connections are read and written on the loop (see
`tcpros`), and registrations survive the master (see `registrar`).

A program that uses the library's classes without a loop of its own (as programs written for rosbridge_library do)
shares the node of `background_node`, whose loop runs in a thread.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import threading
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Any, Callable, Optional, Tuple, TypeVar

import rospy
import rospy.impl.tcpros
import rospy.impl.tcpros_base
from rospy.impl.registration import Registration, get_topic_manager

from rosbridge_library.access import Access
from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.ros.accepting import relieve_accept_thread
from rosbridge_library.ros.feeds import Feeds
from rosbridge_library.ros.graph import Graph, GraphReader, GraphWatch, TopicInfo
from rosbridge_library.ros.master import Master, MasterUnreachable
from rosbridge_library.ros.outcome import know_outcome
from rosbridge_library.ros.param_watch import ParamWatch
from rosbridge_library.ros.providers import ServiceProviders
from rosbridge_library.ros.publishers import Publishers
from rosbridge_library.ros.registrar import Registrar
from rosbridge_library.ros.services import ServiceCaller
from rosbridge_library.ros.tcpros import LoopTcprosHandler

logger = logging.getLogger("rosbridge.node")

CALL_THREADS = 16
MASTER_TIMEOUT_S = 5.0
AWAY_AFTER_S = 1.2
CALL_TIMEOUT_S = MASTER_TIMEOUT_S + 1.0
"""Longer, because what a call to the master says when its own time is over tells more."""
DEFAULT_UNREGISTER_TIMEOUT_S = 10.0

T = TypeVar("T")


class RosTimeout(RosbridgeError):
    """A blocking ROS call didn't end in time."""


async def call_blocking(
    threads: Executor, function: Callable[..., T], args: Tuple[Any, ...], timeout: Optional[float]
) -> T:
    """See `Node.call`."""
    work = asyncio.get_running_loop().run_in_executor(threads, functools.partial(function, *args))
    try:
        # Not wait_for: before Python 3.12 it may swallow a cancellation that comes at its end.
        await asyncio.wait({work}, timeout=timeout)
        if work.done():
            return work.result()
    finally:
        if not work.cancel() and not work.cancelled():
            work.exception()  # known now, also when nobody waits for it any more
    name = getattr(function, "__name__", str(function))
    raise RosTimeout(f"no answer to {name} within {timeout:g} s")


class Node:
    """Feeds, publishers, services and the master, for one process. All methods are for the loop's thread."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        access: Optional[Access] = None,
        unregister_timeout_s: float = DEFAULT_UNREGISTER_TIMEOUT_S,
    ) -> None:
        self.loop = loop
        self.access = access or Access()
        self.caller_id: str = rospy.get_name()
        self.master = Master(self.caller_id, timeout=MASTER_TIMEOUT_S)
        self._threads = ThreadPoolExecutor(CALL_THREADS, thread_name_prefix="ros-call")
        self._registrar = Registrar(self.master)
        self._handler = LoopTcprosHandler(loop, functools.partial(self._registrar.renew, Registration.SUB))
        self.feeds = Feeds(loop, self._handler, self._registrar, self.now)
        self.publishers = Publishers(loop, self._handler, unregister_timeout_s)
        self.services = ServiceCaller(self.call, self.master, self.caller_id)
        self.providers = ServiceProviders(self.call, self.master, self.caller_id)
        self._graph_reader = GraphReader(self.master)
        self.graph_watch = GraphWatch(self._ask_graph)
        self.param_watch = ParamWatch(loop, self.master, self._registrar, self.call)
        self._topic_lookup: Optional[asyncio.Task[Graph]] = None
        self._graph: Optional[Graph] = None
        self._graph_time_s = 0.0

    async def start(self) -> None:
        """Take rospy's place at the topic sockets and at the master. Raises RuntimeError before rospy.init_node."""
        relieve_accept_thread()
        self._registrar.install()
        self.param_watch.install()
        rospy.impl.tcpros._handler = self._handler
        rospy.impl.tcpros_base._tcpros_server.topic_connection_handler = self._handler.topic_connection_handler
        self._registrar.rospy_registration.handler.protocol_handlers[:] = [self._handler]
        # What rospy has subscribed so far (/clock) is read by its threads; connect it anew, on the loop.
        for topic, subscriber in list(get_topic_manager().subs.items()):
            for connection in list(subscriber.connections):
                connection.close()
            self._registrar.renew(Registration.SUB, topic)

    async def stop(self) -> None:
        """End every feed, publisher and provided service. Doesn't wait for the master."""
        self.graph_watch.close()
        self.feeds.close_all()
        self.publishers.close_all()
        await self.providers.close()
        await self.services.close()
        await self.loop.run_in_executor(None, self._registrar.close)
        self._threads.shutdown(wait=False)

    async def call(self, function: Callable[..., T], *args: Any, timeout: Optional[float] = CALL_TIMEOUT_S) -> T:
        """What the blocking `function(*args)` returns, run on the thread pool.

        Raises RosTimeout after `timeout` seconds (the thread then goes on by itself, so `function` needs a deadline
        of its own), and whatever `function` raises.
        """
        return await call_blocking(self._threads, function, args, timeout)

    async def registered(self, kind: str, name: str) -> None:
        """Wait until the master knows a publisher ("pub") or service ("srv") of this node.

        Raises MasterError when it refuses, MasterUnreachable when it takes too long; it is told when it is back.
        """
        settled = asyncio.wrap_future(self._registrar.settled(kind, name))
        try:
            await asyncio.wait({settled}, timeout=AWAY_AFTER_S)
            # A master that is known to be away by now is not waited for.
            left_s = MASTER_TIMEOUT_S - AWAY_AFTER_S if self._registrar.trouble is None else 0
            await asyncio.wait_for(settled, left_s)
        except asyncio.TimeoutError:
            reason = self._registrar.trouble or f"the master did not register {name} within {MASTER_TIMEOUT_S:g} s"
            raise MasterUnreachable(reason) from None

    @property
    def master_generation(self) -> int:
        """Counts up when the master is found to have been started anew."""
        return self._registrar.generation

    @staticmethod
    def is_simulated() -> bool:
        """Whether time is that of /clock: /use_sim_time was set when this node began."""
        return not rospy.rostime.is_wallclock()

    @staticmethod
    def now() -> Tuple[int, int]:
        """ROS time as seconds and nanoseconds: simulated time when /use_sim_time is set."""
        time = rospy.get_rostime()
        return time.secs, time.nsecs

    def resolve(self, global_name: str) -> str:
        """The name that ROS uses for a global name: another one where this node was started with a remapping."""
        resolved: str = rospy.names.resolve_name(global_name)
        return resolved

    async def topic(self, topic: str, max_age_s: float = 0.0) -> TopicInfo:
        """What the master knows of `topic`, asked after this call, or at most `max_age_s` before it.

        Raises MasterUnreachable or MasterError.

        The master remembers the types of topics that are gone, so a topic that nobody publishes or subscribes has no
        type here.
        """
        if self._graph is not None and self.loop.time() - self._graph_time_s < max_age_s:
            return self._graph.topic(topic)
        # One look serves all who asked before it began.
        lookup = self._topic_lookup
        if lookup is None:
            lookup = self._topic_lookup = self.loop.create_task(self._look_up_topics())
            lookup.add_done_callback(know_outcome)
        graph = await asyncio.shield(lookup)
        return graph.topic(topic)

    async def _look_up_topics(self) -> Graph:
        await asyncio.sleep(0)  # whoever asks in this turn of the loop is served too
        self._topic_lookup = None
        return await self._ask_graph()

    async def _ask_graph(self) -> Graph:
        time_s = self.loop.time()
        graph = await self.call(self._graph_reader.ask, timeout=2 * MASTER_TIMEOUT_S + 1)
        self._graph, self._graph_time_s = graph, time_s
        return graph


class _Background:
    """The loop and node of programs that have no loop."""

    def __init__(self) -> None:
        self._lock = threading.Lock()  # at the door: any thread may be the first to ask
        self._node: Optional[Node] = None

    def node(self) -> Node:
        with self._lock:
            if self._node is None:
                loop = asyncio.new_event_loop()
                threading.Thread(target=loop.run_forever, name="rosbridge-loop", daemon=True).start()
                node = asyncio.run_coroutine_threadsafe(self._make(loop), loop).result()
                self._node = node
            return self._node

    @staticmethod
    async def _make(loop: asyncio.AbstractEventLoop) -> Node:
        node = Node(loop)
        await node.start()
        return node


background_node: Callable[[], Node] = _Background().node
"""The node of a program without a loop of its own, made at the first call, from any thread."""
