# SPDX-License-Identifier: BSD-3-Clause
"""Splitting long outgoing messages into fragment operations (specification 3.1.1), for programs that do it themselves.

The protocol and its subscriptions fragment what they send by `encodings.in_fragments`.
"""

from __future__ import annotations

from typing import Any, Dict, List, Union

from rosbridge_library.capability import Capability
from rosbridge_library.codec import encode_json
from rosbridge_library.encodings import fragments


class Fragmentation(Capability):
    """Splits messages."""

    def fragment(
        self, message: Union[str, Dict[str, Any]], fragment_size: int, mid: Union[str, int, None] = None
    ) -> List[Dict[str, Any]]:
        """The message's JSON text in fragment operations of at most `fragment_size` characters of it.

        A message that is not longer is returned as it is, alone in the list.
        """
        text = message if isinstance(message, str) else encode_json(message).decode("utf-8")
        if len(text) <= fragment_size:
            return [message]  # type: ignore[list-item]
        return list(fragments(text, fragment_size, mid))
