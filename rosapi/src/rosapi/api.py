# SPDX-License-Identifier: BSD-3-Clause
"""What rosapi answers: one method per service, named and filled in like it, without a node around it.

A method takes the fields of the request and returns the fields of the response. What is unknown, or closed by
the globs, is an empty string or list. Only the details of a type and changes of parameters fail, as does
everything while the master is away: with a `RosbridgeError` that tells the reason. Names are global names.
"""

from __future__ import annotations

import re
from typing import Any, Callable, Dict, List, Mapping, Sequence, Tuple

from rosapi import typedefs
from rosapi.graph import Graph, action_servers, fetch_graph, names_with
from rosapi.params import Params
from rosapi.recent import Recent
from rosapi.service_types import Probe, ServiceTypes
from rosbridge_library.access import Access
from rosbridge_library.internal.exceptions import TypeLoadError
from rosbridge_library.names import global_name
from rosbridge_library.ros.master import MasterError
from rosbridge_library.xml_text import is_xml_text

MAX_AGE_S = 1.0
"""How old the master's state may be that an answer comes from."""

_TYPE_NAME = re.compile(r"[A-Za-z]\w*/[A-Za-z]\w*\Z")

Response = Dict[str, Any]


class Api:
    """Answers from the master (`call(method, *arguments)`) and from service nodes (`probe`), within `access`.

    `look_up` gives the uris of services by name, `now` is the ROS time. Safe to call from several threads.
    """

    def __init__(
        self,
        call: Callable[..., Any],
        look_up: Callable[[Sequence[str]], Mapping[str, str]],
        probe: Probe,
        now: Callable[[], Any],
        access: Access,
    ) -> None:
        self._call = call
        self._now = now
        self._access = access
        self._params = Params(call, access)
        self._graph: Recent[Graph] = Recent(lambda: fetch_graph(call), MAX_AGE_S)
        self._uris: Recent[Mapping[str, str]] = Recent(lambda: look_up(fetch_graph(call).services()), MAX_AGE_S)
        self._service_types = ServiceTypes(probe)

    # Topics.

    def topics(self) -> Response:
        topics, types = self._topics_and_types()
        return {"topics": topics, "types": types}

    def topics_for_type(self, type: str) -> Response:
        return {"topics": [topic for topic, kind in zip(*self._topics_and_types()) if type and kind == type]}

    def topics_and_raw_types(self) -> Response:
        topics, types = self._topics_and_types()
        texts = {kind: _definition_text(kind) for kind in set(types)}
        return {"topics": topics, "types": types, "typedefs_full_text": [texts[kind] for kind in types]}

    def topic_type(self, topic: str) -> Response:
        name = global_name(topic)
        return {"type": self._graph.get().topic_type(name) if self._may_see_topic(name) else ""}

    def publishers(self, topic: str) -> Response:
        return {"publishers": self._nodes_of_topic(self._graph.get().publishers, topic)}

    def subscribers(self, topic: str) -> Response:
        return {"subscribers": self._nodes_of_topic(self._graph.get().subscribers, topic)}

    def action_servers(self) -> Response:
        return {"action_servers": action_servers(self._topics())}

    # Services.

    def services(self) -> Response:
        return {"services": self._services()}

    def services_for_type(self, type: str) -> Response:
        return {"services": self._services_of_type(type)}

    def service_type(self, service: str) -> Response:
        name, uri = self._look_up(service)
        return {"type": self._service_types.types({name: uri}).get(name, "") if uri else ""}

    def service_node(self, service: str) -> Response:
        return {"node": next(iter(self._providers(service)), "")}

    def service_host(self, service: str) -> Response:
        return {"host": _host(self._look_up(service)[1])}

    def service_providers(self, service: str) -> Response:
        """The nodes that provide the service of this name; or, as old clients ask, services of this type."""
        providers = set(self._providers(service))
        if not providers and _TYPE_NAME.match(service):
            providers.update(*(self._providers(each) for each in self._services_of_type(service)))
        return {"providers": sorted(providers)}

    # Nodes.

    def nodes(self) -> Response:
        return {"nodes": self._graph.get().nodes()}

    def node_details(self, node: str) -> Response:
        graph, name = self._graph.get(), global_name(node)
        return {
            "subscribing": list(filter(self._may_see_topic, names_with(graph.subscribers, name))),
            "publishing": list(filter(self._may_see_topic, names_with(graph.publishers, name))),
            "services": list(filter(self._access.may_call, names_with(graph.providers, name))),
        }

    # Types.

    def message_details(self, type: str) -> Response:
        return {"typedefs": typedefs.message_typedefs(type)}

    def service_request_details(self, type: str) -> Response:
        return {"typedefs": typedefs.request_typedefs(type)}

    def service_response_details(self, type: str) -> Response:
        return {"typedefs": typedefs.response_typedefs(type)}

    # Parameters.

    def get_param(self, name: str, default: str) -> Response:
        return {"value": self._params.get(name, default)}

    def set_param(self, name: str, value: str) -> Response:
        self._params.set(name, value)
        return {}

    def has_param(self, name: str) -> Response:
        return {"exists": self._params.has(name)}

    def search_param(self, name: str) -> Response:
        return {"global_name": self._params.search(name)}

    def delete_param(self, name: str) -> Response:
        self._params.delete(name)
        return {}

    def get_param_names(self) -> Response:
        return {"names": self._params.names()}

    # Time.

    def get_time(self) -> Response:
        return {"time": self._now()}

    # What the answers have in common.

    def _may_see_topic(self, topic: str) -> bool:
        return self._access.may_subscribe(topic) or self._access.may_publish(topic)

    def _topics(self) -> List[str]:
        return list(filter(self._may_see_topic, self._graph.get().topics()))

    def _topics_and_types(self) -> Tuple[List[str], List[str]]:
        graph = self._graph.get()
        topics = list(filter(self._may_see_topic, graph.topics()))
        return topics, [graph.topic_type(topic) for topic in topics]

    def _nodes_of_topic(self, nodes: Mapping[str, Sequence[str]], topic: str) -> List[str]:
        name = global_name(topic)
        return list(nodes.get(name, ())) if self._may_see_topic(name) else []

    def _services(self) -> List[str]:
        return list(filter(self._access.may_call, self._graph.get().services()))

    def _services_of_type(self, type: str) -> List[str]:
        uris = {name: uri for name, uri in self._uris.get().items() if self._access.may_call(name)}
        types = self._service_types.types(uris)
        return sorted(name for name, kind in types.items() if kind == type)

    def _providers(self, service: str) -> Sequence[str]:
        name = global_name(service)
        return self._graph.get().providers.get(name, ()) if self._access.may_call(name) else ()

    def _look_up(self, service: str) -> Tuple[str, str]:
        """The global name and the uri of a service; "" when there is none, or the globs close it."""
        name = global_name(service)
        if not self._access.may_call(name) or not is_xml_text(name):
            return name, ""
        try:
            return name, str(self._call("lookupService", name))
        except MasterError:
            return name, ""


def _host(uri: str) -> str:
    """The host of rosrpc://host:port."""
    return uri.partition("://")[2].rpartition(":")[0].strip("[]")


def _definition_text(type: str) -> str:
    try:
        return typedefs.definition_text(type)
    except TypeLoadError:
        return ""  # what a type is that isn't installed here, rosapi can't tell
