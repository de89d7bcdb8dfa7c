# SPDX-License-Identifier: BSD-3-Clause
"""The websocket server's settings: defaults, then private ROS parameters, then command-line flags.

Every setting is a private parameter (``~port``) and a flag (``--port 9090`` or ``--port=9090``) of the same
name. Both may come as strings, since roslaunch and a shell give them so: ``"None"``, ``""``, ``"true"`` and
numbers are understood. Remapping arguments (``__name:=x``, ``_param:=v``, ``a:=b``) are rospy's, and skipped
here. A value that makes no sense is an error which names the setting, the value and what is expected; nothing
is guessed.
"""

from __future__ import annotations

import dataclasses
import math
import re
from dataclasses import dataclass
from typing import Any, Callable, Dict, Mapping, Optional, Sequence, Tuple, Type, TypeVar

import yaml

from rosbridge_library.foxglove.options import CAPABILITIES, Options

MEBIBYTE = 1 << 20


class SettingsError(ValueError):
    """A flag that does not exist, or a value that is not what a setting expects."""


class Kind:
    """What a setting's value may be: how to read it (raising ValueError or TypeError), and its
    description."""

    def __init__(self, read: Callable[[Any], Any], expected: str) -> None:
        self.read = read
        self.expected = expected


def _boolean(value: Any) -> bool:
    text = str(value).strip().lower()
    if text in ("true", "1", "yes", "on"):
        return True
    if text in ("false", "0", "no", "off"):
        return False
    raise ValueError(text)


def _integer(low: int, high: Optional[int] = None) -> Callable[[Any], int]:
    def read(value: Any) -> int:
        if isinstance(value, bool):
            raise TypeError("a boolean is no number")
        number = int(value) if isinstance(value, str) else float(value)
        if number != int(number) or number < low or (high is not None and number > high):
            raise ValueError(value)
        return int(number)

    return read


def _seconds(value: Any) -> float:
    if isinstance(value, bool):
        raise TypeError("a boolean is no number")
    number = float(value)
    if not math.isfinite(number) or number < 0:
        raise ValueError(value)
    return number


def _text(value: Any) -> str:
    # A parameter loaded from YAML may be a list where the launch file has its text ("[/tf, /scan]").
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(str(item) for item in value)}]"
    return "" if value is None else str(value)


def _choice(*names: str) -> Callable[[Any], str]:
    def read(value: Any) -> str:
        if str(value) not in names:
            raise ValueError(value)
        return str(value)

    return read


def _texts(value: Any) -> Tuple[str, ...]:
    """Several strings: a list, as a launch file's <rosparam> has it, the same as YAML text, or one string."""
    listed = value
    if isinstance(value, str):
        try:
            listed = yaml.safe_load(value)
        except yaml.YAMLError:  # a regular expression need not be YAML
            listed = value
    if isinstance(listed, (list, tuple)):
        return tuple(str(item) for item in listed)
    return (str(value),) if str(value).strip() else ()


def _patterns(value: Any) -> Tuple[str, ...]:
    patterns = _texts(value)
    for pattern in patterns:
        try:
            re.compile(pattern)
        except re.error as error:
            raise ValueError(f"{pattern}: {error}") from error
    return patterns


def _names(*known: str) -> Callable[[Any], Tuple[str, ...]]:
    def read(value: Any) -> Tuple[str, ...]:
        names = _texts(value)
        if not set(names) <= set(known):
            raise ValueError(value)
        return names

    return read


def _or_none(kind: Kind) -> Kind:
    def read(value: Any) -> Any:
        return None if str(value).strip().lower() in ("none", "") else kind.read(value)

    return Kind(read, kind.expected + ", or None")


BOOLEAN = Kind(_boolean, "true or false")
SECONDS = Kind(_seconds, "a number of seconds, 0 or more")
TEXT = Kind(_text, "a string")
BYTES = Kind(_integer(1), "a number of bytes, 1 or more")
BYTES_OR_0 = Kind(_integer(0), "a number of bytes, 0 for no limit")
MILLISECONDS = Kind(_integer(1), "a number of milliseconds, 1 or more")
PATTERNS = Kind(_patterns, "a list of regular expressions")
FOXGLOVE_CAPABILITIES = Kind(_names(*CAPABILITIES), f"a list of some of {', '.join(CAPABILITIES)}")
PORT = Kind(_integer(1, 65535), "a port from 1 to 65535")
PORT_OR_0 = Kind(_integer(0, 65535), "a port from 0 to 65535")


def setting(default: Any, kind: Kind, meaning: str) -> Any:
    """A field of a settings dataclass, with what its value may be and the help text of its flag."""
    return dataclasses.field(default=default, metadata={"kind": kind, "meaning": meaning})


@dataclass(frozen=True)
class Settings:
    """Settings of ``rosbridge_websocket``. Times are in seconds, sizes in bytes."""

    port: int = setting(9090, PORT_OR_0, "TCP port to listen on; 0 picks a free one, told in ~actual_port")
    address: str = setting("0.0.0.0", TEXT, "address to listen on; empty for all interfaces")
    ssl: bool = setting(False, BOOLEAN, "serve wss://, with certfile and keyfile")
    certfile: Optional[str] = setting(None, _or_none(TEXT), "PEM certificate (chain) for ssl")
    keyfile: Optional[str] = setting(None, _or_none(TEXT), "PEM private key for ssl; None if certfile has it")
    retry_startup_delay: float = setting(5.0, SECONDS, "between attempts to listen, while the port is held")
    fragment_timeout: float = setting(600.0, SECONDS, "until the fragments of an incomplete message are dropped")
    delay_between_messages: float = setting(0.0, SECONDS, "least time between two messages to a client")
    max_message_size: Optional[int] = setting(None, _or_none(BYTES), "larger outgoing messages are fragmented")
    unregister_timeout: float = setting(10.0, SECONDS, "that a publisher lives on after its last client left")
    websocket_external_port: Optional[int] = setting(None, _or_none(PORT), "port that clients see, behind a proxy")
    use_compression: bool = setting(False, BOOLEAN, "offer permessage-deflate to clients")
    authenticate: bool = setting(False, BOOLEAN, "accept operations only after a rosauth authentication")
    websocket_ping_interval: float = setting(20.0, SECONDS, "between two pings to a client; 0 for none")
    websocket_ping_timeout: float = setting(
        30.0, SECONDS, "after a ping until a client that stays silent is closed; 0 for never"
    )
    websocket_null_origin: bool = setting(True, BOOLEAN, "accept clients whose Origin header is null")
    topics_glob: str = setting("[*]", TEXT, "topics that clients may use, such as \"[/tf, '/camera/*']\"")
    services_glob: str = setting("[*]", TEXT, "services that clients may use")
    params_glob: str = setting("[*]", TEXT, "parameters that clients may use")
    bson_only_mode: bool = setting(False, BOOLEAN, "every frame is one BSON document")
    binary_encoder: str = setting(
        "default",
        Kind(_choice("default", "b64", "bson"), "default, b64 or bson"),
        "how uint8[] and char[] go out",
    )
    default_call_service_timeout: float = setting(30.0, SECONDS, "that a service call may take; 0 for any time")
    max_incoming_size: int = setting(
        256 * MEBIBYTE, BYTES_OR_0, "a client that sends a larger message is closed; 0 for no limit"
    )
    burst_bytes: int = setting(MEBIBYTE, BYTES_OR_0, "that may wait for a client before messages are dropped")
    max_client_bytes: int = setting(64 * MEBIBYTE, BYTES, "that may wait for a client at most")
    stall_timeout: float = setting(
        30.0, SECONDS, "until a client that takes nothing while something waits for it is closed; 0 for never"
    )

    foxglove_port: Optional[int] = setting(
        None, _or_none(Kind(_integer(0, 65535), "a port from 1 to 65535, 0 for none")), "a second port to listen on"
    )
    topic_whitelist: Tuple[str, ...] = setting(Options.topic_whitelist, PATTERNS, "topics that Foxglove clients see")
    service_whitelist: Tuple[str, ...] = setting(
        Options.service_whitelist, PATTERNS, "services that Foxglove clients see and may call"
    )
    param_whitelist: Tuple[str, ...] = setting(
        Options.param_whitelist, PATTERNS, "parameters that Foxglove clients may use"
    )
    client_topic_whitelist: Tuple[str, ...] = setting(
        Options.client_topic_whitelist, PATTERNS, "topics that Foxglove clients may publish"
    )
    capabilities: Tuple[str, ...] = setting(
        Options.capabilities, FOXGLOVE_CAPABILITIES, "what Foxglove clients are offered beside topics"
    )
    asset_uri_allowlist: Tuple[str, ...] = setting(
        Options.asset_uri_allowlist, PATTERNS, "URIs of files that Foxglove clients may fetch"
    )
    send_buffer_limit: Optional[int] = setting(
        None, _or_none(BYTES_OR_0), "burst_bytes of Foxglove clients, if another one"
    )
    max_update_ms: int = setting(
        Options.max_update_ms, MILLISECONDS, "between two looks at topics and services, for Foxglove clients"
    )
    service_type_retrieval_timeout_ms: int = setting(
        Options.service_type_retrieval_timeout_ms, MILLISECONDS, "that a node may take to tell a service's type"
    )


AnySettings = TypeVar("AnySettings")


def read_flags(kind: Type[AnySettings], arguments: Sequence[str]) -> Dict[str, Any]:
    """The values of the ``--name value`` and ``--name=value`` flags among ``arguments``.

    ``kind`` is the settings dataclass. Raises SettingsError for anything else but ROS remapping arguments.
    """
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    flags: Dict[str, Any] = {}
    rest = list(arguments)
    while rest:
        argument = rest.pop(0)
        name, equals, value = argument[2:].partition("=")
        if not argument.startswith("--"):
            if ":=" in argument:
                continue
            raise SettingsError(f"unexpected argument {argument!r}")
        if name not in fields:
            raise SettingsError(f"unknown flag --{name}")
        if not equals:
            # A value may begin with dashes only as --name=value, so that a forgotten one is noticed.
            if not rest or rest[0].startswith("--") or ":=" in rest[0]:
                raise SettingsError(f"flag --{name} needs a value: {fields[name].metadata['kind'].expected}")
            value = rest.pop(0)
        flags[name] = _read(fields[name], value, f"flag --{name}")
    return flags


def load(kind: Type[AnySettings], parameters: Mapping[str, Any], flags: Mapping[str, Any]) -> AnySettings:
    """Settings from defaults, private ROS ``parameters``, and the result of `read_flags`, the later the
    stronger.

    Parameters of other names are ignored. Raises SettingsError for a value that is not what is expected.
    """
    fields = dataclasses.fields(kind)  # type: ignore[arg-type]
    values = {
        field.name: _read(field, parameters[field.name], f"parameter ~{field.name}")
        for field in fields
        if field.name in parameters and field.name not in flags
    }
    values.update(flags)
    return kind(**values)


def usage(program: str) -> str:
    """The line that tells how to call ``program``."""
    return f"usage: {program} [--name value]... [ros_remapping:=argument]...  (--help lists the names)"


def help_text(kind: Type[AnySettings], program: str) -> str:
    """The answer to ``--help``: every setting with its meaning and default."""
    lines = [
        usage(program),
        "",
        "Each name is a private ROS parameter too. Times in seconds, sizes in bytes.",
        "",
    ]
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        expected = field.metadata["kind"].expected
        lines.append(f"  --{field.name}  ({expected}; default {field.default})")
        lines.append("        " + field.metadata["meaning"])
    return "\n".join(lines)


def _read(field: dataclasses.Field[Any], value: Any, what: str) -> Any:
    kind: Kind = field.metadata["kind"]
    try:
        return kind.read(value)
    except (ValueError, TypeError, OverflowError) as error:
        raise SettingsError(f"{what} is {value!r}, but must be {kind.expected}") from error
