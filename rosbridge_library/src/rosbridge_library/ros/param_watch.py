# SPDX-License-Identifier: BSD-3-Clause
"""Changes of parameters, as the master tells them to subscribers.

The master calls each node that subscribed to a parameter when it, a part of it, or a namespace around it is set or
deleted. rospy keeps such values in a cache; here a cache that also tells listeners takes its place. Each parameter is
subscribed to once for all listeners, and again when the master was started anew.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
from typing import Any, Awaitable, Callable, Dict, Iterable, List, Set

import rospy.impl.paramserver

from rosbridge_library.names import global_name
from rosbridge_library.ros.master import Master
from rosbridge_library.ros.registrar import Registrar

Listener = Callable[[str, Any], None]
"""Told the global name of what was set, and its value: {} when it was deleted."""


class ParamWatch:
    """The parameters that are watched, and by whom. All methods are for the loop's thread."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        master: Master,
        registrar: Registrar,
        call_blocking: Callable[..., Awaitable[Any]],
    ) -> None:
        self._loop = loop
        self._master = master
        self._registrar = registrar
        self._call_blocking = call_blocking
        self._listeners: Dict[str, Set[Listener]] = {}
        self._subscribed: Set[str] = set()
        self._generation = 0
        self._settling = asyncio.Lock()

    def install(self) -> None:
        """Take the place of rospy's cache; after rospy.init_node."""
        rospy.impl.paramserver._param_server_cache = _TellingCache(self._loop, self._updated)

    def add(self, names: Iterable[str], listener: Listener) -> None:
        """Tell `listener` of changes of these global names, once `settle` has told the master."""
        for name in names:
            self._listeners.setdefault(name, set()).add(listener)

    def remove(self, names: Iterable[str], listener: Listener) -> None:
        """Tell `listener` no more of these."""
        for name in names:
            listeners = self._listeners.get(name, set())
            listeners.discard(listener)
            if not listeners:
                self._listeners.pop(name, None)

    @property
    def unsettled(self) -> bool:
        """Whether the master has to be told something."""
        return self._subscribed != set(self._listeners) or self._generation != self._registrar.generation

    async def settle(self) -> None:
        """Tell the master what is watched now. Raises MasterUnreachable or MasterError; then `unsettled` stays."""
        async with self._settling:
            if self._generation != self._registrar.generation:
                self._generation = self._registrar.generation
                self._subscribed.clear()
            wanted = set(self._listeners)
            await self._call_blocking(self._tell_master, wanted - self._subscribed, self._subscribed - wanted)

    def _tell_master(self, added: Set[str], removed: Set[str]) -> None:
        uri = self._registrar.rospy_registration.uri
        for name in sorted(added):
            self._master.call("subscribeParam", uri, name)
            self._loop.call_soon_threadsafe(self._subscribed.add, name)
        for name in sorted(removed):
            self._master.call("unsubscribeParam", uri, name)
            self._loop.call_soon_threadsafe(self._subscribed.discard, name)

    def _updated(self, name: str, value: Any) -> None:
        """Tell, once each, those who watch the parameter or a namespace that it is in."""
        parts: List[str] = name.strip("/").split("/")
        above = ["/", *("/" + "/".join(parts[: end + 1]) for end in range(len(parts)))]
        told: Set[Listener] = set().union(*(self._listeners.get(each, set()) for each in above))
        for listener in told:
            listener(name, value)


class _TellingCache(rospy.impl.paramserver.ParamServerCache):  # type: ignore[misc]  # rospy has no types
    """rospy's cache, which also tells of what it is told, in the thread of rospy's XML-RPC server."""

    def __init__(self, loop: asyncio.AbstractEventLoop, updated: Listener) -> None:
        super().__init__()
        self._tell: Callable[[str, Any], object] = functools.partial(loop.call_soon_threadsafe, updated)  # type: ignore[arg-type]

    def update(self, key: str, value: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody is left to tell
            self._tell(global_name(key), value)
        with contextlib.suppress(LookupError):  # rospy itself does not keep this one
            super().update(key, value)
