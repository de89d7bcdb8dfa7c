# SPDX-License-Identifier: BSD-3-Clause
"""Message and service classes by type name."""

from __future__ import annotations

import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any, Callable

import genpy
import pytest
from geometry_msgs.msg import Twist
from std_msgs.msg import String
from std_srvs.srv import SetBool, SetBoolRequest, SetBoolResponse

from rosbridge_library.codec import get_message_type, get_service_type
from rosbridge_library.internal.exceptions import RosbridgeError
from rosbridge_library.internal.ros_loader import (
    InvalidClassException,
    InvalidModuleException,
    InvalidPackageException,
    InvalidTypeStringException,
    get_message_class,
    get_message_instance,
    get_service_class,
    get_service_instance,
    get_service_request_instance,
    get_service_response_instance,
)


@pytest.mark.parametrize("name", ["geometry_msgs/Twist", "geometry_msgs/msg/Twist", "/geometry_msgs/Twist"])
def test_messages_are_found(name: str) -> None:
    assert get_message_class(name) is Twist
    assert type(get_message_instance(name)) is Twist
    assert get_message_type(name) is get_message_type("geometry_msgs/Twist")


@pytest.mark.parametrize("name", ["std_srvs/SetBool", "std_srvs/srv/SetBool"])
def test_services_are_found(name: str) -> None:
    assert get_service_class(name) is SetBool
    assert type(get_service_instance(name)) is SetBool
    assert type(get_service_request_instance(name)) is SetBoolRequest
    assert type(get_service_response_instance(name)) is SetBoolResponse
    assert get_service_type(name) is get_service_type("std_srvs/SetBool")
    assert get_service_type(name).md5sum == SetBool._md5sum


def test_instances_are_new() -> None:
    first, second = get_message_instance("std_msgs/String"), get_message_instance("std_msgs/String")
    assert type(first) is String
    assert first is not second


def test_time_and_duration_have_instances() -> None:
    assert get_message_instance("time") == genpy.Time()
    assert get_message_instance("duration") == genpy.Duration()


BOTH = [get_message_class, get_service_class, get_message_type, get_service_type]


@pytest.mark.parametrize("load", BOTH)
@pytest.mark.parametrize(
    "name", ["", "/", "Twist", "a/b/c", "geometry_msgs/", "//x", "os path/x", "a/b/c/d", "a.b/C", 7, None]
)
def test_what_is_no_type_name(load: Callable[[Any], Any], name: Any) -> None:
    with pytest.raises(InvalidTypeStringException):
        load(name)


@pytest.mark.parametrize("load", BOTH)
def test_a_package_that_is_not_there(load: Callable[[str], Any]) -> None:
    with pytest.raises(InvalidPackageException, match="no_such_package"):
        load("no_such_package/Type")


@pytest.mark.parametrize("load", BOTH)
def test_a_package_without_messages(load: Callable[[str], Any]) -> None:
    for package in ("antigravity", "__main__", "sys", "wave"):
        with pytest.raises((InvalidModuleException, InvalidPackageException), match=package):
            load(f"{package}/Type")
    # Clients choose these names: no package's code is run for them but that of messages.
    assert not {"antigravity", "wave"} & set(sys.modules)


def test_a_type_that_is_not_in_its_package() -> None:
    with pytest.raises(InvalidClassException, match="NoSuchType"):
        get_message_class("std_msgs/NoSuchType")
    with pytest.raises(InvalidClassException, match="NoSuchService"):
        get_service_class("std_srvs/NoSuchService")
    # A service's request is no message of srv, and a module attribute that is no message is none either.
    with pytest.raises(InvalidClassException):
        get_service_class("std_srvs/SetBoolRequest")
    with pytest.raises(InvalidClassException):
        get_message_class("std_msgs/__name__")


def test_every_failure_is_one_that_a_client_can_be_told() -> None:
    for error in (InvalidTypeStringException, InvalidPackageException, InvalidModuleException, InvalidClassException):
        assert issubclass(error, RosbridgeError)


def test_a_package_that_comes_later_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(InvalidPackageException):
        get_message_class("late_msgs/Late")
    (tmp_path / "late_msgs" / "msg").mkdir(parents=True)
    (tmp_path / "late_msgs" / "__init__.py").write_text("")
    (tmp_path / "late_msgs" / "msg" / "__init__.py").write_text("from std_msgs.msg import Int8 as Late\n")
    try:
        assert get_message_class("late_msgs/Late")._type == "std_msgs/Int8"
    finally:
        for name in ("late_msgs", "late_msgs.msg"):
            sys.modules.pop(name, None)


def test_a_package_that_fails_to_import_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken_msgs" / "msg").mkdir(parents=True)
    (tmp_path / "broken_msgs" / "__init__.py").write_text("")
    (tmp_path / "broken_msgs" / "msg" / "__init__.py").write_text("raise RuntimeError('out of order')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(InvalidModuleException, match="out of order"):
        get_message_class("broken_msgs/Thing")
    sys.modules.pop("broken_msgs", None)


def test_a_module_that_another_thread_is_importing_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Calls that come at once on a bridge that has just started."""
    gate: Any = ModuleType("loader_gate")
    gate.inside, gate.open = threading.Event(), threading.Event()
    monkeypatch.setitem(sys.modules, "loader_gate", gate)
    package = tmp_path / "slow_import_msgs" / "msg"
    package.mkdir(parents=True)
    (package.parent / "__init__.py").touch()
    (package / "__init__.py").write_text(
        "import loader_gate\n"
        "loader_gate.inside.set()\n"
        "assert loader_gate.open.wait(10)\n"
        "from std_msgs.msg import String\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with ThreadPoolExecutor(2) as threads:
        first = threads.submit(get_message_class, "slow_import_msgs/String")
        assert gate.inside.wait(10)
        second = threads.submit(get_message_class, "slow_import_msgs/String")
        opening = threading.Timer(0.1, gate.open.set)  # by then the second one has met the half-imported module
        opening.start()
        assert second.result(10) is String
        assert first.result(10) is String
