# SPDX-License-Identifier: BSD-3-Clause
"""The types of services, which the master doesn't know: each node must be asked for its own.

An answer is kept until the service's uri changes, that is until its node starts anew. A service that gives
none within the deadline is left alone for `SILENT_FOR_S`. Callers in several threads that want the same
service share one probe: this is a door between threads, so it has a lock, never held while probing.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from concurrent.futures import Future
from typing import Callable, Dict, List, Mapping, NamedTuple, Optional

from rosbridge_library.ros.service_probe import ServiceUnreachable, probe_services

logger = logging.getLogger("rosbridge.rosapi")

Tell = Callable[[str, Optional[str]], None]
Probe = Callable[[Mapping[str, str], Tell], None]

PROBE_TIMEOUT_S = 1.5
SILENT_FOR_S = 5.0

# Far more services than a robot has; what is beyond is asked again.
MAX_KNOWN = 10_000


def probe_types(caller_id: str, uris: Mapping[str, str], tell: Tell) -> None:
    """Ask the nodes at `uris` for the types of their services, all at once; `tell` what each node answers when it does.

    Takes `PROBE_TIMEOUT_S` at most. Blocks the calling thread.
    """
    nodes: Dict[str, Dict[str, str]] = {}
    for service, uri in uris.items():
        nodes.setdefault(uri, {})[service] = uri

    async def probe_node(services: Mapping[str, str]) -> None:
        for service, answer in (await probe_services(services, caller_id, PROBE_TIMEOUT_S)).items():
            if isinstance(answer, ServiceUnreachable):
                logger.debug("%s", answer)
                tell(service, None)
            else:
                tell(service, answer.get("type"))

    async def probe_nodes() -> None:
        await asyncio.gather(*(probe_node(services) for services in nodes.values()))

    asyncio.run(probe_nodes())


class _Known(NamedTuple):
    uri: str
    answer: Future[Optional[str]]
    asked: float


class ServiceTypes:
    """What each service answered, or is being asked.

    `probe` takes the uris of services by name, and tells of each, once, its type, or None when it didn't answer; it
    returns when it has told of all.
    """

    def __init__(self, probe: Probe, clock: Callable[[], float] = time.monotonic) -> None:
        self._probe = probe
        self._clock = clock
        self._lock = threading.Lock()
        self._known: Dict[str, _Known] = {}

    def types(self, uris: Mapping[str, str]) -> Dict[str, str]:
        """The types of those services, given with their uris, that answer."""
        with self._lock:
            unknown = [service for service, uri in uris.items() if not self._is_known(service, uri)]
            for service in unknown:
                self._known.pop(service, None)  # goes to the end: the oldest answers are first
                self._known[service] = _Known(uris[service], Future(), self._clock())
            answers = {service: self._known[service].answer for service in uris}
            self._forget_oldest(len(uris))
        if unknown:
            self._ask({service: uris[service] for service in unknown}, answers)
        types = {service: answer.result() for service, answer in answers.items()}
        return {service: kind for service, kind in types.items() if kind is not None}

    def _is_known(self, service: str, uri: str) -> bool:
        known = self._known.get(service)
        if known is None or known.uri != uri:
            return False
        if not known.answer.done():
            return True
        if known.answer.exception() is not None:
            return False
        return known.answer.result() is not None or self._clock() - known.asked < SILENT_FOR_S

    def _ask(self, uris: Mapping[str, str], answers: Mapping[str, Future[Optional[str]]]) -> None:
        try:
            self._probe(uris, lambda service, kind: answers[service].set_result(kind))
        except BaseException as error:  # whatever it is, those who wait must hear of it
            for service in uris:
                if not answers[service].done():
                    answers[service].set_exception(error)
            raise

    def _forget_oldest(self, wanted: int) -> None:
        surplus: List[str] = list(self._known)[: max(0, len(self._known) - max(MAX_KNOWN, wanted))]
        for service in surplus:
            del self._known[service]
