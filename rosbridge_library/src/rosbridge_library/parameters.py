# SPDX-License-Identifier: BSD-3-Clause
"""The parameters of a protocol, as servers pass them on from their own."""

from __future__ import annotations

import dataclasses
from typing import Any, Mapping, Optional


@dataclasses.dataclass(frozen=True)
class Parameters:
    """What a protocol can be told. Times are in seconds."""

    fragment_timeout: float = 600.0
    """How long a client's fragments wait for the rest of their message."""
    max_message_size: Optional[int] = None
    """The length in characters above which every outgoing text is sent in fragments; None never."""
    max_incoming_size: int = 256 * 1024 * 1024
    """The most bytes that fragments of one client, or what they unpack to, may take; 0 is no limit."""
    default_call_service_timeout: float = 30.0
    """The deadline of service calls that name none; 0 is none."""
    bson_only_mode: bool = False
    """Every message in both directions is a BSON document."""
    binary_encoder: str = "default"
    """How byte arrays are sent: `default` and `b64` as base64 strings, `bson` by sending what has any as BSON."""

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Parameters:
        """From a mapping that may hold other entries too; None stands for the default."""
        names = {field.name for field in dataclasses.fields(cls)}
        return cls(**{name: value for name, value in values.items() if name in names and value is not None})
