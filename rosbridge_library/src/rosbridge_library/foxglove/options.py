# SPDX-License-Identifier: BSD-3-Clause
"""What the Foxglove side of a server can be told, with the names that foxglove_bridge gave its parameters.

The four whitelists are regular expressions that a whole name must match; they narrow what the server's access rules
allow, and never widen it.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any, Mapping, Sequence, Tuple

CAPABILITIES = ("clientPublish", "parameters", "parametersSubscribe", "services", "connectionGraph", "assets")

DEFAULT_ASSET_URIS = (
    r"^package://(?:[-\w%]+/)*[-\w%.]+\.(?:dae|fbx|glb|gltf|jpe?g|mtl|obj|png|stl|tiff?|urdf|webp|xacro)$",
)
"""Meshes, textures and robot models in packages."""

ALL = (".*",)


def matches(patterns: Sequence[str], text: str) -> bool:
    """Whether the whole of `text` matches one of the regular expressions."""
    return any(re.fullmatch(pattern, text) for pattern in patterns)


@dataclasses.dataclass(frozen=True)
class Options:
    """Times in milliseconds, sizes in bytes."""

    topic_whitelist: Tuple[str, ...] = ALL
    service_whitelist: Tuple[str, ...] = ALL
    param_whitelist: Tuple[str, ...] = ALL
    client_topic_whitelist: Tuple[str, ...] = ALL
    asset_uri_allowlist: Tuple[str, ...] = DEFAULT_ASSET_URIS
    capabilities: Tuple[str, ...] = CAPABILITIES
    max_update_ms: int = 1000
    """Between two looks at the ROS graph."""
    service_type_retrieval_timeout_ms: int = 250
    """How long a node may take to say of what type its service is."""
    max_client_bytes: int = 64 * 1024 * 1024
    """The largest asset that is sent: more may not wait for a client."""

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Options:
        """From a mapping that may hold other entries too; None stands for the default."""
        names = {field.name for field in dataclasses.fields(cls)}
        return cls(**{name: value for name, value in values.items() if name in names and value is not None})
