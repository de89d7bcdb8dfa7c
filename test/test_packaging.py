# SPDX-License-Identifier: BSD-3-Clause
"""The ways to build and install: plain CMake into a prefix, and catkin_make with this checkout in a workspace.

After sourcing what each of them makes, ROS's tools find the packages, their messages and executables, and these run
under the Python that the build was configured with. (The devel space of plain CMake is what all other suites run in.)
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Dict, List

import pytest
import yaml

from rosbridge_server.settings import Settings, load
from support.process import Process
from support.ros import ROOT, RosMaster
from support.wait import wait_until

PACKAGES = ["rosapi", "rosbridge_library", "rosbridge_msgs", "rosbridge_server"]


def _clean_environment() -> Dict[str, str]:
    """What a user has who sourced nothing of ours, so that no built package is found by accident."""
    kept = ("HOME", "PATH", "LANG", "TMPDIR")
    return {name: os.environ[name] for name in kept if name in os.environ}


def _run(command: List[str], directory: Path) -> str:
    done = subprocess.run(
        command,
        cwd=directory,
        env=_clean_environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        timeout=300,
    )
    assert done.returncode == 0, f"{command}:\n{done.stdout}"
    return done.stdout


def _sourced(setup: Path, command: str) -> List[str]:
    return ["bash", "-c", f'source "$0" && {command}', str(setup)]


@pytest.fixture(scope="module")
def prefix(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A prefix that is named only when installing, relative to the working directory."""
    directory = tmp_path_factory.mktemp("cmake")
    _run(["cmake", "-S", str(ROOT), "-B", "build", f"-DPYTHON_EXECUTABLE={sys.executable}"], directory)
    _run(["cmake", "--build", "build", "--parallel", "2"], directory)
    _run(["cmake", "--install", "build", "--prefix", "installed"], directory)
    return directory / "installed"


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("workspace")
    (directory / "src").mkdir()
    (directory / "src" / "rosbridge").symlink_to(ROOT)
    _run(["catkin_make", "install", "-j2", f"-DPYTHON_EXECUTABLE={sys.executable}"], directory)
    return directory


@pytest.fixture(scope="module", params=["prefix", "workspace devel", "workspace install"])
def setup(request: pytest.FixtureRequest) -> Path:
    """The setup.bash of each space."""
    name, _, space = request.param.partition(" ")
    return Path(request.getfixturevalue(name)) / space / "setup.bash"


def test_packages_and_messages_are_found(setup: Path):
    found = _run(_sourced(setup, f"for package in {' '.join(PACKAGES)}; do rospack find $package; done"), setup.parent)
    assert [Path(line).name for line in found.split()] == PACKAGES
    assert Path(_run(_sourced(setup, "rosstack find rosbridge_suite"), setup.parent).strip()).is_dir()
    shown = _run(_sourced(setup, "rosmsg show rosbridge_msgs/ConnectedClients"), setup.parent)
    assert shown.split("\n")[:2] == ["rosbridge_msgs/ConnectedClient[] clients", "  string ip_address"]


def test_the_python_packages_hold_code_and_messages(setup: Path):
    source = (
        "import rosapi.graph, rosapi.msg, rosapi.srv, rosbridge_library.codec, rosbridge_library.internal.ros_loader, "
        "rosbridge_library.capabilities.advertise, rosbridge_library.ros.node, rosbridge_library.msg, "
        "rosbridge_library.srv, rosbridge_server.websocket, rosbridge_msgs.msg as m; print(m.__file__)"
    )
    printed = _run(_sourced(setup, f"{sys.executable} -c '{source}'"), setup.parent)
    assert setup.parent in Path(printed.strip()).parents


def test_the_launch_file_starts_both_nodes(setup: Path):
    nodes = _run(_sourced(setup, "roslaunch --nodes rosbridge_server rosbridge_websocket.launch"), setup.parent)
    assert nodes.split() == ["/rosbridge_websocket", "/rosapi"]


def test_the_launch_file_of_foxglove_bridge_starts_the_same_server_on_its_port(setup: Path):
    launch = "rosbridge_server foxglove_bridge.launch"
    assert _run(_sourced(setup, f"roslaunch --nodes {launch}"), setup.parent).split() == ["/foxglove_bridge"]
    parameters = yaml.safe_load(_run(_sourced(setup, f"roslaunch --dump-params {launch}"), setup.parent))
    given = {name[len("/foxglove_bridge/") :]: value for name, value in parameters.items() if "foxglove" in name}
    assert set(given) > {"topic_whitelist", "asset_uri_allowlist", "max_update_ms", "send_buffer_limit"}
    assert load(Settings, given, {}) == Settings(port=8765)


@pytest.mark.parametrize(
    ("package", "name", "line"),
    [
        ("rosbridge_server", "rosbridge_websocket", "server started"),
        ("rosbridge_server", "rosbridge_websocket.py", "server started"),
        ("rosapi", "rosapi_node", "serving"),
    ],
)
def test_executables_run_under_the_python_of_the_build(
    setup: Path, ros_master: RosMaster, tmp_path: Path, package: str, name: str, line: str
):
    found = _run(_sourced(setup, f"catkin_find --first-only --without-underlays --libexec {package}"), setup.parent)
    assert (Path(found.strip()) / name).read_text().startswith(f"#!{sys.executable}\n")
    arguments = "--port 0" if package == "rosbridge_server" else ""
    environment = {**_clean_environment(), "ROS_IP": "127.0.0.1", "ROS_LOG_DIR": str(tmp_path)}
    command = _sourced(setup, f"export ROS_MASTER_URI={ros_master.uri} && exec rosrun {package} {name} {arguments}")
    with Process(command, name=name, directory=tmp_path, environment=environment) as process:
        process.wait_for_line(line, 30.0)
    wait_until(lambda: not ros_master.call("getSystemState")[0], 5.0, "the node to be gone")
