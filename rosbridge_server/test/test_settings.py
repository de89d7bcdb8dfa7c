# SPDX-License-Identifier: BSD-3-Clause
"""Settings: every parameter and flag in every form that roslaunch and a shell give it, and what is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, List
from xml.etree import ElementTree

import pytest

from rosbridge_server.settings import Settings, SettingsError, help_text, load, read_flags

LAUNCH_FILE = Path(__file__).resolve().parents[1] / "launch" / "rosbridge_websocket.launch"
NAMES = [field.name for field in dataclasses.fields(Settings)]

# For each setting: a value other than the default as text, and what it means.
TEXTS = {
    "port": ("9191", 9191),
    "address": ("127.0.0.1", "127.0.0.1"),
    "ssl": ("true", True),
    "certfile": ("/etc/cert.pem", "/etc/cert.pem"),
    "keyfile": ("/etc/key.pem", "/etc/key.pem"),
    "retry_startup_delay": ("0.25", 0.25),
    "fragment_timeout": ("60", 60.0),
    "delay_between_messages": ("0.01", 0.01),
    "max_message_size": ("50000", 50000),
    "unregister_timeout": ("0", 0.0),
    "websocket_external_port": ("443", 443),
    "use_compression": ("True", True),
    "authenticate": ("1", True),
    "websocket_ping_interval": ("5", 5.0),
    "websocket_ping_timeout": ("1e1", 10.0),
    "websocket_null_origin": ("false", False),
    "topics_glob": ("[/tf, '/camera/*']", "[/tf, '/camera/*']"),
    "services_glob": ("[]", "[]"),
    "params_glob": ("", ""),
    "bson_only_mode": ("yes", True),
    "binary_encoder": ("b64", "b64"),
    "default_call_service_timeout": ("2.5", 2.5),
    "max_incoming_size": ("0", 0),
    "burst_bytes": ("65536", 65536),
    "max_client_bytes": ("1000000", 1000000),
    "stall_timeout": ("12.5", 12.5),
    "foxglove_port": ("8765", 8765),
    "topic_whitelist": ("['/tf', '/camera/.{1,9}']", ("/tf", "/camera/.{1,9}")),
    "service_whitelist": ("/[ab].*", ("/[ab].*",)),
    "param_whitelist": ("[]", ()),
    "client_topic_whitelist": ("[/cmd_vel]", ("/cmd_vel",)),
    "capabilities": ("[assets, services]", ("assets", "services")),
    "asset_uri_allowlist": (r"^package://.*\.dae$", (r"^package://.*\.dae$",)),
    "send_buffer_limit": ("10000000", 10000000),
    "max_update_ms": ("5000", 5000),
    "service_type_retrieval_timeout_ms": ("500", 500),
}


def _typed(text: str) -> Any:
    """What a launch file makes of a parameter's text: a number or a boolean where it looks like one."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return {"true": True, "false": False}.get(text.lower(), text)


def test_every_setting_is_covered_here() -> None:
    assert list(TEXTS) == NAMES


def test_the_launch_file_has_every_setting_with_its_default() -> None:
    launch = ElementTree.parse(LAUNCH_FILE).getroot()
    arguments = {each.get("name"): each.get("default") for each in launch.findall("arg")}
    node = next(each for each in launch.findall("node") if each.get("type") == "rosbridge_websocket")
    parameters = {each.get("name"): each.get("value") for each in node.findall("param")}
    assert parameters == {name: f"$(arg {name})" for name in NAMES}
    defaults = {name: arguments[name] for name in NAMES}
    assert load(Settings, defaults, {}) == Settings()


def test_defaults_are_those_of_the_launch_file() -> None:
    settings = load(Settings, {}, {})
    assert (settings.port, settings.address, settings.ssl) == (9090, "0.0.0.0", False)
    assert (settings.certfile, settings.keyfile) == (None, None)
    assert (settings.retry_startup_delay, settings.fragment_timeout) == (5.0, 600.0)
    assert (settings.delay_between_messages, settings.max_message_size) == (0.0, None)
    assert (settings.unregister_timeout, settings.websocket_external_port) == (10.0, None)
    assert (settings.use_compression, settings.authenticate) == (False, False)
    assert (settings.websocket_ping_interval, settings.websocket_ping_timeout) == (20.0, 30.0)
    assert settings.websocket_null_origin
    assert (settings.topics_glob, settings.services_glob, settings.params_glob) == ("[*]", "[*]", "[*]")
    assert (settings.bson_only_mode, settings.binary_encoder) == (False, "default")
    assert settings.default_call_service_timeout == 30.0


@pytest.mark.parametrize("name", NAMES)
def test_every_setting_is_a_flag(name: str) -> None:
    text, value = TEXTS[name]
    assert read_flags(Settings, [f"--{name}={text}"]) == {name: value}
    if text:
        assert read_flags(Settings, [f"--{name}", text]) == {name: value}
    assert getattr(load(Settings, {}, {name: value}), name) == value


@pytest.mark.parametrize("name", NAMES)
def test_every_setting_is_a_parameter_as_text_and_typed(name: str) -> None:
    text, value = TEXTS[name]
    for parameter in (text, _typed(text)):
        got = getattr(load(Settings, {name: parameter}, {}), name)
        assert (got, type(got)) == (value, type(value))


def test_a_flag_is_stronger_than_a_parameter_and_hides_its_mistakes() -> None:
    assert load(Settings, {"port": 1234, "address": "::1"}, {"port": 0}) == Settings(port=0, address="::1")
    assert load(Settings, {"port": "wrong"}, {"port": 0}).port == 0


def test_other_private_parameters_are_ignored() -> None:
    assert load(Settings, {"actual_port": 9090, "something": {"else": 1}}, {}) == Settings()


@pytest.mark.parametrize("nothing", ["None", "none", "", " ", None])
@pytest.mark.parametrize("name", ["max_message_size", "websocket_external_port", "certfile", "keyfile"])
def test_none_in_all_its_forms(name: str, nothing: Any) -> None:
    assert getattr(load(Settings, {name: nothing}, {}), name) is None


@pytest.mark.parametrize("value", [["/a.*", "/b"], "['/a.*', '/b']", '["/a.*", /b]'])
def test_a_list_of_expressions_may_be_a_list_or_yaml(value: Any) -> None:
    assert load(Settings, {"topic_whitelist": value}, {}).topic_whitelist == ("/a.*", "/b")


def test_a_glob_list_may_be_a_list() -> None:
    assert load(Settings, {"topics_glob": ["/tf", "/camera/*"]}, {}).topics_glob == "[/tf, /camera/*]"


@pytest.mark.parametrize("number", [9090.0, "9090", " 9090 ", 9090])
def test_whole_numbers_of_any_type(number: Any) -> None:
    assert load(Settings, {"port": number}, {}).port == 9090


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("port", "ninety", "a port from 0 to 65535"),
        ("port", 70000, "a port from 0 to 65535"),
        ("port", -1, "a port from 0 to 65535"),
        ("port", 90.5, "a port from 0 to 65535"),
        ("port", True, "a port from 0 to 65535"),
        ("port", None, "a port from 0 to 65535"),
        ("port", float("inf"), "a port from 0 to 65535"),
        ("port", [9090], "a port from 0 to 65535"),
        ("ssl", "maybe", "true or false"),
        ("ssl", 2, "true or false"),
        ("max_message_size", 0, "a number of bytes, 1 or more, or None"),
        ("max_message_size", "many", "a number of bytes, 1 or more, or None"),
        ("max_client_bytes", 0, "a number of bytes, 1 or more"),
        ("unregister_timeout", -1, "a number of seconds, 0 or more"),
        ("unregister_timeout", "nan", "a number of seconds, 0 or more"),
        ("websocket_ping_timeout", False, "a number of seconds, 0 or more"),
        ("binary_encoder", "base85", "default, b64 or bson"),
        ("foxglove_port", 70000, "a port from 1 to 65535, 0 for none, or None"),
        ("topic_whitelist", "*", "a list of regular expressions"),
        ("topic_whitelist", "['(']", "a list of regular expressions"),
        ("max_update_ms", 0, "a number of milliseconds, 1 or more"),
        (
            "capabilities",
            "[time]",
            "a list of some of clientPublish, parameters, parametersSubscribe, services, connectionGraph, assets",
        ),
    ],
)
def test_a_wrong_value_names_itself_and_what_is_expected(name: str, value: Any, expected: str) -> None:
    with pytest.raises(SettingsError) as parameter:
        load(Settings, {name: value}, {})
    assert str(parameter.value) == f"parameter ~{name} is {value!r}, but must be {expected}"
    if isinstance(value, str):
        with pytest.raises(SettingsError) as flag:
            read_flags(Settings, [f"--{name}", value])
        assert str(flag.value) == f"flag --{name} is {value!r}, but must be {expected}"


@pytest.mark.parametrize(
    "arguments",
    [
        ["__name:=bridge", "__log:=/tmp/x.log"],
        ["_port:=9191"],
        ["/cmd_vel:=/robot/cmd_vel", "a:=b"],
        ["--port", "0", "__ns:=/robot", "--address", "", "x:=--y"],
    ],
)
def test_ros_arguments_are_skipped(arguments: List[str]) -> None:
    assert set(read_flags(Settings, arguments)) <= {"port", "address"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--colour", "blue"], "unknown flag --colour"),
        (["--colour=blue"], "unknown flag --colour"),
        (["--"], "unknown flag --"),
        (["-p", "9090"], "unexpected argument '-p'"),
        (["9090"], "unexpected argument '9090'"),
        (["--port"], "flag --port needs a value: a port from 0 to 65535"),
        (["--port", "--ssl", "true"], "flag --port needs a value: a port from 0 to 65535"),
        (["--port", "__name:=x"], "flag --port needs a value: a port from 0 to 65535"),
    ],
)
def test_a_command_line_that_makes_no_sense(arguments: List[str], message: str) -> None:
    with pytest.raises(SettingsError) as error:
        read_flags(Settings, arguments)
    assert str(error.value) == message


def test_a_negative_value_is_a_wrong_value_and_not_a_flag() -> None:
    with pytest.raises(SettingsError, match="--fragment_timeout is '-5', but must be a number of seconds"):
        read_flags(Settings, ["--fragment_timeout", "-5"])


def test_help_tells_every_name_with_its_default() -> None:
    text = help_text(Settings, "rosbridge_websocket")
    for field in dataclasses.fields(Settings):
        assert f"--{field.name}  (" in text
        assert f"default {field.default}" in text
