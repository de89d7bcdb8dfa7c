# SPDX-License-Identifier: BSD-3-Clause
"""getParameters, setParameters, subscribeParameterUpdates, unsubscribeParameterUpdates and parameterValues.

A parameter that clients may not use looks as if it were not set, and can't be set; nor can a namespace that holds
one. An entry without a value stands for a parameter that is not set, or not any more.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Any, Dict, List, Optional

from rosbridge_library.capabilities.publication import AccessDenied
from rosbridge_library.capability import Capability, Operation
from rosbridge_library.foxglove import messages
from rosbridge_library.foxglove.fields import entries, optional_text, text
from rosbridge_library.foxglove.options import Options, matches
from rosbridge_library.foxglove.parameter_values import ABSENT, entry, from_entry, leaves, visible
from rosbridge_library.foxglove.protocol import FoxgloveProtocol
from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.names import checked_global_name, global_name
from rosbridge_library.ros.master import Master, MasterError, MasterUnreachable
from rosbridge_library.ros.node import Node

logger = logging.getLogger("rosbridge.foxglove")

READ_TIMEOUT_S = 30.0
"""Reading one by one, where the parameter server can't give all at once, takes its time."""


class ParameterServer:
    """The parameter server as clients may use it; calls block, and belong on the thread pool."""

    def __init__(self, node: Node, options: Options) -> None:
        self._access = node.access
        self._whitelist = options.param_whitelist
        self._reader = node.master
        # The master does not tell a node of changes that it made itself: with another name, one client hears of what
        # another has set in the same way as of all else.
        self._writer = Master(f"{node.caller_id}_parameters", node.master.uri, node.master.timeout)

    def may_use(self, name: str) -> bool:
        """Whether clients may use the parameter of this global name."""
        return self._access.may_use_param(name) and matches(self._whitelist, name)

    def value(self, name: str) -> Any:
        """What a client sees of a parameter or namespace, or ABSENT. Raises MasterUnreachable."""
        return visible(name, self._get(name), self.may_use)

    def all(self) -> Dict[str, Any]:
        """All parameters that clients may see, by name. Raises MasterUnreachable and MasterError."""
        try:
            tree = self._reader.call("getParam", "/")
        except (MasterError, MasterUnreachable) as error:
            # The master can hold values that it can't write: one of them spoils the answer for all.
            logger.debug("%s", error)
            names = self._reader.call("getParamNames")
            values = {name: self._get(name) for name in names if self.may_use(name)}
            return {name: value for name, value in values.items() if value is not ABSENT}
        return {name: value for name, value in leaves("/", tree) if self.may_use(name)}

    def set(self, name: str, value: Any) -> None:
        """Set a parameter, or delete it with ABSENT. Raises AccessDenied, MasterUnreachable, UnsupportedValue."""
        changed = {name} if value is ABSENT or value == {} else {leaf for leaf, _ in leaves(name, value)}
        present = self._get(name)
        if isinstance(present, dict):
            changed |= {leaf for leaf, _ in leaves(name, present)}
        if not all(map(self.may_use, changed)):
            raise AccessDenied(f"the server does not let clients change the parameter {name}")
        if value is not ABSENT:
            self._writer.call("setParam", name, value)
        elif present is not ABSENT:
            self._writer.call("deleteParam", name)

    def _get(self, name: str) -> Any:
        try:
            return self._reader.call("getParam", name)
        except MasterError as error:
            # It also answers so when it can't write the value.
            logger.debug("%s", error)
            return ABSENT


class ParameterAccess(Capability):
    """Reads and sets parameters for one client."""

    protocol: FoxgloveProtocol

    def __init__(self, protocol: FoxgloveProtocol) -> None:
        super().__init__(protocol)
        protocol.register_operation("getParameters", self.get)
        protocol.register_operation("setParameters", self.set)

    async def get(self, message: Operation) -> None:
        """Answer with the parameters of these names, or all. Those that are not set have no value."""
        names, request_id = entries(message, "parameterNames", str), optional_text(message, "id")
        server = self.protocol.server.parameters
        if names:
            values = await self.protocol.node.call(_read, server, names, timeout=READ_TIMEOUT_S)
        else:
            values = await self.protocol.node.call(server.all, timeout=READ_TIMEOUT_S)
        self._answer(values, request_id)

    async def set(self, message: Operation) -> None:
        """Set or unset each of these, as far as possible; answer with what they are then, if an id asks for it."""
        parameters, request_id = entries(message, "parameters", dict), optional_text(message, "id")
        names = []
        for parameter in parameters:
            try:
                names.append(await self._set(parameter))
            except RosbridgeError as error:
                self.protocol.log("error", f"setParameters: {error}")
                if isinstance(parameter.get("name"), str):
                    names.append(parameter["name"])
        if request_id is not None:
            server = self.protocol.server.parameters
            values = await self.protocol.node.call(_read, server, names, timeout=READ_TIMEOUT_S)
            self._answer(values, request_id)

    async def _set(self, parameter: Operation) -> str:
        name, value = text(parameter, "name"), from_entry(parameter)
        key = checked_global_name(name, "parameter")
        await self.protocol.node.call(self.protocol.server.parameters.set, key, value)
        return name

    def _answer(self, values: Dict[str, Any], request_id: Optional[str]) -> None:
        told = [entry(name, value) for name, value in values.items()]
        self.protocol.send(messages.parameter_values(told, request_id))


def _read(server: ParameterServer, names: List[str]) -> Dict[str, Any]:
    """The values by the names as the client wrote them; blocking."""
    return {name: server.value(global_name(name)) for name in names}


class ParameterUpdates(Capability):
    """Tells one client of changes of the parameters that it subscribed to."""

    protocol: FoxgloveProtocol

    def __init__(self, protocol: FoxgloveProtocol) -> None:
        super().__init__(protocol)
        self._names: Dict[str, str] = {}  # global name: as the client wrote it
        self._watch = protocol.node.param_watch
        protocol.register_operation("subscribeParameterUpdates", self.subscribe)
        protocol.register_operation("unsubscribeParameterUpdates", self.unsubscribe)

    async def subscribe(self, message: Operation) -> None:
        """Subscribe to these, or to all that there are now."""
        names = entries(message, "parameterNames", str)
        server = self.protocol.server.parameters
        wanted = {checked_global_name(name, "parameter"): name for name in names}
        if not names:
            wanted = {name: name for name in await self.protocol.node.call(server.all, timeout=READ_TIMEOUT_S)}
        closed = [name for name in names if not server.may_use(global_name(name))]
        if closed:
            reason = f"the server does not let clients use {', '.join(closed)}"
            self.protocol.log("error", f"subscribeParameterUpdates: {reason}")
        for key, name in wanted.items():
            if name not in closed:
                self._names.setdefault(key, name)
        self._watch.add(list(self._names), self._updated)
        await self._watch.settle()

    async def unsubscribe(self, message: Operation) -> None:
        """Unsubscribe from these, or from all."""
        names = entries(message, "parameterNames", str)
        keys = {global_name(name) for name in names} if names else set(self._names)
        for key in keys:
            self._names.pop(key, None)
        self._watch.remove(keys, self._updated)
        await self._watch.settle()

    def _updated(self, key: str, value: Any) -> None:
        # The master says {} of what was deleted; a namespace without parameters is none either.
        server = self.protocol.server.parameters
        seen = visible(key, value, server.may_use)
        if seen is not ABSENT or server.may_use(key):
            self.protocol.send(
                messages.parameter_values([entry(self._names.get(key, key), ABSENT if seen == {} else seen)])
            )

    def finish(self) -> None:
        if self._names:
            self._watch.remove(list(self._names), self._updated)
            settling = self.protocol.loop.create_task(self._watch.settle())
            settling.add_done_callback(_settled)


def _settled(task: asyncio.Task[None]) -> None:
    error = None if task.cancelled() else task.exception()
    if error is not None:  # the watch stays unsettled, and settles when it is next used
        logger.debug("the master was not told that parameters are watched no more: %s", error)
