# SPDX-License-Identifier: BSD-3-Clause
"""What channels and services have in common: ids that stay, and changes that all clients are told of alike."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any, NamedTuple, Sequence

from rosbridge_library.payload import Payload

MAX_IDS = 10_000
"""How many ids are remembered."""


class Change(NamedTuple):
    """`removed` are gone, then `added` are there; `payloads` say so, encoded once for all clients."""

    added: Sequence[Any]
    removed: Sequence[Any]
    payloads: Sequence[Payload]


class Ids:
    """Numbers for keys; the same key gets the same number again."""

    def __init__(self) -> None:
        self._ids: OrderedDict[Any, int] = OrderedDict()
        self._last = 0

    def of(self, key: Any) -> int:
        """The number of `key`. Of those asked for long ago the oldest are forgotten, never to come back."""
        if key not in self._ids:
            self._last += 1
            self._ids[key] = self._last
            if len(self._ids) > MAX_IDS:
                self._ids.popitem(last=False)
        self._ids.move_to_end(key)
        return self._ids[key]
