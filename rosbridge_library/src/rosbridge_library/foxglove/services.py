# SPDX-License-Identifier: BSD-3-Clause
"""advertiseServices, unadvertiseServices and service calls.

`Services` is what this server offers, the same for all clients. The master does not know the types of services, so
each provider is asked, with a short deadline; one that does not answer is left out, and asked again later. Calls run
beside each other and beside everything else that a client does.
"""

from __future__ import annotations

import logging
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

from rosbridge_library.capabilities.publication import AccessDenied
from rosbridge_library.capability import Capability, Operation
from rosbridge_library.codec import ServiceType, decode_json, get_service_type
from rosbridge_library.foxglove import messages
from rosbridge_library.foxglove.latest import Latest
from rosbridge_library.foxglove.offer import Change, Ids
from rosbridge_library.foxglove.options import Options, matches
from rosbridge_library.foxglove.protocol import FoxgloveProtocol
from rosbridge_library.foxglove.topics import RETRY_S
from rosbridge_library.internal.exceptions import InvalidArgumentException, RosbridgeError
from rosbridge_library.ros.graph import Graph
from rosbridge_library.ros.master import Master, MasterError
from rosbridge_library.ros.node import Node
from rosbridge_library.ros.service_probe import probe_services

logger = logging.getLogger("rosbridge.foxglove")

PROBED_AT_ONCE = 64
"""So many services share one deadline: a robot may have a thousand."""


class OfferedService(NamedTuple):
    """One service as clients see it."""

    id: int
    name: str
    type: ServiceType

    def advertisement(self) -> Dict[str, Any]:
        """Its entry in an advertiseServices message."""
        return messages.service(self.id, self.name, self.type.name, self.type.request, self.type.response)


class Services:
    """The services, by name. Belongs to the node's loop."""

    def __init__(self, node: Node, options: Options) -> None:
        self.offered: Dict[str, OfferedService] = {}
        self.known = False
        self._node = node
        self._options = options
        self._timeout_s = options.service_type_retrieval_timeout_ms / 1000
        self._audiences: List[ServiceCalls] = []
        self._ids = Ids()
        self._whole: Optional[Change] = None  # what a new client is told, if that is made already
        self._providers: Dict[str, List[str]] = {}  # those that the type of an offered service was learnt from
        self._told: Dict[str, Tuple[str, str]] = {}  # service: uri, and the type that it told
        self._retry_at_s: Dict[str, float] = {}
        self._settled: Optional[Graph] = None  # the graph of which every service is offered
        self._following: Latest[Graph] = Latest(self._follow)

    def may_see(self, service: str) -> bool:
        """Whether clients may know of `service`, and call it."""
        return self._node.access.may_call(service) and matches(self._options.service_whitelist, service)

    def add(self, audience: ServiceCalls) -> None:
        """Tell `audience` of all that is there, and of every change."""
        self._audiences.append(audience)
        if self.offered:
            if self._whole is None:
                self._whole = _change(list(self.offered.values()), ())
            audience.services_changed(self._whole)

    def remove(self, audience: ServiceCalls) -> None:
        """Tell it no more."""
        self._audiences.remove(audience)

    def follow(self, graph: Optional[Graph]) -> None:
        """Bring the services in line with the graph; without one, what there is stays."""
        if graph is not None:
            self._following.take(graph)

    def forget(self) -> None:
        """Nobody follows the graph any more: what there is will be found anew. Ids stay."""
        self._following.cancel()
        self.offered.clear()
        self._whole = None
        self._providers.clear()
        self._retry_at_s.clear()
        self._settled = None

    async def _follow(self, graph: Graph) -> None:
        if graph is self._settled:
            return
        provided = {name: nodes for name, nodes in graph.services.items() if nodes and self.may_see(name)}
        gone = [service for name, service in self.offered.items() if provided.get(name) != self._providers.get(name)]
        self._change([], gone)
        for name in [name for name in self._retry_at_s if name not in provided]:
            del self._retry_at_s[name]
        for name in [name for name in self._told if name not in provided]:
            del self._told[name]
        now_s = self._node.loop.time()
        unknown = sorted(
            name for name in provided if name not in self.offered and self._retry_at_s.get(name, 0.0) <= now_s
        )
        for start in range(0, len(unknown), PROBED_AT_ONCE):
            await self._learn(unknown[start : start + PROBED_AT_ONCE], provided)
        self._settled = graph if len(self.offered) == len(provided) else None

    async def _learn(self, names: Sequence[str], provided: Dict[str, List[str]]) -> None:
        uris = await self._node.call(_look_up, self._node.master, names)
        type_names = await self._type_names(uris)
        types = await self._node.call(_load, sorted(set(type_names.values()) - {""}))
        added = []
        for name in names:
            type_ = types.get(type_names.get(name, ""))
            if type_ is None:
                self._retry_at_s[name] = self._node.loop.time() + RETRY_S
                logger.debug("%s is left out: its type is %s", name, type_names.get(name, "not known"))
                continue
            self._providers[name] = provided[name]
            added.append(OfferedService(self._ids.of((name, type_.name, type_.md5sum)), name, type_))
        self._change(added, [])

    async def _type_names(self, uris: Dict[str, str]) -> Dict[str, str]:
        """The types of services at these uris, as far as they tell; asked once for each uri."""
        unknown = {name: uri for name, uri in uris.items() if self._told.get(name, ("", ""))[0] != uri}
        for name, header in (await probe_services(unknown, self._node.caller_id, self._timeout_s)).items():
            if isinstance(header, dict) and header.get("type"):
                self._told[name] = (uris[name], header["type"])
            else:
                logger.debug("%s does not tell its type: %s", name, header)
        return {name: self._told[name][1] for name, uri in uris.items() if self._told.get(name, ("", ""))[0] == uri}

    def _change(self, added: List[OfferedService], gone: List[OfferedService]) -> None:
        for service in gone:
            del self.offered[service.name]
            del self._providers[service.name]
        self.offered.update({service.name: service for service in added})
        if added or gone:
            self._whole = None
            change = _change(added, gone)
            for audience in list(self._audiences):
                audience.services_changed(change)


def _change(added: Sequence[OfferedService], removed: Sequence[OfferedService]) -> Change:
    payloads = []
    if removed:
        payloads.append(messages.text({"op": "unadvertiseServices", "serviceIds": [each.id for each in removed]}))
    if added:
        payloads.append(
            messages.text({"op": "advertiseServices", "services": [each.advertisement() for each in added]})
        )
    return Change(added, removed, payloads)


def _look_up(master: Master, services: Sequence[str]) -> Dict[str, str]:
    """Where services are, but for those that have just gone; blocking. Raises MasterUnreachable."""
    uris = {}
    for service in services:
        try:
            uris[service] = str(master.call("lookupService", service))
        except MasterError as error:
            logger.debug("%s", error)
    return uris


def _load(names: Sequence[str]) -> Dict[str, ServiceType]:
    """Those of these types that are installed; blocking."""
    types = {}
    for name in names:
        try:
            types[name] = get_service_type(name)
        except RosbridgeError as error:
            logger.debug("services of type %s are left out: %s", name, error)
    return types


class ServiceCalls(Capability):
    """What services one client is offered, and its calls."""

    protocol: FoxgloveProtocol

    def __init__(self, protocol: FoxgloveProtocol) -> None:
        super().__init__(protocol)
        self._offered: Dict[int, OfferedService] = {}
        protocol.register_operation(messages.SERVICE_CALL, self.call)
        protocol.server.services.add(self)

    def services_changed(self, change: Change) -> None:
        """Take a change of the services."""
        for payload in change.payloads:
            self.protocol.send_payload(payload)
        for service in change.removed:
            self._offered.pop(service.id, None)
        self._offered.update({service.id: service for service in change.added})

    def call(self, message: Operation) -> None:
        """Begin a call. It gets exactly one answer."""
        self.protocol.spawn(self._call(message), message)

    async def _call(self, message: Operation) -> None:
        service_id, call_id = message["serviceId"], message["callId"]
        try:
            response = await self._response(service_id, message["encoding"], message["payload"])
        except RosbridgeError as error:
            self.protocol.send(messages.service_call_failure(service_id, call_id, str(error)))
        except Exception as error:  # a bug here must not leave the client waiting; it is reported whole by the caller
            reason = f"internal error ({type(error).__name__})"
            self.protocol.send(messages.service_call_failure(service_id, call_id, reason))
            raise
        else:
            payload = messages.service_response(service_id, call_id, message["encoding"], response)
            self.protocol.send_payload(payload)

    async def _response(self, service_id: int, encoding: str, payload: bytes) -> bytes:
        service = self._offered.get(service_id)
        if service is None:
            raise InvalidArgumentException(f"there is no service {service_id}")
        if encoding not in messages.ENCODINGS:
            known = ", ".join(messages.ENCODINGS)
            raise InvalidArgumentException(f"the encoding must be one of {known}, not '{encoding[:100]}'")
        node, name = self.protocol.node, service.name
        if not self.protocol.server.services.may_see(name):
            raise AccessDenied(f"the server does not let clients call {name}")
        timeout_s = self.protocol.parameters.default_call_service_timeout
        if encoding == "ros1":
            reply = await node.services.call(name, payload, None, timeout_s, now=node.now)
            return reply.wire
        values = decode_json(payload)
        if not isinstance(values, dict):
            raise InvalidArgumentException(f"a request in JSON must be an object, not {type(values).__name__}")
        reply = await node.services.call(name, values, None, timeout_s, now=node.now)
        return reply.type.to_json(reply.wire)

    def finish(self) -> None:
        self.protocol.server.services.remove(self)
