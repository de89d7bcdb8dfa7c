# SPDX-License-Identifier: BSD-3-Clause
"""Which files clients may fetch: packages with and without a manifest, links, dots, sizes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from rosbridge_library.foxglove.assets import AssetError, Assets
from rosbridge_library.foxglove.options import DEFAULT_ASSET_URIS, Options, matches

MAX_BYTES = 1000


@pytest.fixture
def share(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A share folder with two packages; only one has a manifest."""
    folder = tmp_path / "prefix" / "share"
    for name in ("robot", "bare_robot"):
        (folder / name / "meshes").mkdir(parents=True)
        (folder / name / "meshes" / "arm.dae").write_bytes(name.encode())
    manifest = "<package format='2'><name>robot</name><version>1.0.0</version><description>it</description>"
    (folder / "robot" / "package.xml").write_text(
        f"{manifest}<maintainer email='a@b.invalid'>me</maintainer><license>BSD</license></package>"
    )
    (tmp_path / "secret.dae").write_text("secret")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(folder))
    monkeypatch.setenv("CMAKE_PREFIX_PATH", str(tmp_path / "prefix"))
    return folder


def assets(**options: Any) -> Assets:
    return Assets(Options(max_client_bytes=MAX_BYTES, **options))


@pytest.mark.parametrize(
    ("uri", "allowed"),
    [
        ("package://robot/meshes/arm.dae", True),
        ("package://robot/a.b/../arm.dae", False),
        ("package://robot/arm.stl", True),
        ("package://robot/my-robot_1/arm%20two.jpeg", True),
        ("package://robot/robot.urdf", True),
        ("package://robot/robot.xacro", True),
        ("package://robot/launch/robot.launch", False),
        ("package://robot/config.yaml", False),
        ("package://robot/meshes/arm.dae\n", False),
        ("package://robot/.dae/key", False),
        ("file:///etc/arm.dae", False),
        ("http://somewhere/arm.dae", False),
        ("xpackage://robot/arm.dae", False),
    ],
)
def test_what_is_allowed_by_default(uri: str, allowed: bool) -> None:
    assert matches(DEFAULT_ASSET_URIS, uri) is allowed


@pytest.mark.parametrize("name", ["robot", "bare_robot"])
def test_files_of_packages_with_and_without_a_manifest(share: Path, name: str) -> None:
    assert assets().read(f"package://{name}/meshes/arm.dae") == name.encode()


def test_a_package_that_is_installed_later_is_found(share: Path) -> None:
    found = assets()
    with pytest.raises(AssetError, match="no package late_robot"):
        found.read("package://late_robot/arm.dae")
    (share / "late_robot").mkdir()
    (share / "late_robot" / "arm.dae").write_text("late")
    assert found.read("package://late_robot/arm.dae") == b"late"


@pytest.mark.parametrize(
    ("uri", "reason"),
    [
        ("package://robot/meshes/../../../../secret.dae", "does not let clients fetch"),
        ("package://robot/%2e%2e/%2E%2E/../secret.dae", "does not let clients fetch"),
        ("package://robot/%2e%2e/%2e%2e/%2e%2e/secret.dae", "'..'"),
        ("package://robot/meshes/%2e%2e%2farm.dae", "'..'"),
        ("package://robot/meshes/leg.dae", "No such file"),
        ("package://no_robot/meshes/arm.dae", "no package no_robot"),
        ("package://%2Ftmp/arm.dae", "no package"),
        ("package://robot/meshes", "does not let clients fetch"),
        ("file:///etc/passwd", "does not let clients fetch"),
        ("", "does not let clients fetch"),
    ],
)
def test_what_is_refused(share: Path, uri: str, reason: str) -> None:
    with pytest.raises(AssetError, match=reason):
        assets().read(uri)


@pytest.mark.parametrize(
    "uri",
    [
        "package://robot/../bare_robot/meshes/arm.dae",
        "package://robot/..",
        "package://../robot/meshes/arm.dae",
        "package://robot/meshes/%2e%2e/../..//meshes/arm.dae",
        "file:///etc/../etc/hostname",
    ],
)
def test_dots_are_refused_whatever_is_allowed(share: Path, uri: str) -> None:
    with pytest.raises(AssetError, match=r"'\.\.'"):
        assets(asset_uri_allowlist=(".*",)).read(uri)


def test_links_out_of_the_package_are_refused(share: Path, tmp_path: Path) -> None:
    robot = share / "robot"
    (robot / "out.dae").symlink_to(tmp_path / "secret.dae")
    (robot / "folder").symlink_to(tmp_path)
    (robot / "circle.dae").symlink_to(robot / "circle.dae")
    (robot / "other.dae").symlink_to(share / "bare_robot" / "meshes" / "arm.dae")
    (robot / "within.dae").symlink_to(robot / "meshes" / "arm.dae")
    for name, reason in (
        ("out.dae", "a link out of the package robot"),
        ("folder/secret.dae", "a link out of the package robot"),
        ("other.dae", "a link out of the package robot"),
        ("circle.dae", "circle.dae"),
    ):
        with pytest.raises(AssetError, match=reason):
            assets().read(f"package://robot/{name}")
    assert assets().read("package://robot/within.dae") == b"robot"


def test_a_package_may_be_a_link_itself(share: Path, tmp_path: Path) -> None:
    (tmp_path / "source").mkdir()
    (tmp_path / "source" / "arm.dae").write_text("source")
    (share / "linked").symlink_to(tmp_path / "source")
    assert assets().read("package://linked/arm.dae") == b"source"


def test_only_files_of_a_bounded_size_are_read(share: Path) -> None:
    robot = share / "robot"
    (robot / "full.dae").write_bytes(b"x" * MAX_BYTES)
    (robot / "over.dae").write_bytes(b"x" * (MAX_BYTES + 1))
    (robot / "folder.dae").mkdir()
    os.mkfifo(robot / "pipe.dae")
    assert len(assets().read("package://robot/full.dae")) == MAX_BYTES
    for name, reason in (
        ("over", "1001 bytes are more than 1000"),
        ("folder", "Is a directory"),
        ("pipe", "not a file"),
    ):
        with pytest.raises(AssetError, match=reason):
            assets().read(f"package://robot/{name}.dae")


def test_local_files_where_allowed(tmp_path: Path) -> None:
    open_folder, shut_folder = tmp_path / "open", tmp_path / "shut"
    for folder in (open_folder, shut_folder):
        folder.mkdir()
        (folder / "map.png").write_text(folder.name)
    (open_folder / "link.png").symlink_to(shut_folder / "map.png")
    (open_folder / "good.png").symlink_to(open_folder / "map.png")
    found = assets(asset_uri_allowlist=(f"file://{open_folder}/.*", "file://relative.*"))
    assert found.read(f"file://{open_folder}/map.png") == b"open"
    assert found.read(f"file://{open_folder}/good.png") == b"open"
    for uri, reason in (
        (f"file://{shut_folder}/map.png", "does not let clients fetch"),
        (f"file://{open_folder}/link.png", "a link to what the server does not let clients fetch"),
        (f"file://{open_folder}/%00.png", "'..'"),
        ("file://relative/map.png", "needs an absolute path"),
    ):
        with pytest.raises(AssetError, match=reason):
            found.read(uri)


def test_other_schemes_are_refused() -> None:
    with pytest.raises(AssetError, match="only package:// and file://"):
        assets(asset_uri_allowlist=(".*",)).read("http://localhost/arm.dae")
