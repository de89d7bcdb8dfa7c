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

Types = Mapping[str, Optional[str]]

PROBE_TIMEOUT_S = 1.5
SILENT_FOR_S = 5.0

# Far more services than a robot has; what is beyond is asked again.
MAX_KNOWN = 10_000


def probe_types(caller_id: str, uris: Mapping[str, str]) -> Types:
    """Ask the nodes at `uris` for the types of their services, all at once; None for those that don't answer.

    Takes `PROBE_TIMEOUT_S` at most. Blocks the calling thread.
    """
    answers = asyncio.run(probe_services(uris, caller_id, PROBE_TIMEOUT_S))
    types: Dict[str, Optional[str]] = {}
    for service, answer in answers.items():
        if isinstance(answer, ServiceUnreachable):
            logger.debug("%s", answer)
            types[service] = None
        else:
            types[service] = answer.get("type")
    return types


class _Known(NamedTuple):
    uri: str
    answer: Future[Optional[str]]
    asked: float


class ServiceTypes:
    """What each service answered, or is being asked.

    `probe` takes the uris of services by name, and gives for each its type, or None when it didn't answer.
    """

    def __init__(
        self, probe: Callable[[Mapping[str, str]], Types], clock: Callable[[], float] = time.monotonic
    ) -> None:
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
            types = self._probe(uris)
        except BaseException as error:  # whatever it is, those who wait must hear of it
            for service in uris:
                answers[service].set_exception(error)
            raise
        for service in uris:
            answers[service].set_result(types.get(service))

    def _forget_oldest(self, wanted: int) -> None:
        surplus: List[str] = list(self._known)[: max(0, len(self._known) - max(MAX_KNOWN, wanted))]
        for service in surplus:
            del self._known[service]
