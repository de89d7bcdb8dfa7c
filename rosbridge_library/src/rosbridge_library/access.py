# SPDX-License-Identifier: BSD-3-Clause
"""What a client may do, asked in one place.

Every operation of every protocol asks an `Access` before it has any effect. Today the answer comes from three lists of
shell-style globs (`topics_glob`, `services_glob`, `params_glob`); finer rules can take their place without the
operations knowing.

A list is written as a string, ``"[/camera/*, '/tf']"``. A missing or empty one, and ``[]``, allow everything. Names are
compared as global names, so ``tf`` and ``/tf`` are the same.
"""

from __future__ import annotations

import fnmatch
import re
from typing import Callable, Iterable, List, Optional, Tuple

from rosbridge_library.names import global_name

Matcher = Callable[[str], bool]

# Web clients list topics and types through rosapi, whatever services_glob says for the robot's own services.
# rosapi itself obeys the globs, so this opens nothing that they close.
ROSAPI_PREFIX = "/rosapi/"


def parse_globs(text: Optional[str]) -> Optional[List[str]]:
    """The globs written in `text` (``"[/camera/*, '/tf']"``), or None when everything is allowed."""
    if text is None:
        return None
    stripped = text.strip()
    if stripped.startswith("[") and stripped.endswith("]"):
        stripped = stripped[1:-1]
    globs = [part.strip().strip("'\"").strip() for part in stripped.split(",")]
    return [glob for glob in globs if glob] or None


def matches(globs: Optional[Iterable[str]], name: str) -> bool:
    """Whether the global form of `name` matches one of `globs`; None matches every name."""
    return _matcher(None if globs is None else list(globs))(name)


def _matcher(globs: Optional[List[str]]) -> Matcher:
    if globs is None or "*" in globs:
        return lambda name: True
    # A glob without a leading slash is a global name too, unless it opens with a wildcard that covers the slash.
    anchored = [glob if glob.startswith(("/", "*")) else "/" + glob for glob in globs]
    pattern = re.compile("|".join(fnmatch.translate(glob) for glob in anchored))
    return lambda name: pattern.match(global_name(name)) is not None


class Access:
    """Answers "may this client …?" for topics, services and parameters, by name."""

    def __init__(
        self,
        topics: Optional[List[str]] = None,
        services: Optional[List[str]] = None,
        params: Optional[List[str]] = None,
    ) -> None:
        self.globs: Tuple[Optional[List[str]], Optional[List[str]], Optional[List[str]]] = (
            topics,
            services,
            params,
        )
        self._topic, self._service, self._param = _matcher(topics), _matcher(services), _matcher(params)

    @classmethod
    def from_parameters(
        cls,
        topics_glob: Optional[str] = None,
        services_glob: Optional[str] = None,
        params_glob: Optional[str] = None,
    ) -> Access:
        """The rules given by the three ROS parameters of these names."""
        return cls(parse_globs(topics_glob), parse_globs(services_glob), parse_globs(params_glob))

    def may_publish(self, topic: str) -> bool:
        """Whether a client may advertise `topic` and publish on it."""
        return self._topic(topic)

    def may_subscribe(self, topic: str) -> bool:
        """Whether a client may subscribe to `topic`."""
        return self._topic(topic)

    def may_call(self, service: str) -> bool:
        """Whether a client may call `service`. rosapi's services stay reachable and obey the globs themselves."""
        return self._service(service) or global_name(service).startswith(ROSAPI_PREFIX)

    def may_provide(self, service: str) -> bool:
        """Whether a client may advertise `service` and answer its calls."""
        return self._service(service)

    def may_use_param(self, name: str) -> bool:
        """Whether a client may see or change the parameter `name`."""
        return self._param(name)
