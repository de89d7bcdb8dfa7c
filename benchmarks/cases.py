# SPDX-License-Identifier: BSD-3-Clause
"""Which measurements there are: loads, encodings and numbers of clients."""

from __future__ import annotations

import fnmatch
from typing import Iterator, List, NamedTuple, Sequence

from benchmarks.messages import LOADS

MANY_CLIENTS = 100
MANY_CLIENTS_SLOWER = 20
"""With 100 clients the rates are divided by this: the clients run on the same machine."""
PUBLISH_RATE_HZ = 1000.0

_SUBSCRIBED = ("json", "cbor", "cbor-raw", "foxglove")
_PNG_LOADS = ("scan", "tf", "path")
_TEN_CLIENTS = ("twist2000", "odometry", "scan", "image", "cloud")
_MANY_CLIENTS = ("twist2000", "scan", "image")


class Case(NamedTuple):
    """One measurement."""

    kind: str
    """topic (ROS → clients), publish (client → ROS), service, idle or startup."""
    load: str
    """A name of `LOADS`; of other kinds than topic, the kind."""
    encoding: str
    clients: int
    rate_hz: float = 0.0

    @property
    def name(self) -> str:
        return f"{self.load}/{self.encoding}/{self.clients}"


def usual_cases() -> List[Case]:
    """The cases of a run that names none, in their order: those that tell something which the others don't."""
    return [*_topic_cases(), *_other_cases(idle_clients=1000)]


def all_cases() -> List[Case]:
    """Every load in every encoding, with each number of clients, and what is not about topics."""
    topics = [
        _topic(load, encoding, clients)
        for load in LOADS
        for clients in (1, 10, MANY_CLIENTS)
        for encoding in (*_SUBSCRIBED, "png")
    ]
    return [*topics, *_other_cases(idle_clients=1000)]


def quick_cases() -> List[Case]:
    """One case of each kind: whether everything works, not how fast."""
    chosen = (("twist2000", "json", 1), ("scan", "cbor-raw", 2), ("tf", "cbor", 1), ("image", "foxglove", 2))
    topics = [_topic(load, encoding, clients) for load, encoding, clients in chosen]
    others = [case for case in _other_cases(idle_clients=20) if case.clients != 10]
    return [*topics, *others]


def matching(cases: Sequence[Case], patterns: Sequence[str]) -> List[Case]:
    """Those whose name (`image/cbor-raw/10`) matches one of the shell patterns; all when there is none."""
    return [case for case in cases if not patterns or any(fnmatch.fnmatch(case.name, each) for each in patterns)]


def _topic_cases() -> Iterator[Case]:
    for load in LOADS:
        for encoding in _SUBSCRIBED:
            yield _topic(load, encoding, 1)
        if load in _PNG_LOADS:
            yield _topic(load, "png", 1)
        for encoding in _SUBSCRIBED:
            if load in _TEN_CLIENTS:
                yield _topic(load, encoding, 10)
        for encoding in _SUBSCRIBED:
            if load in _MANY_CLIENTS:
                yield _topic(load, encoding, MANY_CLIENTS)


def _topic(load: str, encoding: str, clients: int) -> Case:
    slower = MANY_CLIENTS_SLOWER if clients >= MANY_CLIENTS else 1
    return Case("topic", load, encoding, clients, LOADS[load].rate_hz / slower)


def _other_cases(idle_clients: int) -> Iterator[Case]:
    for encoding in ("json", "foxglove"):
        yield Case("publish", "publish", encoding, 1, PUBLISH_RATE_HZ)
    for encoding in ("json", "foxglove"):
        yield Case("service", "service", encoding, 1)
        yield Case("service", "service", encoding, 10)
    yield Case("idle", "idle", "json", idle_clients)
    yield Case("startup", "startup", "json", 0)
